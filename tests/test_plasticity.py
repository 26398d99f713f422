"""Plastic flow against the bilinear curve, closed forms of relaxation and unloading, and a dense return mapping."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

from fracsim.forms.energies import ENERGIES
from fracsim.forms.schemes import SCHEMES
from fracsim.mechanics.plasticity import LIMITS, ImplicitPlasticFlow
from fracsim.mechanics.return_mapping import POLICY
from fracsim.meshes import BUILDERS
from fracsim.meshes.write import write_mesh
from fracsim.output.frame_files import FieldEvaluator
from fracsim.scene import Scene
from fracsim.study.check import check_study
from fracsim.timestepping.state import State
from support.laws import law_of, rotation
from support.oscillator import slopes
from support.scenes import Values, deform, each_step, make_scene, make_study, march, positions

EPS = np.finfo(float).eps
YOUNG, POISSON = 1.0, 0.3
MU, LAMBDA = YOUNG / 2.6, YOUNG * 0.3 / (1.3 * 0.4)
MATERIAL = {"young": YOUNG, "poisson": POISSON, "density": 1.0}
FINITE = ("corotated", "stvk", "neo-hookean")
TINY = 1e-5  # yield strain: what is not linear in strain is smaller by this
BAR = {"builder": "box", "size": [1.0, 0.5, 0.5], "h": 0.5}
ROLLERS = [{"on": "left", "fix": "x"}, {"on": "front", "fix": "y"}, {"on": "bottom", "fix": "z"}]


def pulled(
    stretch: list[float], steps: int, energy: str = "neo-hookean", scheme: str = "quasi-static", **plasticity: Any
) -> tuple[Scene, State]:
    """A bar in uniaxial stress whose strain is tabulated over [0, 1] s at equal intervals; solved with its own flow."""
    times = np.linspace(0, 1, len(stretch)).tolist()
    pull = {"on": "right", "displacement": {"time": times, "value": [[e, "free", "free"] for e in stretch]}}
    extra = {key: plasticity.pop(key) for key in ("fracture",) if key in plasticity}
    return make_scene(
        mesh=BAR,
        material=MATERIAL | {"energy": energy},
        boundary=[*ROLLERS, pull],
        plasticity={"yield_stress": TINY * YOUNG, "update": "implicit", **plasticity},
        time={"scheme": scheme, "step": 1 / steps, "end": 1.0},
        probe=[{"name": "grip", "on": "right"}],
        **extra,
    )


def stress(scene: Scene) -> float:
    """Nominal stress at the grip, Pa."""
    return float(scene.probes()[0]) / 0.25


def bilinear(strain: float, hardening: float, limit: float = TINY * YOUNG) -> float:
    """E up to yield, then E K / (E + K): sigma = E (eps - eps_p) = Y + K eps_p."""
    first = limit / YOUNG
    return YOUNG * strain if strain < first else limit + (strain - first) * YOUNG * hardening / (YOUNG + hardening)


def memory_of(scene: Scene) -> Values:
    """(cells, 10) F_p^-1 and alpha."""
    rows: Values = scene.balance.stress.material.plastic.snapshot()
    return rows[:, [*range(9), -1]]


def plastic_strain(scene: Scene) -> Values:
    strain: Values = scene.balance.stress.material.plastic.accumulated_strain
    return strain


# --- uniaxial stress ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("hardening", (0.0, 0.1, -0.05))
@pytest.mark.parametrize("energy", FINITE)
def test_tension_follows_the_bilinear_curve(energy: str, hardening: float) -> None:
    """In every step, however large: what is left is the nonlinearity of strains of 4e-5 and the root's tolerance."""
    scene, state = pulled([0, 4 * TINY], 8, energy, hardening=hardening)
    for _ in each_step(scene, state):
        assert stress(scene) == pytest.approx(bilinear(4 * TINY * state.t, hardening), rel=20 * TINY)


