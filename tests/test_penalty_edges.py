"""Edges that cross between their points in explicit steps: against closed forms, differences and conservation laws."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import numpy.typing as npt
import pytest

from fracsim.contact.penalty_edges import find_sharp_edges
from fracsim.contact.penalty_law import ContactStiffness
from fracsim.contact.penalty_pairs import PenaltyPairs
from support.scenes import each_step, make_scene, positions
from support.solids import lattice
from test_self_contact import SOFT

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

# a roof: the ridge 0-1 along x, the eaves below it
ROOF = np.array([[-1.0, 0, 0], [1, 0, 0], [-1, -1, -1], [1, -1, -1], [-1, 1, -1], [1, 1, -1]])
ROOF_SIDES = np.array([[0, 2, 1], [1, 2, 3], [0, 1, 4], [1, 5, 4], [2, 4, 3], [3, 4, 5], [0, 4, 2], [1, 3, 5]])
ROOF_CELLS = np.array([[0, 1, 2, 4], [1, 2, 3, 4], [1, 3, 4, 5]])
TURN = np.array([[0.0, 1, 0], [1, 0, 0], [0, 0, -1]])  # upside down, the ridge along y
WIDTH = 0.1


def roofs(*, shift: tuple[float, float, float], angle: float = np.pi / 2) -> tuple[PenaltyPairs, Values]:
    """A roof and another one upside down over it, its ridge at an angle to the first, shifted."""
    turn = np.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    above = (ROOF * [1, 1, -1]) @ turn.T + shift
    x = np.concatenate([ROOF, above])
    elements = np.concatenate([ROOF_SIDES, ROOF_SIDES[:, ::-1] + len(ROOF)])
    stiffness = ContactStiffness.of_one_body(np.linspace(3.0, 4.0, len(x)))
    return PenaltyPairs(x, elements, stiffness, distance=WIDTH), x


def test_a_roof_has_nine_sharp_edges() -> None:
    """Ridge, eaves, slopes and feet; not the diagonals of its faces, nor the valley of a bent sheet."""
    sharp = find_sharp_edges(ROOF, ROOF_SIDES)
    assert {tuple(ends) for ends in sharp.ends} == {
        (0, 1), (0, 2), (0, 4), (1, 3), (1, 5), (2, 3), (2, 4), (3, 5), (4, 5),
    }  # fmt: skip
    np.testing.assert_array_equal(sharp.weight, 1.0)
    valley = np.array([[0.0, 0, 0], [1, 0, 0], [0.5, 1, 0.3], [0.5, -1, 0.3]])
    assert len(find_sharp_edges(valley, np.array([[0, 1, 2], [1, 0, 3]])).ends) == 0


@pytest.mark.parametrize("height", (0.06, 0.02))
def test_two_ridges_that_cross_push_each_other_apart(height: float) -> None:
    """k (D - g) on both, shared among the ends as at a lever; none of 3 D apart."""
    pairs, x = roofs(shift=(0.2, 0.0, height))
    force, k = -pairs.gradient(x), 3.0  # of the softest of the four ends
    push = k * (WIDTH - height)
    expected = np.zeros_like(x)
    expected[[0, 1], 2] = -push * np.array([0.4, 0.6])
    expected[[6, 7], 2] = 0.5 * push
    np.testing.assert_allclose(force, expected, atol=1e-12)
    assert pairs.energy(x) == pytest.approx(0.5 * k * (WIDTH - height) ** 2)
    x[6:, 2] += WIDTH - height
    assert not pairs.gradient(x).any()


def test_ridges_that_have_crossed_are_pushed_back_where_they_came_from() -> None:
    """As deep as D the force is twice that of a closed gap; ridges that never met each other do not act."""
    pairs, x = roofs(shift=(0.0, 0.0, 0.05))
    pairs.end_step(x)
    x[6:, 2] -= 0.15
    np.testing.assert_allclose(-pairs.gradient(x)[6:].sum(axis=0), [0, 0, 3.0 * 2 * WIDTH], atol=1e-12)
    assert pairs.min_gap(x) == pytest.approx(-0.1)
    again, _ = roofs(shift=(0.0, 0.0, 0.05))
    assert not again.gradient(x).any()


@pytest.mark.parametrize(
    ("shift", "angle"), [((0.9, 0.1, 0.03), 1.2), ((0.05, 0.01, 0.05), 0.15), ((0.0, 0.0, -0.02), 0.6)]
)
def test_forces_are_a_derivative_and_sum_to_nothing(shift: tuple[float, float, float], angle: float) -> None:
    """Near the ends of edges, and of nearly parallel ones: against differences; force and moment vanish."""
    pairs, x = roofs(shift=(shift[0], shift[1], 0.05), angle=angle)
    pairs.end_step(x)
    x = x + np.repeat([[0.0, 0, 0], [0, 0, shift[2] - 0.05]], 6, axis=0)
    x = x + 0.01 * np.random.default_rng(4).normal(size=x.shape)
    contacts, gradient, h = pairs.contacts(x), pairs.gradient(x), 1e-7
    assert contacts.side.all() and len(contacts.gap)
    for motion in np.random.default_rng(1).normal(size=(6, *x.shape)):
        slope = (pairs.energy(x + h * motion) - pairs.energy(x - h * motion)) / (2 * h)
        assert np.vdot(gradient, motion) == pytest.approx(slope, abs=2e-5 * np.linalg.norm(gradient))
    size = np.linalg.norm(gradient)
    assert size > 1e-3
    np.testing.assert_allclose(gradient.sum(axis=0), 0.0, atol=1e-12 * size)
    np.testing.assert_allclose(np.cross(x, gradient).sum(axis=0), 0.0, atol=1e-12 * size)


def test_ridges_rub() -> None:
    """A spring across the gap, which slips at mu N; forces on both sum to nothing."""
    pairs, x = roofs(shift=(0.0, 0.0, 0.05))
    pairs.end_step(x, np.zeros((1, 3)))
    for motion, expected in ((1e-3, 3.0 * 1e-3), (0.03, 0.4 * 3.0 * 0.05)):
        moved = x + np.repeat([[0.0, 0, 0], [motion, 0, 0]], 6, axis=0)
        force = pairs.forces(moved, x, 0.4).friction_force
        np.testing.assert_allclose(force[6:].sum(axis=0), [-expected, 0, 0], atol=1e-12)
        np.testing.assert_allclose(force.sum(axis=0), 0.0, atol=1e-12)


def tilted_bar() -> tuple[Values, Ints]:
    """(n, 3) points and (k, 4) cells of a bar of square section on edge, along y, its middle at the origin."""
    bar = lattice(1, 6, 1, size=0.25)
    tilt = np.sqrt(0.5) * np.array([[1.0, 0, 1], [0, np.sqrt(2), 0], [-1, 0, 1]])
    return (bar.points - bar.points.mean(axis=0)) @ tilt.T, bar.cells


def two_bars(folder: Path, angle: float) -> str:
    """Two bars of square section on edge, one across over the other, 0.05 m apart."""
    (X, bar_cells), c, s = tilted_bar(), np.cos(angle), np.sin(angle)
    over = X @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + [0.03, 0.07, 0.25 * np.sqrt(2) + 0.05]
    cells = np.concatenate([bar_cells, bar_cells + len(X)])
    meshio.Mesh(np.concatenate([X, over]), [("tetra", cells)]).write(folder / "bars.vtu")
    return str(folder / "bars.vtu")


@pytest.mark.parametrize("friction", (0.0, 0.3))
def test_two_bars_on_edge_collide(tmp_path: Path, friction: float) -> None:
    """Across each other, so that no point of one comes before a facet of the other: they part again, with all of their
    momentum and energy."""
    scene, state = make_scene(
        mesh={"file": two_bars(tmp_path, 1.1)}, material=SOFT, contact={"friction": friction},
        time={"scheme": "explicit", "step": 0.02, "end": 0.5},
    )  # fmt: skip
    X, m = positions(scene), scene.balance.mass.lumped.reshape(-1, 3)
    high, v = X[:, 2] > 0.2, np.zeros_like(X)
    v[high] = [0.1 * (friction > 0), 0.0, -0.5]
    state.v = v.reshape(-1)
    state.settle()
    before, began, stored = (m * v).sum(axis=0), 0.5 * float((m * v * v).sum()), 0.0
    for report in each_step(scene, state):
        np.testing.assert_allclose((m * state.v.reshape(-1, 3)).sum(axis=0), before, atol=1e-12 * abs(before[2]))
        assert report.kinetic + report.elastic + state.dissipated == pytest.approx(began, rel=0.02)
        stored = max(stored, report.elastic)
    momentum = (m * state.v.reshape(-1, 3))[high].sum(axis=0)
    assert stored > 0.2 * began
    assert abs(momentum[2]) < 0.35 * abs(before[2])
