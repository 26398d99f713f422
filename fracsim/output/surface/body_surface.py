"""Split surface of a body at a time: built again if edges broke, otherwise only moved."""

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
from .fragment_table import FragmentNames, FragmentTable, enclosed_volumes, group_sums, tabulate_fragments

if TYPE_CHECKING:
    from ...mesh.split_surface.surface_map import SurfaceMap

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Arrays = dict[str, npt.NDArray[np.generic]]
# Correction of drawn points, so that nothing is drawn inside an obstacle or another fragment: from the points, their
# elements, the nodal displacement u and the time t.
type PointCorrection = Callable[[SurfaceMap, Ints, Values, float], SurfaceMap]
# viewers use single precision
MAX_COORDINATE = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class SurfaceFrame:
    """Split surface at a time, ready to be written.

    Attributes:
        t: time, s.
        points: present positions (n, d) of the points, m.
        triangles: in 3D the closed surface (k, 3); in 2D triangles that cover the body.
        segments: in 2D the closed outlines (m, 2); none in 3D.
        point_fields: fields at the points, by name.
        element_fields: fields of the elements, by name. Elements are the triangles, then the segments.
        origins: names of the numbers in element_fields["origin"].
        fragments: mass, volume and motion of the fragments.
    """

    t: float
    points: Values
    triangles: Ints
    segments: Ints
    point_fields: Arrays
    element_fields: Arrays
    origins: list[str]
    fragments: FragmentTable