@pytest.mark.parametrize("energy", FINITE)
def test_long_steps_are_solved_with_the_stress_after_the_return(energy: str) -> None:
    """Trial strains of 250 yield strains: forces with the flow of the step are those after the return, where F_p has
    changed, within 15 %; the tangent is their derivative within a quarter, in volume, extension and shear."""
    scene, _ = homogeneous(energy, yield_stress=4e-4 * YOUNG, update="implicit")
    balance, F = scene.balance, rotation(3, 4) @ expm([[0.03, 0.08, 0.0], [0.0, -0.05, 0.04], [0.0, 0.0, 0.0205]])
    balance.begin_step(0.1, 0.1, *(np.zeros(24) for _ in range(3)))
    deform(scene, F)
    during = balance.stress.assemble_forces()
    X, u = positions(scene), balance.u.x.array.copy()
    for gradient in (np.eye(3), np.diag([1.0, 1.0, -2.0]), np.outer([1.0, 0, 0], [0, 1.0, 0])):
        v = (X @ (gradient @ F).T).reshape(-1)
        ends = []
        for sign in (1.0, -1.0):
            balance.set_displacement(u + 1e-6 * sign * v)
            ends.append(balance.stress.assemble_forces())
        balance.set_displacement(u)
        difference = (ends[0] - ends[1]) / 2e-6
        balance.tangent.assemble()
        x, y = balance.work_vector.duplicate(), balance.work_vector.duplicate()
        x.array_w[:] = v
        balance.tangent.matrix.mult(x, y)
        of_inertia = sum(term.mass_factor for term in balance.terms) * balance.mass.lumped * v
        assert np.linalg.norm(y.array_r - of_inertia - difference) < 0.25 * np.linalg.norm(difference)
    scene.stepper.inelastic.flow.begin_step(0.1)
    scene.stepper.inelastic.flow()
    after = balance.stress.assemble_forces()
    assert np.linalg.norm(during - after) < 0.15 * np.linalg.norm(after)


def test_tension_with_the_frobenius_norm() -> None:
    """|sigma| = sigma in uniaxial stress: the same curve; with hardening to first order in the step.

    Without any hardening, a few times the stress, a bar in tension would neck.
    """
    scene, state = pulled([0, 4 * TINY], 8, measure="frobenius", hardening=10 * TINY)
    for _ in each_step(scene, state):
        assert stress(scene) == pytest.approx(bilinear(4 * TINY * state.t, 10 * TINY), rel=20 * TINY)
    errors = []
    for steps in (10, 20, 40):
        scene, state = pulled([0, 4 * TINY], steps, measure="frobenius", hardening=0.1)
        march(scene, state)
        errors.append(abs(stress(scene) / bilinear(4 * TINY, 0.1) - 1))
    assert errors[-1] < 0.01 and errors[2] < errors[1] < errors[0]


@pytest.mark.parametrize("energy", FINITE)
def test_unloading_leaves_the_plastic_strain(energy: str) -> None:
    """eps_p = (4 - 1) eps_y E / (E + K) after a strain of 4 eps_y; back at that strain there is no force."""
    hardening = 0.1
    left = 3 * TINY * YOUNG / (YOUNG + hardening)
    scene, state = pulled([0, 4 * TINY, left], 12, energy, hardening=hardening)
    march(scene, state, 6)
    top = stress(scene)
    np.testing.assert_allclose(plastic_strain(scene), left, rtol=20 * TINY)
    before = plastic_strain(scene).copy()
    for _ in each_step(scene, state):
        strain = np.interp(state.t, [0.5, 1.0], [4 * TINY, left])
        assert stress(scene) == pytest.approx(top - YOUNG * (4 * TINY - strain), abs=20 * TINY * top)
    assert np.array_equal(plastic_strain(scene), before)


def test_softening_ends_at_a_small_stress() -> None:
    """K = -0.3 E uses the yield stress up at eps_p = 3.3 eps_y; softened_share of it is left."""
    scene, state = pulled([0, 8 * TINY], 40, hardening=-0.3)
    march(scene, state)
    assert stress(scene) == pytest.approx(LIMITS.softened_share * TINY * YOUNG, rel=1e-3)


