"""Free obstacles that meet one another: derivatives by differences, momentum, no way through, piles."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fracsim.contact.laws import Barrier
from fracsim.contact.node_contact import mixed_pose_hessian
from fracsim.contact.obstacle import RigidObstacle
from fracsim.contact.obstacle_pairs import ObstaclePair
from fracsim.contact.pose import Pose
from fracsim.contact.rigid_pose import FreeRigidObstacles
from fracsim.contact.shapes import Capsule, RoundedBox, RoundedCylinder, Shape, Sphere
from support.scenes import Scene, Walk, each_step, make_scene, march

Values = npt.NDArray[np.float64]
SCHEMES = ("backward-euler", "newmark", "generalized-alpha")
G = 10.0

BESIDE: list[tuple[Shape, Shape]] = [
    (Sphere(0.3), RoundedBox((0.6, 0.4, 0.5), rounding=0.05)),
    (RoundedCylinder(0.2, 0.5, rounding=0.05), Capsule(0.1, 0.5, axis=(1.0, 0.0, 0.0))),
    (RoundedBox((0.6, 0.4), rounding=0.05), RoundedBox((0.5, 0.3), rounding=0.05)),
]


@pytest.mark.parametrize("friction", (0.0, 0.4))
@pytest.mark.parametrize("both", BESIDE, ids=lambda both: "-".join(type(each).__name__ for each in both))
def test_mixed_derivatives_by_both_poses(both: tuple[Shape, Shape], friction: float) -> None:
    """Second derivative of the energy by an increment of one pose and of the other, by differences; with friction after
    a step in which one slid over the other."""
    d, turns = both[0].dim, 1 if both[0].dim == 2 else 3
    one, other = (RigidObstacle(*item, np.zeros(d), friction=friction) for item in zip("ab", both, strict=True))
    stop, barrier = ObstaclePair.between(one, other), Barrier(50.0, 0.2)
    here = Pose.at_point(np.array([0.05, 0.03, 1.0][3 - d :])).incremented(
        np.concatenate([np.zeros(d), 0.1 * np.ones(turns)])
    )
    there = Pose.at_point(np.zeros(d)).incremented(np.concatenate([np.zeros(d), np.linspace(-0.1, 0.1, turns)]))
    apart = min(gap.min() for gap in stop.gaps(here, there))
    here = here.incremented(np.eye(d + turns)[d - 1] * (0.05 - apart))
    slid = here.incremented(0.03 * np.eye(d + turns)[0])
    rub = stop.lag_friction(here, there, barrier, lambda points, normals: 0.1) if friction else None
    assert (rub is not None and len(rub.force) > 0) == (friction > 0)

    def energy(q: Values, p: Values) -> float:
        poses = slid.incremented(q), there.incremented(p)
        sides = stop.contact_forces(*poses, barrier, None)
        return sum(contact.potential for contact, _ in sides) + (0.0 if rub is None else rub.energy(poses))

    (own, x), (its, y) = stop.contact_forces(slid, there, barrier, None)
    found = mixed_pose_hessian(own, x, slid, there, exact=True) + mixed_pose_hessian(its, y, there, slid, exact=True).T
    if rub is not None:
        found = found + rub.derivatives((slid, there), exact=True)[2]
    steps, assembled = 1e-4 * np.eye(d + turns), np.zeros_like(found)
    for i, q in enumerate(steps):
        for j, p in enumerate(steps):
            assembled[i, j] = (energy(q, p) - energy(q, -p) - energy(-q, p) + energy(-q, -p)) / 4e-8
    assert energy(0 * steps[0], 0 * steps[0]) > 1e-4
    np.testing.assert_allclose(found, assembled, atol=2e-5 * np.abs(assembled).max())


def scene_of(*obstacles: dict[str, Any], dim: int = 2, **more: Any) -> tuple[Scene, Walk, FreeRigidObstacles]:
    """A block from 0 to 1 in x, up to 0.3, that is held below, and obstacles."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.3] if dim == 2 else [1.0, 1.0, 0.3], "h": 0.3},
        material={"energy": "neo-hookean", "young": 1e5, "poisson": 0.3, "density": 100.0},
        boundary=[{"on": "bottom", "fix": "xyz"[:dim]}], solver={"snes_rtol": 1e-9, "ksp_rtol": 1e-9},
        obstacle=list(obstacles), **more,
    )  # fmt: skip
    (term,) = [term for term in scene.balance.terms if isinstance(term, FreeRigidObstacles)]
    return scene, state, term


