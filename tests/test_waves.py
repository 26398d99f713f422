"""Bars: elastic waves, natural frequencies, static bending, against closed forms.

With nu = 0 a bar of equal lattice cells moves as a chain: planes of nodes keep their shape, since nodal forces and
lumped masses of an inner plane are in the same proportion (not so on an end plane, which has cells on one side only).
The chain's dispersion is omega = (2 c0 / dx) sin(k dx / 2), c0 = sqrt(E / rho), exactly.
"""

from __future__ import annotations

from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse import csr_matrix, diags
from scipy.sparse.linalg import eigsh

from fracsim.scene import Scene
from support.scenes import Values, displacement, each_step, make_scene, march, positions

EPS = np.finfo(float).eps
STEEL = {"energy": "linear", "young": 210e9, "poisson": 0.0, "density": 7850.0}


# --- waves ---

N, DX, DT = 64, 1.0 / 64, 0.5 / 64
PULL, AREA = 1e-3, 0.03125  # E = rho = c0 = L = 1; the bar is 2 cells high, of unit thickness
# Airy width of a front in a chain: phase c k t - c k^3 t (dx^2 / 24 + c^2 dt^2 / 12), lattice and trapezoidal rule
FRONT = (3 * (DX**2 / 24 + DT**2 / 12)) ** (1 / 3)


def bar(boundary: list[dict[str, Any]], end: float, **tables: Any) -> Any:
    """A bar of unit length, wave speed and impedance, pulled by a sudden traction at x = 1 for all t > 0."""
    pull = {"on": "right", "traction": [PULL, 0.0]}
    mesh = {"builder": "box", "size": [1.0, AREA], "h": DX}
    return make_scene(
        mesh=mesh, boundary=[*boundary, pull], time={"scheme": "newmark", "step": DT, "end": end}, **tables
    )


def profile(scene: Scene, values: Values) -> tuple[Values, Values]:
    """(x of each plane of nodes, mean of the values on it)."""
    x = np.round(positions(scene)[:, 0] / DX).astype(int)
    return np.arange(N + 1) * DX, np.bincount(x, values) / np.bincount(x)


@pytest.mark.parametrize("energy", ("linear", "corotated"))
def test_the_front_runs_at_c0(energy: str) -> None:
    """Behind the front v = sigma / (rho c0); the front, where v is half of that, is at 1 - c0 t within its Airy
    width."""
    scene, state = bar([], end=0.6, material={"energy": energy, "young": 1.0, "poisson": 0.0, "density": 1.0})
    for _ in each_step(scene, state):
        if state.t < 0.2:
            continue
        x, v = profile(scene, state.v.reshape(-1, 2)[:, 0])
        first = np.flatnonzero(v > PULL / 2)[0]  # from the left: nothing has arrived there yet
        place = np.interp(PULL / 2, v[first - 1 : first + 1], x[first - 1 : first + 1])
        assert place == pytest.approx(1 - state.t, abs=FRONT)
    behind = v[x > 1 - state.t + 4 * FRONT]
    assert behind.mean() == pytest.approx(PULL, rel=0.02)


def test_a_free_end_doubles_the_particle_velocity() -> None:
    """The wave reaches x = 0 at t = 1; from then to t = 2 that end moves at 2 sigma / (rho c0).

    The displacement is compared, so that the ripple behind the front averages out: off by a front's width at most.
    """
    scene, state = bar([], end=1.6)
    march(scene, state)
    end = displacement(scene, state)[np.isclose(positions(scene)[:, 0], 0), 0]
    np.testing.assert_allclose(end, 2 * PULL * (state.t - 1.0), atol=2 * PULL * FRONT)


def test_a_clamped_end_doubles_the_stress() -> None:
    """From t = 1 to t = 2 the clamp holds 2 sigma: its impulse is 2 sigma A (t - 1)."""
    scene, state = bar([{"on": "left", "fix": "xy"}], end=1.6)
    reaction, impulse = 0.0, 0.0
    for _ in each_step(scene, state):
        now = scene.balance.reactions[scene.balance.motion.owned].sum()
        impulse += DT * (reaction + now) / 2
        reaction = now
    assert -impulse == pytest.approx(2 * PULL * AREA * (state.t - 1.0), abs=2 * PULL * AREA * FRONT)