def test_a_staggered_bar_pulls_too_hard_by_one_step() -> None:
    """A steady state: each step of strain d adds E d, and gives up what 3 mu eps_p = sigma - sigma_y relaxes.

    The deviator returns at a held shape, eps_p = (sigma - sigma_y) / (3 mu), and over a step eps_p = d: the force is
    too high by 3 mu d, that is of first order. Solved with its flow the same bar is on the curve (above).
    """
    for steps in (40, 80):
        scene, state = pulled([0, 4 * TINY], steps, "corotated", update="staggered")
        march(scene, state)
        assert stress(scene) - TINY * YOUNG == pytest.approx(3 * MU * 4 * TINY / steps, rel=0.01)


@pytest.mark.parametrize(
    ("scheme", "update", "is_noted"),
    [("quasi-static", "staggered", True), ("quasi-static", "implicit", False), ("backward-euler", "staggered", True)],
)
def test_check_notes_staggered_flow(scheme: str, update: str, is_noted: bool) -> None:
    study = make_study(
        material={"energy": "corotated", "young": 1e3, "poisson": 0.3, "density": 1.0},
        plasticity={"yield_stress": 1.0, "update": update},
        boundary=[{"on": "left", "fix": "xy"}],
        time={"scheme": scheme, "step": 0.1, "end": 1.0},
    )
    assert ("up to 3 G d above" in "\n".join(check_study(study))) == is_noted


def test_an_extrapolated_bar_overshoots_where_flow_begins_and_then_catches_up() -> None:
    """The step in which flow begins is elastic: up by E d at most. Seven steps later the bar is on the curve."""
    for steps in (20, 80):
        scene, state = pulled([0, 4 * TINY], steps, "corotated", update="extrapolated", hardening=0.1)
        gaps = np.array([stress(scene) - bilinear(4 * TINY * state.t, 0.1) for _ in each_step(scene, state)])
        first = int(np.ceil(steps / 4))
        assert 0 < gaps.max() < 4 * TINY / steps * YOUNG and first - 1 <= gaps.argmax() <= first + 1
        np.testing.assert_allclose(gaps[first + 7 :], 0, atol=20 * TINY * bilinear(4 * TINY, 0.1))


def test_extrapolated_flow_follows_a_change_of_step() -> None:
    """Flow goes on at its rate per second: that of another step would leave 3 mu d / 2, 5 to 15 % of the stress."""
    scene, state = pulled([0, 8 * TINY], 40, "corotated", update="extrapolated", hardening=0.1)
    march(scene, state, 20)
    for dt in (1 / 80, 1 / 20):
        state.dt = dt
        march(scene, state, 1)
        assert abs(stress(scene) / bilinear(8 * TINY * state.t, 0.1) - 1) < 0.01


@pytest.mark.parametrize("energy", FINITE)
def test_a_step_is_solved_with_the_last_flow_once_more(energy: str) -> None:
    """The stress that balances is that of F G S^r, G and S = exp(-beta e) of the step before and r the ratio of the
    steps: S once more for a step of the same size, its first term in r for another. F_p itself is as it was afterwards.

    Against a dense evaluation, from the nodal forces of a body in one state of strain: int P : H dX of w = H x.
    """
    scene, _ = homogeneous(energy, yield_stress=0.02, hardening=0.01)
    plastic, random = scene.balance.stress.material.plastic, np.random.default_rng(5)
    before = np.eye(3) + 0.1 * random.uniform(-1, 1, (3, 3))
    deform(scene, before)
    scene.stepper.inelastic.flow.begin_step(0.1)
    scene.stepper.inelastic.flow()
    rows = plastic.inverse_rows.copy()
    G = rows[0].reshape(3, 3)
    F, H = before + 0.1 * random.uniform(-1, 1, (3, 3)), random.uniform(-1, 1, (3, 3))
    points, law = scene.domain.nodes[: scene.domain.node_count], law_of(ENERGIES[energy](MU, LAMBDA), 3)
    for dt, ratio in ((0.1, 1.0), (0.05, 0.5), (0.0, 0.0)):
        plastic.begin_step(dt)
        deform(scene, F)  # with the rotation of what stands in for F_e
        stand_in = G @ (np.eye(3) + ratio * (G - np.eye(3)))  # F_p was I, so that S = G
        stand_in /= np.cbrt(np.linalg.det(stand_in))
        tau = np.linalg.det(F) * law.cauchy(F @ stand_in)
        found = np.sum(scene.balance.stress.assemble_forces().reshape(-1, 3) * (points @ H.T))
        assert found == pytest.approx(np.sum(tau * (H @ np.linalg.inv(F))), rel=1e-10)
    np.testing.assert_array_equal(plastic.inverse_rows, rows)


