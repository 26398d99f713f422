"""How much each load of a study comes to: the area that it acts on and its resultant. No DOLFINx here."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..mechanics.time_functions import TabulatedFunction
from ..mesh.selectors import Group, Selector
from ..meshes.data import MeshData
from ..meshes.topology import boundary_facets, facets_where, signed_measures
from . import Study
from .conditions import BoundaryCondition, boundary_conditions, volume_loads

Values = npt.NDArray[np.float64]

MAX_CHECK_CELLS = 60_000  # of a builder's mesh that is built to be measured: a few seconds


def facet_loads(study: Study, dim: int) -> list[BoundaryCondition]:
    """Conditions that are loads on facets."""
    return [each for each in boundary_conditions(study, dim) if not each.prescribes_motion]


def resultant_lines(study: Study, dim: int, mesh: MeshData | None) -> Iterator[str]:
    """A line for each load, where one acts on facets. InputError where one selects none; `mesh`: None where it has too
    many cells to be built for that."""
    loads = facet_loads(study, dim)
    if not loads:
        return
    if mesh is None:
        yield (
            f"areas and resultants are not worked out of meshes of more than {MAX_CHECK_CELLS:,} cells; coarsen mesh.h"
        )
        return
    thick = study.thickness if dim == 2 else 1.0
    for load in loads:
        each, total = facet_area_vectors(mesh, load)
        yield f"{load.key}.{load.kind} on {load.place}: {_on_facets(load, each, total, thick, dim)}"
    for name, function in volume_loads(study, dim).items():
        assert isinstance(function, TabulatedFunction)
        rows = _weight(study, mesh, name) * thick * function.rows
        yield f"load.{name}: {_said(rows, function.times, 'N' if dim == 3 or thick != 1 else 'N/m')} on the body"


def facet_area_vectors(mesh: MeshData, load: BoundaryCondition) -> tuple[Values, float]:
    """Sum of the outward area vectors of the facets of a load, (d,), and of their areas, m^2 (2D: m). InputError where
    it selects none."""
    facets = _facets(mesh, load.place)
    if not len(facets):
        raise InputError(f"{load.key}.on: {load.place} selects no boundary facet")
    vectors = _area_vectors(mesh, facets)
    return vectors.sum(axis=0), float(np.linalg.norm(vectors, axis=1).sum())


def _facets(mesh: MeshData, place: Selector) -> npt.NDArray[np.int64]:
    if isinstance(place, Group):
        return mesh.facet_groups[place.name]
    size = float(np.linalg.norm(np.ptp(mesh.points, axis=0)))
    return facets_where(boundary_facets(mesh.cells), place.selects(mesh.points, size))


def _area_vectors(mesh: MeshData, facets: npt.NDArray[np.int64]) -> Values:
    """(n, d) area times outward normal: by the corner of the cell behind that the facet does not have."""
    key = np.sort(facets, axis=1)
    d, count = mesh.dim, len(mesh.points)
    corners = np.arange(d + 1)
    sides = np.concatenate([mesh.cells[:, corners != k] for k in corners])
    opposite = np.concatenate([mesh.cells[:, k] for k in corners])
    weights = float(count) ** np.arange(d)
    wanted, every = key @ weights, np.sort(sides, axis=1) @ weights
    order = np.argsort(every)
    behind = opposite[order[np.searchsorted(every[order], wanted)]]
    x = mesh.points[facets]
    a = x[:, 1] - x[:, 0]
    vectors = np.column_stack([a[:, 1], -a[:, 0]]) if d == 2 else np.cross(a, x[:, 2] - x[:, 0]) / 2
    inward = np.einsum("ni,ni->n", vectors, mesh.points[behind] - x[:, 0]) > 0
    return np.where(inward[:, None], -vectors, vectors)


def _on_facets(load: BoundaryCondition, vector: Values, area: float, thick: float, dim: int) -> str:
    function = load.function
    assert isinstance(function, TabulatedFunction)
    rows = function.rows * thick
    if load.kind == "traction":
        rows = rows * area
    elif load.kind == "pressure":
        rows = -rows * vector
    unit = "m^2" if dim == 3 or thick != 1 else "m"
    return f"{area * thick:.4g} {unit}, {_said(rows, function.times, 'N' if unit == 'm^2' else 'N/m')}"


def _said(rows: Values, times: Values, unit: str) -> str:
    """The largest of forces (n, d) at times (n,)."""
    most = int(np.argmax(np.linalg.norm(rows, axis=1)))
    when = f" at t = {times[most]:g} s" if len(times) > 1 else ""
    return f"({', '.join(f'{value + 0.0:.4g}' for value in rows[most])}) {unit}{when}"


def _weight(study: Study, mesh: MeshData, name: str) -> float:
    """Volume of the body for a body force, its mass for gravity."""
    volumes = signed_measures(mesh.points, mesh.cells)
    if name == "body_force":
        return float(volumes.sum())
    density = np.full(len(mesh.cells), study.material.density)
    for region, table in study.material.regions.items():
        if table.density is not None:
            density[mesh.regions[region]] = table.density
    return float(density @ volumes)
