"""Free obstacles that meet held and driven ones: derivatives by differences, bounces, pushes, no way through."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fracsim.contact.laws import Barrier, ObstacleLaw
from fracsim.contact.obstacle import FreeObstacle, RigidObstacle, overlap_depth
from fracsim.contact.obstacle_pairs import BarrierPair, ObstaclePairs
from fracsim.contact.pose import Pose, PosedShape
from fracsim.contact.rigid_pose import FreeRigidObstacles
from fracsim.contact.shapes import Capsule, HalfSpace, RoundedBox, RoundedCylinder, Shape, Sphere
from support.scenes import each_step, make_scene

Values = npt.NDArray[np.float64]
SCHEMES = ("backward-euler", "newmark", "generalized-alpha")

BESIDE: list[tuple[Shape, Shape]] = [
    (RoundedBox((0.6, 0.4, 0.5), rounding=0.05), HalfSpace((0.0, 0.0, 1.0))),
    (Sphere(0.3), RoundedBox((0.6, 0.4, 0.5), rounding=0.05)),
    (RoundedCylinder(0.2, 0.5, rounding=0.05), Sphere(0.3)),
    (RoundedCylinder(0.2, 0.5, rounding=0.05, axis=(0.0, 1.0, 0.3)), HalfSpace((0.0, 0.0, 1.0))),
    (Capsule(0.1, 0.5, axis=(1.0, 0.0, 0.0)), Capsule(0.1, 0.5, axis=(0.0, 1.0, 0.0))),
    (RoundedBox((0.6, 0.4), rounding=0.05), RoundedBox((0.5, 0.3), rounding=0.05)),
]


class AtRest:
    """Obstacles that begin a step without velocities."""

    def __init__(self, posed: list[PosedShape]) -> None:
        self.start_posed = posed

    def velocity(self, number: int, x: Values) -> Values:
        return 0 * x


def thing(shape: Shape) -> FreeObstacle:
    """A free obstacle of that shape, of 1 kg."""
    d, turns = shape.dim, 1 if shape.dim == 2 else 3
    return FreeObstacle(
        "it", shape, np.zeros(d), mass=1.0, inertia=shape.inertia(1.0), motion_basis=np.eye(d + turns),
        mass_centre=np.zeros(d), gravity=np.zeros(d), start_rate=np.zeros(d + turns),
    )  # fmt: skip


@pytest.mark.parametrize("friction", (0.0, 0.3))
@pytest.mark.parametrize("along", (False, True))
@pytest.mark.parametrize("both", BESIDE, ids=lambda both: "-".join(type(each).__name__ for each in both))
def test_derivatives_by_the_pose(both: tuple[Shape, Shape], along: bool, friction: float) -> None:
    """Of the energy of a body that nearly touches, by differences of the increment; `along`: of a step that began a
    little further away."""
    shape, other = both
    d, turns = shape.dim, 1 if shape.dim == 2 else 3
    there = PosedShape(other, Pose.at_point(np.zeros(d)))
    start = Pose.at_point(np.zeros(d)).incremented(
        np.concatenate([np.array([0.05, 0.03, 1.0][-d:]), np.linspace(0.3, 0.5, turns)])
    )
    gap = -overlap_depth(PosedShape(shape, start), there)
    down = -there.normal(start.centre[None])[0] if d == 3 else np.array([0.0, -1.0])
    here = start.incremented(np.concatenate([(gap - 0.02) * down, np.zeros(turns)]))
    body = thing(shape)
    obstacles = {0: body, 1: RigidObstacle("other", other, np.zeros(d), friction=friction)}
    law = ObstacleLaw(Barrier(50.0, 0.2), sticking_speed=1.0)
    stops = ObstaclePairs([BarrierPair((0, 1), obstacles, law)], free=[0])

    def placed(pose: Pose) -> list[PosedShape]:
        return [PosedShape(shape, pose), there]

    further = here.incremented(np.concatenate([-0.05 * down, 0.05 * np.ones(turns)]))
    stops.begin_step(AtRest(placed(further)), 0.1, time_averaged=along)
    found, h = stops.derivatives(placed(here), exact=True)[0][0], 1e-6
    steps = h * np.eye(d + turns)

    def potential(q: Values) -> float:
        return stops.energies(placed(here.incremented(q)))[1]

    assert stops.are_open(placed(here)) and found.energy > 1e-3
    slope = np.array([potential(e) - potential(-e) for e in steps]) / (2 * h)
    np.testing.assert_allclose(found.gradient, slope, atol=1e-6 * np.abs(slope).max())
    h, zero = 1e-4, np.zeros(d + turns)
    steps = h * np.eye(d + turns)
    for a in range(d + turns):
        curved = (potential(steps[a]) - 2 * potential(zero) + potential(-steps[a])) / h**2
        assert found.hessian[a, a] == pytest.approx(curved, rel=1e-3, abs=1e-3 * np.abs(found.hessian).max())
        for b in range(a):
            pair = [potential(s * steps[a] + t * steps[b]) for s, t in ((1, 1), (1, -1), (-1, 1), (-1, -1))]
            if a < d or d == 2:  # two turns do not commute
                mixed = (pair[0] - pair[1] - pair[2] + pair[3]) / (4 * h**2)
                assert found.hessian[a, b] == pytest.approx(mixed, abs=1e-3 * np.abs(found.hessian).max())


def thrown(
    obstacles: list[dict[str, Any]],
    scheme: str,
    step: float,
    end: float,
    dim: int = 2,
    gravity: Sequence[float] = (0.0, -10.0, 0.0),
    distance: float = 0.03,
) -> Iterator[dict[str, float]]:
    """Columns of history.csv after each step, with the energy of all less what was put in and lost, J. Nothing lies in
    another one, beside a body that is out of the way."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0] * dim, "h": 1.0}, boundary=[{"on": "bottom", "fix": "xyz"[:dim]}],
        material={"energy": "linear", "young": 1e5, "poisson": 0.0, "density": 1.0},
        load={"gravity": list(gravity[:dim])}, obstacle=obstacles,
        contact={"distance": distance, "stiffness": 3e3, "itself": False}, solver={"snes_rtol": 1e-9, "ksp_rtol": 1e-9},
        time={"scheme": scheme, "step": step, "end": end},
    )  # fmt: skip
    (contact,) = [term for term in scene.balance.terms if isinstance(term, FreeRigidObstacles)]
    for report in each_step(scene, state):
        placed = contact.posed_at(state.t)
        assert overlap_depth(placed[-1], placed[0]) < 0
        row = dict(zip(scene.probes.columns, scene.probes(), strict=True))
        yield row | {"time": state.t, "energy": report.kinetic + report.elastic + state.dissipated - state.work}