def test_nothing_is_extrapolated_where_u_is_known(monkeypatch: pytest.MonkeyPatch) -> None:
    """Explicit steps, whatever the scheme is called: no time history stands in for the flow of the step."""
    monkeypatch.setitem(SCHEMES, "newmark", SCHEMES["explicit"])
    scene, _ = pulled([0, TINY], 100, "neo-hookean", "newmark", update="extrapolated")
    assert isinstance(scene.balance.stress.material.plastic.prediction, ImplicitPlasticFlow)


def test_a_stretch_never_turns_over() -> None:
    """Flow that took nearly all of a deviator, then a step ten times as long: the stand-in keeps det F_p = 1."""
    scene, _ = homogeneous("neo-hookean", yield_stress=1e-4)
    deform(scene, np.diag([3.0, 1.0, 0.3]))
    scene.stepper.inelastic.flow.begin_step(0.1)
    scene.stepper.inelastic.flow()
    plastic = scene.balance.stress.material.plastic
    G = plastic.inverse_rows[0].reshape(3, 3).copy()
    plastic.begin_step(1.0)
    factors = np.linalg.eigvals(np.linalg.inv(G) @ plastic.inverse_rows[0].reshape(3, 3))
    assert np.all(factors.real > 0) and np.prod(factors).real == pytest.approx(1)


@pytest.mark.parametrize("measure", ("von-mises", "frobenius"))
@pytest.mark.parametrize("energy", FINITE)
def test_the_energy_known_from_flow_is_the_assembled_one(energy: str, measure: str) -> None:
    """int psi dX after the secant's last step, which looks at no stress; at large strain too."""
    for size in (0.02, 0.3) if measure == "von-mises" else (0.02,):  # pressure does not flow
        scene, _ = homogeneous(energy, yield_stress=0.01, hardening=0.02, measure=measure)
        deform(scene, np.eye(3) + size * np.random.default_rng(2).uniform(-1, 1, (3, 3)))
        scene.stepper.inelastic.flow.begin_step(0.1)
        scene.stepper.inelastic.flow()
        assert plastic_strain(scene).all()
        assert scene.stepper.inelastic.flow.elastic_energy == pytest.approx(
            scene.balance.stress.stored_energy(), rel=10 * POLICY.tolerance
        )


@pytest.mark.parametrize("energy", FINITE)
def test_flow_at_a_pressure_beyond_yield_dissipates_nothing(energy: str) -> None:
    """Frobenius norm: the pressure alone exceeds Y, so that what flows carries no shear stress.

    A step dissipated -K alpha^2 / 2 J/m^3 before, alpha its flow.
    """
    hardening = 0.1
    scene, _ = homogeneous(energy, yield_stress=0.01, hardening=hardening, measure="frobenius")
    scene.stepper.inelastic.flow.begin_step(0.1)
    deform(scene, np.diag([1.02, 1.02, 1.021]))
    scene.stepper.inelastic.flow()
    before = plastic_strain(scene).copy()
    scene.stepper.inelastic.flow.begin_step(0.1)
    deform(scene, np.diag([1.03, 1.03, 1.0315]))
    lost = scene.stepper.inelastic.flow()
    flowed = float((plastic_strain(scene) - before).mean())
    assert flowed > 1e-4
    assert abs(lost) < 0.01 * hardening * flowed**2 / 2


