"""The trials of the stability, dependence and experiments groups, what they measure, and the sections made of them."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.deformable_run import run_study
from fracsim.errors import InputError
from fracsim.studies.evidence import (
    block_stretch,
    contact_studies,
    custom_meshes,
    diametral_cracks,
    experiments,
    mesh_dependence,
    published_results,
    rejected_approaches,
    run_results,
    slit_specimens,
    stability,
    stability_measures,
    stability_studies,
)
from fracsim.studies.evidence.trial import Trial
from fracsim.study.check import check_study
from fracsim.study.reader import validate

TRIALS = [*stability.trials(), *mesh_dependence.trials()]


def test_trials_have_places_of_their_own() -> None:
    places = [(trial.group, trial.case, trial.name) for trial in TRIALS]
    assert len(set(places)) == len(places) > 100
    for trial in TRIALS:
        assert json.loads(json.dumps(trial.settings)) == trial.settings
        assert trial.limit <= 600 and (trial.study is None) != (not trial.script)
    pairs = {(t.case, t.name.rpartition("-r")[0]) for t in stability.trials() if t.case != "failed"}
    assert all((case, f"{name}-r{n}") in {p[1:] for p in places} for case, name in pairs for n in (1, 2))


def test_each_case_is_run_five_times_in_full() -> None:
    """On 1 and on 2 ranks; once of them always, and all of them are compared."""
    runs = [t for t in stability.trials() if t.case == "dt-5e-2" and t.name.startswith("cylinder-neo-hookean")]
    assert len(runs) == 10 and sorted(t.name for t in runs if not t.full) == [
        "cylinder-neo-hookean-r1", "cylinder-neo-hookean-r2",
    ]  # fmt: skip
    assert len({str(t.study) for t in runs}) == 1 and len({stability._study_name({"name": t.name}) for t in runs}) == 1


ONCE = [t for t in TRIALS if t.study and t.ranks == 1 and "." not in t.name.rpartition("-r")[2]]


@pytest.mark.parametrize("trial", ONCE, ids=lambda t: f"{t.case}-{t.name}")
def test_studies_are_valid(trial: Trial) -> None:
    """All but those that are there to be refused: a strength of zero, or none that is a number."""
    assert trial.study is not None
    if trial.name in ("0-Pa-r1", "nan-Pa-r1"):
        with pytest.raises(InputError, match=r"fracture\.strength"):
            validate(trial.study, "trial")
        return
    assert check_study(validate(trial.study, "trial"))


def test_measures_exist() -> None:
    modules = {
        module.__name__.rpartition(".")[2]: module for module in (stability_measures, mesh_dependence, contact_studies)
    }
    for trial in TRIALS:
        if trial.measure:
            module, _, name = trial.measure.partition(":")
            assert callable(getattr(modules[module], name))


# --- closed forms ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("energy", ["linear", "corotated", "stvk", "neo-hookean"])
def test_principal_stress_is_the_derivative_of_the_energy(energy: str) -> None:
    """P_1 = d psi / d l_1 and P_t = (1/2) d psi / d l_t, psi in principal stretches, by central differences."""
    material = stability_studies.RUBBER | {"energy": energy}
    mu, lmbda = 1e6 / 2.6, 3e5 / (1.3 * 0.4)

    def psi(l1: float, lt: float) -> float:
        stretches = np.array([l1, lt, lt])
        if energy == "neo-hookean":
            m, volumetric = 4 / 3 * mu, lmbda + 5 / 6 * mu
            trace, alpha = stretches @ stretches, 1 + m / volumetric - m / (4 * volumetric)
            both = m * (trace - 3) - m * np.log(trace + 1)
            return float(both / 2 + volumetric / 2 * (stretches.prod() - alpha) ** 2)
        strain = (stretches**2 - 1) / 2 if energy == "stvk" else stretches - 1
        return float(mu * strain @ strain + lmbda / 2 * strain.sum() ** 2)

    l1, lt, step = 1.7, 0.8, 1e-6
    P = block_stretch.principal_stress(material, l1, lt)
    along = (psi(l1 + step, lt) - psi(l1 - step, lt)) / (2 * step)
    across = (psi(l1, lt + step) - psi(l1, lt - step)) / (4 * step)
    assert pytest.approx((along, across), rel=1e-6) == P  # eps psi / step


def test_lateral_stretch_of_hooke_is_poissons() -> None:
    """l_t = 1 - nu (l_1 - 1); and where that is not positive there is no answer."""
    material = stability_studies.RUBBER | {"energy": "linear"}
    assert block_stretch.lateral_stretch(material, 1.2) == pytest.approx(1 - 0.3 * 0.2, rel=1e-12)
    with pytest.raises(ValueError):
        block_stretch.lateral_stretch(material, 5.0)


# --- measures -------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", [2, 3])
def test_volume_ratios_are_determinants(dim: int) -> None:
    """An affine map x = A X + b has J = det A in every cell; a mirror has a negative one."""
    from fracsim.meshes.builders.box import lattice

    points, cells = lattice((2,) * dim)
    A = np.eye(dim) + np.random.default_rng(1).normal(size=(dim, dim)) * 0.3
    for map_ in (A, A @ np.diag([-1.0] + [1.0] * (dim - 1))):
        u = np.zeros((len(points), 3))
        u[:, :dim] = points @ map_.T + 5.0 - points
        padded = np.pad(points, ((0, 0), (0, 3 - dim)))
        assert np.allclose(stability_measures.volume_ratios(padded, cells, u), np.linalg.det(map_), rtol=1e-12)


def rows(**columns: list[float]) -> dict[str, Any]:
    names = ("elastic", "kinetic", "dissipated", "external_work")
    return {name: np.array(columns.get(name, [0.0] * 3), float) for name in names}


def test_energy_growth() -> None:
    """A rise of the balance counts against the largest energy; a loss does not, nor what was there at first."""
    lossy = rows(kinetic=[1.0, 0.5, 0.4], external_work=[1.0, 1.0, 1.0])
    assert stability_measures.energy_growth(lossy, moving_at_start=False) == 0
    grown = rows(kinetic=[1.0, 0.5, 3.0], external_work=[1.0, 1.0, 1.0])
    assert stability_measures.energy_growth(grown, moving_at_start=False) == pytest.approx(2.5 / 3.0)
    thrown = rows(kinetic=[1.0, 1.0, 1.0])
    assert stability_measures.energy_growth(thrown, moving_at_start=True) == 0
    assert stability_measures.energy_growth(thrown, moving_at_start=False) == 1
    static = rows(elastic=[1.0, 2.0, 1.0], dissipated=[0.0, -0.5, 1.0], external_work=[1.0, 1.5, 2.0])
    assert stability_measures.energy_growth(static, moving_at_start=False) == pytest.approx(0.25)


def test_what_is_measured_of_a_run(tmp_path: Path) -> None:
    """A block stretched until all its edges along x break at once: the closed form and the counts."""
    study = stability_studies.stretched_block(1.2, steps=8, strength=1e5, material={"energy": "corotated"})
    run_study(MPI.COMM_WORLD, validate(study, "x"), tmp_path / "run")
    figures = stability_measures.measure_stretch(tmp_path / "run")
    assert figures["finite"] and figures["error"] < 1e-6 and figures["break_off_by"] == 0
    # 8 x 2 x 2 cubes have 8 x 3 x 3 edges along x; others follow where stress is left
    assert figures["broken_in_a_step"] >= 72 and figures["steps"] == 8
    assert figures["smallest_J"] == 1.0  # at rest: the body that is pulled swells, nu < 1/2


def test_a_wrong_force_is_an_error(tmp_path: Path) -> None:
    study = stability_studies.stretched_block(1.2, steps=2) | {"solver": {"snes_rtol": 1e-8}}
    run_study(MPI.COMM_WORLD, validate(study, "x"), tmp_path / "run")
    history = run_results.history(tmp_path / "run")
    history["reaction_pull_x"] *= 1.01
    error = block_stretch.stretch_error(run_results.study(tmp_path / "run"), history)["error"]
    assert error == pytest.approx(0.01, rel=1e-4)


def test_a_stiff_fall_has_the_impulse_of_its_momentum(tmp_path: Path) -> None:
    """At 1e11 Pa the first guess, cut at the floor, is off by more than all forces of the step (with a tolerance that
    looks at it the impulse was 4 % off). A force that is 1 % off, and a floor that was passed, are found."""
    study = contact_studies.falling_bar(1e-3, young=1e11, speed=1.0, steps=5)
    run = tmp_path / "run"
    run_study(MPI.COMM_WORLD, validate(study, "x"), run)
    figures = contact_studies.measure_fall(run)
    assert figures["error"] < 1e-3 and figures["passed"] == 0 and figures["newton_max"] > 3
    force = run_results.history(run)["contact_floor_z"]
    assert contact_studies._impulse_error(run, -1.01 * force) == pytest.approx(0.01, rel=0.1)
    stated = (run / "study.toml").read_text()
    (run / "study.toml").write_text(stated.replace("-0.0011", "0.1"))
    assert contact_studies.measure_fall(run)["passed"] > 0


def test_nodes_of_one_body_inside_another(tmp_path: Path) -> None:
    """Two cubes of 8 nodes, one moved into the other by a quarter: of one the 4 nodes of a face lie inside."""
    import h5py

    from fracsim.meshes.builders.box import Box

    one = Box(size=(1.0, 1.0, 1.0), h=1.0).build()
    points = np.concatenate([one.points, 0.5 * one.points + [0.25, 0.25, 1.0]])
    for shift, inside in ((0.1, 0), (-0.25, 4)):
        with h5py.File(tmp_path / "fields.h5", "w") as file:
            file["points"], file["cells"] = points, np.concatenate([one.cells, one.cells + 8])
            file["frames/000001/displacement"] = np.outer(np.arange(16) >= 8, [0.0, 0.0, shift])
            file["frames/000001"].attrs["time"] = 1.0
        assert contact_studies.count_penetrating_nodes(tmp_path) == inside


def test_nothing_is_measured_of_a_refusal(tmp_path: Path) -> None:
    assert stability_measures.measure_run(tmp_path) == {} and stability_measures.measure_stretch(tmp_path / "run") == {}


def test_crack_of_a_bar_in_two(tmp_path: Path) -> None:
    """A bar that came apart: its crack is at least as long as the ligament of 7 mm, and it carries nothing."""
    study = slit_specimens.specimen_study(
        slit_specimens.BAR, slit_specimens.unstructured_mesh(slit_specimens.BAR, 1e-3), 0.0
    )
    run_study(MPI.COMM_WORLD, validate(study, "x"), tmp_path / "run")
    figures = mesh_dependence.measure_bar(tmp_path / "run")
    assert figures["broken_area"] >= 7e-3 and figures["left"] < 1e-3
    assert 0 <= figures["stray"] < 20e-3 and figures["dissipated"] > 0


def test_structured_slit_has_the_same_outline() -> None:
    for specimen in slit_specimens.SPECIMENS.values():
        for h in (5e-4, 2.5e-4):
            mesh = slit_specimens.structured_mesh(specimen, h)
            corners = mesh.points[mesh.cells]
            area = np.linalg.det(corners[:, 1:] - corners[:, :1]).sum() / 2
            cut = np.prod(np.subtract(*specimen.slit[::-1]))
            assert area == pytest.approx(np.prod(specimen.size) - cut, rel=1e-12)


@pytest.mark.parametrize("name", list(custom_meshes.CUSTOM_STUDIES))
def test_written_studies_fit_their_meshes(name: str, tmp_path: Path) -> None:
    from fracsim.meshes.write import write_mesh

    mesh, study = custom_meshes.CUSTOM_STUDIES[name]()
    write_mesh(mesh, tmp_path / "mesh.msh")
    study["mesh"] = {"file": str(tmp_path / "mesh.msh")}
    assert check_study(validate(study, "x"))


# --- the failed approaches ------------------------------------------------------------------------------------------


@pytest.mark.parametrize("approach", rejected_approaches.APPROACHES)
def test_force_and_tangent_of_an_undamaged_bar(approach: str) -> None:
    """All approaches agree while nothing is broken: f is the derivative of the energy, K that of f."""
    bar = rejected_approaches.lattice_bar(approach)
    u = np.random.default_rng(2).normal(size=bar.points.shape) * 0.01
    f, K = bar.force_and_tangent(u)
    way, step = np.random.default_rng(3).normal(size=u.shape), 1e-6
    slope = (bar.energy(u + step * way) - bar.energy(u - step * way)) / (2 * step)
    assert f @ way.ravel() == pytest.approx(slope, rel=1e-6)
    turn = (bar.force_and_tangent(u + step * way)[0] - bar.force_and_tangent(u - step * way)[0]) / (2 * step)
    assert np.allclose(K @ way.ravel(), turn, atol=1e-6 * np.abs(turn).max())


def test_two_approaches_fail_and_chi_holds() -> None:
    assert rejected_approaches.judge(rejected_approaches.simulate("chi")) == "holds"
    projected = rejected_approaches.simulate("projected-stress")
    assert (
        projected["loop"] > 0.1 and projected["peak"] > 10 and "energy created" in rejected_approaches.judge(projected)
    )
    inverse = rejected_approaches.simulate("pseudo-inverse")
    assert inverse["rest_stress"] > 0.1 and inverse["lowest"] < -0.01 and inverse["jump"] > 1


# --- sections -------------------------------------------------------------------------------------------------------


def record(case: str, name: str, ranks: int, **changes: Any) -> dict[str, Any]:
    figures = {"finite": True, "growth": 0.0, "error": 1e-9, "broken": 3, "pieces": 2}
    return {
        "group": "stability", "case": case, "name": f"{name}-r{ranks}", "ranks": ranks, "settings": {"of": name},
        "outcome": "done", "message": "", "wall": [1.0], "summary": None, "figures": figures,
    } | changes  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({}, "right"),
        ({"figures": {"finite": True}}, "stable"),
        ({"outcome": "refused", "message": "fracsim: strength = 0"}, "refused: strength = 0"),
        ({"outcome": "refused"}, "WRONG: refused without a word"),
        ({"outcome": "out of time"}, "WRONG: out of time"),
        ({"figures": {"finite": False}}, "WRONG: not finite"),
        ({"figures": {}}, "WRONG: not finite"),
        ({"figures": {"finite": True, "growth": 0.2}}, "WRONG: energy grew"),
        ({"figures": {"finite": True, "passed": 3, "error": 0.0}}, "WRONG: 3 points passed through"),
        ({"figures": {"finite": True, "error": 0.5}}, "WRONG: far from the closed form"),
        ({"figures": {"finite": True, "error": float("nan")}}, "WRONG: far from the closed form"),
        (
            {"message": "fracsim: note: gained 1 J from nowhere; note: met fast"},
            "warned: gained 1 J from nowhere; note: met fast",
        ),
        ({"message": "fracsim: note: 3 cells are turned inside out"}, "warned: 3 cells are turned inside out"),
    ],
)
def test_verdicts(changes: dict[str, Any], words: str) -> None:
    assert stability.verdict(record("dt", "1e-6", 1, **changes)) == words


def test_section_of_the_table() -> None:
    """One row for both ranks; a difference between them and a hang are found."""
    records = [record("dt", "a", 1), record("dt", "a", 2), record("young", "b", 1), record("young", "b", 2)]
    (section,) = stability.sections(records)
    assert [claim.holds for claim in section.claims] == [True] * 4
    assert [row[:4] for row in section.tables[0].rows] == [("dt", "a", "right", True), ("young", "b", "right", True)]
    assert all(len(row) == len(section.tables[0].columns) for row in section.tables[0].rows)
    records[3] = record("young", "b", 2, outcome="out of time", figures={"broken": 4})
    (section,) = stability.sections(records)
    assert [claim.holds for claim in section.claims] == [False, True, False, False]
    assert section.tables[0].rows[1][2] == "right; on 2 ranks WRONG: out of time"


def test_runs_that_nobody_vouches_for_may_end_unlike_and_are_named() -> None:
    """A warning here and no solution there is no answer on any rank; an answer on one rank only is a fault."""
    warned = {"message": "fracsim: note: 3 cells are turned inside out"}
    lost = {"outcome": "not converged", "message": "fracsim: no solution at t = 1 s", "figures": {"finite": True}}
    (section,) = stability.sections([record("dt", "a", 1, **warned), record("dt", "a", 2, **lost)])
    assert section.claims[3].holds and section.claims[3].measured.endswith("warn or do not converge: dt/a")
    assert section.tables[0].rows[0][3] is False
    (section,) = stability.sections([record("dt", "a", 1), record("dt", "a", 2, **lost)])
    assert section.claims[3].holds is False and "against it: dt/a" in section.claims[3].measured


def test_iterations_with_contact_stand_beside_those_without() -> None:
    counts = {"newton_mean": 4.0, "newton_max": 9, "krylov_mean": 80.0, "krylov_max": 200}
    name, alone = next(iter(stability.WITHOUT_CONTACT.items()))
    assert {name, alone} <= {t.settings["of"] for t in stability.trials() if t.case == "contact"}
    less = {"newton_mean": 1.0, "newton_max": 2, "krylov_mean": 5.0, "krylov_max": 6}
    records = [record("contact", name, 1, figures={"finite": True} | counts),
               record("contact", alone, 1, figures={"finite": True} | less)]  # fmt: skip
    (row,) = stability.sections(records)[1].tables[0].rows
    assert row == (name, 4.0, 9, 80.0, 200, 20.0, 1.0, 2, 5.0, 6, 5.0)


def test_section_of_the_failed_approaches() -> None:
    figures = {"peak": 5.0, "rest_stress": 0.0, "loop": 1.0, "lowest": 0.0, "newton_failed_at": 0.1, "jump": 2.0}
    found = stability.sections([record("failed", "projected-stress", 1, figures=figures | {"reach": 1.0})])[1]
    assert found.tables[0].rows[0][-1] == "fails: energy created, no solution, a cycle does work"


def test_section_of_dependence() -> None:
    """Spread (max - min) / mean: (3 - 1) / 2 = 1; a run that failed stays in the table."""
    records = []
    for number, (pattern, h) in enumerate(mesh_dependence.MESHES[:3]):
        figures = dict.fromkeys(mesh_dependence.FIGURES, 1.0 + number)
        settings = {"h": h, "pattern": pattern, "radius": 0.0}
        records.append(record("bar-local", str(number), 1, figures=figures, settings=settings))
    records.append(record("bar-local", "3", 1, outcome="out of time", figures={}, settings=settings))
    (section,) = mesh_dependence.sections(records)
    spread, every = section.tables
    assert spread.rows == (("bar-local", 3, 1.0, 1.0, 1.0, 1.0),)
    assert len(every.rows) == 4 and every.rows[3][3] == "out of time"
    assert section.plots[0].series[0].y == (1.0, 2.0, 3.0) and len(section.plots) == 2


def test_plates_before_and_with_an_energy() -> None:
    """One figure of what they carry, one of their cracks, from side to side, without that of the average."""
    line = mesh_dependence.crack_path(np.array([0.3, 0.1, 0.2]), np.array([3.0, 1.0, 2.0]))
    assert line == [[0.1, 1.0], [0.2, 2.0], [0.3, 3.0]]
    assert len(mesh_dependence.crack_path(np.arange(1001.0), np.zeros(1001))) <= mesh_dependence.MAX_PATH_POINTS
    settings, records = {"h": 1e-3, "pattern": "unstructured", "radius": 0.0}, []
    for number, case in enumerate(("plate-local", "plate-averaged", "plate-energy")):
        figures = dict.fromkeys(mesh_dependence.FIGURES, 1.0 + number) | {"path": line}
        records.append(record(case, "1-mm", 1, figures=figures, settings=settings))
    *_, peaks, paths = mesh_dependence.sections(records)[0].plots
    assert [each.y for each in peaks.series] == [(1.0,), (2.0,), (3.0,)]
    assert [each.label for each in paths.series] == ["plate-local, 1 mm", "plate-energy, 1 mm"]
    assert paths.series[0].y == (1.0, 2.0, 3.0)


# --- experiments ----------------------------------------------------------------------------------------------------


def test_experiments_have_three_meshes_each_and_are_valid() -> None:
    trials = experiments.trials()
    for case, experiment in experiments.BY_CASE.items():
        own = [trial for trial in trials if trial.case == case]
        assert len(own) == 3 and len({trial.name for trial in own}) == 3
        assert callable(getattr(experiments, own[0].measure.partition(":")[2]))
        for trial, h in zip(own, experiment.sizes[1], strict=True):
            assert trial.study is not None and trial.study["mesh"][experiment.sizes[0]] == h
            assert check_study(validate(trial.study, case))


def test_the_second_peak_is_the_top_of_the_longest_rise_after_the_first() -> None:
    load = np.array([0.0, 5.0, 10.0, 4.0, 4.5, 3.0, 7.0, 6.5, 6.9, 1.0])
    assert experiments.second_peak(load) == 7.0
    assert experiments.second_peak(np.array([0.0, 3.0, 2.0, 1.0])) == 3.0  # there is none
    rows = {"contact_striker_y": -load, "motion_striker_y": -np.arange(10.0), "work_striker": load, "pieces": load}
    found = experiments.load_figures(rows, "striker", "y")
    assert (found["peak"], found["at"], found["second"], found["last"], found["travel"]) == (10.0, 1.0, 7.0, 1.0, 8.0)
    assert found["plateau"] == 6.5  # of the ways 5 to 9: 3, 7, 6.5, 6.9, 1
    assert max(found["curve"][1]) == 10.0 and len(found["curve"][0]) == 10
    held = experiments.load_figures(
        rows | {"reaction_striker_y": load, "motion_striker_y": np.arange(1.0, 11.0)}, "striker", "y"
    )
    assert (held["at"], held["travel"], held["curve"][0][0]) == (
        3.0,
        10.0,
        1.0,
    )  # a grip that has moved in the first row


def test_angle_of_kalthoffs_crack(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """At the first row in which the tip is 40 mm or more from the notch."""
    tips = 0.05 + 0.045 * np.cos(1.1) * np.array([0.0, 0.5, 1.0, 2.0]), 0.025 + 0.045 * np.sin(1.1) * np.arange(4) / 2
    rows = {"tip_x": tips[0], "tip_y": tips[1], "pieces": np.ones(4)}
    study = {"crack": [{"segment": [[-0.01, 0.025], [0.05, 0.025]]}]}
    monkeypatch.setattr(experiments.run_results, "history", lambda run: rows)
    monkeypatch.setattr(experiments.run_results, "study", lambda run: study)
    assert experiments.measure_kalthoff(tmp_path)["angle"] == pytest.approx(np.degrees(1.1))


def test_the_branches_of_a_crack() -> None:
    """A straight crack, from 20 mm on two at 20 and 30 degrees, with a short one aside; none where there is one."""
    x, aside = np.arange(0.0, 0.05, 2e-4), np.column_stack([np.arange(5.0), np.arange(5.0)]) * 2e-4 + [0.01, 0.0]
    arms = [np.column_stack([x, np.maximum(x - 0.02, 0) * slope]) for slope in np.tan(np.radians([20, -30]))]
    where, upper, lower = experiments.branch_angles(np.concatenate([*arms, aside]), 2e-3) or (0.0, 0.0, 0.0)
    assert (where, upper, lower) == (pytest.approx(0.02, abs=1e-3), pytest.approx(20, abs=1), pytest.approx(30, abs=1))
    assert experiments.branch_angles(arms[0], 2e-3) is None
    stopped = np.concatenate([arms[0], arms[1][x < 0.03]])
    assert experiments.branch_angles(stopped, 2e-3) is None
    first = experiments.branch_angles(stopped, 2e-3, experiments.FIRST_BRANCH_LENGTH)
    assert first is not None and first[0] == pytest.approx(0.02, abs=1e-3)


def test_only_branches_that_run_on_from_the_first_fork_count() -> None:
    """A pane whose first two branches part by 3 degrees holds; one that is measured at a later fork does not."""
    figures = {"first": 0.063, "fork": 0.064, "upper": 30.0, "lower": 27.0, "peak": 645.0, "angle": 70.0}
    records = [{"case": case, "outcome": "done", "figures": dict(figures)} for case in ("branching",) * 3]
    (claim,) = (each for each in experiments._notch_claims(records) if "branches" in each.text)
    assert claim.holds is True
    records[1]["figures"]["fork"] = 0.079  # type: ignore[index]
    (claim,) = (each for each in experiments._notch_claims(records) if "branches" in each.text)
    assert claim.holds is False


def test_a_curve_that_begins_late_is_read_from_where_its_line_does() -> None:
    """2 N/m from - 1 m on, to 20 N, then a drop; and no table of a plate that was not run."""
    way = [*np.linspace(0, 9, 10), 9.5]
    assert published_results.curve_figures(way, [*(2 * (np.array(way[:-1]) + 1)), 1.0]) == pytest.approx(
        (20.0, 10.0, 2.0)
    )
    assert published_results.table([]) == ()


def test_section_of_experiments() -> None:
    """A disk 5 % off on two meshes and 20 % on the third is no claim that holds; a failed run stays in the table."""
    exact = experiments.BY_CASE["brazilian"].peak
    records = []
    for h, off in ((0.01, 1.05), (0.008, 0.95), (0.0065, 1.2)):
        figures = {"peak": off * exact, "last": 0.4 * exact, "along": 0.7, "curve": [[0.0, 1e-3], [0.0, exact]]}
        records.append(record("brazilian", f"{h}", 1, figures=figures, settings={"h": h}))
    records.append(record("charpy-klst", "x", 1, outcome="out of time", figures={}, settings={"h": 1.6e-4}))
    (section,) = experiments.sections(records)
    assert [claim.holds for claim in section.claims] == [False, True, True, *[None] * 12]
    every, spreads = section.tables
    assert len(every.rows) == 4 and every.rows[3][2] == "out of time"
    assert spreads.rows[0][:4] == ("brazilian", 3, pytest.approx(exact * 3.2 / 3), pytest.approx(0.25 / (3.2 / 3)))
    assert [series.style for series in section.plots[0].series] == ["line", "line", "line", "reference"]


def test_how_much_of_a_section_is_covered() -> None:
    """A triangle with half of it, two that overlap, whichever way round; nothing by none."""
    low, high = np.array([-1.0, 0.0]), np.array([1.0, 1.0])
    half = np.array([[[-1.0, 0.0], [1.0, 0.0], [-1.0, 1.0]]])
    assert diametral_cracks.covered_fraction(half, low, high) == pytest.approx(0.5, abs=0.02)
    left = np.array([[[-1.0, 0.0], [0.0, 1.0], [0.0, 0.0]], [[-1.0, 0.0], [0.0, 1.0], [-1.0, 1.0]]])
    assert diametral_cracks.covered_fraction(left, low, high) == pytest.approx(0.5, abs=0.02)
    assert diametral_cracks.covered_fraction(np.concatenate([half, left[:1]]), low, high) == pytest.approx(
        13 / 24, abs=0.02
    )
    assert diametral_cracks.covered_fraction(half[:0], low, high) == 0.0


def test_where_the_cracks_of_a_cylinder_are() -> None:
    """A plane through its middle, both sides, and another half as large beside it."""
    sides = np.array([[[-0.2, 0.0], [0.2, 0.0], [0.2, 0.1]], [[-0.2, 0.0], [0.2, 0.1], [-0.2, 0.1]]])
    middle = np.concatenate([np.zeros((2, 3, 1)), sides], axis=2)
    beside = middle[:1] + np.array([0.05, 0.0, 0.0])
    found = diametral_cracks.diametral_figures(np.concatenate([middle, middle, beside, beside]), 0.2, 0.1)
    assert found == pytest.approx({"along": 2 / 3, "covered": 1.0, "area": 1.5})
    assert diametral_cracks.diametral_figures(middle[:0], 0.2, 0.1) == {"along": 0.0, "covered": 0.0, "area": 0.0}


def test_a_cylinder_that_splits_and_is_crushed_says_so() -> None:
    """A peak 4 % over, half of it left; what was one plane is not in the end."""
    split = {"split_along": 0.9, "split_covered": 0.7, "split_area": 1.0}
    figures = {"peak": 104.0, "last": 50.0, "end_along": 0.3, "end_covered": 0.9, "end_area": 9.0, "pieces": 6.0}
    held = [claim.holds for claim in diametral_cracks.claims([split | figures] * 3, 100.0, 0.1)]
    assert held == [True, True, True, True, False]
    assert {claim.holds for claim in diametral_cracks.claims([split | figures] * 2, 100.0, 0.1)} == {None}
    (table,) = diametral_cracks.table([{"settings": {"h": 0.01}, "figures": split | figures}])
    assert table.rows == ((0.01, 0.9, 0.7, 1.0, 0.3, 0.9, 9.0, 6.0),) and diametral_cracks.table([]) == ()


def test_a_measured_curve_lies_beside_the_runs() -> None:
    """Its greatest load is the reference's, and three panels 5 % above it are within a tenth."""
    panel, (way, load) = experiments.BY_CASE["l-panel"], published_results.MEASURED["l-panel"]
    assert max(load) == pytest.approx(panel.peak, rel=1e-3) and sorted(way) == list(way)
    figures = {"peak": 1.05 * panel.peak, "curve": [[0.0, 1e-3], [0.0, panel.peak]]}
    records = [record("l-panel", f"{h}", 1, figures=figures, settings={"h": h}) for h in panel.sizes[1]]
    (section,) = experiments.sections(records)
    assert section.claims[-1].holds and section.plots[0].series[-1].y == load
