"""The evidence: fronts, orders and recommendations against brute force; duplication with virtual nodes; trials once."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from fracsim.mesh.simplices import local_edges, node_groups
from fracsim.meshes.builders.box import lattice
from fracsim.meshes.topology import facets_of, signed_measures
from fracsim.studies.evidence import __main__ as program
from fracsim.studies.evidence import (
    crack_count_cost,
    feature_cost,
    fracture_step_cost,
    self_contact_cost,
    solver_comparison,
)
from fracsim.studies.evidence.report_section import (
    CostPoint,
    Section,
    cheapest_point,
    fitted_order,
    median_and_half_range,
    pareto_front,
)
from fracsim.studies.evidence.trial import Trial
from fracsim.studies.evidence.virtual_nodes import DuplicatedMesh, duplicate_cut_cells
from fracsim.study.check import build_mesh
from fracsim.study.reader import validate

POINTS = st.lists(st.tuples(st.integers(0, 6), st.integers(0, 6)), max_size=12)


# --- arithmetic -----------------------------------------------------------------------------------------------------


@given(POINTS)
def test_the_front_is_what_nothing_beats(points: list[tuple[int, int]]) -> None:
    def beaten(p: tuple[int, int]) -> bool:
        return any(q[0] <= p[0] and q[1] <= p[1] and q != p for q in points)

    front = pareto_front([(float(a), float(b)) for a, b in points])
    assert sorted(front) == [i for i, point in enumerate(points) if not beaten(point)]
    assert [points[i] for i in front] == sorted(points[i] for i in front)


def test_failed_points_are_on_no_front() -> None:
    assert pareto_front([(1.0, float("nan")), (2.0, 3.0), (float("inf"), 0.0)]) == [1]


@given(st.floats(0.5, 4.0), st.floats(1e-6, 1e3))
def test_an_exact_power_has_its_order(order: float, factor: float) -> None:
    h = np.array([0.2, 0.1, 0.07, 0.01])
    assert fitted_order(h.tolist(), (factor * h**order).tolist()) == pytest.approx(order, rel=1e-9)


def test_the_order_is_that_of_least_squares() -> None:
    h, error = np.array([0.4, 0.2, 0.1, 0.05]), np.array([0.31, 0.07, 0.022, 0.004])
    slope = np.polyfit(np.log(h), np.log(error), 1)[0]
    assert fitted_order(h.tolist(), error.tolist()) == pytest.approx(slope, rel=1e-12)


@given(POINTS, st.integers(0, 6))
def test_the_recommended_setting_is_the_cheapest_that_is_good_enough(points: list[tuple[int, int]], limit: int) -> None:
    given_ = [CostPoint(float(a), float(b)) for a, b in points]
    found = cheapest_point(given_, limit)
    good = [point for point in given_ if point.error <= limit]
    assert (found is None) == (not good)
    assert found is None or (found in good and all(found.cost <= point.cost for point in good))


def test_timings_are_medians_with_half_their_range() -> None:
    assert median_and_half_range([3.0, 1.0, 1.5]) == (1.5, 1.0)


# --- virtual nodes --------------------------------------------------------------------------------------------------


def block(steps: tuple[int, int, int]) -> tuple[Any, Any]:
    points, cells = lattice(steps)
    return points * np.array(steps), cells


def groups_after(cells: Any, broken: Any) -> Any:
    """Node groups of cells whose edges are broken where `broken(a, b)` says so, for arrays of nodes."""
    edges = local_edges(3)
    flags = broken(cells[:, edges[:, 0]], cells[:, edges[:, 1]])
    return node_groups(3)[flags @ (1 << np.arange(len(edges)))]


def pieces_of(cells: Any, nodes: int) -> int:
    a, b = cells[:, :-1].ravel(), cells[:, 1:].ravel()
    return int(connected_components(coo_array((np.ones(len(a)), (a, b)), (nodes, nodes)))[0])


def check_laws(points: Any, cells: Any, new: DuplicatedMesh) -> None:
    """What holds for any cut: copies lie where their cell lies, material is neither lost nor made, the mesh is one."""
    np.testing.assert_array_equal(new.node[new.cells], cells[new.cell])
    np.testing.assert_allclose(np.bincount(new.cell, new.share), 1.0, rtol=1e-15)
    volume = np.abs(signed_measures(points[new.node], new.cells)) @ new.share
    assert volume == pytest.approx(np.abs(signed_measures(points, cells)).sum(), rel=1e-12)
    assert new.owned.sum() == cells.size, "each corner of each cell is owned by one copy"
    faces = np.sort(facets_of(new.cells).reshape(-1, 3), axis=1)
    assert np.unique(faces, axis=0, return_counts=True)[1].max() <= 2, "no face has three cells"
    assert np.array_equal(np.unique(new.cells), np.arange(len(new.node)))


def test_a_whole_body_is_left_as_it_is() -> None:
    points, cells = block((3, 2, 2))
    new = duplicate_cut_cells(cells, np.zeros_like(cells), len(points))
    np.testing.assert_array_equal(new.node[new.cells], cells)
    assert len(new.node) == len(points) and new.share.min() == 1.0 and len(new.cells) == len(cells)


def test_a_plane_through_doubles_the_nodes_beside_it() -> None:
    """Cut between x = 1 and x = 2 of a lattice: the 12 nodes of each of the two layers get a virtual twin, and every
    cell between them a twin: 3 x 2 cubes of 6 cells."""
    points, cells = block((4, 3, 2))
    groups = groups_after(cells, lambda a, b: (points[a, 0] < 1.5) != (points[b, 0] < 1.5))
    new = duplicate_cut_cells(cells, groups, len(points))
    check_laws(points, cells, new)
    assert len(new.node) == len(points) + 2 * 12
    assert len(new.cells) == len(cells) + 3 * 2 * 6
    assert pieces_of(new.cells, len(new.node)) == 2


def test_a_cut_that_ends_inside_leaves_one_body() -> None:
    """The same plane over half of a greater width: what lies ahead of its tip stays joined."""
    points, cells = block((4, 8, 2))

    def broken(a: Any, b: Any) -> Any:
        across = (points[a, 0] < 1.5) != (points[b, 0] < 1.5)
        return across & (points[a, 1] < 4.5) & (points[b, 1] < 4.5)

    new = duplicate_cut_cells(cells, groups_after(cells, broken), len(points))
    check_laws(points, cells, new)
    assert pieces_of(new.cells, len(new.node)) == 1
    copies = np.bincount(new.node)
    beside = np.isin(points[:, 0], (1, 2))
    np.testing.assert_array_equal(copies[beside & (points[:, 1] <= 2)], 2, "behind the tip, as in a plane through")
    np.testing.assert_array_equal(copies[~beside | (points[:, 1] > 5)], 1, "ahead of it and elsewhere nothing changes")


@pytest.mark.parametrize("share", [0.1, 0.3, 0.6, 0.9, 1.0])
@pytest.mark.parametrize("seed", range(4))
def test_pieces_are_those_of_the_graph(share: float, seed: int) -> None:
    """Edges broken at random, crack tips everywhere: nodes are joined in the mesh where intact edges join them."""
    points, cells = block((3, 3, 2))
    count = len(points)
    cut = np.random.default_rng(seed).random((count, count)) < share
    cut |= cut.T
    new = duplicate_cut_cells(cells, groups_after(cells, lambda a, b: cut[a, b]), count)
    check_laws(points, cells, new)
    pairs = cells[:, local_edges(3)].reshape(-1, 2)
    a, b = pairs[~cut[pairs[:, 0], pairs[:, 1]]].T
    graph = coo_array((np.ones(len(a)), (a, b)), (count, count))
    assert pieces_of(new.cells, len(new.node)) == connected_components(graph, directed=False)[0]


# --- growth and ladder ----------------------------------------------------------------------------------------------


def test_growth_of_a_small_body(monkeypatch: pytest.MonkeyPatch) -> None:
    """One plane halves the body for both methods; only the baseline has more unknowns for it, and both move alike."""
    mesh = {"builder": "box", "size": [0.6, 0.2, 0.2], "h": 0.1}
    monkeypatch.setitem(crack_count_cost.SCENES, "small", mesh)
    figures = crack_count_cost.measure("small", [0, 1], baseline=True)
    before, after = figures["stages"]
    assert (before["pieces"], after["pieces"]) == (1, 2) and before["broken_edges"] == 0 < after["broken_edges"]
    assert before["unknowns"] == after["unknowns"] == before["baseline_unknowns"] == 3 * figures["nodes"]
    # between x = 0.3 and x = 0.4 lie two layers of 3 x 3 nodes, which get twins
    assert figures["nodes"] == 7 * 9 and after["baseline_unknowns"] == 3 * (figures["nodes"] + 2 * 9)
    assert all(stage[key] > 0 for stage in figures["stages"] for key in ("cut", "whole", "baseline", "cut_ratio"))


def test_sections_show_what_failed() -> None:
    """Groups make their sections from records of trials that failed, and say so."""
    for module in (crack_count_cost, feature_cost):
        records = [
            {
                "group": trial.group, "case": trial.case, "name": trial.name, "settings": trial.settings, "ranks": 1,
                "outcome": "failed (1)", "message": "boom", "command": "x", "wall": [1.0], "stepping": [],
                "summary": None, "figures": {},
            }
            for trial in module.trials()
        ]  # fmt: skip
        sections = module.sections(records)
        rows = [row for section in sections for table in section.tables for row in table.rows]
        assert len(rows) == len(records) and all(str(row[-1]).startswith("failed (1)") for row in rows)
        assert all(claim.holds is not True for section in sections for claim in section.claims)


def test_faces_lie_on_each_other_or_cross_in_edges() -> None:
    """By the height of the lower cube and what of the upper is nearest: a face of it, or an edge of 2 nodes or more."""
    for kind, top, nearest in (("flat", 0.5, 9), ("edge", 0.5**0.5, 3)):
        x = self_contact_cost.two_cubes(kind, 1, 0.1).points
        lower, upper = x[:8, 2], x[8:, 2]
        assert lower.max() == pytest.approx(top) and upper.min() == pytest.approx(top + 0.1)
        assert (upper < upper.min() + 1e-9).sum() == nearest


def test_cost_of_self_contact_is_measured(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip("ipctk")
    monkeypatch.setattr(self_contact_cost, "CONTACT_STEPS", 1)
    monkeypatch.setattr(self_contact_cost, "REPEATS", 1)
    figures = self_contact_cost.measure("flat", 1)
    assert figures["touching"] > 0 and all(figures[name] > 0 for name in self_contact_cost.PAIR_OPERATIONS)


def test_flat_on_flat_is_held_against_edge_on_edge() -> None:
    def record(kind: str, step: float) -> dict[str, Any]:
        figures = {"triangles": 1, "touching": 1, "newton": 2.0, "step": step} | dict.fromkeys(
            self_contact_cost.PAIR_OPERATIONS, 1e-3
        )
        return {"name": kind, "figures": figures, "outcome": "done", "message": ""}

    for step, holds in ((1.2, True), (1.5, False)):
        section = self_contact_cost.section([record("flat", step), record("edge", 1.0)])
        assert section.claims[0].holds is holds and len(section.tables[0].rows) == 2


def test_modules_of_other_features_are_noticed() -> None:
    edges, average = "fracsim.mesh.edge_graph", "fracsim.fracture.nonlocal_average"
    modules = ["fracsim.deformable_run", "fracsim.output.surface", "fracsim.fracture.edge_history", edges, average]
    assert feature_cost.unused_feature_modules("elastic", 10, modules) == sorted(modules[1:])
    assert feature_cost.unused_feature_modules("damage", 10, [edges, average]) == [average]
    assert feature_cost.unused_feature_modules("average", 10, [edges, average]) == []


def test_every_feature_scene_is_a_study() -> None:
    from fracsim.study.reader import validate

    for name in feature_cost.feature_scenes(4):
        assert validate(feature_cost.feature_study(name, 4), name).title.startswith("bench")


# --- running --------------------------------------------------------------------------------------------------------


def test_trials_run_once_and_failed_ones_stay(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of three trials one fails and one is for --full; a second call takes what is there, a third what is new."""

    class Group:
        @staticmethod
        def trials() -> list[Trial]:
            broken = ("fracsim.no_such_module",)
            return [
                Trial("ladder", "a", "good", script=("json.tool", "--help"), limit=20.0),
                Trial("ladder", "a", "bad", script=broken, limit=20.0),
                Trial("ladder", "a", "long", script=broken, limit=20.0, full=True),
            ]

        @staticmethod
        def sections(records: list[dict[str, Any]]) -> list[Section]:
            return [Section(" ".join(f"{record['name']} {record['outcome']}" for record in records))]

    monkeypatch.setattr(program.importlib, "import_module", lambda *_: Group)

    def title(*options: str) -> str:
        monkeypatch.setattr(sys, "argv", ["evidence", str(tmp_path), "--only", "ladder", *options])
        program.main()
        data = json.loads((tmp_path / "evidence.json").read_text())
        assert data["about"]["cores"]
        return str(data["groups"]["ladder"]["sections"][0]["title"])

    record = tmp_path / "ladder" / "a" / "good" / "record.json"
    assert title() == "good done bad failed (1)"
    made = record.stat().st_mtime_ns
    assert title() == "good done bad failed (1)"
    assert title("--full") == "good done bad failed (1) long failed (1)"
    assert title() == "good done bad failed (1) long failed (1)", "what --full has left is shown"
    assert record.stat().st_mtime_ns == made