def two_halves(folder: Path) -> Path:
    """BAR of cells of 0.25 m in a file whose right half is the region "stiff"."""
    mesh = BUILDERS["box"](size=(1.0, 0.5, 0.5), h=0.25).build()
    stiff = np.flatnonzero(mesh.points[mesh.cells].mean(axis=1)[:, 0] > 0.5)
    write_mesh(replace(mesh, regions={"stiff": stiff}), folder / "bar.msh")
    return folder / "bar.msh"


def test_regions_yield_each_at_their_own(tmp_path: Path) -> None:
    """[material.NAME].yield_stress: inf never yields."""
    scene, state = make_scene(
        mesh={"file": str(two_halves(tmp_path))},
        material=MATERIAL | {"energy": "neo-hookean", "stiff": {"yield_stress": float("inf")}},
        plasticity={"yield_stress": TINY, "hardening": 0.1},
        boundary=[
            {"on": {"box": [[0, 0, 0], [0, 1, 1]]}, "fix": "xyz"},
            {"on": {"box": [[1, 0, 0], [1, 1, 1]]}, "displacement": [5 * TINY, 0.0, 0.0]},
        ],
        time={"scheme": "quasi-static", "step": 0.5, "end": 1.0},
    )
    march(scene, state)
    stiff, strain = scene.domain.cell_region == scene.domain.region_names.index("stiff"), plastic_strain(scene)
    assert 0 < np.count_nonzero(stiff) < len(stiff)
    assert not strain[stiff].any() and strain[~stiff].all()


# --- one return, against a dense one --------------------------------------------------------------------------------


def homogeneous(energy: str, dim: int = 3, **plasticity: Any) -> tuple[Scene, State]:
    return make_scene(
        mesh={"builder": "box", "size": [1.0] * dim, "h": 1.0},
        material=MATERIAL | {"energy": energy},
        plasticity=plasticity,
        time={"scheme": "backward-euler", "step": 0.1, "end": 1.0},
    )


def von_mises_of(sigma: Values) -> float:
    s = sigma - np.trace(sigma) / 3 * np.eye(3)
    return float(np.sqrt(1.5 * np.sum(s * s)))


@pytest.mark.parametrize("measure", ("von-mises", "frobenius"))
@pytest.mark.parametrize("energy", FINITE)
def test_the_return_is_that_of_a_dense_solver(energy: str, measure: str) -> None:
    """From a flowed state, loaded along other axes, at large strain: F_e = U Sigma (det(Sigma)^(-1/3) Sigma)^-beta V^T.

    SVD, Brent's method and the UFL energy evaluated in Python. The elastic part keeps its axes, which it would not
    with the factors in the order that M22 eq. 30 prints.
    """
    Y, K, share = 0.05, 0.2, 0.7
    rate = -np.log(1 - share) / 0.1
    scene, _ = homogeneous(energy, yield_stress=Y, hardening=K, measure=measure, flow_rate=rate)
    random, flow = np.random.default_rng(3), scene.stepper.inelastic.flow
    F, law = np.eye(3) + 0.25 * random.uniform(-1, 1, (3, 3)), law_of(ENERGIES[energy](MU, LAMBDA), 3)
    F *= 1.01 / np.cbrt(np.linalg.det(F))  # little pressure: the Frobenius norm can come down to yield
    G = np.eye(3) + 0.2 * random.uniform(-1, 1, (3, 3))
    G /= np.cbrt(np.linalg.det(G))
    inverse = scene.balance.stress.material.plastic.inverse.x.array.reshape(-1, 3, 3)
    inverse[:] = G
    plastic_strain(scene)[:] = 0.02
    deform(scene, F)
    flow.begin_step(0.1)
    flow()
    U, S, Vt = np.linalg.svd(F @ G)
    e = np.log(S) - np.log(S).mean()
    size = np.sqrt(2 / 3 * np.sum(e**2))

    def excess(beta: float) -> float:
        sigma = law.cauchy(U @ np.diag(S * np.exp(-beta * e)) @ Vt)
        q = von_mises_of(sigma) if measure == "von-mises" else np.linalg.norm(sigma)
        return float(q - Y - K * (0.02 + beta * size))

    assert excess(0) > Y  # well beyond yield
    beta = brentq(lambda x: excess(x) - (1 - share) * excess(0), 0, 1, xtol=1e-14)
    np.testing.assert_allclose(plastic_strain(scene), 0.02 + beta * size, rtol=100 * POLICY.tolerance)
    expected = U @ np.diag(S * np.exp(-beta * e)) @ Vt
    np.testing.assert_allclose(F @ inverse, np.broadcast_to(expected, inverse.shape), atol=100 * POLICY.tolerance)