def gap(term: FreeRigidObstacles) -> float:
    """The least between free obstacles, m."""
    at = [each.motion.pose for each in term.free.values()]
    return min(
        float(g.min(initial=9.0))
        for pair in term.pairs.pairs
        for g in pair.pair.gaps(*(at[number] for number in pair.numbers))
    )


def linear(term: FreeRigidObstacles) -> Values:
    """(d,) momentum of the free obstacles, kg m/s."""
    return np.asarray(sum(each.motion.momentum[: term.dim] for each in term.free.values()))


def disk(name: str, x: float, y: float, **more: Any) -> dict[str, Any]:
    return {"name": name, "shape": "sphere", "radius": 0.1, "at": [x, y], "mass": 5.0} | more


@pytest.mark.parametrize("scheme", SCHEMES)
def test_two_disks_share_their_momentum(scheme: str) -> None:
    """Off centre, far from the body: none enters the other, momentum stays to round-off, energy does not grow, and
    they part; without friction none is turned."""
    scene, state, term = scene_of(
        disk("it", 3.0, 0.5, velocity=[1.0, 0.0]),
        disk("other", 3.3, 0.55),
        time={"scheme": scheme, "step": 0.01, "end": 0.3},
    )
    for report in each_step(scene, state):
        np.testing.assert_allclose(linear(term), [5.0, 0.0], atol=1e-12)
        assert gap(term) > 0 and report.kinetic + report.elastic <= 2.5 * (1 + 1e-9)
    first, second = (each.motion.momentum / 5.0 for each in term.free.values())
    n = np.array([np.sqrt(0.2**2 - 0.05**2), 0.05]) / 0.2  # where they met
    assert 0 < second[:2] @ n - first[:2] @ n <= n[0]
    assert second[0] > 0.4 and abs(second[1] / second[0] - n[1] / n[0]) < 0.1
    assert abs(first[2]) < 1e-9 and abs(second[2]) < 1e-9


@pytest.mark.parametrize("dim", (2, 3))
def test_fast_ones_do_not_pass_through_each_other(dim: int) -> None:
    """A plate and a small ball at 100 m/s that would cross it in a tenth of the step: it pushes the plate on."""
    tail = [0.5] * (dim - 2)
    ball = {"name": "ball", "shape": "sphere", "radius": 0.02, "at": [3.0, *tail, 0.5], "mass": 1.0,
            "velocity": [100.0, *[0.0] * (dim - 1)]}  # fmt: skip
    box = {"name": "box", "shape": "box", "size": [0.1, *[3.0] * (dim - 1)], "at": [3.3, *tail, 0.52], "mass": 10.0}
    scene, state, term = scene_of(ball, box, dim=dim, time={"scheme": "backward-euler", "step": 0.01, "end": 0.05})
    for _ in each_step(scene, state):
        np.testing.assert_allclose(linear(term), [100.0, *[0.0] * (dim - 1)], atol=1e-10)
        assert gap(term) > 0
    one, other = (each.motion.pose.centre[0] for each in term.free.values())
    assert one < other and term.free[1].motion.momentum[0] > 50


def test_a_pile_on_a_body_weighs_what_it_weighs() -> None:
    """A disk on a box on a damped body, guided: at rest the body carries both, and each bears what lies on it."""
    box = {"name": "box", "shape": "box", "size": [0.5, 0.1], "at": [0.5, 0.37], "mass": 8.0, "guide": "y"}
    scene, state, term = scene_of(
        box, disk("it", 0.5, 0.54, guide="y"), load={"gravity": [0.0, -G]}, damping={"stiffness": 0.02},
        time={"scheme": "backward-euler", "step": 0.05, "end": 0.8},
    )  # fmt: skip
    march(scene, state)
    told = dict(zip(scene.probes.columns, scene.probes(), strict=True))
    assert told["contact_box_y"] == pytest.approx(13.0 * G, rel=1e-3) and told["contact_it_y"] == 0.0
    wrenches = term.pairs.wrenches(term.posed)
    assert [wrenches[number][1] for number in (0, 1)] == pytest.approx([-5.0 * G, 5.0 * G], rel=1e-3)
    assert max(abs(told[f"velocity_{name}_y"]) for name in ("box", "it")) < 1e-3
