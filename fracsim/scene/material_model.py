"""The material of a study on its mesh."""

from __future__ import annotations

from typing import Any

from ..mechanics.material_fields import MaterialFields, PerCell, material_fields, parameter_by_region
from ..mesh.domain import Domain
from ..mesh.selectors import check_regions
from ..study import Study


def build_material(study: Study, domain: Domain) -> MaterialFields:
    """The energy with its moduli and what flow needs. InputError where a region does not exist in the mesh."""
    table = study.material
    check_regions(table.regions, domain.region_names)
    young, poisson, density = (per_cell(study, domain, table, key) for key in ("young", "poisson", "density"))
    plane_stress = table.plane == "stress"
    material = material_fields(
        domain, table.energy, young=young, poisson=poisson, density=density, plane_stress=plane_stress
    )
    return material if study.plasticity is None else _flowing(study, domain, material)


def _flowing(study: Study, domain: Domain, material: MaterialFields) -> MaterialFields:
    from ..mechanics.plasticity import YieldLaw, plastic_material

    table = study.plasticity
    assert table is not None
    law = YieldLaw(
        per_cell(study, domain, table, "yield_stress"),
        frobenius=table.measure == "frobenius",
        flow_rate=table.flow_rate,
        hardening=table.hardening,
        update=table.update,
    )
    return plastic_material(domain, law, material, implicit=study.time.scheme_class.implicit)


def per_cell(study: Study, domain: Domain, table: Any, key: str, special_key: str | None = None) -> PerCell:
    """`key` of a table as one number, or as (cells,) where a region of the material overrides it.

    `special_key`: the region's key, where it is another.
    """
    special_key, regions = special_key or key, study.material.regions.items()
    special = {
        name: getattr(region, special_key) for name, region in regions if getattr(region, special_key) is not None
    }
    return parameter_by_region(domain, float(getattr(table, key)), special)