class BodySurface:
    """Split surface of a mesh, on the rank that has the mesh.

    Attributes:
        skeleton: edges, facets and boundary of the mesh.
        split: surface in the reference configuration.
        mass: lumped masses (N,) of the nodes, kg.
        fragment_names: names (fragments,), numbers that stay with a fragment.
        volume: volumes (fragments,), m^3 (2D: m^2).
        build_count: how often the surface was built.
    """

    split: SplitSurface

    def __init__(self, mesh: MeshData, density: Values | float, *, smooth: bool = False) -> None:
        """Build the surface of the intact mesh.

        Args:
            mesh: input mesh.
            density: mass density, kg/m^3; one number or (C,).
            smooth: broken edges without a given cut are cut so that cracks are smooth.
        """
        self._smooth = smooth
        self.skeleton = EntityNumbering(mesh)
        volume = signed_measures(mesh.points, mesh.cells)
        share = np.broadcast_to((density * volume / (mesh.dim + 1))[:, None], mesh.cells.shape)
        self.mass = group_sums(mesh.cells.ravel(), share.ravel(), len(mesh.points))
        self._names = FragmentNames()
        self._pattern: npt.NDArray[np.integer] = np.zeros(len(mesh.cells), np.uint8)
        self.build_count = 0
        self._build(None)

    def update(self, pattern: npt.NDArray[np.integer], cut: Values | None = None) -> bool:
        """Build the surface again if edges broke; returns True if it was built.

        Args:
            pattern: edge patterns (C,) of the cells.
            cut: positions (E,) of the cuts of broken edges, see `build_split_surface`.
        """
        if np.array_equal(pattern, self._pattern):
            return False
        self._pattern = pattern.copy()
        self._build(cut)
        return True

    @property
    def undamaged_cells(self) -> npt.NDArray[np.bool_]:
        """Mask (C,) of the cells without a broken edge."""
        return self._pattern == 0

    def replay_fragment_names(self, broken_at: Values, times: Iterable[float]) -> None:
        """Restore the names of the fragments after a restart.

        Args:
            broken_at: times (E,) at which edges broke, s.
            times: times of the earlier frames, s.
        """
        for t in times:
            count, fragment_of_node = self.skeleton.find_fragments(broken_at <= t * (1 + 1e-12))
            self._names.update(count, fragment_of_node, self.mass)

    def _build(self, cut: Values | None) -> None:
        if self._smooth:
            from ...mesh.split_surface.smooth_cuts import smooth_cuts

            cut = smooth_cuts(self.skeleton, self.skeleton.broken_edges(self._pattern), cut)
        self.split = built = build_split_surface(self.skeleton, self._pattern, cut)
        self.fragment_names = self._names.update(built.fragment_count, built.node_fragment, self.mass)
        fragment = built.point_fragment
        self.volume = enclosed_volumes(
            built.points, built.elements, fragment[built.elements[:, 0]], built.fragment_count
        )
        self._rotations = NodalRotations(self.skeleton, self._pattern, built.parents.rotating_nodes)
        self._name_of_point = self.fragment_names[fragment]
        # map from nodal displacement to points, before corrections
        self._uncorrected: SurfaceMap | None = None
        self.build_count += 1

    def make_frame(
        self,
        t: float,
        u: Values,
        v: Values,
        *,
        broken_at: Values | None = None,
        fields: Iterable[Field] = (),
        corrections: Sequence[PointCorrection] = (),
    ) -> SurfaceFrame:
        """Surface at a time. The velocity of a point is the mean over its parent nodes, without their rotation.

        Args:
            t: time, s.
            u: nodal displacement (N, d), m.
            v: nodal velocity (N, d), m/s.
            broken_at: times (E,) at which edges broke, s, for the age of the crack.
            fields: further fields. Nodal ones are averaged over the parent nodes; an element has the value of the cell
                behind it.
            corrections: corrections of the drawn points.

        Raises:
            NotConverged: a displacement or velocity is not finite in single precision; with fragment and cell.
        """
        self._check_finite(t, u, v)
        follow = self.split.parents
        displacement = self._point_displacement(t, u, corrections)
        fields = [field for field in fields if field.name not in ("displacement", "velocity", "piece")]
        point_fields: Arrays = {"displacement": displacement, "velocity": follow.mean(v)}
        point_fields["piece"] = self._name_of_point.astype(np.int32)
        point_fields |= {field.name: follow.mean(field.values) for field in fields if field.centre == "Node"}
        triangles, segments, cell, element_fields = self._elements()
        element_fields["age"] = self._crack_age(t, broken_at)
        element_fields |= {field.name: field.values[cell] for field in fields if field.centre == "Cell"}
        table = tabulate_fragments(
            self.fragment_names, self.split.node_fragment, self.mass, self.volume, self.skeleton.points + u, v
        )
        points, origins = self.split.points + displacement, self.skeleton.origins
        return SurfaceFrame(t, points, triangles, segments, point_fields, element_fields, origins, table)

    def make_rigid_frame(
        self, t: float, points: Values, velocity: Values, fragments: FragmentTable, broken_at: Values | None = None
    ) -> SurfaceFrame:
        """Surface of rigid bodies at a time.

        Args:
            t: time, s.
            points: present positions (n, d) of the points, m.
            velocity: velocities (n, d) of the points, m/s.
            fragments: motion of the fragments, in the order of `split`.
            broken_at: times (E,) at which edges broke, s, for the age of the crack.
        """
        triangles, segments, _, element_fields = self._elements()
        element_fields["age"] = self._crack_age(t, broken_at)
        point_fields: Arrays = {"displacement": points - self.split.points, "velocity": velocity}
        point_fields["piece"] = self._name_of_point.astype(np.int32)
        table = replace(fragments, name=self.fragment_names)
        origins = self.skeleton.origins
        return SurfaceFrame(t, points, triangles, segments, point_fields, element_fields, origins, table)

    def _point_displacement(self, t: float, u: Values, corrections: Sequence[PointCorrection]) -> Values:
        """Displacements (n, d) of the points, m."""
        built = self.split
        if not corrections:
            return built.parents.displacement(u, self._rotations(u))
        if self._uncorrected is None:
            from ...mesh.split_surface.surface_map import make_surface_map

            self._uncorrected = make_surface_map(built, self.skeleton, self._pattern, built.points)
        point_map = self._uncorrected
        for correct in corrections:
            point_map = correct(point_map, built.elements, u, t)
        return point_map(u) - built.points

    def _elements(self) -> tuple[Ints, Ints, Ints, Arrays]:
        """Triangles, segments, the cell behind each element, and the fields that do not depend on the motion."""
        built, flat = self.split, self.skeleton.dim == 2
        triangles, segments = (built.fill, built.elements) if flat else (built.elements, built.elements[:0, :2])
        cell = np.concatenate([built.fill_cell, built.cell])
        origin = np.concatenate([np.full(len(built.fill), BODY), built.origin])
        first_point = np.concatenate([built.fill[:, 0], built.elements[:, 0]])
        is_single_node = np.bincount(built.node_fragment)[built.point_fragment] == 1
        fixed = {
            "piece": self._name_of_point[first_point], "origin": origin, "cell": cell,
            "dust": is_single_node[first_point],
        }  # fmt: skip
        return triangles, segments, cell, {name: values.astype(np.int32) for name, values in fixed.items()}

    def _crack_age(self, t: float, broken_at: Values | None) -> Values:
        """Time (elements,) since the edge behind each element broke, s; 0 on the boundary and if unknown.

        Viewers would draw NaN in a colour of its own.
        """
        edge = np.concatenate([np.full(len(self.split.fill), -1), self.split.edge])
        age = np.zeros(len(edge))
        if broken_at is not None:
            age[edge >= 0] = np.nan_to_num(t - broken_at[edge[edge >= 0]])
        return age

    def _check_finite(self, t: float, u: Values, v: Values) -> None:
        """Raise NotConverged if a nodal displacement or velocity (N, d) exceeds `MAX_COORDINATE`."""
        for values, quantity in ((u, "displacement"), (v, "velocity")):
            lost = np.flatnonzero(~np.all(np.abs(values) <= MAX_COORDINATE, axis=1))
            if len(lost):
                node = lost[0]
                cell = int(np.argmax(np.any(self.skeleton.cells == node, axis=1)))
                name = self.fragment_names[self.split.node_fragment[node]]
                raise NotConverged(
                    f"the surface at t = {t:g} s was not written: node {node} of piece {name} (cell {cell}) has the "
                    f"{quantity} {values[node]}; {len(lost)} nodes are not numbers below {MAX_COORDINATE:.0e}; "
                    "choose a smaller time.step"
                )