def test_momentum_is_the_impulse_of_the_load() -> None:
    """A free bar gains p A t, whatever its waves do: the trapezoidal rule integrates a constant load exactly."""
    scene, state = bar([], end=1.1)
    for _ in each_step(scene, state):
        momentum = (scene.balance.mass.lumped * state.v).reshape(-1, 2).sum(axis=0)
        np.testing.assert_allclose(momentum, [PULL * AREA * state.t, 0], atol=1e-10 * PULL)


# --- frequencies ---


def lowest_frequency(scene: Scene) -> float:
    """f1 in Hz of K and M as the program assembles them, held dofs left out."""
    balance = scene.balance
    x = balance.vector.duplicate()
    x.set(0.0)
    balance.assemble_tangent(balance.tangent)
    K = csr_matrix(balance.tangent.getValuesCSR()[::-1], shape=balance.tangent.size)
    free = np.ones(len(balance.mass.lumped), bool)
    free[balance.motion.owned] = False
    mass = balance.mass.lumped[free]
    K = K[free][:, free] - (diags(balance.c_a * mass) if balance.scheme.inertia else 0)
    value = eigsh(K.tocsc(), k=1, M=diags(mass).tocsc(), sigma=0, which="LM", return_eigenvectors=False)[0]
    return float(np.sqrt(value) / (2 * np.pi))


def cantilever(size: list[float], h: float, **tables: Any) -> Scene:
    """A steel bar clamped at x = 0."""
    plain: dict[str, Any] = {
        "mesh": {"builder": "box", "size": size, "h": h},
        "material": STEEL | ({"plane": "stress"} if len(size) == 2 else {}),
        "boundary": [{"on": "left", "fix": "xyz"[: len(size)]}],
        "time": {"scheme": "newmark", "step": 1.0, "end": 1.0},
    }
    scene, state = make_scene(**plain | tables)
    scene.balance.begin(1.0, 1.0, state.u, state.v, state.a)
    return scene


def axial_frequency(dim: int, h: float, ends: tuple[str, ...]) -> float:
    """Lowest frequency of a bar that slides along x between smooth walls, so that only axial motion is left."""
    walls = (("bottom", "top", "front", "back"), ("yz"[dim == 3], "yz"[dim == 3], "y", "y"))
    smooth = [{"on": name, "fix": axis} for name, axis in list(zip(*walls, strict=True))[: 2 * (dim - 1)]]
    return lowest_frequency(
        cantilever([1.0, 0.25, 0.25][:dim], h, boundary=[{"on": end, "fix": "x"} for end in ends] + smooth)
    )


@pytest.mark.parametrize("dim", (2, 3))
def test_axial_frequency_between_two_clamps(dim: int) -> None:
    """f = c0 / (2 L); the chain of planes has c0 / (pi dx) sin(pi dx / (2 L)) exactly."""
    h, c0 = 0.125, np.sqrt(STEEL["young"] / STEEL["density"])
    found = axial_frequency(dim, h, ("left", "right"))
    assert found == pytest.approx(c0 / (np.pi * h) * np.sin(np.pi * h / 2), rel=1e-9)
    assert found == pytest.approx(c0 / 2, rel=(np.pi * h) ** 2 / 24)


@pytest.mark.parametrize("dim", (2, 3))
def test_axial_frequency_of_a_cantilever(dim: int) -> None:
    """f = c0 / (4 L), approached with h^2; the chain's own error is (k dx)^2 / 24 with k = pi / (2 L)."""
    exact = np.sqrt(STEEL["young"] / STEEL["density"]) / 4
    errors = [abs(axial_frequency(dim, h, ("left",)) - exact) / exact for h in (0.25, 0.125)]
    assert np.log2(errors[0] / errors[1]) == pytest.approx(2, abs=0.2)
    assert errors[1] < 2 * (np.pi / 2 * 0.125) ** 2 / 24


def extrapolated(values: list[float]) -> float:
    """Richardson's limit of values at h, h/2 with error h^2 (P1 energies and eigenvalues)."""
    return (4 * values[-1] - values[-2]) / 3


