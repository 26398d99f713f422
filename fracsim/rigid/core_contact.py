"""Contact between fragments and the cores of other fragments.

The core of a fragment is the cells of the mesh that belong to it entirely. A crack goes through the cells between two
cores, and no node of a fragment lies in another core when the body breaks. Convex parts that overlap from the moment of
fracture (fragment_overlap) do not show when a fragment moves on through another one; cores do.

Nodes beside cracks are searched for in the cores of the fragments whose parts overlap with theirs, at their positions
at the end of the step without contact. A node that is deeper than a tolerance behind the faces beside cracks, by d,
touches the tangent plane there with a gap

    g = max(0, dt c - d + tolerance),   c the speed of approach,

so that it goes no deeper than the step carries it, and is not pushed out. Fragments as they are drawn can overlap by
the cells that the crack goes through. Contact between the drawn crack faces would cost many times as much, and would
lock fragments with jagged cracks into one.

A node is searched for again when it may have moved as far as its distance from the core.
"""

from __future__ import annotations

from collections.abc import Sequence
from ctypes import c_double, c_int64
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..mesh.c_library import load_library
from ..mesh.split_surface.closed_surface import SplitSurface
from ..mesh.split_surface.entity_numbering import EntityNumbering
from ..meshes.topology import facets_of
from .bodies import Bodies

SOURCE = Path(__file__).with_suffix(".c")
Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class CoreSettings:
    """Accuracy of the search in cores; lengths in mean edges of the mesh.

    Attributes:
        tolerance: depth behind the faces of a core that is not yet contact.
        search_radius: distance up to which faces of a core are searched.
        box_side: side of the boxes that faces are sorted into.
        max_nodes: nodes of a fragment that may touch the core of another one, the deepest ones.
    """

    tolerance: float = 0.02
    search_radius: float = 0.8
    box_side: float = 0.5
    max_nodes: int = 2


SETTINGS = CoreSettings()


@dataclass(frozen=True)
class CoreGeometry:
    """Nodes beside cracks and faces of cores, of the fragments of one instance of the mesh, in its axes.

    Attributes:
        nodes: (k, 3) m.
        node_fragment: (k,) fragments of the nodes, ascending.
        faces: (m, 3, 3) corners of faces, normals outwards, m.
        face_fragment: (m,) fragments of the faces, ascending.
        is_crack_face: (m,) 1 for faces beside cracks, 0 for others.
    """

    nodes: Values
    node_fragment: Ints
    faces: Values
    face_fragment: Ints
    is_crack_face: Ints

    @classmethod
    def from_split_surface(cls, surface: SplitSurface, mesh: EntityNumbering) -> CoreGeometry:
        """Return the cores of a broken mesh, with its split surface and the numbering of its entities."""
        node = np.unique(mesh.edges[surface.broken])
        node = node[np.argsort(surface.node_fragment[node], kind="stable")]
        fragment_of_corner, facets = surface.node_fragment[mesh.cells], mesh.cell_facets
        in_core = np.all(fragment_of_corner == fragment_of_corner[:, :1], axis=1)
        cells, core_cells = (
            np.bincount(numbers.ravel(), minlength=len(mesh.facets)) for numbers in (facets, facets[in_core])
        )
        # a face of a core is a facet of exactly one of its cells
        cell, side = np.nonzero((core_cells == 1)[facets] & in_core[:, None])
        order = np.argsort(fragment_of_corner[cell, 0], kind="stable")
        cell, side = cell[order], side[order]
        corners = mesh.cells[cell[:, None], facets_of(np.arange(4)[None])[0][side]]
        is_crack_face = np.asarray(cells[facets[cell, side]] == 2, np.int64)
        node_fragment, face_fragment = surface.node_fragment[node], fragment_of_corner[cell, 0]
        return cls(mesh.points[node], node_fragment, mesh.points[corners], face_fragment, is_crack_face)

    @classmethod
    def empty(cls) -> CoreGeometry:
        """Return the geometry of an instance without cores: an unbroken one, or a shell."""
        numbers = np.empty(0, np.int64)
        return cls(np.empty((0, 3)), numbers, np.empty((0, 3, 3)), numbers, numbers)