def test_what_a_group_doubts_is_run_again_and_kept(tmp_path: Path) -> None:
    """Times are added to those of the record, on disk too, until the group is content; other trials stay."""

    class Group:
        trials = staticmethod(lambda: [Trial("precision", "a", name, script=("json.tool", "--help")) for name in "xy"])

        @staticmethod
        def trials_to_repeat(records: list[dict[str, Any]]) -> set[tuple[str, str]]:
            return {("a", "y")} if len(records[1]["wall"]) < 3 else set()

    found = program._run("precision", Group, tmp_path, full=False)
    assert [len(record["wall"]) for record in found] == [1, 3]
    on_disk = [json.loads((tmp_path / "precision" / "a" / name / "record.json").read_text()) for name in "xy"]
    assert on_disk == found
    assert [len(record["wall"]) for record in program._run("precision", Group, tmp_path, full=False)] == [1, 3]


def test_a_section_that_cannot_be_made_says_so(tmp_path: Path) -> None:
    def broken(records: list[dict[str, Any]]) -> list[Section]:
        raise KeyError("step")

    path = program.write_evidence(tmp_path, {"growth": [{"group": "growth"}]}, {"growth": broken})
    (section,) = json.loads(path.read_text())["groups"]["growth"]["sections"]
    assert "KeyError: 'step'" in section["text"]


