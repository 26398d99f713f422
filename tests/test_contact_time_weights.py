"""Bodies that bounce: what the schemes do with forces of contact, against a particle by hand and the height it fell."""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest

from fracsim.forms.schemes import BackwardEuler, GeneralizedAlpha, Newmark, QuasiStatic, Scheme
from fracsim.mechanics.contact_time_weights import ContactTimeWeights, acceleration_change
from fracsim.studies.evidence.precision.bouncing_block import block_study, return_height
from support.scenes import each_step, make_scene, march

Values = npt.NDArray[np.float64]
SCHEMES: list[Scheme] = [BackwardEuler(), Newmark(), Newmark(0.4, 0.8), GeneralizedAlpha(), GeneralizedAlpha(0.0)]


@pytest.mark.parametrize("scheme", SCHEMES, ids=lambda each: type(each).__name__)
def test_a_particle_that_is_struck(scheme: Scheme) -> None:
    """m = 2 kg at v = 3, a = 5 is struck by f = 7 N over a step of 0.1 s: beside what a does, v changes by dt f / m and
    u by theta dt^2 f / m (theta = 1, or beta / gamma), and what is carried on is as if nothing had struck it."""
    dt, m, f = 0.1, 2.0, 7.0
    c_a, _ = scheme.rate_coefficients(dt)
    start = np.zeros(1), np.full(1, 3.0), np.full(1, 5.0)
    x, _ = scheme.reference_displacements(dt, *start)
    moved = np.full(1, ContactTimeWeights.for_scheme(scheme).factor * (1 - scheme.alpha_f) * f / m / c_a)
    (u, v, a), (u_f, v_f, a_f) = scheme.complete_step(dt, x, *start), scheme.complete_step(dt, x + moved, *start)
    newmark = getattr(scheme, "newmark", scheme)
    theta = 1.0 if isinstance(scheme, BackwardEuler) else newmark.beta / newmark.gamma
    assert [v_f - v, u_f - u] == pytest.approx([dt * f / m, theta * dt**2 * f / m], rel=1e-9)
    assert a_f - acceleration_change(scheme, dt, moved) == pytest.approx(a, rel=1e-9)


def test_without_inertia_there_are_no_blows() -> None:
    assert ContactTimeWeights.for_scheme(QuasiStatic()) == ContactTimeWeights()


def bounce(scheme: str, step: float) -> float:
    """Share of its height that a stiff block returns to which is thrown on the floor at 1 m/s as if from 0.05 m, by the
    place and the velocity of its centre as it leaves. The barrier is wide: it takes 50 ms to turn it round."""
    scene, state = make_scene(**block_study(scheme, step))
    energy, touched = 0.5 * 100, False
    for report in each_step(scene, state):
        now = report.kinetic + report.elastic - state.work
        assert now < energy + 1e-6
        energy = now
        force = scene.probes()[1]
        if touched and force == 0:
            break
        touched |= force != 0
    return return_height(scene, state)


@pytest.mark.parametrize(
    ("scheme", "fine", "ratio"),
    [("backward-euler", 0.6, 0.65), ("newmark", 0.95, 0.55), ("generalized-alpha", 0.95, 0.55)],
)
def test_a_bounce_returns_the_height_less_the_loss_of_the_scheme(scheme: str, fine: float, ratio: float) -> None:
    """In 7, 25 and 50 steps from touch to leave: never higher, energy falls in every step, and the loss falls with the
    step, to 4 % with second order; backward Euler loses a third."""
    heights = [bounce(scheme, step) for step in (8e-3, 2e-3, 1e-3)]
    assert heights == sorted(heights) and fine < heights[-1] < 1
    assert (1 - heights[2]) / (1 - heights[1]) < ratio


