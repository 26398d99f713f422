"""Material parameters on the mesh: numbers for a uniform body, DG0 fields where regions differ."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..forms.energies import ENERGIES, Energy, lame, plane_stress_lambda
from ..mesh.domain import Domain

PerCell = npt.NDArray[np.float64] | float  # a number, or (cells,)


@dataclass(frozen=True)
class MaterialFields:
    """Undamaged material on a mesh.

    Attributes:
        energy: stored energy with its coefficients.
        density: kg/m^3.
        young: Young's modulus, Pa.
        mu, lmbda: Lame's parameters, Pa.
        plastic: history of plastic flow (mechanics.plasticity), None for an elastic body.
    """

    energy: Energy
    density: PerCell
    young: PerCell
    mu: PerCell
    lmbda: PerCell
    plastic: Any = None


def material_fields(
    domain: Domain,
    energy: str | Callable[[Any, Any], Energy],
    *,
    young: PerCell,
    poisson: PerCell,
    density: PerCell,
    plane_stress: bool = False,
) -> MaterialFields:
    """Elastic material on a mesh.

    Args:
        domain: the mesh.
        energy: name of the stored energy (forms.energies.ENERGIES), or a function of mu and lambda that returns one.
        young: Young's modulus, Pa.
        poisson: Poisson's ratio.
        density: kg/m^3.
        plane_stress: plane stress instead of plane strain, for a 2D mesh.
    """
    mu, lmbda = lame(young, poisson)  # type: ignore[arg-type]
    options = {}
    if domain.dim == 2 and plane_stress:
        lmbda = plane_stress_lambda(mu, lmbda)
        options = {"plane_stress": True}
    make = ENERGIES[energy] if isinstance(energy, str) else energy
    psi = make(coefficient(domain, mu), coefficient(domain, lmbda), **options)
    return MaterialFields(psi, density, young, mu, lmbda)


def parameter_by_region(domain: Domain, base: float, region_values: Mapping[str, float]) -> PerCell:
    """Parameter as one number, or as (cells,) if regions, by name, have values of their own."""
    if not region_values:
        return base
    values = np.full(domain.cell_count, base)
    for name, value in region_values.items():
        values[domain.cell_region == domain.region_names.index(name)] = value
    return values


def coefficient(domain: Domain, value: PerCell) -> Any:
    """Parameter as a UFL coefficient: a constant, or a field that is constant in each cell."""
    if np.ndim(value) == 0:
        return fem.Constant(domain.mesh, np.float64(value))
    field = fem.Function(domain.scalar_cell_space)
    field.x.array[: domain.cell_count] = value
    return field
