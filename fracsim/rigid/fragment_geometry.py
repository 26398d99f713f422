"""Mass properties and collision shapes of fragments, from the split surface of their mesh."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from ..mesh.split_surface.closed_surface import SplitSurface, build_split_surface
from ..mesh.split_surface.entity_numbering import EntityNumbering
from ..mesh.split_surface.polyhedron_moments import PolyhedronMoments, moments
from ..meshes.data import MeshData
from .convex_decomposition import Polyhedron, convex_parts, hull_corners, shell_convex_parts
from .core_contact import CoreContact, CoreGeometry
from .instance_placement import InstancePoses
from .obstacles import COLLISION_SHAPES, Part
from .round_shape import RoundShape
from .shell_contact import ShellSurface

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Patterns = npt.NDArray[np.uint8]
# Key of the surface, convex parts, outermost points.
_CollisionShape = tuple[int, list[Part], Values]


@dataclass(frozen=True)
class FragmentShapes:
    """Shapes of n fragments, which are named by their lowest node.

    Attributes:
        names: (n,) lowest nodes.
        moments: volume, centre of mass and second moments of each.
        node_fragment: (N,).
        convex_parts: of each, corners (m, 3) or a shape, relative to its centre, in the axes of the mesh, m. Unbroken
            instances share theirs.
        rotation: (n, 3, 3) from these axes to those of the body at rest.
        hull_points: outermost points (k, 3) of each, likewise.
        shells: surfaces of those whose convex parts are the prisms of an unbroken shell, likewise; None for others.
        core_contact: None if nothing has broken.
    """

    names: Ints
    moments: PolyhedronMoments
    node_fragment: Ints
    convex_parts: list[list[Part]]
    rotation: Values
    hull_points: list[Values]
    shells: list[ShellSurface | None]
    core_contact: CoreContact | None = None


@dataclass(frozen=True)
class _InstanceShapes:
    """Shapes of the fragments of one instance, in the axes of the mesh, with its nodes at `points` (N, 3), m.

    Nodes are numbered from 0. The other attributes are those of FragmentShapes.
    """

    points: Values
    pattern: Patterns
    names: Ints
    moments: PolyhedronMoments
    node_fragment: Ints
    convex_parts: list[list[Part]]
    hull_points: list[Values]
    shell: ShellSurface | None
    core: CoreGeometry


class FragmentGeometry:
    """Shapes of the fragments of all instances of a mesh (one rank); unchanged ones are not computed again.

    Attributes:
        mean_edge: of the mesh, m.
    """

    def __init__(
        self, mesh: MeshData, poses: InstancePoses | None = None, round_shape: RoundShape | None = None,
        max_prisms: float = np.inf,
    ) -> None:  # fmt: skip
        """Compute the shape of the unbroken mesh.

        Args:
            mesh: of one instance.
            poses: of the instances at rest; None: one, as the mesh is.
            round_shape: that the unbroken mesh stands for; None: it collides as a union of convex parts.
            max_prisms: triangles of all shells up to which they touch as such; with more they are convex parts.
        """
        self._max_prisms = max_prisms
        self._round_shape = round_shape
        self.numbering, self.poses = EntityNumbering(mesh), poses or InstancePoses.identity(1)
        self._shell = mesh.shell
        edges = mesh.points[self.numbering.edges]
        self.mean_edge = float(np.linalg.norm(np.diff(edges, axis=1), axis=2).mean())
        # Collision shapes of each instance by lowest node. They are kept only if all digits of the surface are the
        # same: cells that fragments share change as neighbours break, and a restart must find the same shapes.
        self._collision_shapes: dict[int, dict[int, _CollisionShape]] = {}
        self._points_at_rest = mesh.points
        self._unbroken = self._make_shapes(np.zeros(len(mesh.cells), np.uint8), None, 0, mesh.points)
        self._placed = [self._place(number, self._unbroken) for number in range(len(self.poses))]
        self._changed: dict[int, _InstanceShapes] = {}

    def update_shapes(
        self, damage: Mapping[int, tuple[Patterns, Values | None]], points: Mapping[int, Values] | None = None
    ) -> FragmentShapes:
        """Return the shapes of all fragments.

        Args:
            damage: by number of the instance, patterns (C,) of broken edges and cut positions (E,) of edges. Other
                instances are unbroken.
            points: by number of the instance, positions (N, 3) of its nodes after plastic flow, m.
        """
        points, unbroken = points or {}, (self._unbroken.pattern, None)
        for number in sorted({*damage, *points}):
            (pattern, cut), x = damage.get(number, unbroken), points.get(number, self._unbroken.points)
            shapes = self._changed.get(number, self._unbroken)
            moved = x is not shapes.points
            if moved:
                self._collision_shapes.pop(number, None)
            if moved or not np.array_equal(shapes.pattern, pattern):
                self._changed[number] = shapes = self._make_shapes(pattern.copy(), cut, number, x)
                self._placed[number] = self._place(number, shapes)
        return self._join_instances()

    def _join_instances(self) -> FragmentShapes:
        """Return the shapes of all instances one after another."""
        placed = self._placed
        first = np.cumsum([0, *(len(shapes.names) for shapes in placed)])
        total = _join_moments([shapes.moments for shapes in placed])
        fragment = np.concatenate([shapes.node_fragment + start for shapes, start in zip(placed, first, strict=False)])
        parts = [part for shapes in placed for part in shapes.convex_parts]
        hull_points = [points for shapes in placed for points in shapes.hull_points]
        shells = [shell for shapes in placed for shell in shapes.shells]
        names = np.concatenate([shapes.names for shapes in placed])
        rotation = np.concatenate([shapes.rotation for shapes in placed])
        cores = self._make_core_contact(rotation)
        return FragmentShapes(names, total, fragment, parts, rotation, hull_points, shells, cores)

    def _make_core_contact(self, rotation: Values) -> CoreContact | None:
        """Return the core contact of all fragments with rotations (n, 3, 3); None if there are no cores."""
        instances = [self._changed.get(number, self._unbroken) for number in range(len(self.poses))]
        if not any(len(shapes.core.faces) for shapes in instances):
            return None
        centre = np.concatenate([shapes.moments.centre for shapes in instances])
        counts = [len(shapes.names) for shapes in instances]
        return CoreContact([shapes.core for shapes in instances], counts, centre, rotation, self.mean_edge)

    def _make_shapes(self, pattern: Patterns, cut: Values | None, number: int, points: Values) -> _InstanceShapes:
        """Return the shapes of an instance with patterns (C,) and nodes at `points` (N, 3)."""
        surface = build_split_surface(self.numbering.with_points(points), pattern, cut)
        fragment = surface.point_fragment[surface.elements[:, 0]]
        body_moments = moments(surface.points, surface.elements, fragment, surface.fragment_count)
        names = np.unique(surface.node_fragment, return_index=True)[1]
        solids = _fragment_solids(surface, fragment)
        before = self._collision_shapes.get(number, {})
        shapes = [before.get(name) for name in map(int, names)]
        new = [k for k, shape in enumerate(shapes) if shape is None or shape[0] != solids[k].content_key]
        round_shape = self._round_shape_of(surface, points)
        if round_shape is not None:
            shapes, new = [(solids[0].content_key, round_shape.collision_parts, round_shape.plane_corners)], []
            body_moments = round_shape.moments(body_moments.volume)
        shell = self._shell_surface(surface, solids, body_moments.centre[0])
        if shell is not None:
            outer = hull_corners(np.concatenate(shell.prisms))
            shapes, new = [(solids[0].content_key, [*shell.prisms], outer)], []
        parts_of_new = self._convex_parts(surface, fragment, solids, np.array(new, np.int64))
        for k, parts in zip(new, parts_of_new, strict=True):
            centre = body_moments.centre[k]
            extreme = hull_corners(solids[k].points if self._uses_clusters(surface) else np.concatenate(parts))
            shapes[k] = solids[k].content_key, [corners - centre for corners in parts], extreme - centre
        result = [shape for shape in shapes if shape is not None]
        self._collision_shapes[number] = dict(zip(map(int, names), result, strict=True))
        has_cores = surface.fragment_count > 1 and not self._uses_clusters(surface)
        core = CoreGeometry.from_split_surface(surface, self.numbering) if has_cores else CoreGeometry.empty()
        parts_of_all, hull_points = [shape[1] for shape in result], [shape[2] for shape in result]
        return _InstanceShapes(
            points, pattern, names, body_moments, surface.node_fragment, parts_of_all, hull_points, shell, core,
        )  # fmt: skip

    def _round_shape_of(self, surface: SplitSurface, points: Values) -> RoundShape | None:
        """Return the round shape of an instance with nodes at `points` (N, 3), m; None if it is broken or dented."""
        is_intact = surface.fragment_count == 1 and points is self._points_at_rest
        return self._round_shape if is_intact else None

    def _shell_surface(
        self, surface: SplitSurface, solids: list[Polyhedron], centre: Values
    ) -> ShellSurface | None:  # fmt: skip
        """Return the surface of an unbroken shell relative to its centre (3,), m; None of others and of convex ones.

        The hull of a closed shell that is convex has the triangles of its outer side.
        """
        if self._shell is None or surface.fragment_count > 1:
            return None
        if len(self.poses) * len(self._shell.triangles) > self._max_prisms:
            return None
        shell, hull = self._shell, solids[0].without_cavities.convex_hull
        if hull.excess_volume <= COLLISION_SHAPES.max_shell_deviation * shell.thickness * hull.area:
            return None
        lower, upper = (self._points_at_rest - centre).reshape(2, -1, 3)
        prisms = [np.concatenate([lower[nodes], upper[nodes]]) for nodes in shell.triangles]
        return ShellSurface((lower + upper) / 2, shell.triangles, shell.thickness, prisms)

    def _convex_parts(
        self, surface: SplitSurface, fragment: Ints, solids: list[Polyhedron], chosen: Ints
    ) -> list[list[Values]]:
        """Return the convex parts of the fragments `chosen` (k,); `fragment`: (m,) of the surface elements."""
        if not self._uses_clusters(surface):
            return [convex_parts(solids[number].without_cavities, self.mean_edge) for number in chosen]
        order = np.full(surface.fragment_count, -1)
        order[chosen] = np.arange(len(chosen))
        of_chosen = order[fragment]
        assert self._shell is not None
        rows, thickness = np.flatnonzero(of_chosen >= 0), self._shell.thickness
        return shell_convex_parts(
            surface.points, surface.elements[rows], of_chosen[rows], len(chosen), thickness, self.mean_edge
        )

    def _uses_clusters(self, surface: SplitSurface) -> bool:
        """Return whether parts are clusters of triangles: those of broken shells.

        An unbroken shell may be closed, and its parts serve all instances.
        """
        return self._shell is not None and surface.fragment_count > 1

    def _place(self, number: int, shapes: _InstanceShapes) -> FragmentShapes:
        """Return the shapes of an instance at its pose at rest."""
        rotation, position = self.poses.rotation[number], self.poses.position[number]
        placed = _place_moments(shapes.moments, rotation, position)
        names = shapes.names + number * len(shapes.node_fragment)
        rotations = np.tile(rotation, (len(shapes.names), 1, 1))
        return FragmentShapes(
            names, placed, shapes.node_fragment, shapes.convex_parts, rotations, shapes.hull_points,
            [shapes.shell] * len(names),
        )  # fmt: skip


def _place_moments(local: PolyhedronMoments, rotation: Values, position: Values) -> PolyhedronMoments:
    """Return the moments of bodies that are rotated (3, 3) and then displaced (3,), m."""
    return PolyhedronMoments(local.volume, local.centre @ rotation.T + position, rotation @ local.second @ rotation.T)


def _join_moments(moments_of_all: list[PolyhedronMoments]) -> PolyhedronMoments:
    """Return the moments of several sets of bodies one after another."""
    columns = zip(*(vars(of_set).values() for of_set in moments_of_all), strict=True)
    return PolyhedronMoments(*(np.concatenate(values) for values in columns))


def _fragment_solids(surface: SplitSurface, fragment: Ints) -> list[Polyhedron]:
    """Return the solids within a split surface, whose elements belong to fragments (m,)."""
    order = np.argsort(fragment, kind="stable")
    ends = np.cumsum(np.bincount(fragment, minlength=surface.fragment_count))[:-1]
    return [
        Polyhedron.from_triangles(surface.points, elements) for elements in np.split(surface.elements[order], ends)
    ]  # fmt: skip