@pytest.mark.parametrize("energy", FINITE)
def test_stress_beyond_yield_decays_with_the_flow_rate(energy: str) -> None:
    """Held in shear, q - Y falls like exp(-nu t) at any step: q(t) = Y + (q_0 - Y) exp(-nu t), at large strain too."""
    F, rate, Y = np.array([[1, 0.3, 0], [0, 1, 0], [0, 0, 1.0]]), 3.0, 0.05
    q_0 = von_mises_of(law_of(ENERGIES[energy](MU, LAMBDA), 3).cauchy(F))
    for dt in (0.1, 0.5):
        scene, state = homogeneous(energy, yield_stress=Y, flow_rate=rate)
        deform(scene, F)
        for _ in range(round(0.5 / dt)):
            scene.stepper.inelastic.flow.begin_step(dt)
            scene.stepper.inelastic.flow()
        found = FieldEvaluator(scene.balance.stress, ["von_mises"])(state, None)[1].values
        np.testing.assert_allclose(found, Y + (q_0 - Y) * np.exp(-rate * 0.5), rtol=20 * POLICY.tolerance)


# --- paths of homogeneous deformation -------------------------------------------------------------------------------


def led(scene: Scene, path: Any, steps: int) -> None:
    """Lead the body through the deformation gradients path(t), t in [0, 1]."""
    for n in range(1, steps + 1):
        deform(scene, path(n / steps))
        scene.stepper.inelastic.flow.begin_step(1 / steps)
        scene.stepper.inelastic.flow()


def winding(t: float) -> Values:
    """Stretch that turns into shear and back into compression, 20 times the yield strain."""
    F = np.eye(3)
    F[0, 0] += 0.02 * np.sin(2 * np.pi * t)
    F[0, 1] += 0.03 * (1 - np.cos(2 * np.pi * t))
    F[2, 0] += 0.01 * t
    return F


@pytest.mark.parametrize("energy", FINITE)
def test_plastic_volume_is_kept(energy: str) -> None:
    """det F_p = 1 to round-off after 1000 steps of flow."""
    scene, _ = homogeneous(energy, yield_stress=1e-3, hardening=0.01)
    led(scene, winding, 1000)
    assert plastic_strain(scene).min() > 0.05
    inverse = scene.balance.stress.material.plastic.inverse.x.array.reshape(-1, 3, 3)
    np.testing.assert_allclose(np.linalg.det(inverse), 1, atol=20 * EPS)


def test_the_result_converges_with_the_step() -> None:
    """Along a winding path, where backward Euler's return is not exact: first order."""
    found = []
    for steps in (50, 100, 200, 400):
        scene, _ = homogeneous("neo-hookean", yield_stress=2e-3, hardening=0.05)
        led(scene, winding, steps)
        found.append(plastic_strain(scene)[0])
    changes = np.abs(np.diff(found))
    assert slopes(changes)[-1] == pytest.approx(1, abs=0.15)
    assert changes[-1] < 0.01 * found[-1]


