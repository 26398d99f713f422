"""How bodies turn where nothing acts: a top keeps its angular momentum to round-off, and its energy."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import numpy.typing as npt
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from fracsim.rigid.bodies import LIMITS, accelerate, apply_tensor, quaternions, rotate_freely

Values = npt.NDArray[np.float64]
TOP = np.diag([1.0, 2.0, 3.0])[None]  # kg m^2
NEARLY = np.array([[0.1, 2 * np.pi, 0.2]])  # rad/s: about the axis that it does not stay on


def tops(steps: int, turns: float) -> tuple[Values, Values, Values]:
    """Rotations (1, 3, 3), spins (1, 3) and energies (steps,) of an asymmetric top that nothing acts on."""
    turn, spin, energy = np.eye(3)[None], NEARLY, []
    for _ in range(steps):
        momentum, inverse = apply_tensor(turn, TOP, spin), np.linalg.inv(TOP)
        turn = rotate_freely(turn, inverse, momentum, np.array([turns / steps]))
        spin = apply_tensor(turn, inverse, momentum)
        energy.append(float(np.einsum("ni,nij,nj->", spin, turn @ TOP @ np.swapaxes(turn, 1, 2), spin)) / 2)
    return turn, spin, np.array(energy)


def kept(turns: int, a_turn: int) -> float:
    """Largest relative error of energy and angular momentum of the top."""
    turn, spin, energy = tops(turns * a_turn, turns)
    start = TOP[0] @ NEARLY[0]
    momentum = (turn @ TOP @ np.swapaxes(turn, 1, 2))[0] @ spin[0]
    assert np.allclose(momentum, start, atol=1e-12 * np.linalg.norm(start))
    return float(np.abs(energy / (NEARLY[0] @ start / 2) - 1).max())


def test_a_top_keeps_its_angular_momentum_to_round_off_and_its_energy() -> None:
    """Four turns with sixty steps each, through its tumbles."""
    assert kept(4, 60) < 1e-3


def test_what_turns_by_a_radian_a_step_keeps_its_energy_as_in_short_steps(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of second order: as many substeps as fit in, squared, better than in one, within a tenth."""
    in_parts, parts = kept(4, 6), math.ceil(2 * np.pi / 6 / LIMITS.substep_angle)
    monkeypatch.setattr("fracsim.rigid.bodies.LIMITS", replace(LIMITS, substep_angle=np.inf))
    assert in_parts * parts**2 == pytest.approx(kept(4, 6), rel=0.1)


@pytest.mark.slow
def test_a_top_keeps_its_energy_over_a_hundred_turns() -> None:
    """Issue 13: 1e-3."""
    assert kept(100, 100) < 1e-3


def test_what_whirls_beside_others_does_not_change_how_they_turn() -> None:
    """Each as it would alone, slow and fast, and one too fast to be found in so many rounds."""
    rng = np.random.default_rng(2)
    turn, size = Rotation.random(20, random_state=1).as_matrix(), rng.uniform(1.0, 3.0, (20, 3))
    inverse, momentum = size[:, :, None] * np.eye(3), np.geomspace(1e-3, 1e3, 20)[:, None] * rng.normal(size=(20, 3))
    together = rotate_freely(turn, inverse, momentum, np.full(20, 0.01))
    for k in range(20):
        alone = rotate_freely(turn[[k]], inverse[[k]], momentum[[k]], np.full(1, 0.01))
        assert np.allclose(alone[0], together[k], rtol=0.0, atol=1e-14)


def test_a_top_turns_as_euler_says() -> None:
    """I dw/dt = (I w) x w in the axes of the body, by an adaptive Runge-Kutta method: of second order in the step."""
    main = np.diag(TOP[0])
    exact = solve_ivp(lambda _, w: np.cross(main * w, w) / main, (0, 1.5), NEARLY[0], rtol=1e-11, atol=1e-12).y[:, -1]
    errors = []
    for steps in (75, 150):
        turn, spin, _ = tops(steps, 1.5)
        errors.append(float(np.abs(turn[0].T @ spin[0] - exact).max()))
    assert errors[1] < 0.05 and errors[0] / errors[1] == pytest.approx(4.0, rel=0.2)


def test_a_rotation_is_its_quaternion() -> None:
    """Of turns about all axes and by all angles, half a turn among them, that of SciPy but for its sign."""
    rng = np.random.default_rng(4)
    axes = np.concatenate([np.eye(3), -np.eye(3), rng.normal(size=(40, 3))])
    axes /= np.linalg.norm(axes, axis=1)[:, None]
    turns = np.concatenate([angle * axes for angle in (0.0, 1e-9, 0.3, 2.0, np.pi - 1e-9, np.pi, 4.0)])
    found, known = quaternions(Rotation.from_rotvec(turns).as_matrix()), Rotation.from_rotvec(turns)
    same = np.abs(np.einsum("ni,ni->n", found, known.as_quat(scalar_first=True)))
    assert np.allclose(same, 1.0, atol=1e-14) and np.allclose(np.linalg.norm(found, axis=1), 1.0, atol=1e-15)
    assert np.allclose(Rotation.from_quat(found, scalar_first=True).as_matrix(), known.as_matrix(), atol=1e-14)


def test_a_tensor_in_the_axes_of_a_body() -> None:
    """R T R^T v of random bodies, by matrices in space."""
    rng = np.random.default_rng(5)
    turn, tensor, vector = Rotation.random(9, rng=rng).as_matrix(), rng.normal(size=(9, 3, 3)), rng.normal(size=(9, 3))
    in_space = turn @ tensor @ np.swapaxes(turn, 1, 2)
    assert np.allclose(apply_tensor(turn, tensor, vector), (in_space @ vector[:, :, None])[:, :, 0], atol=1e-14)


def test_what_drives_bodies_changes_their_momenta_by_what_it_gives() -> None:
    """m dv = dt (F + m g), d(R I R^T w) = dt R M, by dense matrices; what spins by more than it may keeps its axis, and
    what nothing acts on its spin."""
    rng = np.random.default_rng(4)
    turn = Rotation.random(6, random_state=4).as_matrix()
    half = rng.normal(size=(6, 3, 3))
    inertia, mass = half @ np.swapaxes(half, 1, 2) + 3 * np.eye(3), rng.uniform(1, 2, 6)
    velocity, spin, force = (rng.normal(size=(6, k)) for k in (3, 3, 6))
    force[0], spin[0], force[1, 3:] = 0.0, 50.0, 1e4
    gravity, dt, most = np.array([0.0, 0.0, -9.81]), 0.01, 10.0
    motion = accelerate(turn, inertia, np.linalg.inv(inertia), mass, (velocity, spin), force, gravity, dt, most)
    pushed = mass[:, None] * (motion[0] - velocity) / dt - mass[:, None] * gravity
    assert np.allclose(pushed, force[:, :3], atol=1e-10)
    own = turn @ inertia @ np.swapaxes(turn, 1, 2)
    given = (own @ spin[:, :, None] + dt * turn @ force[:, 3:, None])[:, :, 0]
    free = np.linalg.solve(own, given[:, :, None])[:, :, 0]
    assert np.allclose(np.delete(motion[1], 1, axis=0), np.delete(free, 1, axis=0), rtol=1e-12, atol=1e-12)
    assert np.allclose(motion[1][1], most * free[1] / np.linalg.norm(free[1])) and np.linalg.norm(free[1]) > most