FLOOR = {"name": "floor", "shape": "plane", "at": [0.0, -1.0], "normal": [0.0, 1.0]}
BALL = {"name": "it", "shape": "sphere", "radius": 0.1, "at": [3.0, -0.8], "mass": 5.0}


@pytest.mark.parametrize(
    ("scheme", "returned"), [("backward-euler", 0.25), ("newmark", 0.8), ("generalized-alpha", 0.8)]
)
def test_a_weight_bounces_on_a_held_floor(scheme: str, returned: float) -> None:
    """Thrown down from 0.1 m above it, as if it had fallen 0.15 m: energy never rises, and it returns as high as the
    scheme lets it."""
    rows = list(thrown([FLOOR, BALL | {"velocity": [0.5, -1.0]}], scheme, 4e-3, 0.16))
    energy = [row["energy"] for row in rows]
    assert max(energy) < energy[0] + 1e-4
    assert rows[-1]["velocity_it_x"] == pytest.approx(0.5)
    assert rows[-1]["position_it_y"] > -0.87
    height = rows[-1]["position_it_y"] + 0.9 + rows[-1]["velocity_it_y"] ** 2 / 20
    assert returned < height / 0.15 < 1


@pytest.mark.parametrize("scheme", SCHEMES)
@pytest.mark.parametrize("speed", (3.0, 30.0))
def test_a_driven_wall_takes_a_weight_along(scheme: str, speed: float) -> None:
    """Also where it goes on by three times the gap in a step: the weight leaves it no slower than it comes, and no
    faster than twice that; what it has is the work of the wall, less what the scheme takes."""
    wall = {"name": "wall", "shape": "box", "size": [0.1, 1.0], "at": [1.95, 0.5], "velocity": [speed, 0.0]}
    rows = list(thrown([wall, BALL | {"at": [2.2, 0.5]}], scheme, 0.01, 0.06 if speed > 5 else 0.12))
    assert speed < rows[-1]["velocity_it_x"] < 2 * speed
    assert max(row["energy"] for row in rows) < rows[0]["energy"] + 1e-4


def test_a_box_falls_on_the_edge_of_another_in_3d() -> None:
    """Spinning, and thrown back: no way through, and it has less energy than before."""
    ledge = {"name": "ledge", "shape": "box", "size": [1.0, 0.3, 1.0], "at": [3.0, -1.0, 0.0]}
    box = {"name": "it", "shape": "box", "size": [0.3, 0.2, 0.25], "at": [3.45, -0.6, 0.1], "mass": 5.0,
           "spin": [1.0, 2.0, 3.0], "velocity": [0.0, -1.0, 0.0]}  # fmt: skip
    rows = list(thrown([ledge, box], "generalized-alpha", 0.01, 0.14, dim=3))
    energy = [row["energy"] for row in rows]
    assert max(energy) < energy[0] + 1e-3 and energy[-1] < energy[0] - 1
    assert max(row["velocity_it_y"] for row in rows) > 0.5


SLOPE, G = 0.3, 10.0  # rad, m/s^2


