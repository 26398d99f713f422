"""The grid of contact: what is touched, its motion and the scheme, in 2D and 3D; what has no meaning is refused."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fracsim.errors import InputError
from support.intersections import intersecting_elements
from support.ranks import run_on_ranks
from support.scenes import each_step, march
from support.touching import (
    COS,
    EVERY,
    FEW,
    MOTIONS,
    OBSTACLES,
    SIN,
    TAN,
    Cell,
    DrawnSurfaces,
    G,
    contact_energy,
    dragged,
    incline,
    momentum,
    obstacle_surfaces,
    obstacles_meet,
    refusal,
    scene_of,
    sliding_part,
)

pytest.importorskip("ipctk", reason="an environment made without a network")

Values = npt.NDArray[np.float64]


def as_parameters(cells: list[Cell], slow: Any) -> list[Any]:
    """Parameters of a test, those of which `slow` is true marked so."""
    return [pytest.param(cell, id="-".join(map(str, cell)), marks=[pytest.mark.slow] * slow(cell)) for cell in cells]


def is_slow(cell: Cell) -> bool:
    """Whether another cell of the same terms is fast."""
    return cell.scheme in ("backward-euler", "generalized-alpha") and (cell.dim == 3 or cell.motion != "free")


@pytest.mark.parametrize("dim", (2, 3))
def test_intersections_are_found(dim: int) -> None:
    """Of a simplex and a copy of it, moved by a share of its size: none beside it, some where it is cut."""
    points = np.vstack([np.zeros(dim), np.eye(dim)])
    sides = np.array([np.delete(np.arange(dim + 1), k) for k in range(dim + 1)])
    for shift, cut in ((1.1, False), (0.3, True), (-0.3, True)):
        moved = np.concatenate([points, points @ np.diag(np.linspace(1.0, 0.9, dim)) + shift / dim])
        found = intersecting_elements(moved, np.concatenate([sides, sides + dim + 1]))
        assert (len(found) > 0) == cut
        assert np.all(found[:, 0] <= dim) and np.all(found[:, 1] > dim)


@pytest.mark.parametrize("cell", as_parameters(EVERY, is_slow))
def test_what_meets_does_not_intersect(cell: Cell, tmp_path: Path) -> None:
    """In no frame, by a test of its own; what is free keeps its momentum."""
    if why := refusal(cell):
        with pytest.raises((InputError, ValueError), match=why):
            scene_of(cell, tmp_path)
        return
    scene, state = scene_of(cell, tmp_path)
    drawn, start, stored = DrawnSurfaces(scene), momentum(scene, state), 0.0
    size = 100.0  # kg m/s, of either side
    for number, _ in enumerate(each_step(scene, state)):
        stored = max(stored, contact_energy(scene))
        if cell.scheme != "explicit" or number % 3 == 0:
            assert not len(intersecting_elements(*drawn.at(state)))
        if cell.motion == "free":
            np.testing.assert_allclose(momentum(scene, state), start, atol=1e-9 * size)
    assert stored > 0.01


def slides(cell: Cell) -> bool:
    """Whether a cell has an incline: parts do so on a fixed one."""
    return not refusal(cell) and cell.scheme != "quasi-static" and (cell.partner in OBSTACLES or cell.motion == "fixed")


def slides_slowly(cell: Cell) -> bool:
    """Whether its incline is slow."""
    if cell == Cell("mesh", "fixed", "newmark", 3):
        return False
    return cell.dim == 3 or (cell.motion, cell.scheme) not in (("fixed", "newmark"), ("prescribed", "explicit"))


@pytest.mark.parametrize("cell", as_parameters([cell for cell in EVERY if slides(cell)], slides_slowly))
def test_coulomb_on_an_incline(cell: Cell, tmp_path: Path) -> None:
    """With mu = 0.9 tan(theta) it slides, held back by mu times the impulse of the pressure; with 1.1 it stays."""
    speeds, ratios = [], []
    for ratio in (0.9, 1.1):
        scene, state = incline(cell, ratio, tmp_path)
        of, mass = sliding_part(scene, cell)
        carried = mass * (cell.motion == "prescribed")  # at 1 m/s
        rows = np.array([(state.t, *momentum(scene, state, of)) for _ in each_step(scene, state)])
        late = rows[rows[:, 0] > 0.45 * rows[-1, 0]]
        change = late[-1] - late[0]
        friction = mass * G * SIN * change[0] - change[1]
        pressure = mass * G * COS * change[0] + change[-1]
        ratios.append(friction / pressure / TAN)
        speeds.append((late[-1, 1] - carried) / mass)
    assert ratios[0] == pytest.approx(0.9, rel=0.03)
    assert speeds[0] > 0.02 and abs(speeds[1]) < 0.45 * speeds[0]
    assert 0.95 < ratios[1] < 1.13


@pytest.mark.parametrize("partner", (pytest.param("analytic", marks=pytest.mark.slow), "mesh"))
def test_friction_is_the_same_in_a_moving_frame(partner: str, tmp_path: Path) -> None:
    """A cube on a plate at rest, and both carried at 1 m/s: it creeps alike where it sticks."""
    ends = []
    for motion in ("fixed", "prescribed"):
        scene, state = incline(Cell(partner, motion, "newmark", 3), 1.1, tmp_path)
        march(scene, state)
        _, mass = sliding_part(scene, Cell(partner, motion, "newmark", 3))
        ends.append(momentum(scene, state)[0] / mass - (motion == "prescribed"))
    assert ends[1] == pytest.approx(ends[0], abs=1e-4)


STILL = [cell for cell in EVERY if cell.scheme == "quasi-static" and not refusal(cell)]


@pytest.mark.parametrize("cell", as_parameters(STILL, lambda cell: cell.dim == 3 or cell.motion != "fixed"))
def test_coulomb_without_inertia(cell: Cell, tmp_path: Path) -> None:
    """What is pressed down and dragged has T = r N if it sticks. With mu = 1.2 r it does, with 0.8 r it slides; crack
    faces are a little rough, and what the soft back of a C carries does not slide."""
    reached = []
    for ratio in (None, 0.8, 1.2):
        scene, state = dragged(cell, 5.0 if ratio is None else ratio * reached[0], tmp_path)
        for _ in each_step(scene, state):
            pass
        told = dict(zip(scene.probes.columns, scene.probes(), strict=True))
        reached.append(abs(told["reaction_grip_x"] / told[f"reaction_grip_{'xyz'[cell.dim - 1]}"]))
    glued, slid, stuck = reached
    assert 0.66 < slid / glued < 0.86 and 0.93 < stuck / glued < 1.05


PAIRS = [(2, "analytic", "analytic"), *((3, *pair) for pair in product(OBSTACLES, OBSTACLES))]


@pytest.mark.parametrize("scheme", ("newmark", "explicit"))
@pytest.mark.parametrize("motion", MOTIONS)
@pytest.mark.parametrize(("dim", "above", "below"), PAIRS)
def test_obstacles_that_meet(dim: int, above: str, below: str, motion: str, scheme: str, tmp_path: Path) -> None:
    """A free one falls on another: they do not intersect, and two free ones keep their momentum."""
    scene, state = obstacles_meet(above, below, motion, scheme, dim, tmp_path)
    start, stored = momentum(scene, state), 0.0
    for _ in each_step(scene, state):
        stored = max(stored, contact_energy(scene))
        (upper, sides), (lower, others) = obstacle_surfaces(scene, state)
        both = np.concatenate([upper, lower]), np.concatenate([sides, others + len(upper)])
        assert not len(intersecting_elements(*both))
        if motion == "free":
            np.testing.assert_allclose(momentum(scene, state), start, atol=1e-9 * 200.0)
    assert stored > 1.0


@pytest.mark.ranks
@pytest.mark.parametrize("module", ("touching", pytest.param("touching_all", marks=pytest.mark.slow)))
def test_cells_are_equal_on_any_number_of_ranks(module: str, tmp_path: Path) -> None:
    alone, *others = (run_on_ranks(f"support.{module}", count, tmp_path, 580) for count in (1, 2, 3))
    assert len(alone) >= len(FEW)
    for together, (name, values) in product(others, alone.items()):
        np.testing.assert_allclose(together[name], values, rtol=1e-5, atol=1e-6 * abs(values).max(), err_msg=name)
