"""Convex parts of pieces of shells."""

from __future__ import annotations

import numpy as np
from scipy.spatial import ConvexHull

from fracsim.meshes.builders.ornament import Ornament
from fracsim.rigid.convex_decomposition import extreme_points, shell_convex_parts
from fracsim.rigid.fragment_geometry import FragmentGeometry

RADIUS, THICKNESS, H = 0.04, 0.001, 0.005


def test_a_ball_broken_in_three_has_parts_near_its_wall() -> None:
    """Each lies between the ball and a chord of a tenth of its length or so, holds its points, and is of one piece."""
    mesh = Ornament(radius=RADIUS, neck=0.0, thickness=THICKNESS, h=H).build()
    outside = np.concatenate([mesh.facet_groups[name] for name in ("inner", "outer")])
    piece = np.digitize(mesh.points[outside].mean(axis=1)[:, 2], [-0.03, 0.02])
    parts = shell_convex_parts(mesh.points, outside, piece, 3, THICKNESS, H)
    assert len(parts[0]) < len(parts[1]) <= 32
    for number, each in enumerate(parts):
        points = mesh.points[np.unique(outside[piece == number])]
        length = float(np.linalg.norm(np.ptp(points, axis=0)))
        hulls = [ConvexHull(corners) for corners in each]
        beyond = np.array([(points @ hull.equations[:, :3].T + hull.equations[:, 3]).max(axis=1) for hull in hulls])
        assert beyond.min(axis=0).max() < 0.02 * length
        inner = min(hull.equations[:, 3].max() for hull in hulls)  # no face is nearer to the middle of the ball
        assert inner > RADIUS - THICKNESS - 0.15 * length


def test_a_flat_piece_is_one_part_however_thin() -> None:
    """Two triangles on either side."""
    corners = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]])
    points = np.concatenate([corners, corners + np.array([0.0, 0.0, 1e-3])])
    triangles = np.array([[0, 2, 1], [0, 3, 2], [4, 5, 6], [4, 6, 7]])
    ((part,),) = shell_convex_parts(points, triangles, np.zeros(4, np.int64), 1, 1e-3, 0.1)
    assert np.allclose(np.ptp(part, axis=0), [1.0, 1.0, 0.011], atol=0.001)


def test_the_farthest_of_a_group_stay() -> None:
    """Corners of a cube and of a smaller one, points within neither."""
    cube = np.stack(np.meshgrid(*3 * [[-1.0, 1.0]]), axis=-1).reshape(-1, 3)
    within = np.random.default_rng(2).uniform(-0.9, 0.9, (50, 3))
    places = np.concatenate([cube, within, 0.1 * cube, 0.1 * within])
    kept = extreme_points(places, np.repeat([3, 7], 58))
    assert np.array_equal(np.flatnonzero(kept), [*range(8), *range(58, 66)])


def test_copies_that_are_whole_share_their_parts() -> None:
    """The arrays themselves: the engine makes them once."""
    from fracsim.rigid.instance_placement import InstancePoses

    shapes = FragmentGeometry(Ornament(h=0.02).build(), InstancePoses.identity(3)).update_shapes({})
    assert shapes.convex_parts[0][0] is shapes.convex_parts[2][0]
