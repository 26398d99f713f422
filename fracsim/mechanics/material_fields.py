"""Material parameters on the mesh: numbers where the body is uniform, DG0 fields where regions differ."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx import fem

from ..forms.energies import ENERGIES, Energy, lame, plane_stress_lambda
from ..mesh.domain import Domain

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


def material_fields(
    domain: Domain, energy: str, *, young: PerCell, poisson: PerCell, density: PerCell, plane_stress: bool = False
) -> MaterialFields:
    """A material by the name of its energy (forms.energies.ENERGIES), Young's modulus in Pa, Poisson's ratio and
    density in kg/m^3, each a number or (cells,). `plane_stress`: of a 2D mesh, in place of plane strain."""
    mu, lmbda = lame(young, poisson)  # type: ignore[arg-type]
    options = {}
    if domain.dim == 2 and plane_stress:
        lmbda = plane_stress_lambda(mu, lmbda)
        options = {"reduced": True}
    psi = ENERGIES[energy](coefficient(domain, mu), coefficient(domain, lmbda), **options)
    return MaterialFields(psi, density, young, mu, lmbda)


def parameter_by_region(domain: Domain, base: float, region_values: Mapping[str, float]) -> PerCell:
    """A parameter as one number, or as (cells,) where regions, by name, have another value."""
    if not region_values:
        return base
    values = np.full(domain.cell_count, base)
    for name, value in region_values.items():
        values[domain.region == domain.region_names.index(name)] = value
    return values


def coefficient(domain: Domain, value: PerCell) -> Any:
    """A parameter as a UFL coefficient: a constant, or a field that is constant in each cell."""
    if np.ndim(value) == 0:
        return fem.Constant(domain.mesh, np.float64(value))
    field = fem.Function(domain.cell_scalar)
    field.x.array[: domain.cell_count] = value
    return field
