"""Cells that carry nothing any more are not integrated, and nothing but the time of a step tells."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from cases import BAR, study
from fracsim.deformable_run import Run
from fracsim.mechanics.jit import CellForm
from fracsim.mechanics.plasticity import ExtrapolatedPlasticFlow
from fracsim.mechanics.tangent import Tangent
from fracsim.scene import Scene, build_scene
from fracsim.timestepping.state import State
from support.reference import dense_tangent
from support.scenes import Values, make_scene, march
from support.torn import SOFT, integrated_cells, weaken

SIDES = [
    {"on": "left", "displacement": [0.1, "free", "free"]},
    {"on": "right", "pressure": 0.2},
    {"on": "top", "pressure": 0.1},
]
CASES: dict[str, dict[str, Any]] = {
    # u is no coefficient of this tangent, but one of its form
    "linear": {"material": SOFT | {"energy": "linear"}, "damping": {"stiffness": 0.2}},
    "damped": {"material": SOFT | {"energy": "neo-hookean"}, "damping": {"mass": 0.1, "stiffness": 0.2}},
    "rotated": {"material": SOFT | {"energy": "corotated"}},
    "flowing": {
        "material": SOFT | {"energy": "neo-hookean"}, "plasticity": {"yield_stress": 0.01, "update": "implicit"},
    },
    "extrapolated": {"material": SOFT | {"energy": "neo-hookean"}, "plasticity": {"yield_stress": 0.01}},
}  # fmt: skip


def damaged(case: str, dim: int, **tables: Any) -> tuple[Scene, State]:
    """An unstructured body, loaded, deformed and flowing at random, with a third of its cells dead."""
    sides = [{key: value[:dim] if isinstance(value, list) else value for key, value in side.items()} for side in SIDES]
    mesh = {"builder": "box", "size": [1.0, 0.7, 0.6][:dim], "h": 0.2 if dim == 2 else 0.3, "pattern": "unstructured"}
    scene, state = make_scene(**CASES[case] | {"mesh": mesh, "boundary": sides, "fracture": {"strength": 1e9}} | tables)
    plastic = scene.balance.stress.material.plastic
    if plastic is not None and isinstance(plastic.prediction, ExtrapolatedPlasticFlow):
        plastic.prediction.rates = np.random.default_rng(4).uniform(0, 0.5, (scene.domain.cell_count, 6))
    scene.balance.begin_step(0.1, 0.1, state.u, state.v, state.a)
    scene.balance.set_displacement(np.random.default_rng(5).uniform(-0.02, 0.02, len(state.u)))
    weaken(scene)
    return scene, state


def forces(scene: Scene) -> list[Values]:
    """Residual, forces of the stress, damping and reactions, copies."""
    balance = scene.balance
    drag = balance.energies.damping_forces()
    parts = [balance.update_forces().copy(), balance.stress.assemble_forces(), *([] if drag is None else [drag])]
    balance.update_reactions()
    return [*parts, balance.reactions.copy()]


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("case", CASES)
def test_the_force_that_went_is_that_of_the_cells_that_lost_some(case: str, dim: int) -> None:
    """The difference of two forces of the whole body, before and after a few cells lost half of what they had; the form
    is then again what it was."""
    stress = damaged(case, dim)[0].balance.stress
    before, old = [field.x.array.copy() for field in stress.damage_fields], stress.assemble_forces()
    stress.chi.x.array[:9] *= 0.5
    expected = old - stress.assemble_forces()
    found = stress.assemble_released_forces(before)
    assert np.abs(expected).max() > 1e-4
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-13 * np.abs(old).max())
    np.testing.assert_allclose(stress.assemble_forces(), old - expected, rtol=0, atol=1e-15 * np.abs(old).max())


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("case", CASES)
def test_forces_and_tangent_without_dead_cells(case: str, dim: int) -> None:
    """They only ever added zeros: not a bit changes, whatever carries the factor chi, facets and supports included."""
    scene, _ = damaged(case, dim)
    whole, tangent = forces(scene), dense_tangent(scene)
    scene.balance.damage_changed()
    assert np.array_equal(integrated_cells(scene), np.flatnonzero(scene.balance.stress.chi.x.array))
    for after, before in zip(forces(scene), whole, strict=True):
        np.testing.assert_array_equal(after, before)
    np.testing.assert_array_equal(dense_tangent(scene), tangent)
    assert np.abs(tangent).max() > 0.1


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("case", CASES)
def test_a_smaller_tangent_is_the_same_one(case: str, dim: int) -> None:
    """Without the entries of dead cells: a node that has no other keeps its place on the diagonal, and not a bit of
    what is left changes."""
    scene, _ = damaged(case, dim)
    balance, tangent = scene.balance, dense_tangent(scene)
    entries = balance.tangent.matrix.getInfo()["nz_used"]
    balance.damage_changed()
    alive = len(integrated_cells(scene)) / scene.domain.cell_count
    assert not balance.tangent.may_shrink(alive - 0.01)
    assert balance.tangent.may_shrink(alive + 0.01)
    balance.tangent.shrink()
    np.testing.assert_array_equal(dense_tangent(scene), tangent)
    assert balance.tangent.matrix.getInfo()["nz_used"] < entries
    assert not balance.tangent.may_shrink(1.0), "nothing died since"


def test_cells_that_are_back_find_room() -> None:
    """A tangent of the body before its last breaks is asked for now and then."""
    scene, _ = damaged("damped", 3)
    balance, chi = scene.balance, scene.balance.stress.chi.x.array
    chi[:] = 0.5
    whole = dense_tangent(scene)
    chi[::2] = 0.0
    balance.damage_changed()
    assert balance.tangent.may_shrink(1.0)
    balance.tangent.shrink()
    chi[:] = 0.5
    balance.damage_changed()
    assert balance.tangent.may_shrink(0.0)
    balance.tangent.shrink()
    np.testing.assert_array_equal(dense_tangent(scene), whole)


@pytest.mark.parametrize("scheme", ("backward-euler", "generalized-alpha"))
def test_a_smaller_tangent_tears_a_plate_the_same_way(monkeypatch: pytest.MonkeyPatch, scheme: str) -> None:
    """Every edge that breaks and every displacement are those of a run whose matrix keeps its size."""
    may, fitted, found = Tangent.may_shrink, [], []
    for choice in (lambda tangent, share: fitted.append(may(tangent, share)) or fitted[-1], lambda *_: False):
        monkeypatch.setattr(Tangent, "may_shrink", choice)
        scene, state = make_scene(
            mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.05, "pattern": "unstructured"},
            boundary=[{"on": "left", "fix": "xy"}, {"on": "right", "velocity": [0.4, 0.0]}],
            fracture={"strength": 0.03},
            time={"scheme": scheme, "step": 0.1, "end": 1.0},
            solver={"ksp_rtol": 1e-10, "snes_rtol": 1e-10},
        )
        march(scene, state)
        entries = scene.balance.tangent.matrix.getInfo()["nz_used"]
        found.append((state.u.copy(), scene.fracture.graph.broken.copy(), entries))
    (small, torn, entries), (kept, same, all_entries) = found
    assert any(fitted) and entries < all_entries
    assert torn.any() and np.array_equal(torn, same)
    np.testing.assert_allclose(small, kept, rtol=0, atol=1e-6 * np.abs(kept).max())


def test_a_consistent_mass_keeps_its_pattern() -> None:
    """It couples the nodes of dead cells, too."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.1, "pattern": "unstructured"},
        boundary=[{"on": "left", "fix": "xy"}, {"on": "right", "velocity": [0.2, 0.0]}],
        fracture={"strength": 0.05},
        time={"mass": "consistent", "scheme": "newmark", "step": 0.1, "end": 1.0},
    )
    march(scene, state)
    assert len(integrated_cells(scene)) < scene.domain.cell_count
    assert not scene.balance.tangent.may_shrink(1.0)