@pytest.mark.parametrize("energy", FINITE)
def test_a_turning_body_flows_alike(energy: str) -> None:
    """F_p lives in configurations that do not turn: the path Q(t) F(t) leaves the same F_p as F(t), to round-off; and
    a rigid turn of the flowed body adds nothing."""
    scenes = [homogeneous(energy, yield_stress=2e-3, hardening=0.05)[0] for _ in range(2)]
    angle = lambda t: np.array([[np.cos(t), -np.sin(t), 0], [np.sin(t), np.cos(t), 0], [0, 0, 1]])  # noqa: E731
    Q = rotation(3, 1)
    led(scenes[0], winding, 40)
    led(scenes[1], lambda t: Q @ angle(2 * t) @ Q.T @ winding(t), 40)
    memory = [memory_of(scene) for scene in scenes]
    assert memory[0][:, -1].min() > 0.01
    np.testing.assert_allclose(memory[1], memory[0], atol=1e-6 * memory[0][:, -1].max())
    led(scenes[0], lambda t: angle(3 * t) @ winding(1.0), 5)
    np.testing.assert_allclose(memory_of(scenes[0]), memory[0], atol=10 * POLICY.tolerance * 2e-3)


def test_pressure_makes_nothing_flow() -> None:
    """With von Mises not at all, far beyond yield; with the Frobenius norm there is no deviator to relax."""
    for measure in ("von-mises", "frobenius"):
        scene, _ = homogeneous("neo-hookean", yield_stress=1e-3, measure=measure)
        led(scene, lambda t: (1 - 0.1 * t) * np.eye(3), 3)
        memory = memory_of(scene)
        np.testing.assert_allclose(memory[:, :9], np.tile(np.eye(3).reshape(-1), (len(memory), 1)), atol=100 * EPS)
        np.testing.assert_allclose(memory[:, 9], 0, atol=100 * EPS)


# --- whole studies --------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("energy", FINITE)
def test_plane_strain_is_a_body_held_across_the_plane(energy: str) -> None:
    """A strip and a bar with u_z = 0, pulled to 20 yield strains: the same force, plastic strain and flow across."""
    found = []
    for dim in (2, 3):
        held = [{"on": "left", "fix": "x"}, {"on": "bottom" if dim == 2 else "front", "fix": "y"}]
        if dim == 3:
            held += [{"on": name, "fix": "z"} for name in ("bottom", "top")]
        pull = {"time": [0, 1], "value": [[0.0, *["free"] * (dim - 1)], [0.2, *["free"] * (dim - 1)]]}
        scene, state = make_scene(
            mesh={"builder": "box", "size": [1.0, 0.5, 1.0][:dim], "h": 0.5},
            material=MATERIAL | {"energy": energy},
            boundary=[*held, {"on": "right", "displacement": pull}],
            plasticity={"yield_stress": 0.01, "hardening": 0.05},
            time={"scheme": "quasi-static", "step": 0.1, "end": 1.0},
            probe=[{"name": "grip", "on": "right"}],
        )
        march(scene, state)
        sigma = FieldEvaluator(scene.balance.stress, ["stress"])(state, None)[1].values
        memory = memory_of(scene)
        np.testing.assert_allclose(memory, memory[:1].repeat(len(memory), 0), atol=1e-7)
        found.append([stress(scene) / 2, *memory[0], *sigma[0]])
    assert found[0][9] != 1.0
    np.testing.assert_allclose(found[0], found[1], atol=1e-7)


def test_quasi_static_dissipation_is_the_plastic_work() -> None:
    """V (sigma_y eps_p + K eps_p^2 / 2); the trapezia miss the corner of the curve within one step."""
    K, steps = 0.1, 80
    scene, state = pulled([0, 4 * TINY], steps, hardening=K)
    march(scene, state)
    left = 3 * TINY / (1 + K)
    assert state.dissipated == pytest.approx(0.25 * (TINY * left + K * left**2 / 2), rel=1e-3)


