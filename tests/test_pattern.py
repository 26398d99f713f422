"""The tangent's pattern grows as nodes are tied and pieces touch: whatever was made for an earlier one is made anew."""

from __future__ import annotations

import os
import re
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from cases import STRIP, changed, fracsim, write_study
from fracsim.mechanics.node_ties import Ties
from support.reference import gradients
from test_cycle import dense
from test_joining import tied

PLAIN = {"snes_type": "ksponly", "ksp_rtol": 1e-8}


@pytest.mark.parametrize("dim", (2, 3))
def test_factors_are_made_anew_once_nodes_are_tied(dim: int) -> None:
    """Kept from before the nodes were tied, while iterations have solved with the longer pattern in between: they find
    what dense elimination finds. With the old symbolic factors MUMPS writes past the end of its arrays."""
    scene, _, tethers = tied(dim, solver=PLAIN)
    linear, vector = scene.solver.linear, scene.balance.work_vector  # type: ignore[union-attr]
    ties = tethers.ties
    force = np.random.default_rng(2).standard_normal(scene.balance.owned_dof_count)
    for each in (Ties.empty(dim), ties):
        tethers._set_ties(each)
        vector.array_w[:] = force
        assert linear.solve()
        vector.array_w[:] = force
        with linear.factors():
            assert linear.solve()
        exact = np.linalg.solve(dense(scene.balance.tangent.matrix), force)
        assert np.abs(linear.correction.array_r - exact).max() < 1e-9 * np.abs(exact).max()
    scene.destroy()


@pytest.mark.parametrize("dim", (2, 3))
def test_a_consistent_mass_goes_to_its_own_entries(dim: int) -> None:
    """Also once the tangent has entries of ties beside it: rho V / ((d + 1) (d + 2)) (1 + delta_ij) of each cell."""
    found = {}
    for mass in ("lumped", "consistent"):
        scene, _, _ = tied(dim, time={"step": 0.1, "end": 1.0, "mass": mass}, solver=PLAIN)
        stiffness, balance, domain = scene.balance.tangent, scene.balance, scene.domain
        balance.c_a = 100.0
        for _ in range(3):  # the first one adds the entries of ties
            stiffness.assemble()
        found[mass] = dense(stiffness.matrix)
        rate = sum(term.mass_factor for term in balance.terms)
        lumped = np.diag(balance.mass.lumped)
    V = gradients(domain.nodes[domain.cell_nodes])[1] / ((dim + 1) * (dim + 2))
    M = np.zeros((len(domain.nodes),) * 2)
    corners = domain.cell_nodes
    of_cell = V[:, None, None] * (1 + np.eye(dim + 1))
    np.add.at(M, (corners[:, :, None], corners[:, None, :]), of_cell)
    expected = found["lumped"] + rate * (np.kron(M, np.eye(dim)) - lumped)
    assert np.abs(found["consistent"] - expected).max() < 1e-12 * np.abs(expected).max()
    assert rate > 0


def _complete_study() -> dict[str, Any]:
    """The study that docs/study-file.md shows."""
    text = (Path(__file__).parents[1] / "docs" / "study-file.md").read_text()
    return tomllib.loads(text.split("```toml")[1].split("```")[0])


TORN = changed(STRIP, fracture={"crumbs": False}, time={"end": 0.15}, output={"every": 10})
FALLING: dict[str, Any] = {"boundary": None, "load": {"gravity": [0.0, -9.81]}, "probe": None}
SHATTERED: dict[str, Any] = {
    "mesh": {"h": 0.06, "pattern": "unstructured"}, "material": {"young": 1e5},
    "fracture": {"strength": 1e3}, "boundary": [{"on": "left", "velocity": [0.0, 3.0]}, {"on": "right", "fix": "xy"}],
}  # fmt: skip
# with ties, contact and cells that die, in the plane and in space
MANY: dict[str, Any] = {
    "complete": changed(_complete_study(), fracture={"crumbs": False}),
    "complete-touching": changed(
        _complete_study(), fracture={"crumbs": False}, contact={}, mesh={"h": 0.03}, time={"end": 0.3}
    ),
    "complete-closing": changed(
        _complete_study(),
        fracture={"crumbs": False, "unilateral": True},
        mesh={"h": 0.03},
        time={"scheme": "backward-euler"},
    ),
    "torn": TORN,
    "torn-consistent": changed(TORN, time={"mass": "consistent", "scheme": "newmark"}),
    "torn-linear": changed(TORN, material={"energy": "linear"}, time={"scheme": "backward-euler"}),
    "shattered": changed(TORN, **SHATTERED),
    "shattered-touching": changed(TORN, **SHATTERED, contact={"friction": 0.3}, time={"scheme": "backward-euler"}),
    "shattered-pieces": changed(TORN, **SHATTERED, contact={"itself": "pieces"}),
    "quasi-static": changed(TORN, time={"scheme": "quasi-static", "step": 0.01, "end": 0.1}),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", MANY)
def test_no_memory_is_overwritten(name: str, tmp_path: Path) -> None:
    """PETSc's own guard around every array is whole at each release, as its malloc_debug tells; it ends the process
    where one is not."""
    path = write_study(tmp_path / "study.toml", MANY[name])
    env = {**os.environ, "PETSC_OPTIONS": "-malloc_debug"}
    done = fracsim("run", path, "-o", tmp_path / "out", env=env, timeout=280)
    assert done.returncode == 0, done.stderr[-3000:]
    assert "corrupted" not in done.stderr
    assert "1568 bytes" in done.stdout + done.stderr  # it was on: what is left is listed at the end
    breaks = int(re.findall(r"(\d+) broken edges", done.stdout)[0])
    assert breaks > 0
