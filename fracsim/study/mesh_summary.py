"""Size, extent, groups and regions of a mesh, before it is built if its source tells them."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..meshes.check import label_bodies
from ..meshes.data import MeshData, MeshError, format_point
from ..meshes.topology import boundary_facets, edges_of, signed_measures
from . import Study
from .check_limits import LIMITS
from .mesh_source import estimate_filled_cells, find_builder

if TYPE_CHECKING:
    from ..meshes.surfaces.closed import ClosedSurface

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class MeshSummary:
    """Properties of a mesh that may not be built yet.

    Attributes:
        dim: dimension d.
        groups, regions: names.
        lower, upper: corners (d,) of the bounding box, m.
        cell_count: number of cells, estimated if there is no mesh.
        size_text: number of cells in words.
        h: size of a builder's finest cells, m; the mean edge of a mesh that was read, or of a builder without a size.
        surface_text: returns the number of facets in words; they are counted when it is called.
        volume: m^d, if it is known.
        notes: on repairs in reading.
        mesh: if it was read or built.
    """

    dim: int
    groups: tuple[str, ...]
    regions: tuple[str, ...]
    lower: tuple[float, ...]
    upper: tuple[float, ...]
    cell_count: int
    size_text: str
    h: float
    surface_text: Callable[[], str]
    volume: float | None = None
    notes: tuple[str, ...] = ()
    mesh: MeshData | None = None

    @property
    def min_side(self) -> float:
        """Least side length of the bounding box, m."""
        return float(np.min(np.subtract(self.upper, self.lower)))

    @property
    def max_side(self) -> float:
        """Longest side length of the bounding box, m."""
        return float(np.max(np.subtract(self.upper, self.lower)))

    @property
    def extent(self) -> str:
        """The corners of the bounding box in words."""
        return f"{format_point(self.lower)} to {format_point(self.upper)}"

    def with_mesh(self, mesh: MeshData) -> MeshSummary:
        """Returns the summary with a mesh that was built, and its mean edge if h is not known."""
        return replace(self, mesh=mesh, h=self.h if np.isfinite(self.h) else mean_edge_length(mesh))


def summarise_source(study: Study, surface: ClosedSurface | None) -> MeshSummary | None:
    """Returns the summary of a builder or of a closed surface; None if the mesh has to be read.

    Args:
        study: with any [mesh].
        surface: of the study, if it has one.

    Raises:
        InputError: if the parameters of the builder are invalid.
    """
    builder = find_builder(study.mesh)
    if builder is not None:
        try:
            (lower, upper), count = builder.bounds(), builder.cells_estimate()
        except MeshError as error:
            raise InputError(f"mesh: {error}") from None
        size, facets = f"about {count:,} cells", partial(_estimate_facets, count, len(lower))
        h = _min_cell_size(builder)
        return MeshSummary(
            len(lower), builder.groups, builder.regions, tuple(lower), tuple(upper), count, size, h, facets
        )
    if surface is not None:
        count = estimate_filled_cells(study.mesh, surface)
        size = f"about {count:,} cells in {len(surface.triangles):,} triangles"
        lower, upper = (tuple(corner.tolist()) for corner in (surface.points.min(axis=0), surface.points.max(axis=0)))
        h, facets = float(study.mesh.parameters["h"]), partial(_estimate_facets, count, 3)
        return MeshSummary(3, ("surface",), (), lower, upper, count, size, h, facets, surface.volume, surface.notes)
    return None


def summarise_mesh(mesh: MeshData) -> MeshSummary:
    """Returns the summary of a mesh that was read or built."""
    count = label_bodies(mesh)[0]
    size = f"{len(mesh.cells):,} cells, {len(mesh.points):,} nodes, {count} {'body' if count == 1 else 'bodies'}"
    lower, upper = (tuple(corner.tolist()) for corner in (mesh.points.min(axis=0), mesh.points.max(axis=0)))
    volume = float(signed_measures(mesh.points, mesh.cells).sum())
    groups, regions, facets = tuple(mesh.facet_groups), tuple(mesh.regions), partial(_count_facets, mesh)
    h, cells = mean_edge_length(mesh), len(mesh.cells)
    return MeshSummary(mesh.dim, groups, regions, lower, upper, cells, size, h, facets, volume, mesh.notes, mesh)


def summarise_shared_mesh(
    groups: Iterable[str], regions: Iterable[str], lower: Values, upper: Values, cell_count: int
) -> MeshSummary:
    """Returns the summary of a mesh that is shared among ranks, without its sizes.

    Args:
        groups: names of groups of facets.
        regions: names of regions.
        lower: (d,) corner of the bounding box, m.
        upper: (d,) opposite corner, m.
        cell_count: number of cells of all ranks.
    """
    low, high = (tuple(float(x) for x in corner) for corner in (lower, upper))
    size = f"{cell_count:,} cells"
    return MeshSummary(len(lower), tuple(groups), tuple(regions), low, high, cell_count, size, np.inf, lambda: "facets")


def mean_edge_length(mesh: MeshData) -> float:
    """Returns the mean edge length of a mesh in m; of a large mesh that of a sample of its cells."""
    edges = edges_of(mesh.cells[:: 1 + len(mesh.cells) // LIMITS.max_sampled_cells])
    return float(np.linalg.norm(mesh.points[edges[:, 1]] - mesh.points[edges[:, 0]], axis=1).mean())


def _min_cell_size(builder: Any) -> float:
    """Least cell size of a builder, m; infinite if it has none. At a notch or hole the default is h / 4."""
    sizes = {name: size for name, size in vars(builder).items() if name == "h" or name.startswith("h_")}
    return float(min((builder.h / 4 if size is None else size for size in sizes.values()), default=np.inf))


def _count_facets(mesh: MeshData) -> str:
    return f"{len(boundary_facets(mesh.cells)):,} facets"


def _estimate_facets(cells: int, dim: int) -> str:
    """A lower bound of the facets of a mesh that is not built, to two digits."""
    count = int(LIMITS.min_facet_ratio[dim] * cells ** ((dim - 1) / dim))
    unit = 10 ** max(0, len(str(count)) - 2)
    return f"{count // unit * unit:,} facets or more"
