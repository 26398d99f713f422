"""What once failed at an extreme, and must not again. The whole table: studies/evidence/stability.py."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.deformable_run import run_study
from fracsim.mesh.selection import select_nodes
from fracsim.mesh.selectors import Group
from fracsim.scene import build_scene
from fracsim.studies.evidence import stability_studies
from fracsim.study.reader import validate
from support.ranks import Arrays, OnRanks
from support.scenes import Walk, make_scene, march
from support.solver_policy import set_policy


@pytest.mark.parametrize(("velocity", "step"), [(1e3, 1e-6), (3e6, 1e-2)])
def test_a_fast_body_flies_on_in_short_steps(velocity: float, step: float) -> None:
    """No force acts: v stays, u = v t. The round-off of M u / dt^2 is more than all that Newton has to balance; taken
    for a residual it cannot be lowered, and halving the step makes it four times as large.
    """
    study = stability_studies.flying_block(velocity, step, 20)
    study["time"]["adapt"] = False
    scene = build_scene(MPI.COMM_WORLD, validate(study, "flying"))
    state = Walk(scene)
    for _ in range(20):
        state.advance()
    u, v = state.u.reshape(-1, 3), state.v.reshape(-1, 3)
    mass = scene.balance.mass.lumped.reshape(-1, 3)[:, :1]
    eps = np.finfo(float).eps
    drift = np.abs((mass * v).sum(axis=0) / mass.sum() - [velocity, 0.0, 0.0]).max()
    assert drift <= 20 * 8 * eps * velocity * 20  # each step divides the round-off of u = 20 v dt by dt
    assert np.allclose((mass * u).sum(axis=0) / mass.sum(), [velocity * step * 20, 0, 0], rtol=1e-12, atol=0.02 * step)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_body_of_flat_cells_flies_on(dim: int) -> None:
    """Cells 1e4 times as long as thick: the round-off of their forces is that of Y V / altitude^2 times u."""
    size = [1.0, 1e-4, 0.3][:dim]
    scene, state = make_scene(
        mesh={"builder": "box", "size": size, "h": 0.1},
        material={"energy": "neo-hookean", "young": 1e6, "poisson": 0.3, "density": 1e3},
        initial={"velocity": [1.0, 2.0, -0.5][:dim]},
        solver={},
        time={"scheme": "newmark", "step": 0.01, "end": 0.1, "adapt": False},
    )
    assert len(march(scene, state)) == 10
    np.testing.assert_allclose(state.v.reshape(-1, dim), np.tile([1.0, 2.0, -0.5][:dim], (len(state.v) // dim, 1)))


def collapsed(energy: str) -> dict[str, Any]:
    """Saint Venant-Kirchhoff in uniaxial tension: E_t = -nu E_1, so that l_t^2 = 1 - nu (l_1^2 - 1) is negative beyond
    l_1 = 2.08 for nu = 0.3: there is no such body.
    """
    study = stability_studies.stretched_block(3.0, material={"energy": energy}, steps=10)
    return study | {"output": study["output"] | {"every": 1}}


def test_a_body_without_volume_is_told(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    summary = run_study(MPI.COMM_WORLD, validate(collapsed("stvk"), "x"), tmp_path / "stvk")
    assert summary["smallest_J"] < 1e-6 and summary["inverted_cells"] == 192
    said = capfd.readouterr().err
    assert "192 unbroken cells are crushed flat or turned inside out" in said
    assert "first seen at t = 0.6 s" in said  # stretches are 1 + 2 t: 2.0 at 0.5 s, 2.2 at 0.6 s
    assert 'energy = "neo-hookean" resists that' in said


def test_a_sound_body_is_not_accused(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """The least J is that of the closed form: the neo-Hookean block's, whose lateral stretch is found by bisection."""
    from fracsim.studies.evidence.block_stretch import lateral_stretch

    study = collapsed("neo-hookean")
    study["boundary"][-1]["displacement"]["value"][1][0] = -0.5
    summary = run_study(MPI.COMM_WORLD, validate(study, "x"), tmp_path / "run")
    exact = 0.5 * lateral_stretch(study["material"], 0.5) ** 2
    assert summary["smallest_J"] == pytest.approx(exact, rel=1e-6) and summary["inverted_cells"] == 0
    assert "inside out" not in capfd.readouterr().err


def first_step(
    dim: int, size: list[float], h: float, order: int, axis: int, displacement: float, **material: Any
) -> tuple[float, int]:
    """Reaction, N, along an axis as the right end is displaced in one step, and whether the solution is rough.

    The left end rolls (axis 0) or is clamped.
    """
    motion: list[Any] = ["free"] * dim
    motion[axis] = displacement
    still = [0.0 if value != "free" else "free" for value in motion]
    supports: list[dict[str, Any]] = [{"on": "left", "fix": "xyz"[:dim]}]
    if axis == 0:
        small, edge = 1e-3 * h, [1e-3 * h, *[2 * length for length in size[1:]]]
        supports = [{"on": "left", "fix": "x"}, {"on": {"box": [[-small] * dim, [small] * dim]}, "fix": "xyz"[:dim]}]
        if dim == 3:
            supports.append({"on": {"box": [[-small] * 3, [*edge[:2], small]]}, "fix": "z"})
    right = {"on": "right", "displacement": {"time": [0.0, 1.0], "value": [still, motion]}}
    scene, state = make_scene(
        mesh={"builder": "box", "size": size, "h": h, "order": order},
        material={"young": 1e6, "density": 1e3, **material},
        boundary=[*supports, right],
        solver={},
        time={"scheme": "quasi-static", "step": 1.0, "end": 1.0},
    )
    march(scene, state, 1)
    nodes = select_nodes(scene.domain, Group("right"))
    force = float(scene.balance.reactions.reshape(-1, dim)[nodes, axis].sum())
    return force, scene.stepper.failure_counts()["rough_solutions"]