@pytest.mark.parametrize("ratio", (1.05, 0.95, 0.3))
def test_a_weight_rubs_on_a_held_floor(ratio: float) -> None:
    """Coulomb, with gravity aslant and mu a little above or below the tangent: it comes to rest, or slides with
    g (sin - mu cos)."""
    mu = ratio * np.tan(SLOPE)
    floor = FLOOR | {"at": [0.0, -1.0], "friction": mu}
    box = {"name": "it", "shape": "box", "size": [0.6, 0.2], "at": [3.0, -0.873], "mass": 5.0, "guide": "xy"}
    gravity = [G * np.sin(SLOPE), -G * np.cos(SLOPE)]
    rows = list(thrown([floor, box], "backward-euler", 5e-3, 0.6, gravity=gravity))
    late = [row for row in rows if row["time"] > 0.4]  # the weight has settled on its barrier
    rate = np.polyfit([row["time"] for row in late], [row["velocity_it_x"] for row in late], 1)[0]
    assert rate == pytest.approx(max(0.0, G * (np.sin(SLOPE) - mu * np.cos(SLOPE))), rel=0.02, abs=0.01)
    if ratio > 1:
        assert abs(rows[-1]["velocity_it_x"]) < 2e-3
    energy = [row["energy"] for row in late]
    assert np.ptp(energy) < 0.02 * 5.0 * G * (late[-1]["position_it_x"] - late[0]["position_it_x"]) + 1e-3


LOG = {"name": "it", "shape": "cylinder", "radius": 0.1, "length": 0.4, "axis": [0.0, 0.0, 1.0],
       "at": [3.0, -0.88, 0.0], "mass": 5.0}  # fmt: skip
TABLE: dict[str, dict[str, Any]] = {
    "plane": {"shape": "plane", "at": [0.0, -1.0, 0.0], "normal": [0.0, 1.0, 0.0]},
    "box": {"shape": "box", "size": [3.0, 0.2, 3.0], "at": [3.0, -1.1, 0.0]},
}


@pytest.mark.parametrize("table", TABLE)
@pytest.mark.parametrize("scheme", ("backward-euler", "generalized-alpha"))
def test_a_cylinder_spins_on_without_friction(scheme: str, table: str) -> None:
    """The normal meets its axis: no moment about it, at whatever angle the cylinder is."""
    log = LOG | {"velocity": [0.2, 0.0, 0.0], "spin": [0.0, 0.0, 5.0]}
    rows = list(thrown([TABLE[table] | {"name": "floor"}, log], scheme, 5e-3, 0.2, dim=3, gravity=(0.0, -10.0, 0.0)))
    np.testing.assert_allclose([row["spin_it_z"] for row in rows], 5.0, rtol=1e-9)
    assert max(row["energy"] for row in rows) < rows[0]["energy"] + 1e-6


def test_a_cylinder_rolls_down_a_slope() -> None:
    """With 2/3 g sin(theta), on the friction of a plane; the gap of the barrier is a thousandth of the radius."""
    gravity = [G * np.sin(SLOPE), -G * np.cos(SLOPE), 0.0]
    floor = TABLE["plane"] | {"name": "floor", "friction": 0.6}
    log = LOG | {"at": [3.0, -0.9, 0.0]}
    rows = list(thrown([floor, log], "generalized-alpha", 2e-3, 0.16, dim=3, gravity=gravity, distance=1e-4))
    time, speed = (np.array([row[key] for row in rows]) for key in ("time", "velocity_it_x"))
    assert speed[-1] == pytest.approx(2 / 3 * G * np.sin(SLOPE) * time[-1], rel=3e-3)
    assert 0.1 * rows[-1]["spin_it_z"] == pytest.approx(-speed[-1], rel=3e-3)


def test_a_spinning_disk_drives_a_plate() -> None:
    """A spinning disk lies on a plate that moves along x: friction gives the plate what it takes of the spin, and the
    momentum along x stays; energy is lost to friction alone, which is told."""
    disk = BALL | {"spin": [30.0], "friction": 0.5, "at": [3.0, 0.178]}
    plate = {"name": "plate", "shape": "box", "size": [2.0, 0.1], "at": [3.0, 0.0], "mass": 20.0, "guide": "x"}
    rows = list(thrown([plate, disk], "backward-euler", 2e-3, 0.2, gravity=[0.0, -10.0]))
    along = [5.0 * row["velocity_it_x"] + 20.0 * row["velocity_plate_x"] for row in rows]
    np.testing.assert_allclose(along, 0.0, atol=1e-9)
    last, inertia = rows[-1], 5.0 * 0.1**2 / 2
    assert abs(last["velocity_it_x"]) > 0.3
    # the moment of the friction force about the centre is its arm times the momentum that it gives along x
    assert inertia * (30.0 - last["spin_it_z"]) == pytest.approx(0.1 * 5.0 * abs(last["velocity_it_x"]), rel=0.1)
    energy = [row["energy"] for row in rows]
    assert max(energy) <= energy[0] * (1 + 1e-9) and energy[-1] > 0.9 * energy[0]
