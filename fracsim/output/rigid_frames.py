"""Frames of rigid bodies: the split surface of all instances of a mesh, in the poses of the fragments.

Only the surface of an instance whose edges broke is built again. The frames are surface.pvd and pieces.csv, with the
rotation of each fragment.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ..contact.obstacle import RigidObstacle
from ..contact.pose import PosedShape
from ..contact.rigid_obstacles import ObstacleTessellations
from ..mesh.split_surface.closed_surface import SplitSurface, build_split_surface
from ..mesh.split_surface.entity_numbering import EntityNumbering
from ..mesh.split_surface.mesh_part import WholeMesh
from ..mesh.split_surface.surface_motion import PointParents
from ..mesh.split_surface.surface_numbering import number_whole_surface
from ..meshes.data import MeshData
from ..meshes.topology import signed_measures
from ..rigid.bodies import Bodies
from ..rigid.instance_placement import InstancePoses
from .surface.body_surface import BodySurface
from .surface.fragment_table import FragmentNames, FragmentTable, group_sums
from .surface.vtk_files import SurfaceFiles

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Patterns = npt.NDArray[np.integer]
# time at which an intact edge breaks
NEVER_BROKEN = np.inf


class RigidFrames:
    """Writer of the frames of rigid bodies (one rank).

    Attributes:
        files: surface.pvd and pieces.csv.
        surface: surface of all instances, as of the last frame.
        broken_at: time (E,) at which each edge broke, s; infinite for intact edges.
    """

    def __init__(
        self,
        folder: Path,
        mesh: MeshData,
        poses: InstancePoses,
        density: float,
        obstacles: Sequence[RigidObstacle],
        resume_at: float | None = None,
        *,
        precision: str,
    ) -> None:
        """Open the files.

        Args:
            folder: output folder.
            mesh: mesh of one instance.
            poses: reference poses of the instances.
            density: mass density, kg/m^3.
            obstacles: obstacles to draw.
            resume_at: keep the frames up to this time, s; None: a new run.
            precision: of points and fields, "single" or "double".

        Raises:
            OSError: the files cannot be written.
        """
        self.files = SurfaceFiles(folder, 3, resume_at, turning=True, precision=precision)
        self.surface = InstanceSurface(mesh, poses, density)
        self.broken_at: Values = np.full(self.surface.edge_count, NEVER_BROKEN)
        points = self.surface.split.points
        self._drawings = ObstacleTessellations(obstacles, points.min(axis=0), points.max(axis=0))

    def resume(self, broken_at: Values) -> None:
        """Continue a run; `broken_at` (E,) in s restores the names of the fragments."""
        self.broken_at = broken_at
        self.surface.replay_fragment_names(broken_at, self.files.times)

    def record_breaks(self, pattern: npt.NDArray[np.uint8], t: float) -> None:
        """Record the edges that broke in the step to time t in s, from the edge patterns (C,) of the cells."""
        broken = self.surface.broken_edges(pattern)
        self.broken_at[broken & (self.broken_at == NEVER_BROKEN)] = t

    def write_frame(
        self,
        t: float,
        bodies: Bodies,
        pattern: npt.NDArray[np.uint8],
        cut: Values,
        dented: Mapping[int, Values],
        obstacles: Sequence[PosedShape],
    ) -> None:
        """Write a frame, if there is none yet at this time.

        Args:
            t: time, s.
            bodies: rigid bodies; the fragments come first.
            pattern: edge patterns (C,) of the cells.
            cut: positions (E,) of the cuts of broken edges.
            dented: instance -> its reference nodes (N, 3) after plastic denting, m.
            obstacles: obstacles in their present poses.

        Raises:
            OSError: the files cannot be written.
        """
        if t in self.files.times:
            return
        surface = self.surface
        surface.update(pattern, cut)
        surface.set_rest_points(dented)
        built = surface.split
        body_of_point, bodies = built.point_fragment, bodies.select(slice(built.fragment_count))
        points = bodies.to_current(built.points, body_of_point)
        velocity = bodies.velocity_at(points, body_of_point)
        nodes = np.bincount(built.node_fragment, minlength=built.fragment_count)
        rotation = np.asarray(Rotation.from_matrix(bodies.rotation).as_rotvec())
        table = FragmentTable(
            surface.fragment_names, nodes, bodies.mass, surface.volume, bodies.position, bodies.velocity, bodies.spin,
            rotation,
        )  # fmt: skip
        broken_at = np.where(self.broken_at == NEVER_BROKEN, np.nan, self.broken_at)
        frame = surface.make_rigid_frame(t, points, velocity, table, broken_at)
        self.files.write_frame(frame, self._drawings(obstacles))


class InstanceSurface(BodySurface):
    """Split surface of all instances of one mesh; see `BodySurface`.

    Nodes, cells, edges and fragments are numbered over all instances.

    Attributes:
        skeleton: edges, facets and boundary of one instance.
    """

    def __init__(self, mesh: MeshData, poses: InstancePoses, density: float) -> None:
        """Build the surface of the intact instances.

        Args:
            mesh: mesh of one instance.
            poses: reference poses of the instances.
            density: mass density, kg/m^3.
        """
        self.part = WholeMesh(EntityNumbering(mesh))
        self.skeleton, self._poses, self._names, self.build_count = self.part.skeleton, poses, FragmentNames(), 0
        count = len(poses)
        share = np.repeat(density * signed_measures(mesh.points, mesh.cells) / (mesh.dim + 1), mesh.dim + 1)
        self.mass = np.tile(group_sums(mesh.cells.ravel(), share, len(mesh.points)), count)
        self._pattern: Patterns = np.zeros(count * len(mesh.cells), np.uint8)
        self._instances = count * [build_split_surface(self.skeleton, self._pattern[: len(mesh.cells)])]
        # patterns of the surfaces in _instances
        self._built_patterns = self._pattern.reshape(count, -1).copy()
        self._dented: dict[int, Values] = {}
        self._build(None)

    def set_rest_points(self, points: Mapping[int, Values]) -> None:
        """Set the reference nodes (N, 3) of dented instances in m; the others keep those of the mesh."""
        changed = [number for number, nodes in points.items() if nodes is not self._dented.get(number)]
        for number in changed:
            self._dented[number] = points[number]
            self._instances[number] = build_split_surface(
                self.skeleton.with_points(points[number]), self._built_patterns[number]
            )
        if changed:
            self._join()

    @property
    def edge_count(self) -> int:
        """Number of edges of all instances."""
        return len(self._poses) * len(self.skeleton.edges)

    def broken_edges(self, pattern: Patterns) -> npt.NDArray[np.bool_]:
        """Broken edges (E,), from the edge patterns (C,) of the cells."""
        broken = np.zeros((len(self._poses), len(self.skeleton.edges)), bool)
        patterns = pattern.reshape(len(self._poses), -1)
        for number in np.flatnonzero(patterns.any(axis=1)):
            broken[number] = self.skeleton.broken_edges(patterns[number])
        return broken.reshape(-1)

    def replay_fragment_names(self, broken_at: Values, times: Iterable[float]) -> None:
        """See `BodySurface.replay_fragment_names`."""
        for t in times:
            broken = (broken_at <= t * (1 + 1e-12)).reshape(len(self._poses), -1)
            components = [self.skeleton.find_fragments(edges) for edges in broken]
            first = np.cumsum([0, *(count for count, _ in components)])
            fragment = np.concatenate([of_node + start for (_, of_node), start in zip(components, first, strict=False)])
            self._names.update(int(first[-1]), fragment, self.mass)

    def _build(self, cut: Values | None) -> None:
        pattern = self._pattern.reshape(len(self._poses), -1)
        cuts = None if cut is None else cut.reshape(len(self._poses), -1)
        for number in np.flatnonzero((pattern != self._built_patterns).any(axis=1)):
            self._instances[number] = build_split_surface(
                self.skeleton, pattern[number], None if cuts is None else cuts[number]
            )
            self._built_patterns[number] = pattern[number]
        self._join()

    def _join(self) -> None:
        """Join the surfaces of the instances."""
        self.split = built = join_surfaces(self._instances, self.skeleton, self._poses)
        numbering = number_whole_surface(len(built.points), len(built.elements), 0)
        self._use_surface(numbering, np.ones(len(built.node_fragment), bool))

    def _input_cells(self, cells: Ints) -> Ints:
        """Cells are numbered over all instances."""
        return cells


def join_surfaces(instances: Sequence[SplitSurface], skeleton: EntityNumbering, poses: InstancePoses) -> SplitSurface:
    """One surface of all instances in their reference poses.

    Args:
        instances: surface of each instance, in the coordinates of the mesh.
        skeleton: edges, facets and boundary of one instance.
        poses: reference poses of the instances.
    """

    def renumbered(name: str, step: int | Sequence[int]) -> Ints:
        """Attribute of all instances, each shifted by the sizes `step` of those before; negative numbers stay."""
        first = np.cumsum([0, *(len(instances) * [step] if isinstance(step, int) else step)])
        arrays = [getattr(instance, name) for instance in instances]
        return np.concatenate(
            [np.where(rows >= 0, rows + start, rows) for rows, start in zip(arrays, first, strict=False)]
        )

    points, nodes = [len(instance.points) for instance in instances], len(skeleton.points)
    posed = list(zip(instances, poses.rotation, poses.position, strict=True))
    x = [instance.points @ turn.T + position for instance, turn, position in posed]
    parents = [instance.parents.parents + nodes * number for number, instance in enumerate(instances)]
    starts = np.cumsum([0, *(len(rows) for rows in parents)])
    start = [instance.parents.start[:-1] + first for instance, first in zip(instances, starts, strict=False)]
    arm = [instance.parents.arm @ turn.T for instance, turn, _ in posed]
    follow = PointParents(np.append(np.concatenate(start), starts[-1]), np.concatenate(parents), np.concatenate(arm),
                    nodes * len(instances))  # fmt: skip
    fragments = [instance.fragment_count for instance in instances]
    return SplitSurface(
        np.concatenate(x), follow, renumbered("elements", points), renumbered("cell", len(skeleton.cells)),
        renumbered("edge", len(skeleton.edges)), np.concatenate([instance.origin for instance in instances]),
        np.empty((0, 3), np.int64), np.empty(0, np.int64), np.concatenate([instance.broken for instance in instances]),
        sum(fragments), renumbered("node_fragment", fragments),
    )  # fmt: skip
