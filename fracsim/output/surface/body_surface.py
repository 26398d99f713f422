"""A body's surface at a time: built again where edges broke, otherwise only moved."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt

from ...errors import NotConverged
from ...mesh.split_surface.closed_surface import SplitSurface, build_split_surface
from ...mesh.split_surface.entity_numbering import BODY, EntityNumbering
from ...mesh.split_surface.surface_motion import NodalRotations
from ...meshes.data import MeshData
from ...meshes.topology import signed_measures
from ..fields_file import Field
from .fragment_table import Fragments, PieceNames, fragments, sums, volumes

if TYPE_CHECKING:
    from ...mesh.split_surface.surface_map import SurfaceMap

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Arrays = dict[str, npt.NDArray[np.generic]]
type Apart = Callable[[SurfaceMap, Ints, Values, float], SurfaceMap]  # of where points are, their elements, u and t
FARTHEST = float(np.finfo(np.float32).max)  # viewers draw in single precision


@dataclass(frozen=True)
class Frame:
    """What is written of a surface at time t (s).

    Attributes:
        points: (n, d) where the points are now, m.
        triangles: (k, 3) the closed surface in 3D; in 2D triangles that cover the body.
        segments: (m, 2) the closed outlines in 2D, none in 3D.
        at_points, at_elements: fields by name; elements are the triangles, then the segments.
        origins: names of the numbers in at_elements["origin"].
        pieces: figures of the pieces.
    """

    t: float
    points: Values
    triangles: Ints
    segments: Ints
    at_points: Arrays
    at_elements: Arrays
    origins: list[str]
    pieces: Fragments


class Surface:
    """The split surface of a mesh, on the rank that has the mesh.

    Attributes:
        skeleton: edges, facets and boundary of the mesh.
        split: the surface in the reference configuration.
        names: (pieces,) numbers that stay with the pieces.    volume: (pieces,) m^3 (2D: m^2).
        builds: how often it was built.
    """

    split: SplitSurface

    def __init__(self, mesh: MeshData, density: Values | float, *, smooth: bool = False) -> None:
        """`density`: kg/m^3, one number or (C,).    `smooth`: edges without a place of their cut get one that makes
        cracks smooth."""
        self._smooth = smooth
        self.skeleton = EntityNumbering(mesh)
        volume = signed_measures(mesh.points, mesh.cells)
        share = np.broadcast_to((density * volume / (mesh.dim + 1))[:, None], mesh.cells.shape)
        self.mass = sums(mesh.cells.ravel(), share.ravel(), len(mesh.points))
        self._names = PieceNames()
        self._pattern: npt.NDArray[np.integer] = np.zeros(len(mesh.cells), np.uint8)
        self.builds = 0
        self._build(None)

    def update(self, pattern: npt.NDArray[np.integer], cut: Values | None = None) -> bool:
        """Build again where the patterns (C,) changed; returns whether they did. `cut`: (E,) see `split`."""
        if np.array_equal(pattern, self._pattern):
            return False
        self._pattern = pattern.copy()
        self._build(cut)
        return True

    @property
    def whole(self) -> npt.NDArray[np.bool_]:
        """(C,) cells without a broken edge."""
        return self._pattern == 0

    def replay(self, broken_at: Values, times: Iterable[float]) -> None:
        """Name the pieces as frames at earlier times did, from the times (E,) at which edges broke (restart)."""
        for t in times:
            count, piece = self.skeleton.pieces(broken_at <= t * (1 + 1e-12))
            self._names.update(count, piece, self.mass)

    def _build(self, cut: Values | None) -> None:
        if self._smooth:
            from ...mesh.split_surface.smooth_cuts import smooth_cuts

            cut = smooth_cuts(self.skeleton, self.skeleton.broken_edges(self._pattern), cut)
        made = build_split_surface(self.skeleton, self._pattern, cut)
        self.split = made
        self.names = self._names.update(made.fragment_count, made.node_fragment, self.mass)
        piece = made.point_fragment
        self.volume = volumes(made.points, made.elements, piece[made.elements[:, 0]], made.fragment_count)
        self._rotations = NodalRotations(self.skeleton, self._pattern, made.parents.rotating_nodes)
        self._piece = self.names[piece]
        self._linear: SurfaceMap | None = None
        self.builds += 1

    def at(
        self,
        t: float,
        u: Values,
        v: Values,
        *,
        broken_at: Values | None = None,
        fields: Iterable[Field] = (),
        apart: Sequence[Apart] = (),
    ) -> Frame:
        """The surface at time t (s) for nodal displacement u (N, d) in m and velocity v (N, d) in m/s.

        Point velocity is the mean of the parents', without their turning. `fields` come along: nodal ones as the mean
        of the parents, cell ones as in the cell behind the element. `broken_at`: (E,) s, for the age of the crack.
        `apart`: what changes where points are, so that nothing is drawn inside something else.
        NotConverged, naming piece and cell, where a node has gone astray.
        """
        self._check(t, u, v)
        made, follow = self.split, self.split.parents
        moved = self._moved(t, u, apart)
        fields = [field for field in fields if field.name not in ("displacement", "velocity", "piece")]
        at_points: Arrays = {"displacement": moved, "velocity": follow.mean(v), "piece": self._piece.astype(np.int32)}
        at_points |= {field.name: follow.mean(field.values) for field in fields if field.centre == "Node"}
        triangles, segments, cell, at_elements = self._elements()
        at_elements["age"] = self._ages(t, broken_at)
        at_elements |= {field.name: field.values[cell] for field in fields if field.centre == "Cell"}
        figures = fragments(self.names, made.node_fragment, self.mass, self.volume, self.skeleton.points + u, v)
        points, origins = made.points + moved, self.skeleton.origins
        return Frame(t, points, triangles, segments, at_points, at_elements, origins, figures)

    def placed(
        self, t: float, points: Values, velocity: Values, pieces: Fragments, broken_at: Values | None = None
    ) -> Frame:
        """The surface at time t (s) with its points (n, d) at given places, m, moving at `velocity` (n, d), m/s; pieces
        by the numbers of `split`."""
        triangles, segments, _, at_elements = self._elements()
        at_elements["age"] = self._ages(t, broken_at)
        at_points: Arrays = {"displacement": points - self.split.points, "velocity": velocity}
        at_points["piece"] = self._piece.astype(np.int32)
        named = replace(pieces, name=self.names)
        return Frame(t, points, triangles, segments, at_points, at_elements, self.skeleton.origins, named)

    def _moved(self, t: float, u: Values, apart: Sequence[Apart]) -> Values:
        """(n, d) displacements of the points, m."""
        made = self.split
        if not apart:
            return made.parents.displacement(u, self._rotations(u))
        if self._linear is None:
            from ...mesh.split_surface.surface_map import whole

            self._linear = whole(made, self.skeleton, self._pattern, made.points)
        at = self._linear
        for each in apart:
            at = each(at, made.elements, u, t)
        return at(u) - made.points

    def _elements(self) -> tuple[Ints, Ints, Ints, Arrays]:
        """Triangles, segments, the cell of each, and the fields that do not move."""
        made, flat = self.split, self.skeleton.dim == 2
        triangles, segments = (made.fill, made.elements) if flat else (made.elements, made.elements[:0, :2])
        cell = np.concatenate([made.fill_cell, made.cell])
        origin = np.concatenate([np.full(len(made.fill), BODY), made.origin])
        piece = self._piece[np.concatenate([made.fill[:, 0], made.elements[:, 0]])]
        alone = np.bincount(made.node_fragment)[made.point_fragment] == 1
        dust = alone[np.concatenate([made.fill[:, 0], made.elements[:, 0]])]
        fixed = {"piece": piece, "origin": origin, "cell": cell, "dust": dust}
        return triangles, segments, cell, {name: values.astype(np.int32) for name, values in fixed.items()}

    def _ages(self, t: float, broken_at: Values | None) -> Values:
        """s since the edge behind an element broke; 0 on the boundary and where it is not known: viewers draw what is
        no number in a colour of its own."""
        edge = np.concatenate([np.full(len(self.split.fill), -1), self.split.edge])
        age = np.zeros(len(edge))
        if broken_at is not None:
            age[edge >= 0] = np.nan_to_num(t - broken_at[edge[edge >= 0]])
        return age

    def _check(self, t: float, u: Values, v: Values) -> None:
        for values, what in ((u, "displacement"), (v, "velocity")):
            lost = np.flatnonzero(~np.all(np.abs(values) <= FARTHEST, axis=1))
            if len(lost):
                node = lost[0]
                cell = int(np.argmax(np.any(self.skeleton.cells == node, axis=1)))
                piece = self.names[self.split.node_fragment[node]]
                raise NotConverged(
                    f"the surface at t = {t:g} s was not written: node {node} of piece {piece} (cell {cell}) has the "
                    f"{what} {values[node]}; {len(lost)} nodes are not numbers below {FARTHEST:.0e}; "
                    "choose a smaller time.step"
                )