@pytest.mark.parametrize(("energy", "dim", "poisson"), [("linear", 2, 0.49999), ("linear", 3, 0.4999999)])
def test_a_nearly_incompressible_block_in_its_first_step(energy: str, dim: int, poisson: float) -> None:
    """Uniaxial tension, E A eps in 3D and E / (1 - nu^2) A eps in 2D: |r_0| is some thousand times that."""
    strain, size = 5e-5, [0.2, 0.1, 0.1][:dim]
    force, is_rough = first_step(dim, size, 0.05, 1, 0, 0.2 * strain, energy=energy, poisson=poisson)
    modulus = 1e6 / (1 - poisson**2) if dim == 2 else 1e6
    assert not is_rough and force == pytest.approx(modulus * 0.1 ** (dim - 1) * strain, rel=1e-4)


def test_a_slender_cantilever_in_its_first_step() -> None:
    """3 E I w / L^3 at a displacement of a thousandth of the thickness, L = 300 t: |r_0| is a million times that."""
    force, is_rough = first_step(2, [300.0, 1.0], 1.0, 2, 1, 1e-3, energy="stvk", poisson=0.0)
    assert not is_rough and force == pytest.approx(3 * 1e6 / 12 * 1e-3 / 300.0**3, rel=1e-3)


def test_a_first_step_that_is_far_off_is_told() -> None:
    """At nu = 0.49999999 the force of a strain of 1e-3 is several times too large after two further iterations."""
    force, is_rough = first_step(2, [0.2, 0.1], 0.05, 1, 0, 2e-4, energy="stvk", poisson=0.49999999)
    assert is_rough and force > 1.2 * 1e6 / 0.75 * 0.1 * 1e-3


def test_factors_where_iterations_fail(monkeypatch: pytest.MonkeyPatch) -> None:
    """With three Krylov iterations no attempt gets through: factors give the answer that enough of them give, and the
    preconditioner is what it was afterwards.
    """
    set_policy(monkeypatch, max_plain_direct_dofs=0)  # the plain solver begins with factors otherwise
    results = []
    for options in ({"ksp_rtol": 1e-10}, {"ksp_max_it": 3, "ksp_rtol": 1e-10}):
        study = stability_studies.stretched_block(1.5, steps=2) | {"solver": options}
        scene = build_scene(MPI.COMM_WORLD, validate(study, "x"))
        state = Walk(scene)
        state.advance()
        assert scene.solver is not None and scene.stepper.failures.steps_failed == 0
        ksp = scene.solver.snes.ksp
        assert (ksp.getType(), ksp.pc.getType()) == ("cg", "gamg")
        results.append(state.u)
        state.advance()
        scene.destroy()
    assert np.allclose(*results, rtol=0, atol=1e-5 * np.abs(results[0]).max())


@pytest.fixture(scope="module")
def results(on_ranks: OnRanks) -> Callable[[int], Arrays]:
    return lambda ranks: on_ranks(ranks)[0]


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", [1, 2, 3])
def test_extremes_on_ranks(ranks: int, results: Callable[[int], Arrays]) -> None:
    """At nu = 0.4999 tangents are indefinite on the way; CG and GMRES gave up on some numbers of ranks, and the steps
    that were halved then led to other cracks. The block that is pushed through itself has F_xx = -1, so J = -1 in each
    of its 8 x 2 x 2 x 6 cells. The body in flight has m v^2 / 2 with m = 62.5 kg and v = 1 km/s, and as good as no
    energy in its spin of 1/s. Newton is solved to 1e-6.

    Energy from nowhere is what generalized-alpha made of 47 J of work where breaks left the acceleration as it was and
    work was that of extrapolated forces: 48 J, with a step that failed on one rank and not on two.
    """
    found = results(ranks)
    for scheme in ("backward-euler", "generalized-alpha"):
        torn, alone = found[scheme], results(1)[scheme]
        assert torn[0] == 0 and torn[1] > 100
        assert torn[1] == alone[1]
        assert torn[3] < 0.1 and torn[3] == pytest.approx(float(alone[3]), abs=1e-4)
    assert found["backward-euler"][2] == pytest.approx(float(results(1)["backward-euler"][2]), rel=1e-4)
    assert found["crushed"] == pytest.approx([192, -1.0, 1.0], rel=1e-6)
    assert found["flown"] == pytest.approx([0, 0.5 * 62.5 * 1e6], rel=1e-6)
