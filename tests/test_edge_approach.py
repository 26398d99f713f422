"""The edge-projected energy against M22 eqs. 19-22 in dense matrices: Voigt strain, T_strain inverted, cell by cell."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI
from pydantic import ValidationError

from cases import STRIP, changed, study
from fracsim.deformable_run import Run
from fracsim.errors import Stopped
from fracsim.forms.energies import lame
from fracsim.mesh.simplices import is_split, local_edges
from fracsim.scene import Scene, build_scene
from support.reference import dense_tangent, gradients
from support.scenes import make_scene, make_study, march

Values = npt.NDArray[np.float64]
YOUNG, POISSON = 1.0, 0.3
VOIGT = {2: [(0, 0), (1, 1), (0, 1)], 3: [(0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2)]}


def scene_of(dim: int, **tables: object) -> Scene:
    scene, _ = make_scene(
        mesh={"builder": "box", "size": [1.0] * dim, "h": 0.5, "pattern": "unstructured"},
        material={"energy": "linear", "young": YOUNG, "poisson": POISSON, "density": 1.0},
        fracture={"strength": 1e9, "approach": "edge"},
        **tables,
    )
    return scene


def elasticity(dim: int) -> Values:
    """E of Hooke's law for (normal strains, engineering shear strains)."""
    mu, lmbda = lame(YOUNG, POISSON)
    E = np.diag([2 * mu] * dim + [mu] * (len(VOIGT[dim]) - dim))
    E[:dim, :dim] += lmbda
    return E


def strain_along_edges(corners: Values) -> Values:
    """T_strain: n_i n_j on each component, shear once, since engineering shear counts twice already."""
    n = np.array([corners[j] - corners[i] for i, j in local_edges(corners.shape[1])])
    n /= np.linalg.norm(n, axis=1)[:, None]
    return np.array([[m[i] * m[j] for i, j in VOIGT[corners.shape[1]]] for m in n])


def strain_displacement(G: Values) -> Values:
    """B: (Voigt, (d + 1) d) from the gradients of the hat functions."""
    dim = G.shape[1]
    B = np.zeros((len(VOIGT[dim]), G.size))
    for row, (i, j) in enumerate(VOIGT[dim]):
        for a, g in enumerate(G):
            B[row, a * dim + i] += g[j]
            if i != j:
                B[row, a * dim + j] += g[i]
    return B


def dense(scene: Scene, integrity: Values) -> Values:
    """Sum of V B^T T^T zeta T^-T E T^-1 zeta T B over the cells (M22 eq. 22)."""
    X, cells = scene.domain.nodes, scene.domain.cell_nodes
    G, V = gradients(X[cells])
    K = np.zeros((X.size, X.size))
    for c, nodes in enumerate(cells):
        T = strain_along_edges(X[nodes])
        D = np.linalg.inv(T) @ np.diag(integrity[c]) @ T
        B = D @ strain_displacement(G[c])
        dofs = (nodes[:, None] * X.shape[1] + np.arange(X.shape[1])).ravel()
        K[np.ix_(dofs, dofs)] += V[c] * B.T @ elasticity(X.shape[1]) @ B
    return K


def patterns(scene: Scene, seed: int) -> Values:
    """Random integrity with every pattern in some cell: pattern c % 8 (64) in cell c, then random."""
    count, edges = scene.domain.cell_count, len(local_edges(scene.domain.dim))
    every = np.arange(1 << edges)
    chosen = np.random.default_rng(seed).integers(0, 1 << edges, count)
    chosen[: min(count, len(every))] = every[: min(count, len(every))]
    return ((chosen[:, None] >> np.arange(edges)) & 1 == 0).astype(float)


@pytest.mark.parametrize("dim", (2, 3))
def test_force_and_tangent_are_those_of_the_paper(dim: int) -> None:
    """Eqs. 21 and 22 on every pattern, and symmetric positive semi-definite."""
    scene = scene_of(dim, time={"scheme": "backward-euler", "step": 0.1, "end": 1.0})
    integrity = patterns(scene, 1)
    scene.balance.stress.integrity.x.array[:] = integrity.reshape(-1)  # type: ignore[union-attr]
    u = np.random.default_rng(2).uniform(-0.1, 0.1, scene.domain.nodes.size)
    scene.balance.set_displacement(u)
    K = dense(scene, integrity)
    scale = np.abs(K).max()
    np.testing.assert_allclose(scene.balance.stress.assemble_forces(), K @ u, atol=1e-12 * scale)
    np.testing.assert_allclose(dense_tangent(scene), K, atol=1e-12 * scale)
    assert np.linalg.eigvalsh(K).min() > -1e-12 * scale
    assert scene.balance.stress.stored_energy() == pytest.approx(0.5 * u @ K @ u, rel=1e-12)


