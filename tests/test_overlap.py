"""How deep shapes lie in one another, against closed forms and points strewn over the body."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from fracsim.contact.obstacle import overlap_depth
from fracsim.contact.pose import Pose, PosedShape
from fracsim.contact.shapes import HalfSpace, RoundedBox, Shape, Sphere
from fracsim.contact.triangle_mesh_shape import TriangleMeshShape
from support.shapes import ALL, BODIES
from test_mesh_obstacles import CORNERS, SIDES

Values = npt.NDArray[np.float64]


def at(shape: Shape, centre: list[float], turn: list[float] | None = None) -> PosedShape:
    d = len(centre)
    q = np.concatenate([centre, turn if turn is not None else np.zeros(1 if d == 2 else 3)])
    return PosedShape(shape, Pose.at_point(np.zeros(d)).incremented(q))


def test_depth_by_hand() -> None:
    """Ball and plane: r - z; two balls: r + r' - distance, also apart; a box on its edge: half a diagonal, less what
    the rounding r takes of it, (sqrt 2 - 1) r, less its height."""
    floor = at(HalfSpace((0.0, 0.0, 1.0)), [0.0, 0.0, 0.0])
    assert overlap_depth(at(Sphere(0.5), [3.0, 4.0, 0.2]), floor) == pytest.approx(0.3)
    assert overlap_depth(at(Sphere(0.5), [3.0, 4.0, 0.6]), floor) == pytest.approx(-0.1)
    for away in (0.9, 1.3):
        one, other = at(Sphere(0.5), [0.0, 0.0, 0.0]), at(Sphere(0.6), [0.0, 0.6 * away, 0.8 * away])
        assert overlap_depth(one, other) == pytest.approx(1.1 - away, abs=1e-5)
    tipped = at(RoundedBox((1.0, 1.0, 1.0), rounding=0.1), [0.0, 0.0, 0.6], [np.pi / 4, 0.0, 0.0])
    assert overlap_depth(tipped, floor) == pytest.approx(np.sqrt(0.5) - 0.1 * (np.sqrt(2) - 1) - 0.6, abs=1e-5)


@pytest.mark.parametrize("name", BODIES)
def test_no_point_of_a_body_lies_deeper(name: str) -> None:
    """20000 points in it, turned and put anywhere about each shape: none is deeper, and some is nearly as deep."""
    body, rng = BODIES[name], np.random.default_rng(3)
    others = [each for each in ALL.values() if each.dim == body.dim]
    X = rng.uniform(-1, 1, (60_000, body.dim))
    X = np.concatenate([X[body.distance(X) < 0][:20_000], body.tessellate()[0]])
    for other in others:
        here = at(body, rng.uniform(-0.8, 0.8, body.dim).tolist(), rng.normal(size=1 if body.dim == 2 else 3).tolist())
        there = at(other, [0.0] * body.dim)
        strewn = -there.distance(here.pose.points_to_space(X)).min()
        assert strewn - 1e-5 < overlap_depth(here, there) < strewn + 0.04


def test_overlaps_of_triangle_meshes() -> None:
    """A cube of triangles over a plane, and into another cube: by the depth of its lowest corners; none where apart."""
    cube = TriangleMeshShape(CORNERS, SIDES)
    floor = at(HalfSpace((0.0, 0.0, 1.0)), [0.0, 0.0, 0.0])
    for pair in ((at(cube, [0.2, 0.1, 0.4]), floor), (floor, at(cube, [0.2, 0.1, 0.4]))):
        assert overlap_depth(*pair) == pytest.approx(0.1)
    assert overlap_depth(at(cube, [0.0, 0.0, 0.6]), floor) == pytest.approx(-0.1)
    assert overlap_depth(at(cube, [0.3, 0.2, 0.9]), at(cube, [0.0, 0.0, 0.0])) == pytest.approx(0.1)
    assert overlap_depth(at(cube, [0.3, 0.2, 1.1]), at(cube, [0.0, 0.0, 0.0])) < 0