def test_no_entry_is_kept_for_nothing() -> None:
    """2 x 2 for each pair of nodes in a living cell, and for each node with itself."""
    scene, _ = make_scene(mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.1}, fracture={"strength": 1e9})
    domain, chi = scene.domain, scene.balance.stress.chi.x.array
    chi[: domain.cell_count] = np.random.default_rng(6).uniform(size=domain.cell_count) < 0.2
    scene.balance.damage_changed()
    assert scene.balance.tangent.may_shrink(1.0)
    scene.balance.tangent.shrink()
    pairs = np.eye(domain.node_count, dtype=bool)
    for nodes in domain.cell_nodes[chi[: domain.cell_count] > 0]:
        pairs[np.ix_(nodes, nodes)] = True
    scene.balance.tangent.assemble()
    assert scene.balance.tangent.matrix.getInfo()["nz_used"] == 4 * np.count_nonzero(pairs)


def test_every_death_counts_from_all_cells() -> None:
    """Bound again after more cells have died, and after chi was read from elsewhere."""
    scene, _ = damaged("damped", 2)
    balance, chi = scene.balance, scene.balance.stress.chi.x.array
    balance.damage_changed()
    chi[::2] = 0.0
    balance.damage_changed()
    assert np.array_equal(integrated_cells(scene), np.flatnonzero(chi))
    chi[:] = 0.5
    balance.damage_changed()
    assert len(integrated_cells(scene)) == len(chi)