@pytest.mark.parametrize("dim", (2, 3))
def test_without_damage_it_is_plain_elasticity(dim: int) -> None:
    """Eqs. 19 and 20: with all edges intact D = I."""
    scene = scene_of(dim, time={"scheme": "backward-euler", "step": 0.1, "end": 1.0})
    plain, _ = make_scene(
        mesh={"builder": "box", "size": [1.0] * dim, "h": 0.5, "pattern": "unstructured"},
        material={"energy": "linear", "young": YOUNG, "poisson": POISSON, "density": 1.0},
        time={"scheme": "backward-euler", "step": 0.1, "end": 1.0},
    )
    K = dense_tangent(plain)
    np.testing.assert_allclose(dense_tangent(scene), K, atol=1e-13 * np.abs(K).max() * 10)


def test_split_cells_keep_the_force_of_their_intact_edges() -> None:
    """Two broken edges of a triangle leave one: pulling its ends is resisted along it, unlike with chi."""
    scene = scene_of(2, time={"scheme": "backward-euler", "step": 0.1, "end": 1.0})
    assert is_split(2)[0b011]
    integrity = np.ones((scene.domain.cell_count, 3))
    integrity[0] = [0.0, 0.0, 1.0]
    K = dense(scene, integrity) - dense(scene, np.where(np.arange(len(integrity))[:, None] == 0, 0.0, integrity))
    i, j = scene.domain.cell_nodes[0][local_edges(2)[2]]
    n = scene.domain.nodes[j] - scene.domain.nodes[i]
    u = np.zeros(scene.domain.nodes.size)
    u[2 * j : 2 * j + 2] = n
    assert u @ K @ u > 1e-3


def test_energy_books_close_while_edges_break() -> None:
    """Work = elastic + kinetic + dissipated to second order in dt, whatever sign a single release has."""
    gaps = []
    for dt in (0.02, 0.01):
        scene, state = make_scene(
            mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.25, "pattern": "unstructured"},
            material={"energy": "linear", "young": 1.0, "poisson": 0.0, "density": 1.0},
            fracture={"strength": 0.02, "approach": "edge"},
            boundary=[{"on": "left", "fix": "xy"}, {"on": "right", "velocity": [0.05, 0.0]}],
            time={"scheme": "newmark", "step": dt, "end": 1.0},
        )
        reports = march(scene, state)
        assert sum(report.broken for report in reports) > 0
        gaps.append(abs(state.work - state.dissipated - reports[-1].elastic - reports[-1].kinetic) / state.work)
    assert gaps[1] < gaps[0] / 3 < 1e-4  # 0.01 and more where breaks leave the acceleration as it was


@pytest.mark.parametrize("energy", ("stvk", "neo-hookean"))
def test_refused_for_nonlinear_strains(energy: str) -> None:
    with pytest.raises(ValidationError, match='approach = "edge" is for the energies linear and corotated'):
        make_study(
            material={"energy": energy, "young": 1.0, "poisson": 0.0, "density": 1.0},
            fracture={"strength": 1.0, "approach": "edge"},
        )


def test_a_restart_takes_up_the_integrity(tmp_path: Path) -> None:
    """Stopped while it tears and continued: the displacement and the broken edges of the run without a stop."""
    data = changed(
        STRIP, material={"energy": "linear"}, fracture={"approach": "edge"}, output={"fields": ["damage"]},
        solver={"snes_rtol": 1e-11, "ksp_rtol": 1e-10},
    )  # fmt: skip
    whole = Run(build_scene(MPI.COMM_SELF, study(data)), tmp_path / "whole")
    whole()
    first = Run(build_scene(MPI.COMM_SELF, study(data)), tmp_path / "parts")
    steps = iter(range(6))
    first.interrupt.stop_reason = lambda: "" if next(steps, None) is not None else "the test"  # type: ignore[method-assign]
    with pytest.raises(Stopped):
        first()
    assert first.scene.fracture.graph.broken.any()
    second = Run(build_scene(MPI.COMM_SELF, study(data)), tmp_path / "parts", restart=True)
    second()
    assert np.array_equal(second.scene.fracture.graph.broken, whole.scene.fracture.graph.broken)
    np.testing.assert_allclose(second.state.u, whole.state.u, atol=1e-7 * np.abs(whole.state.u).max())
    assert second.state.dissipated == pytest.approx(whole.state.dissipated, rel=1e-6)
