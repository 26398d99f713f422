"""Material parameters on the mesh: numbers where the body is uniform, DG0 fields where regions differ."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..forms.energies import ENERGIES, Energy, lame, plane_stress_lambda
from ..mesh.domain import Domain
from ..mesh.names import check_regions
from ..study import Material, Region

PerCell = npt.NDArray[np.float64] | float


@dataclass(frozen=True)
class MaterialFields:
    """The energy with its coefficients, and density (kg/m^3) and moduli (Pa) per cell or as one number."""

    energy: Energy
    density: PerCell
    young: PerCell
    mu: PerCell
    lmbda: PerCell
    plastic: Any = None  # mechanics.plasticity.Plasticity of a body that flows


def material_fields(domain: Domain, material: Material) -> MaterialFields:
    """Coefficients of [material] with its regions. InputError where a region does not exist in the mesh."""
    check_regions(material.regions, domain.region_names)
    young, poisson, density = (per_cell(domain, material, key) for key in ("young", "poisson", "density"))
    mu, lmbda = lame(young, poisson)  # type: ignore[arg-type]
    options = {}
    if domain.dim == 2 and material.plane == "stress":
        lmbda = plane_stress_lambda(mu, lmbda)
        options = {"reduced": True}
    energy = ENERGIES[material.energy](coefficient(domain, mu), coefficient(domain, lmbda), **options)
    return MaterialFields(energy, density, young, mu, lmbda)


def per_cell(domain: Domain, source: Any, key: str, regions: dict[str, Region] | None = None) -> PerCell:
    """`key` of a table as one number, or as (cells,) where a region of the material overrides it."""
    base = float(getattr(source, key))
    overrides = source.regions if regions is None else regions
    special = {name: getattr(region, key) for name, region in overrides.items() if getattr(region, key) is not None}
    if not special:
        return base
    values = np.full(domain.cell_count, base)
    for name, value in special.items():
        values[domain.region == domain.region_names.index(name)] = value
    return values


def coefficient(domain: Domain, value: PerCell) -> Any:
    """A parameter as a UFL coefficient: a constant, or a field that is constant in each cell."""
    if np.ndim(value) == 0:
        return fem.Constant(domain.mesh, np.float64(value))
    field = fem.Function(domain.cell_scalar)
    field.x.array[: domain.cell_count] = value
    return field