def test_hard_steps_are_held_against_their_bounds() -> None:
    def record(name: str, **figures: float) -> dict[str, Any]:
        return {"settings": {"of": name}, "figures": figures, "outcome": "done", "message": ""}

    def pane(share: float) -> dict[str, Any]:
        return record("explicit", cells=9000, steps=100, breaking=60, share=share, whole=2.0, all=2.0 * (1 + share))

    quick, slow = (
        record(name, worst=worst)
        for name, worst in (("pulled", 1.5), ("bent", 2 * fracture_step_cost.MAX_STEP_SECONDS))
    )
    collapse, breaking, _ = fracture_step_cost.section([quick, pane(0.9)]).claims
    assert collapse.holds and collapse.measured == "1.5 s (pulled)"
    assert breaking.holds and breaking.measured.startswith("0.90 of it: 3.8 s beside 2.0 s of 100 steps")
    collapse, breaking, _ = fracture_step_cost.section([quick, slow, pane(1.1)]).claims
    assert collapse.holds is False and "bent" in collapse.measured and breaking.holds is False
    for share, holds in ((0.04, True), (0.06, False)):
        *_, waits = fracture_step_cost.section([record("front", cells=192000, steps=60, share=share)]).claims
        assert waits.holds is holds and waits.measured == f"{share:.1%} of one of 192,000 tetrahedra"
    assert [claim.holds for claim in fracture_step_cost.section([]).claims] == [None, None, None]


def test_scenes_of_hard_steps_are_what_they_are_called() -> None:
    """Lattices of 5,280 triangles with a notch in one, and as many trials as scenes."""
    for name, data in fracture_step_cost.COLLAPSES.items():
        assert len(build_mesh(validate(data, name).mesh).cells) == 5280
    assert len({trial.name for trial in fracture_step_cost.trials()}) == len(fracture_step_cost.COLLAPSES) + 2


def test_the_default_solver_is_held_against_the_better_of_two() -> None:
    def record(name: str, default: float) -> dict[str, Any]:
        counts = {"newton": 1, "krylov": 9, "apart": 0.0}
        seconds = {"default": default, "CG": 1.0, "factors": 2.0}
        figures = {"dofs": 10} | {way: counts | {"seconds": each} for way, each in seconds.items()}
        return {"settings": {"of": name}, "figures": figures, "outcome": "done", "message": ""}

    claim = solver_comparison.section([record("a", 1.2), record("b", 0.9)]).claims[0]
    assert claim.holds and claim.measured.startswith("1.20 at most (a), of 2")
    assert solver_comparison.section([record("a", 1.2), record("b", 1.4)]).claims[0].holds is False
