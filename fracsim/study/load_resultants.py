"""Area and resultant of each load of a study, for `fracsim check`. No DOLFINx here."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..mechanics.time_functions import TabulatedFunction
from ..mesh.selectors import Group, Selector
from ..meshes.data import MeshData
from ..meshes.topology import boundary_facets, facets_on_nodes, signed_measures
from . import Study
from .check_limits import LIMITS
from .conditions import BoundaryCondition, boundary_conditions, volume_loads

Values = npt.NDArray[np.float64]


def facet_loads(study: Study, dim: int) -> list[BoundaryCondition]:
    """Returns the boundary conditions that are loads on facets."""
    return [condition for condition in boundary_conditions(study, dim) if not condition.prescribes_motion]


def resultant_lines(study: Study, dim: int, mesh: MeshData | None) -> Iterator[str]:
    """Yield a line for each load, if any acts on facets.

    Args:
        study: with any table.
        dim: dimension of the mesh.
        mesh: None if it has too many cells to be built for this.

    Raises:
        InputError: if a load selects no facet.
    """
    loads = facet_loads(study, dim)
    if not loads:
        return
    if mesh is None:
        yield (
            f"areas and resultants are not computed for meshes of more than {LIMITS.max_built_cells:,} cells; "
            "coarsen mesh.h"
        )
        return
    thickness = study.thickness if dim == 2 else 1.0
    for load in loads:
        vector, area = facet_area_vectors(mesh, load)
        yield f"{load.key}.{load.kind} on {load.selector}: {_facet_resultant(load, vector, area, thickness, dim)}"
    for name, function in volume_loads(study, dim).items():
        assert isinstance(function, TabulatedFunction)
        rows = _volume_factor(study, mesh, name) * thickness * function.rows
        unit = "N" if dim == 3 or thickness != 1 else "N/m"
        yield f"load.{name}: {_format_maximum(rows, function.times, unit)} on the body"


def facet_area_vectors(mesh: MeshData, load: BoundaryCondition) -> tuple[Values, float]:
    """Returns the sum of the outward area vectors of the facets of a load, (d,), and of their areas, m^2 (2D: m).

    Raises:
        InputError: if the load selects no facet.
    """
    facets = _facets(mesh, load.selector)
    if not len(facets):
        raise InputError(f"{load.key}.on: {load.selector} selects no boundary facet")
    vectors = _area_vectors(mesh, facets)
    return vectors.sum(axis=0), float(np.linalg.norm(vectors, axis=1).sum())


def _facets(mesh: MeshData, place: Selector) -> npt.NDArray[np.int64]:
    if isinstance(place, Group):
        return mesh.facet_groups[place.name]
    size = float(np.linalg.norm(np.ptp(mesh.points, axis=0)))
    return facets_on_nodes(boundary_facets(mesh.cells), place.selects(mesh.points, size))


def _area_vectors(mesh: MeshData, facets: npt.NDArray[np.int64]) -> Values:
    """Returns area times outward normal of boundary facets, (n, d)."""
    d, count = mesh.dim, len(mesh.points)
    corners = np.arange(d + 1)
    # a facet points away from the corner of its cell that is not its own
    sides = np.concatenate([mesh.cells[:, corners != k] for k in corners])
    opposite = np.concatenate([mesh.cells[:, k] for k in corners])
    # sorted corners as one number, so that facets are found among the sides of cells by bisection
    weights = float(count) ** np.arange(d)
    facet_keys, side_keys = np.sort(facets, axis=1) @ weights, np.sort(sides, axis=1) @ weights
    order = np.argsort(side_keys)
    behind = opposite[order[np.searchsorted(side_keys[order], facet_keys)]]
    x = mesh.points[facets]
    a = x[:, 1] - x[:, 0]
    vectors = np.column_stack([a[:, 1], -a[:, 0]]) if d == 2 else np.cross(a, x[:, 2] - x[:, 0]) / 2
    inward = np.einsum("ni,ni->n", vectors, mesh.points[behind] - x[:, 0]) > 0
    return np.where(inward[:, None], -vectors, vectors)


def _facet_resultant(load: BoundaryCondition, vector: Values, area: float, thickness: float, dim: int) -> str:
    """Area and largest resultant of a load in words; area vector (d,) and area in m^2, in 2D m."""
    function = load.function
    assert isinstance(function, TabulatedFunction)
    rows = function.rows * thickness
    if load.kind == "traction":
        rows = rows * area
    elif load.kind == "pressure":
        rows = -rows * vector
    unit = "m^2" if dim == 3 or thickness != 1 else "m"
    return f"{area * thickness:.4g} {unit}, {_format_maximum(rows, function.times, 'N' if unit == 'm^2' else 'N/m')}"


def _format_maximum(rows: Values, times: Values, unit: str) -> str:
    """The largest of forces (n, d) at times (n,), in words."""
    largest = int(np.argmax(np.linalg.norm(rows, axis=1)))
    time = f" at t = {times[largest]:g} s" if len(times) > 1 else ""
    return f"({', '.join(f'{value + 0.0:.4g}' for value in rows[largest])}) {unit}{time}"


def _volume_factor(study: Study, mesh: MeshData, name: str) -> float:
    """Volume of the body (m^3) for a body force, its mass (kg) for gravity; in 2D per metre of thickness."""
    volumes = signed_measures(mesh.points, mesh.cells)
    if name == "body_force":
        return float(volumes.sum())
    density = np.full(len(mesh.cells), study.material.density)
    for region, table in study.material.regions.items():
        if table.density is not None:
            density[mesh.regions[region]] = table.density
    return float(density @ volumes)