@pytest.mark.parametrize(
    "tables",
    (
        {"fracture": {"strength": 1e9, "unilateral": True}},
        {"fracture": {"strength": 1e9, "approach": "edge"}},
        {"time": {"scheme": "quasi-static", "step": 0.1, "end": 1.0}, "boundary": [{"on": "left", "fix": "xy"}]},
    ),
    ids=("closing", "edge", "quasi-static"),
)
def test_cells_that_keep_something_stay(tables: dict[str, Any]) -> None:
    """Springs of cracks, projected strains, and the floor of a quasi-static study."""
    scene, _ = make_scene(**{"fracture": {"strength": 1e9}} | tables)
    if scene.balance.stress.chi is not None:
        scene.balance.stress.chi.x.array[:] = 0.0
    scene.balance.damage_changed()
    assert len(integrated_cells(scene)) == scene.domain.cell_count


@pytest.mark.parametrize("strength", (0.05, 1e9), ids=("torn", "whole"))
def test_cells_are_left_out_as_they_die_and_not_before(monkeypatch: pytest.MonkeyPatch, strength: float) -> None:
    """A scene where nothing breaks never binds a form again; in a torn one just the living cells are integrated."""
    bound = []
    leave_out = CellForm.exclude_cells
    monkeypatch.setattr(CellForm, "exclude_cells", lambda form, dead: bound.append(1) or leave_out(form, dead))
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.1, "pattern": "unstructured"},
        boundary=[{"on": "left", "fix": "xy"}, {"on": "right", "velocity": [0.2, 0.0]}],
        fracture={"strength": strength},
    )
    march(scene, state)
    living = np.flatnonzero(scene.balance.stress.chi.x.array)
    assert np.array_equal(integrated_cells(scene), living)
    assert bool(bound) == (len(living) < scene.domain.cell_count) == (strength < 1)


@pytest.mark.parametrize("solver", ({}, {"ksp_type": "preonly", "pc_type": "lu"}), ids=("multigrid", "direct"))
@pytest.mark.parametrize("scheme", ("newmark", "explicit"))
def test_dust_falls(scheme: str, solver: dict[str, Any]) -> None:
    """With every edge broken no cell is left: each node falls by g t^2 / 2, which both schemes have exactly."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.25},
        material=SOFT | {"energy": "neo-hookean"},
        fracture={"strength": 1e9},
        load={"gravity": [0.0, -9.81]},
        time={"scheme": scheme, "step": 0.01, "end": 0.1},
        solver={} if scheme == "explicit" else solver,
    )
    graph = scene.fracture.graph
    graph.break_edges(np.ones(len(graph.broken), bool))
    scene.fracture.degradation(True, *scene.fracture.evaluate_undamaged_stress())
    scene.balance.damage_changed()
    assert len(integrated_cells(scene)) == 0
    march(scene, state)
    fallen = state.u.reshape(-1, 2) - [0.0, -9.81 * 0.1**2 / 2]
    np.testing.assert_allclose(fallen, 0.0, atol=1e-9)


def test_a_restart_leaves_the_same_cells_out(tmp_path: Path) -> None:
    """chi of a checkpoint binds the forms before the first step."""
    data = study(BAR, time={"scheme": "backward-euler"}, fracture={"strength": 1e9})
    going = Run(build_scene(MPI.COMM_SELF, data), tmp_path)
    graph = going.scene.fracture.graph
    graph.break_edges(np.random.default_rng(3).uniform(size=len(graph.broken)) < 0.6)
    going.scene.fracture.degradation(True, *going.scene.fracture.evaluate_undamaged_stress())
    going.scene.balance.damage_changed()
    going.record_breaks()
    going.checkpoint()
    again = Run(build_scene(MPI.COMM_SELF, data), tmp_path, restart=True)
    living = integrated_cells(again.scene)
    assert np.array_equal(living, integrated_cells(going.scene))
    assert 0 < len(living) < going.scene.domain.cell_count