@pytest.mark.parametrize("scheme", ("backward-euler", "newmark", "generalized-alpha"))
def test_what_holds_a_side_reads_the_force_that_presses_it(scheme: str) -> None:
    """A platen comes near a side that is held: the body behind it stays as it is, and the reaction is the force that
    the platen reads, not twice as much for the weight of a blow."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.5}, boundary=[{"on": "top", "fix": "xy"}],
        contact={"distance": 0.03, "itself": False}, probe=[{"name": "held", "on": "top"}],
        obstacle=[{"name": "platen", "shape": "plane", "at": [0.0, 0.525], "normal": [0.0, -1.0],
                   "velocity": [0.0, -0.3]}],
        time={"scheme": scheme, "step": 0.01, "end": 0.05},
    )  # fmt: skip
    march(scene, state)
    row = dict(zip(scene.probes.columns, scene.probes(), strict=True))
    assert row["contact_platen_y"] > 0.1 and not state.u.any()
    assert row["reaction_held_y"] == pytest.approx(row["contact_platen_y"], rel=1e-9)


@pytest.mark.parametrize("scheme", ("backward-euler", "newmark", "generalized-alpha"))
def test_a_body_that_breaks_as_it_lands_keeps_the_books(scheme: str) -> None:
    """Momentum is what gravity and the floor gave, to the solver's tolerance, in steps with breaks as well: what a
    break releases has no resultant, and the force that is read is that of the step. No energy comes from nothing."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.25, "pattern": "unstructured"},
        load={"gravity": [0.0, -10.0]},
        material={"energy": "neo-hookean", "young": 1e5, "poisson": 0.3, "density": 100.0},
        initial={"velocity": [0.5, -3.0]}, fracture={"strength": 2e3, "radius": 0.2},
        obstacle=[{"name": "floor", "shape": "plane", "at": [0.0, -0.02], "normal": [0.1, 1.0], "friction": 0.2}],
        solver={"snes_rtol": 1e-9, "ksp_rtol": 1e-9}, time={"scheme": scheme, "step": 2e-3, "end": 0.05},
    )  # fmt: skip
    mass, weight = scene.balance.mass.lumped.reshape(-1, 2)[:, :1], np.array([0.0, -500.0])
    impulse, broken = 50 * np.array([0.5, -3.0]), 0
    for report in each_step(scene, state):
        impulse = impulse + (weight - scene.probes()[:2]) * report.dt
        broken += report.broken
        np.testing.assert_allclose((mass * state.v.reshape(-1, 2)).sum(axis=0), impulse, atol=1e-5)
        assert report.kinetic + report.elastic + state.dissipated - state.work < 25 * 9.25 * (1 + 1e-9)
    assert broken > 2


def energies(scheme: str, energy: str, **more: Any) -> tuple[Values, list[bool]]:
    """Of a soft bar 0.25 m high in steps of 10 ms, four waves through it, as shares of what it starts with; and whether
    it touched anything at the end of each step."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.25], "h": 0.125},
        material={"energy": energy, "young": 1e7, "poisson": 0.3, "density": 1e3},
        time={"scheme": scheme, "step": 1e-2, "end": 0.3}, **more,
    )  # fmt: skip
    if not more:  # its upper half and its lower half come towards each other
        v = np.zeros((scene.domain.node_count, 2))
        v[:, 1] = -10.0 * (scene.domain.nodes[: len(v), 1] / 0.125 - 1)
        state.v = v.reshape(-1)
        state.settle()
    start, found, touched = scene.balance.energies.kinetic_energy(state.v), [], []
    for report in each_step(scene, state):
        found.append((report.kinetic + report.elastic) / start)
        struck = scene.balance.contact.forces()
        touched.append(struck is not None and bool(np.abs(struck).max() > 0))
    return np.array([1.0, *found]), [False, *touched]


def test_newmark_rings_at_large_strains_without_contact() -> None:
    """Free of all: the energy of linear forces is kept to round-off, that of finite strains grows by a fifth; that of
    generalized-alpha falls."""
    assert energies("newmark", "linear")[0] == pytest.approx(1.0, abs=1e-9)
    assert energies("newmark", "neo-hookean")[0].max() > 1.2
    assert energies("generalized-alpha", "neo-hookean")[0].max() == 1.0


def test_no_step_in_touch_gains_even_so() -> None:
    """The same bar falls at 10 m/s on a floor by Newmark's method: it gains in steps in which it touches nothing."""
    floor = {"name": "floor", "shape": "plane", "at": [0.0, -1e-3], "normal": [0.0, 1.0]}
    contact = {"itself": False, "distance": 1e-3}
    E, touched = energies(
        "newmark", "neo-hookean", obstacle=[floor], contact=contact, initial={"velocity": [0.0, -10.0]}
    )
    gained, near = np.diff(E), np.array(touched[1:]) | np.array(touched[:-1])
    assert near.sum() >= 1 and gained[near].max() <= 1e-9 and gained[~near].max() > 1e-3
