"""Frames of rigid bodies: surface.pvd with the poses of the pieces applied, and pieces.csv with how they are turned."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

from ..contact.drawing import ObstacleTessellations
from ..contact.obstacle import RigidObstacle
from ..contact.pose import PosedShape
from ..meshes.data import MeshData
from ..rigid.bodies import Bodies
from ..rigid.instance_placement import Poses
from .surface.fragment_table import Fragments
from .surface.instance_surface import SurfaceOfCopies
from .surface.vtk_files import SurfaceFiles

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
NEVER = np.inf  # when an intact edge breaks


class RigidFrames:
    """Writes frames, and knows when edges broke (one rank).

    Attributes:
        surface: of the mesh as it was broken at the last frame.    broken_at: (E,) s when each edge broke.
    """

    def __init__(
        self,
        folder: Path,
        mesh: MeshData,
        poses: Poses,
        density: float,
        obstacles: Sequence[RigidObstacle],
        resume_at: float | None = None,
    ) -> None:
        """Of copies of a mesh; `resume_at`: keep the frames up to this time, s. Raises OSError."""
        self.files = SurfaceFiles(folder, 3, resume_at, turning=True)
        self.surface = SurfaceOfCopies(mesh, poses, density)
        self.broken_at: Values = np.full(self.surface.edge_count, NEVER)
        points = self.surface.split.points
        self._drawings = ObstacleTessellations(obstacles, points.min(axis=0), points.max(axis=0))

    def resume(self, broken_at: Values) -> None:
        """Edges broke at these times (E,), s: pieces have the names that they had."""
        self.broken_at = broken_at
        self.surface.replay(broken_at, self.files.times)

    def note(self, pattern: npt.NDArray[np.uint8], t: float) -> None:
        """Edges may have broken in the step that ended at t (s), as the patterns (C,) say."""
        broken = self.surface.broken_edges(pattern)
        self.broken_at[broken & (self.broken_at == NEVER)] = t

    def write(
        self,
        t: float,
        bodies: Bodies,
        pattern: npt.NDArray[np.uint8],
        cut: Values,
        dented: Mapping[int, Values],
        obstacles: Sequence[PosedShape],
    ) -> None:
        """A frame at time t (s), where there is none yet, of bodies that are pieces first; `cut`: (E,) where edges are
        cut; `dented`: where nodes (N, 3) of copies are at rest, m; `obstacles`: where they are. Raises OSError."""
        if t in self.files.times:
            return
        surface = self.surface
        surface.update(pattern, cut)
        surface.reshape(dented)
        made = surface.split
        of, bodies = made.point_fragment, bodies.part(slice(made.fragment_count))
        points = bodies.to_space(made.points, of)
        velocity = bodies.velocity_at(points, of)
        nodes = np.bincount(made.node_fragment, minlength=made.fragment_count)
        turn = np.asarray(Rotation.from_matrix(bodies.turn).as_rotvec())
        volume = surface.volume
        pieces = Fragments(
            surface.names, nodes, bodies.mass, volume, bodies.place, bodies.velocity, bodies.spin, turn
        )  # fmt: skip
        age = np.where(self.broken_at == NEVER, np.nan, self.broken_at)
        frame = surface.placed(t, points, velocity, pieces, age)
        self.files.write(frame, self._drawings(obstacles))
