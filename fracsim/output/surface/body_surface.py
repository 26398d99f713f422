"""Split surface of a body at a time: built again if edges broke, otherwise only moved.

Each rank has the surface of its part of the mesh (mesh_part): its own cells, or a whole mesh on one rank.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ...errors import NotConverged
from ...mesh.parallel import Gather, allgather
from ...mesh.split_surface.closed_surface import SplitSurface, build_split_surface
from ...mesh.split_surface.entity_numbering import BODY, EntityNumbering
from ...mesh.split_surface.mesh_part import MeshPart, WholeMesh, total
from ...mesh.split_surface.surface_motion import NodalGradients, NodalRotations
from ...mesh.split_surface.surface_numbering import SurfaceNumbering, number_surface, number_whole_surface
from ...meshes.data import MeshData
from ...meshes.topology import signed_measures
from ..fields_file import Field, rounded
from .fragment_table import FragmentNames, FragmentTable, enclosed_volumes, group_sums, tabulate_fragments
from .vtu_file import CompressedGrid, GridCompressor

if TYPE_CHECKING:
    from ...mesh.split_surface.drawn_surface import DrawnSurface, SharedPoints
    from ...mesh.split_surface.surface_map import SurfaceMap

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Arrays = dict[str, npt.NDArray[np.generic]]
# Correction of drawn points, so that nothing is drawn inside an obstacle or another fragment (collective).
type PointCorrection = Callable[[SurfaceMap, DrawnSurface], SurfaceMap]
# viewers use single precision
MAX_COORDINATE = float(np.finfo(np.float32).max)


@dataclass(frozen=True)
class SurfaceFrame:
    """Split surface at a time, ready to be written, or the part of it that a rank has.

    Attributes:
        t: time, s.
        points: present positions (n, d) of the points, m.
        triangles: in 3D the closed surface (k, 3); in 2D triangles that cover the body.
        segments: in 2D the closed outlines (m, 2); none in 3D.
        point_fields: fields at the points, by name.
        element_fields: fields of the elements, by name. Elements are the triangles, then the segments.
        origins: names of the numbers in element_fields["origin"].
        fragments: mass, volume and motion of the fragments of the body.
        numbering: numbers of points and elements on the whole surface.
        compressor: compresses surfaces with these elements.
    """

    t: float
    points: Values
    triangles: Ints
    segments: Ints
    point_fields: Arrays
    element_fields: Arrays
    origins: list[str]
    fragments: FragmentTable
    numbering: SurfaceNumbering
    compressor: GridCompressor

    def compress(self, precision: str) -> CompressedGrid | None:
        """The frame for its file on rank 0, None elsewhere (collective).

        `precision`: of points and fields, "single" or "double".
        """
        point_fields, element_fields = (
            {name: rounded(values, precision) for name, values in fields.items()}
            for fields in (self.point_fields, self.element_fields)
        )
        return self.compressor(rounded(self.points, precision), point_fields, element_fields, self.origins)

    def gather(self) -> SurfaceFrame | None:
        """The frame of the whole surface on rank 0, None elsewhere (collective)."""
        numbering = self.numbering
        if numbering.comm.size == 1:
            return self
        is_own = numbering.is_own
        gather_points, gather_elements = (
            Gather(numbering.comm, numbers) for numbers in (numbering.points[is_own], numbering.elements)
        )
        # a segment has no third point
        segments = np.pad(numbering.points[self.segments], ((0, 0), (0, 1)))
        points = gather_points(self.points[is_own])
        elements = gather_elements(np.concatenate([numbering.points[self.triangles], segments]))
        point_fields: Any = {name: gather_points(values[is_own]) for name, values in self.point_fields.items()}
        element_fields: Any = {name: gather_elements(values) for name, values in self.element_fields.items()}
        if points is None or elements is None:
            return None
        triangles, segments = elements[: numbering.triangle_count], elements[numbering.triangle_count :, :2]
        whole = number_whole_surface(len(points), len(triangles), len(segments))
        return replace(
            self, points=points, triangles=triangles, segments=segments, point_fields=point_fields,
            element_fields=element_fields, numbering=whole, compressor=GridCompressor(whole, triangles, segments),
        )  # fmt: skip


@dataclass(frozen=True)
class MidsideMotion:
    """Masses and motion of the midside nodes that this rank owns, with quadratic displacement.

    Attributes:
        ends: corners (m, 2) at the ends of their edges, nodes of the part.
        mass: lumped masses (m,), kg.
        x: present positions (m, d), m.
        v: velocities (m, d), m/s.
        corner_share: share of the lumped mass of linear displacement that corners have.
    """

    ends: Ints
    mass: Values
    x: Values
    v: Values
    corner_share: float


class BodySurface:
    """Split surface of a mesh, or of the part of it that a rank has.

    Attributes:
        part: the part of the mesh.
        skeleton: edges, facets and boundary of the part.
        split: surface in the reference configuration; its fragments are those of the body.
        numbering: numbers of its points and elements on the surface of all ranks.
        mass: lumped masses (N,) of the nodes, kg; 0 at nodes that another rank owns.
        fragment_names: names (fragments,), numbers that stay with a fragment.
        fragment_nodes: numbers (fragments,) of nodes.
        volume: volumes (fragments,), m^3 (2D: m^2).
        build_count: how often the surface was built.
    """

    split: SplitSurface

    def __init__(self, mesh: MeshData | MeshPart, density: Values | float, *, smooth: bool = False) -> None:
        """Build the surface of the intact mesh (collective).

        Args:
            mesh: input mesh on one rank, or the part of it that this rank has.
            density: mass density, kg/m^3; one number or (C,).
            smooth: broken edges without a given cut are cut so that cracks are smooth.
        """
        self._smooth = smooth
        part: MeshPart = WholeMesh(EntityNumbering(mesh)) if isinstance(mesh, MeshData) else mesh
        self.part, self.skeleton, topology = part, part.skeleton, part.skeleton
        volume, nodes = signed_measures(topology.points, topology.cells), np.arange(len(topology.points))
        share = np.broadcast_to((density * volume / (topology.dim + 1))[:, None], topology.cells.shape)
        mass = group_sums(topology.cells.ravel(), share.ravel(), len(nodes))
        self._is_owned = part.owner == part.comm.rank
        self.mass = np.where(self._is_owned, part.sum_at(nodes, mass[:, None])[:, 0], 0.0)
        self._names = FragmentNames(part.comm)
        self._pattern: npt.NDArray[np.integer] = np.zeros(len(topology.cells), np.uint8)
        self.build_count = 0
        self._build(None)

    def update(self, pattern: npt.NDArray[np.integer], cut: Values | None = None) -> bool:
        """Build the surface again if edges broke; returns True if it was built (collective).

        Args:
            pattern: edge patterns (C,) of the cells.
            cut: positions (E,) of the cuts of broken edges, see `build_split_surface`.
        """
        if self.part.comm.allreduce(np.array_equal(pattern, self._pattern), op=MPI.LAND):
            return False
        self._pattern = pattern.copy()
        self._build(cut)
        return True

    @property
    def undamaged_cells(self) -> npt.NDArray[np.bool_]:
        """Mask (C,) of the cells without a broken edge."""
        return self._pattern == 0

    def replay_fragment_names(self, broken_at: Values, times: Iterable[float]) -> None:
        """Restore the names of the fragments after a restart (collective).

        Args:
            broken_at: times (E,) at which edges broke, s.
            times: times of the earlier frames, s.
        """
        for t in times:
            count, fragment_of_node = self.part.find_fragments(broken_at <= t * (1 + 1e-12))
            self._names.update(count, fragment_of_node, self.mass)

    def _build(self, cut: Values | None) -> None:
        part, topology = self.part, self.skeleton
        if self._smooth:
            from ...mesh.split_surface.smooth_cuts import smooth_cuts

            cut = smooth_cuts(part, topology.broken_edges(self._pattern), cut)
        self.split = built = build_split_surface(topology, self._pattern, cut, fragments=part.find_fragments)
        self._rotations = NodalRotations(part, self._pattern, built.parents.rotating_nodes)
        self._use_surface(number_surface(part, built, self._pattern), self._is_owned)
        # what corrections of points need
        self._corrected: tuple[SharedPoints, NodalGradients] | None = None

    def _use_surface(self, numbering: SurfaceNumbering, is_owned: npt.NDArray[np.bool_]) -> None:
        """Names, sizes and volumes of the fragments of `split`; `is_owned` (N,): nodes of this rank (collective)."""
        built, self.numbering, add = self.split, numbering, partial(total, self.part)
        count, fragment = built.fragment_count, built.point_fragment
        self.fragment_names = self._names.update(count, built.node_fragment, self.mass)
        self.fragment_nodes = add(np.bincount(built.node_fragment[is_owned], minlength=count))
        centre = add(built.points.sum(axis=0)) / add(np.array([len(built.points)]))
        of_element = fragment[built.elements[:, 0]]
        self.volume = add(enclosed_volumes(built.points - centre, built.elements, of_element, count))
        self._name_of_point = self.fragment_names[fragment]
        self._compressor: GridCompressor | None = None
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
        midside: MidsideMotion | None = None,
    ) -> SurfaceFrame:
        """Surface at a time (collective).

        The velocity of a point is the mean over its parent nodes, without their rotation.

        Args:
            t: time, s.
            u: nodal displacement (N, d), m.
            v: nodal velocity (N, d), m/s.
            broken_at: times (E,) at which edges broke, s, for the age of the crack.
            fields: further fields. Nodal ones are averaged over the parent nodes; an element has the value of the cell
                behind it.
            corrections: corrections of the drawn points.
            midside: midside nodes; None with linear displacement.

        Raises:
            NotConverged: a displacement or velocity is not finite in single precision; with fragment and cell.
        """
        self._check_finite(t, u, v)
        follow = self.split.parents
        displacement = self._point_displacement(u, corrections)
        fields = [field for field in fields if field.name not in ("displacement", "velocity", "piece")]
        point_fields: Arrays = {"velocity": follow.mean(v)}
        point_fields |= {field.name: follow.mean(field.values) for field in fields if field.centre == "Node"}
        cell_fields: dict[str, Any] = {field.name: field.values for field in fields if field.centre == "Cell"}
        table = self._tabulate_fragments(self.skeleton.points + u, v, midside)
        return self._frame(t, displacement, point_fields, cell_fields, table, broken_at)

    def _tabulate_fragments(self, x: Values, v: Values, midside: MidsideMotion | None) -> FragmentTable:
        """Mass and motion of the fragments (collective).

        Each end of an edge has half of the mass of its midside node. At an edge between two fragments this half moves
        with the end: a midside node there is attached to neither fragment.

        Args:
            x: present positions (N, d) of the nodes, m.
            v: velocities (N, d) of the nodes, m/s.
            midside: midside nodes; None with linear displacement.
        """
        owned, fragment_of_node = self._is_owned, self.split.node_fragment
        fragment, mass, positions, velocities = fragment_of_node[owned], self.mass[owned], x[owned], v[owned]
        if midside is not None:
            ends = midside.ends
            inside = (fragment_of_node[ends[:, 0]] == fragment_of_node[ends[:, 1]])[:, None]
            fragment = np.concatenate([fragment, *fragment_of_node[ends].T])
            mass = np.concatenate([midside.corner_share * mass, 0.5 * midside.mass, 0.5 * midside.mass])
            positions = np.concatenate([positions, *(np.where(inside, midside.x, x[end]) for end in ends.T)])
            velocities = np.concatenate([velocities, *(np.where(inside, midside.v, v[end]) for end in ends.T)])
        add = partial(total, self.part)
        table = tabulate_fragments(self.fragment_names, fragment, mass, self.volume, positions, velocities, add)
        return replace(table, nodes=self.fragment_nodes)

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
        table = replace(fragments, name=self.fragment_names)
        return self._frame(t, points - self.split.points, {"velocity": velocity}, {}, table, broken_at)

    def _frame(
        self,
        t: float,
        displacement: Values,
        point_fields: Arrays,
        cell_fields: Arrays,
        table: FragmentTable,
        broken_at: Values | None,
    ) -> SurfaceFrame:
        """Frame with the fields that all bodies have, further ones of the points and of the cells (C, ...)."""
        built = self.split
        triangles, segments, cell, element_fields = self._elements()
        element_fields["age"] = self._crack_age(t, broken_at)
        element_fields |= {name: values[cell] for name, values in cell_fields.items()}
        point_fields = {"displacement": displacement, **point_fields, "piece": self._name_of_point.astype(np.int32)}
        if self._compressor is None:
            self._compressor = GridCompressor(self.numbering, triangles, segments)
        return SurfaceFrame(
            t, built.points + displacement, triangles, segments, point_fields, element_fields, self.skeleton.origins,
            table, self.numbering, self._compressor,
        )  # fmt: skip

    def _point_displacement(self, u: Values, corrections: Sequence[PointCorrection]) -> Values:
        """Displacements (n, d) of the points, m (collective)."""
        built = self.split
        if not corrections:
            return built.parents.displacement(u, self._rotations(u))
        from ...mesh.split_surface.drawn_surface import DrawnSurface, SharedPoints, gradients_of_copies

        if self._corrected is None:
            shared = SharedPoints(self.part, built, self.numbering)
            self._corrected = shared, gradients_of_copies(self.part, self._pattern, built)
        surface = DrawnSurface.at_displacement(self.part, self._pattern, built, self.numbering, *self._corrected, u)
        points = surface.placed_points()
        for correct in corrections:
            points = correct(points, surface)
        return points.rest - built.points

    def _elements(self) -> tuple[Ints, Ints, Ints, Arrays]:
        """Triangles, segments, the cell behind each element, and the fields that do not depend on the motion."""
        built, flat = self.split, self.skeleton.dim == 2
        triangles, segments = (built.fill, built.elements) if flat else (built.elements, built.elements[:0, :2])
        cell = np.concatenate([built.fill_cell, built.cell])
        origin = np.concatenate([np.full(len(built.fill), BODY), built.origin])
        first_point = np.concatenate([built.fill[:, 0], built.elements[:, 0]])
        is_single_node = self.fragment_nodes[built.point_fragment] == 1
        fixed = {
            "piece": self._name_of_point[first_point], "origin": origin, "cell": self._input_cells(cell),
            "dust": is_single_node[first_point],
        }  # fmt: skip
        return triangles, segments, cell, {name: values.astype(np.int32) for name, values in fixed.items()}

    def _input_cells(self, cells: Ints) -> Ints:
        """Numbers (n,) in the input mesh of cells (n,)."""
        return self.part.cell_numbers[cells]

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
        """Raise NotConverged if a nodal displacement or velocity (N, d) exceeds `MAX_COORDINATE` (collective)."""
        part = self.part
        exceeding = [~np.all(np.abs(values) <= MAX_COORDINATE, axis=1) for values in (u, v)]
        counts = total(part, np.array([np.count_nonzero(lost & self._is_owned) for lost in exceeding]))
        for values, quantity, lost, count in zip((u, v), ("displacement", "velocity"), exceeding, counts, strict=True):
            if not count:
                continue
            # ranks that have the lowest node may have other cells at it
            rows = []
            for node in np.flatnonzero(lost)[:1]:
                cell = part.cell_numbers[np.argmax(np.any(self.skeleton.cells == node, axis=1))]
                name = self.fragment_names[self.split.node_fragment[node]]
                rows.append((int(part.node_numbers[node]), int(cell), int(name), str(values[node])))
            node, cell, name, value = min(row for rows_of_rank in allgather(part.comm, rows) for row in rows_of_rank)
            raise NotConverged(
                f"the surface at t = {t:g} s was not written: node {node} of piece {name} (cell {cell}) has the "
                f"{quantity} {value}; {count} nodes are not numbers below {MAX_COORDINATE:.0e}; "
                "choose a smaller time.step"
            )