def test_bending_frequency_of_a_cantilever() -> None:
    """BENCHMARKS: 1 x 0.1 m, E = 210 GPa, rho = 7850: 83.6 Hz by Euler and Bernoulli.

    Shear and rotary inertia take some 0.7 % off at this slenderness (Timoshenko), and P1 triangles are too stiff in
    bending by O((h / depth)^2): the frequencies fall with h, and their limit is the beam's within 1 %.
    """
    found = [lowest_frequency(cantilever([1.0, 0.1], h)) for h in (0.025, 0.0125, 0.00625)]
    beam = 0.5596 * np.sqrt(STEEL["young"] * 0.1**2 / 12 / STEEL["density"])
    assert beam == pytest.approx(83.6, abs=0.1)
    assert found[0] > found[1] > found[2] > extrapolated(found)
    assert np.log2((found[0] - found[1]) / (found[1] - found[2])) == pytest.approx(2, abs=0.3)
    assert extrapolated(found) == pytest.approx(beam, rel=0.01)


def test_bending_frequency_of_a_solid_cantilever() -> None:
    """The same in 3D: from above, with an extrapolation from two coarse meshes that is good to some percent only."""
    found = [lowest_frequency(cantilever([1.0, 0.1, 0.1], h)) for h in (0.05, 0.025)]
    assert found[0] > found[1] > 83.6
    assert extrapolated(found) == pytest.approx(83.6, rel=0.05)


def test_the_period_of_a_clamped_bar_in_time() -> None:
    """Released from its first axial mode a bar between clamps swings as sin(2 pi f t), through the whole program.

    f is that of the chain, L = c0 = 1. The trapezoidal rule lags by (omega dt)^2 / 12 of the phase.
    """
    n, steps = 16, 200
    f = n / np.pi * np.sin(np.pi / (2 * n))
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.125], "h": 1 / n},
        boundary=[{"on": "left", "fix": "xy"}, {"on": "right", "fix": "xy"}],
        time={"scheme": "newmark", "step": 1 / f / steps, "end": 1 / f},
    )
    X = positions(scene)
    shape = np.column_stack([np.sin(np.pi * X[:, 0]), np.zeros(len(X))]).reshape(-1)
    state.v = shape.copy()
    omega, lag = 2 * np.pi * f, 2 * np.pi * (2 * np.pi / steps) ** 2 / 12
    for _ in each_step(scene, state):
        np.testing.assert_allclose(state.u, np.sin(omega * state.t) / omega * shape, atol=lag / omega)


# --- statics ---


def tip_deflection(h: float) -> float:
    """Of a 1 x 0.1 m cantilever in plane stress under a unit end shear force."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.1], "h": h},
        material=STEEL | {"plane": "stress", "poisson": 0.3},
        boundary=[{"on": "left", "fix": "xy"}, {"on": "right", "traction": [0.0, 10.0]}],
        time={"scheme": "quasi-static", "step": 1.0, "end": 1.0},
    )
    march(scene, state)
    end = np.isclose(positions(scene)[:, 0], 1.0)
    return float(displacement(scene, state)[end, 1].mean())


def test_static_cantilever() -> None:
    """Timoshenko: w = P L^3 / (3 E I) + P L / (kappa G A), kappa = 10 (1 + nu) / (12 + 11 nu). P1 is too stiff: from
    below.

    The clamp also stops the section's warping and contraction there, which beam theory leaves free: within 1 %.
    """
    E, nu, b = STEEL["young"], 0.3, 0.1
    kappa, G = 10 * (1 + nu) / (12 + 11 * nu), E / (2 * (1 + nu))
    beam = 1 / (3 * E * b**3 / 12) + 1 / (kappa * G * b)
    found = [tip_deflection(h) for h in (0.025, 0.0125, 0.00625)]
    assert found[0] < found[1] < found[2] < beam
    assert extrapolated(found) == pytest.approx(beam, rel=0.01)


def test_poissons_contraction_of_a_pulled_bar() -> None:
    """A solid bar pulled by tractions, free sideways: E sigma / E along, -nu of it across, in every node."""
    sigma, nu = 2e6, 0.3
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.4, 0.4], "h": 0.2, "pattern": "unstructured"},
        material=STEEL | {"poisson": nu},
        boundary=[
            {"on": "left", "fix": "x"},
            {"on": "front", "fix": "y"},
            {"on": "bottom", "fix": "z"},
            {"on": "right", "traction": [sigma, 0.0, 0.0]},
        ],
        time={"scheme": "quasi-static", "step": 1.0, "end": 1.0},
    )
    march(scene, state)
    strain = sigma / STEEL["young"]
    expected: npt.NDArray[np.float64] = positions(scene) * [strain, -nu * strain, -nu * strain]
    np.testing.assert_allclose(displacement(scene, state), expected, atol=1e-9 * strain)