@pytest.mark.parametrize("scheme", ("newmark", "generalized-alpha", "explicit"))
def test_energy_balance(scheme: str) -> None:
    """Work = elastic + kinetic + dissipated as dt -> 0, with most of the work gone into flow."""
    gaps = []
    undamped = {"rho": 1.0} if scheme == "generalized-alpha" else {}
    for steps in (100, 200):
        scene, state = make_scene(
            mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.25},
            material=MATERIAL | {"energy": "neo-hookean"},
            boundary=[
                {"on": "left", "fix": "xy"},
                {"on": "right", "traction": {"time": [0, 4], "value": [[0.0, 0.0], [0.03, 0.002]]}},
            ],
            plasticity={"yield_stress": 0.02, "hardening": 0.02},
            time={"scheme": scheme, "step": 4.0 / steps, "end": 4.0} | undamped,
        )
        report = march(scene, state)[-1]
        gaps.append(abs(state.work - report.kinetic - report.elastic - state.dissipated) / state.work)
        assert state.dissipated > 0.5 * state.work
    assert gaps[-1] < 0.01 and slopes(gaps)[-1] > 0.8


def test_a_ductile_bar_yields_and_then_breaks() -> None:
    """Edges along the bar see sigma = Y + K eps_p: they break at eps_p = (strength - Y) / K, within a step.

    Without hardening the stress stays below the strength for ever, where an elastic bar would have broken.
    """
    strength, K = 1.5 * TINY, 0.1
    tough = {"fracture": {"strength": strength, "tie_break": 0.0}}
    scene, state = pulled([0, 10 * TINY], 200, hardening=K, **tough)
    for report in each_step(scene, state):
        if report.broken:
            break
    expected = (strength - TINY) / K
    assert plastic_strain(scene).max() == pytest.approx(expected, abs=2 * 10 * TINY / 200)
    scene, state = pulled([0, 10 * TINY], 50, **tough)
    assert sum(report.broken for report in march(scene, state)) == 0
    assert plastic_strain(scene).min() > 8 * TINY


def test_passes_flow_once() -> None:
    """Solving a step several times leaves one flow: the same state as a single pass where nothing breaks, and in a
    tearing body each pass starts from the step's start."""
    memory = []
    for passes in (1, 4):
        scene, state = pulled([0, 4 * TINY], 8, hardening=0.1, fracture={"strength": 1.0, "passes": passes})
        march(scene, state)
        memory.append(memory_of(scene))
    np.testing.assert_allclose(memory[1], memory[0], atol=1e-12)
    tearing = {"strength": 1.2 * TINY, "passes": 5, "cap": 0.02, "tie_break": 1e-3}
    scene, state = pulled([0, 8 * TINY], 20, "neo-hookean", "newmark", hardening=0.1, fracture=tearing)
    for _ in range(12):
        start = plastic_strain(scene).copy()
        march(scene, state, 1)
        assert np.all(plastic_strain(scene) >= start)
    assert scene.fracture.graph.broken.any()


def test_a_failed_step_does_not_flow() -> None:
    """Halved steps start from the F_p of the last good time: the curve is met all the same."""
    scene, state = pulled([0, 4 * TINY], 4, hardening=0.1)
    attempt, tries = scene.stepper._attempt, iter([False, True, False, *[True] * 99])

    def now_and_then(state: State, dt: float) -> Any:
        outcome = attempt(state, dt)
        return (
            outcome if next(tries) else type(outcome)(False, outcome.newton_iterations, outcome.krylov_iterations, "no")
        )

    scene.stepper._attempt = now_and_then  # type: ignore[method-assign]
    march(scene, state)
    assert scene.stepper.failures.steps_failed == 2
    assert stress(scene) == pytest.approx(bilinear(4 * TINY, 0.1), rel=20 * TINY)