class CoreContact:
    """Contact of n fragments with the cores of one another, and the distances that were found so far."""

    def __init__(
        self, cores: Sequence[CoreGeometry], counts: Sequence[int], centre: Values, rotation: Values, edge: float
    ) -> None:
        """Sort the faces into boxes.

        Args:
            cores: of the instances of a mesh.
            counts: number of fragments of each.
            centre: (n, 3) centres of the fragments in the axes of the mesh, m.
            rotation: (n, 3, 3) from these axes to those of the fragments at rest.
            edge: mean edge of the mesh, m.
        """
        first = np.cumsum([0, *counts])
        self._centre, self._rotation, self._edge = np.ascontiguousarray(centre), rotation, edge
        self._nodes = np.concatenate([core.nodes for core in cores])
        numbered = list(zip(cores, first, strict=False))
        self._node_fragment = np.concatenate([core.node_fragment + start for core, start in numbered])
        self._face_fragment = np.concatenate([core.face_fragment + start for core, start in numbered])
        self._faces = np.ascontiguousarray(np.concatenate([core.faces for core in cores]))
        self._is_crack_face = np.concatenate([core.is_crack_face for core in cores])
        # where the nodes, and the faces, of each fragment begin
        self._first_node = np.searchsorted(self._node_fragment, np.arange(first[-1] + 1))
        self._first_face = np.searchsorted(self._face_fragment, np.arange(first[-1] + 1))
        self._side = SETTINGS.box_side * edge
        self._boxes, self._first_in_box, self._face_in_box = self._sort_into_boxes()
        self._distances: _Distances | None = None

    def _box_ranges(self, begin: Ints, end: Ints, fragment: Ints) -> tuple[Ints, Ints]:
        """Return the lowest boxes (n, 3) of fragments and their numbers of boxes (n, 3).

        Their items (k,) are in the boxes from `begin` (k, 3) to `end` (k, 3).
        """
        # no box has this number
        beyond_all = 1 << 40
        low = np.full((len(self._centre), 3), beyond_all)
        high = np.full((len(self._centre), 3), -beyond_all)
        np.minimum.at(low, fragment, begin)
        np.maximum.at(high, fragment, end)
        return low, np.maximum(high - low + 1, 0)

    def _close_pairs(self, pairs: Ints) -> Ints:
        """Return those of pairs (k, 2) of which nodes of the second were within reach of the core of the first.

        Positions are those at the moment of fracture.
        """
        box = np.floor(self._nodes / self._side).astype(np.int64)
        low, size = self._box_ranges(box, box, self._node_fragment)
        (a, b), margin = pairs.T, int(np.ceil(SETTINGS.search_radius / SETTINGS.box_side))
        core, core_size = self._boxes[:, :3], self._boxes[:, 3:6]
        apart = (low[b] > core[a] + core_size[a] + margin) | (low[b] + size[b] < core[a] - margin)
        return pairs[~apart.any(axis=1) & (core_size[a, 0] > 0) & (size[b, 0] > 0)]

    def _sort_into_boxes(self) -> tuple[Ints, Ints, Ints]:
        """Return the boxes of each fragment, where the faces in every box begin, and these faces.

        The boxes (n, 7) are: the lowest one along each axis, their number along each axis, the number of the first.
        """
        corners = self._faces.min(axis=1), self._faces.max(axis=1)
        begin, end = (np.floor(x / self._side).astype(np.int64) for x in corners)
        low, size = self._box_ranges(begin, end, self._face_fragment)
        ends = np.cumsum(size.prod(axis=1))
        first = ends - size.prod(axis=1)
        # a face is listed in all boxes of its bounding box
        span = end - begin + 1
        count = span.prod(axis=1)
        face = np.repeat(np.arange(len(begin)), count)
        number = np.arange(count.sum()) - np.repeat(np.cumsum(count) - count, count)
        fragment, (_, b, c) = self._face_fragment[face], span[face].T
        offset = np.stack([number // (b * c), number // c % b, number % c])
        i, j, k = (begin[face] - low[fragment]).T + offset
        box = first[fragment] + (i * size[fragment, 1] + j) * size[fragment, 2] + k
        order = np.argsort(box, kind="stable")
        boxes = np.concatenate([low, size, first[:, None]], axis=1)
        return boxes, np.searchsorted(box[order], np.arange(ends[-1] + 1)), face[order]

    def __call__(self, pairs: Ints, bodies: Bodies, end: Bodies, dt: float) -> tuple[Ints, Values, Values, Values]:
        """Return contacts of fragments with cores in a step.

        Args:
            pairs: (k, 2) fragments that overlap; later calls may have fewer of them, but no others.
            bodies: as the step begins.
            end: the same after the step without contact.
            dt: s.

        Returns:
            Bodies (m, 2), of which the first has the core; points (m, 3), m; axes (m, 3, 3) with the normal out of the
            core first; gaps (m,), m.
        """
        touching, node, depth, normal = self.find_deepest(pairs, end)
        first, second = touching.T
        arm = np.einsum("kij,kj->ki", self._rotation[second], self._nodes[node] - self._centre[second])
        x = bodies.to_current(bodies.centre[second] + arm, second)
        relative = bodies.velocity_at(x, first) - bodies.velocity_at(x, second)
        approach_speed = np.einsum("ki,ki->k", normal, relative)
        gap = np.maximum(dt * approach_speed - depth + SETTINGS.tolerance * self._edge, 0.0)
        return touching, x, _axes(normal), gap

    def find_deepest(self, pairs: Ints, bodies: Bodies) -> tuple[Ints, Ints, Values, Values]:
        """Return the deepest nodes in cores: bodies (m, 2), nodes (m,), depths (m,), m, and normals (m, 3).

        A node of the second body is in the core of the first; the normal points out of the core.
        """
        n, tolerance = len(self._centre), SETTINGS.tolerance * self._edge
        ordered = np.concatenate([pairs, pairs[:, ::-1]])
        if self._distances is None:
            codes: Ints = np.asarray(np.unique(self._close_pairs(ordered) @ [n, 1]), np.int64)
            self._distances = _Distances.at_fracture(codes, n, self._first_node, self._nodes, tolerance)
        distances = self._distances
        ordered = ordered[np.isin(ordered @ [n, 1], distances.code)]
        chosen, count = np.searchsorted(distances.code, ordered @ [n, 1]), len(ordered)
        rotation = np.ascontiguousarray(bodies.rotation[:n] @ self._rotation)
        position = np.ascontiguousarray(bodies.position)
        result, node = np.zeros(count, np.int64), np.zeros((count, SETTINGS.max_nodes), np.int64)
        depth, normal = np.zeros((count, SETTINGS.max_nodes)), np.zeros((count, SETTINGS.max_nodes, 3))
        fragments = [rotation, position, self._centre, self._first_node, self._nodes]
        grid = [self._boxes, self._first_in_box, self._face_in_box, self._faces, self._is_crack_face, self._first_face]
        lengths = c_double(self._side), c_double(tolerance), c_double(SETTINGS.search_radius * self._edge)
        state, results = [distances.position, distances.face, distances.first], [result, node, depth, normal]
        load_library(SOURCE).find_deepest(
            c_int64(count), chosen, distances.pairs, *fragments, *grid, *lengths,
            c_int64(SETTINGS.max_nodes), *state, *results,
        )  # fmt: skip
        row, rank = np.nonzero(np.arange(SETTINGS.max_nodes) < result[:, None])
        touching = ordered[row]
        outwards = np.einsum("kij,kj->ki", rotation[touching[:, 0]], normal[row, rank])
        return touching, node[row, rank], depth[row, rank], outwards


@dataclass(frozen=True)
class _Distances:
    """Distances of nodes from cores, of k ordered pairs of fragments; core_contact.c updates them.

    Attributes:
        code: (k,) of the pairs, ascending.
        pairs: (k, 2).
        position: (m, 4) positions of nodes relative to the core when they were searched for, and distances then, m.
        face: (m,) nearest faces; -1 for none.
        first: (k,) where the nodes of a pair begin.
    """

    code: Ints
    pairs: Ints
    position: Values
    face: Ints
    first: Ints

    @classmethod
    def at_fracture(cls, code: Ints, count: int, first_node: Ints, nodes: Values, tolerance: float) -> _Distances:
        """Return the distances at the moment of fracture, when no node is in a core."""
        pairs = np.stack([code // count, code % count], axis=1)
        sizes = np.diff(first_node)[pairs[:, 1]]
        first = np.cumsum(sizes) - sizes
        node = np.arange(sizes.sum()) + np.repeat(first_node[pairs[:, 1]] - first, sizes)
        position = np.concatenate([nodes[node], np.full((len(node), 1), tolerance)], axis=1)
        return cls(code, pairs, position, np.full(len(node), -1), first)


def _axes(normal: Values) -> Values:
    """Return rotations (k, 3, 3) whose first rows are unit vectors (k, 3)."""
    across = np.cross(np.eye(3)[np.abs(normal).argmin(axis=1)], normal)
    across /= np.linalg.norm(across, axis=1)[:, None]
    return np.stack([normal, across, np.cross(normal, across)], axis=1)
