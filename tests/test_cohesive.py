"""[fracture] law = "cohesive": a bar in tension against its closed form, and what a cut cell takes against G_c."""

from __future__ import annotations

import csv
import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI

from fracsim.deformable_run import Run
from fracsim.fracture.cohesive_cracks import (
    CohesiveFracturePass,
    OpeningCells,
    opening_widths,
    remove_normal_stress,
)
from fracsim.scene import Scene, build_scene
from fracsim.studies import folder as packaged
from fracsim.studies.evidence.cohesive_beam import DEPTH, load_by_springs
from fracsim.study.check import check_study
from support.cohesive_beam import bend
from support.resumed import assert_alike, going_stopped_resumed
from support.scenes import DIRECT, Walk, each_step, make_scene, make_study, march
from support.tearing import RUNS

Values = npt.NDArray[np.float64]

YOUNG, STRENGTH, ENERGY = 1e4, 100.0, 0.6  # Pa, Pa, J/m^2: l_ch = E G_c / f_t^2 = 0.6 m
TOUGH = 20 * ENERGY  # J/m^2: openings are large beside the elastic strain of a cell
LENGTH, SECTION = 0.4, 0.5  # m: shorter than l_ch, so that the bar does not snap back


# --- parts -----------------------------------------------------------------------------------------------------------


def random_openings(d: int) -> tuple[OpeningCells, Values]:
    """Cells (60,) cut at random angles, up to 60 degrees to grad N; and the normals (60, d) of the cuts."""
    rng = np.random.default_rng(d)
    normal = rng.normal(size=(60, d))
    normal /= np.linalg.norm(normal, axis=1)[:, None]
    aside = rng.normal(size=(60, d))
    aside -= np.einsum("ni,ni->n", aside, normal)[:, None] * normal
    aside *= (rng.uniform(0, np.sqrt(3), 60) / np.linalg.norm(aside, axis=1))[:, None]
    width, poisson = rng.uniform(0.02, 0.06, 60), rng.uniform(0, 0.4, 60)
    mu, lmbda = YOUNG / (2 * (1 + poisson)), YOUNG * poisson / ((1 + poisson) * (1 - 2 * poisson))
    strength, energy = np.full(60, STRENGTH), np.full(60, TOUGH)
    return OpeningCells((normal + aside) / width[:, None], width, strength, energy, mu, lmbda), normal


def stress_of(cells: OpeningCells, opening: Values) -> tuple[Values, Values]:
    """Stress (n, d, d), Pa, and energy density (n,), J/m^3, of cells whose sides part rigidly by openings (n, d), m."""
    strain = np.einsum("ni,nj->nij", opening, cells.gradient)
    strain = (strain + strain.transpose(0, 2, 1)) / 2
    trace, unit = np.trace(strain, axis1=1, axis2=2)[:, None, None], np.eye(opening.shape[1])
    stress = 2 * cells.mu[:, None, None] * strain + cells.lmbda[:, None, None] * trace * unit
    return stress, np.einsum("nij,nij->n", stress, strain) / 2


@pytest.mark.parametrize("d", (2, 3))
def test_a_cell_resists_as_a_flat_crack_at_any_angle(d: int) -> None:
    """Sides that part by w across the cut do the work sigma(w) dw a unit of area V / l, G_c in all, from the forces on
    the nodes: V chi stress . grad N; at angles of 0 to 60 degrees between the cell and the crack. Of energy alone a
    cell at 60 degrees would carry 1.5 f_t."""
    cells, normal = random_openings(d)
    openings = np.concatenate([[0.0], np.geomspace(1e-8, 20 * TOUGH / STRENGTH, 1500)])
    chi, force = np.ones(60), []
    for w in openings:
        stress, psi = stress_of(cells, w * normal)
        np.testing.assert_allclose(cells.openings(stress), w * normal, atol=1e-9)
        yielded = psi > cells.onset_density
        chi[yielded] = np.minimum(cells.chi(stress, np.maximum(psi, cells.onset_density)), chi)[yielded]
        force.append(chi * cells.width * np.einsum("ni,nij,nj->n", normal, stress, cells.gradient))
    traction = np.array(force)
    taken = np.trapezoid(traction, openings, axis=0)
    np.testing.assert_allclose(taken, TOUGH, rtol=0.012)  # it is cut off at 1 % of f_t
    rho = openings[:, None] * cells.young / (cells.width * STRENGTH)
    softens = (rho > cells.shear_factor) & (traction > 0.02 * STRENGTH)
    expected = STRENGTH * np.exp(-(rho - 1) / cells.softening)
    np.testing.assert_allclose(traction[softens], expected[softens], rtol=1e-6)
    # The elastic part of an opening is small: the law of a crack.
    flat = STRENGTH * np.exp(-openings[:, None] * STRENGTH / TOUGH)
    np.testing.assert_allclose(traction[softens], np.broadcast_to(flat, rho.shape)[softens], atol=0.02 * STRENGTH)


@pytest.mark.parametrize("d", (2, 3))
def test_the_width_of_a_cell_is_how_its_sides_part(d: int) -> None:
    """The node (nodes) on one side moved by w along the normal of the cut stretch the cell by w / l along it."""
    rng = np.random.default_rng(d)
    corners = rng.uniform(0, 1, (40, d + 1, d))
    normal = np.eye(d)[0]
    # the cut half way between the first corner and the others: edges (0, k) in a plane of this normal
    corners[:, 0, 0], corners[:, 1:, 0] = 1.0, 0.0
    points = (corners[:, :1] + corners[:, 1:]) / 2
    gradient = np.linalg.inv(np.concatenate([np.ones((40, d + 1, 1)), corners], axis=2))[:, 1:, 0]
    found = opening_widths(gradient, points, np.ones((40, d), bool))
    np.testing.assert_allclose(found, 1 / np.abs(gradient @ normal))
    np.testing.assert_allclose(found, 1.0)


def test_where_a_crack_goes() -> None:
    """Straight on under tension across it, whatever acts along it; across a uniaxial stress that is little askew, to
    second order; as the greatest principal stress has it where nothing lies behind."""
    angles = np.linspace(-0.2, 0.2, 9)
    pull = np.column_stack([-np.sin(angles), np.cos(angles)])  # normal of the crack as it ought to go
    stress = np.einsum("ni,nj->nij", pull, pull)
    behind, along = np.tile([3.0, 0.0], (9, 1)), np.diag([5.0, 0.0])
    found = np.linalg.eigh(remove_normal_stress(stress, behind))[1][:, :, -1]
    found *= np.sign(found[:, 1])[:, None]
    np.testing.assert_allclose(np.arctan2(-found[:, 0], found[:, 1]), angles, atol=np.abs(angles).max() ** 3)
    np.testing.assert_allclose(
        remove_normal_stress(stress + along, behind), remove_normal_stress(stress, behind), atol=1e-12
    )
    np.testing.assert_array_equal(remove_normal_stress(stress, 0 * behind), stress)


# --- a bar -----------------------------------------------------------------------------------------------------------


def bar(
    kind: str, n: int, steps: int, scheme: str = "quasi-static", **mesh: Any
) -> tuple[Scene, Values, Values, float]:
    """A bar pulled apart: the scene, (steps,) motion of its end in m and stress there in Pa, and what it lost, J."""
    mesh = {"builder": "box", "size": [LENGTH, SECTION], "h": 1 / n, "pattern": kind} | mesh
    size, peak = mesh["size"], LENGTH * STRENGTH / YOUNG
    ramp = {"time": [0.0, 0.25, 0.5, 1.0], "value": [0.0, peak, 3 * peak, 12 * peak]}
    course = [[each, *["free"] * (len(size) - 1)] for each in ramp["value"]]
    scene, state = make_scene(
        mesh=mesh,
        material={"energy": "linear", "young": YOUNG, "poisson": 0.0, "density": 1.0},
        fracture={"strength": STRENGTH, "energy": ENERGY, "law": "cohesive"},
        boundary=[
            {"on": "left", "fix": "xyz"[: len(size)]},
            {"on": "right", "displacement": {"time": ramp["time"], "value": course}},
        ],
        time={"scheme": scheme, "step": 1 / steps, "end": 1.0},
    )
    pulled = np.flatnonzero(scene.domain.nodes[:, 0] > size[0] * (1 - 1e-9))
    way, stress = [], []
    while not scene.ended(state.state):
        state.advance()
        force = scene.balance.stress.assemble_forces().reshape(-1, len(size))[pulled, 0].sum()
        way.append(np.interp(state.t, ramp["time"], ramp["value"]))
        stress.append(force / np.prod(size[1:]))
    return scene, np.array(way), np.array(stress), state.dissipated


def closed_form(h: float) -> tuple[Values, Values]:
    """Motion in m and stress in Pa of a bar with one row of cells of width h that opens."""
    start = STRENGTH**2 / (2 * YOUNG)
    r = np.linspace(1, 100, 20_000)
    stress = STRENGTH * np.exp(-(r - 1) / ((ENERGY / (h * start) - 1) / 2))
    way = ((LENGTH - h) * stress + h * r * STRENGTH) / YOUNG
    return np.concatenate([[0.0], way]), np.concatenate([[0.0], stress])


@pytest.mark.parametrize(("kind", "n"), [("structured", 10), ("unstructured", 12)])
def test_a_bar_in_tension(kind: str, n: int) -> None:
    """It takes G_c times its section, carries f_t, and softens by the exponential; the crack that it parts by is as
    long as the section, wherever it cuts the edges, and its edges are broken in the end, and not before."""
    scene, way, stress, lost = bar(kind, n, 300)
    assert stress.max() == pytest.approx(STRENGTH, rel=0.02)
    assert lost == pytest.approx(ENERGY * SECTION, rel=0.015)
    np.testing.assert_allclose(stress, np.interp(way, *closed_form(1 / n)), atol=0.04 * STRENGTH)
    breaking = scene.fracture
    assert isinstance(breaking, CohesiveFracturePass)
    cells = np.flatnonzero(breaking.cut_graph.split)
    area = (scene.domain.volumes[cells] / breaking.softening.opening_cells(cells).width).sum()
    assert area == pytest.approx(SECTION, rel=1e-3)
    assert breaking.graph.split[cells].all() and stress[-1] < 1e-3 * STRENGTH


@pytest.mark.parametrize("scheme", ("newmark", "backward-euler"))
def test_a_bar_that_is_pulled_slowly(scheme: str) -> None:
    """With inertia, in 250 times the time of a wave along the bar, it carries and takes what it does at rest. Newmark's
    scheme keeps the vibrations that the opening crack starts."""
    _, way, stress, lost = bar("structured", 10, 300, scheme)
    assert stress.max() == pytest.approx(STRENGTH, rel=0.03)
    assert lost == pytest.approx(ENERGY * SECTION, rel=0.03)
    error = stress - np.interp(way, *closed_form(0.1))
    assert np.sqrt(np.mean(error**2)) < 0.06 * STRENGTH
    assert abs(error.mean()) < 0.005 * STRENGTH


def test_a_bar_in_space() -> None:
    """The same among the tetrahedra of a lattice."""
    _, _, stress, lost = bar("structured", 10, 150, size=[LENGTH, 0.3, 0.3])
    assert stress.max() == pytest.approx(STRENGTH, rel=0.02)
    assert lost == pytest.approx(ENERGY * 0.09, rel=0.03)


@pytest.mark.slow
@pytest.mark.parametrize("seed", (1, 2, 3, 4))
def test_a_bar_of_random_tetrahedra(seed: int) -> None:
    """The cut is rough, and takes G_c of the section of the bar to 3 %, in steps of a tenth of its elastic limit."""
    _, _, stress, lost = bar("unstructured", 10, 600, size=[LENGTH, 0.3, 0.3], seed=seed)
    assert stress.max() == pytest.approx(STRENGTH, rel=0.01)
    assert lost == pytest.approx(ENERGY * 0.09, rel=0.03)


# --- its work and its peak load --------------------------------------------------------------------------------------

PEAK = LENGTH * STRENGTH / YOUNG  # m: motion of the end at the strength
APART = 150 * PEAK  # m: a crack of the energy TOUGH carries nothing
PULLED = {"time": [0.0, 1.0], "value": [0.0, APART]}
UNLOADED = {"time": [0.0, 0.2, 0.3, 1.0], "value": [0.0, 0.2 * APART, 0.1 * APART, APART]}
WIDE: dict[str, Any] = {"builder": "box", "size": [LENGTH, SECTION], "h": 0.1, "pattern": "structured"}
COARSE = WIDE | {"h": 1 / 6, "pattern": "unstructured"}
HIGH = WIDE | {"size": [SECTION, LENGTH], "pattern": "unstructured"}


def pulled_bar(mesh: dict[str, Any], course: dict[str, list[float]], along: int = 0, **time: Any) -> dict[str, Any]:
    """Tables of a bar whose end moves along an axis, in steps of 0.75 of the elastic limit by default."""
    dim, ends = len(mesh["size"]), (("left", "right"), ("bottom", "top"))[along]
    motion = [["free"] * along + [way] + ["free"] * (dim - 1 - along) for way in course["value"]]
    return {
        "mesh": mesh,
        "material": {"energy": "linear", "young": YOUNG, "poisson": 0.0, "density": 1.0},
        "fracture": {"strength": STRENGTH, "energy": TOUGH, "law": "cohesive"},
        "boundary": [
            {"on": ends[0], "fix": "xyz"[:dim]},
            {"on": ends[1], "displacement": {"time": course["time"], "value": motion}},
        ],
        "probe": [{"name": "end", "on": ends[1]}],
        "time": {"scheme": "quasi-static", "step": 0.75 / 150, "end": 1.0} | time,
        "output": {"picture": False, "interval": 1.0},
    }


@pytest.mark.parametrize(
    ("mesh", "course", "along"),
    [(WIDE, PULLED, 0), (COARSE, PULLED, 0), (HIGH, PULLED, 1), (WIDE, UNLOADED, 0)],
    ids=("lattice", "coarse", "along y", "unloaded"),
)
def test_long_steps_have_the_work_of_the_load_that_the_bar_carries(
    tmp_path: Path, mesh: dict[str, Any], course: dict[str, list[float]], along: int
) -> None:
    """In steps of 0.75 of the elastic limit the bar takes G_c of its section, and its peak is that of its reaction.

    The equilibrium with the damage of the start of a step has up to 1.75 times the strength, and is not carried.
    """
    scene = build_scene(MPI.COMM_SELF, make_study(**pulled_bar(mesh, course, along)))
    Run(scene, tmp_path)()
    summary = json.loads((tmp_path / "summary.json").read_text())
    with (tmp_path / "history.csv").open(newline="") as file:
        rows = {name: np.array(column, float) for name, *column in zip(*csv.reader(file), strict=True)}
    axis = "xy"[along]
    load, way = (np.append(0.0, rows[f"{name}_end_{axis}"]) for name in ("reaction", "motion"))
    assert summary["peak_reactions"][f"reaction_end_{axis}"] == pytest.approx(load.max(), rel=1e-9)
    assert load.max() == pytest.approx(STRENGTH * SECTION, rel=0.025)
    assert summary["dissipated"] == pytest.approx(TOUGH * SECTION, rel=0.015)
    assert summary["external_work"] == pytest.approx(np.trapezoid(load, way), rel=1e-6)
    total = rows["elastic"] + rows["dissipated"]
    np.testing.assert_allclose(rows["external_work"], total, atol=3e-5 * total.max())


def test_an_obstacle_that_bends_a_beam_does_the_work_that_the_beam_takes() -> None:
    """Its work is that of contact at the end of each step; the beam lost 10 % more than that."""
    tables = pulled_bar(WIDE | {"size": [0.8, 0.3], "pattern": "unstructured"}, PULLED, step=0.05)
    del tables["probe"]
    tables["fracture"]["energy"] = ENERGY
    scene, state = make_scene(**tables | {
        "boundary": [
            {"on": {"box": [[-0.01, -0.01], [0.05, 0.01]]}, "fix": "xy"},
            {"on": {"box": [[0.75, -0.01], [0.81, 0.01]]}, "fix": "y"},
        ],
        "obstacle": [
            {"name": "pin", "shape": "sphere", "at": [0.4, 0.41], "radius": 0.1,
             "displacement": {"time": [0.0, 1.0], "value": [[0.0, 0.0], [0.0, -0.04]]}},
        ],
        "contact": {"distance": 0.005},
    })  # fmt: skip
    gaps = [abs(state.work - report.elastic - state.dissipated) for report in each_step(scene, state)]
    assert max(gaps) < 0.01 * state.work
    assert state.dissipated > 0.9 * state.work and scene.fracture.graph.broken_count > 0


def test_explicit_steps_have_the_work_of_the_softened_bar() -> None:
    """Supports move on while forces are those of softened cells: work is the sum of all energies to 1e-4 of it."""
    course = {"time": [0.0, 1.0], "value": [0.0, 12 * PEAK]}
    tables = pulled_bar(WIDE, course, scheme="explicit", step=1.0)
    tables["fracture"]["energy"] = ENERGY
    scene, state = make_scene(**tables)
    for report in each_step(scene, state):
        total = report.elastic + report.kinetic + state.dissipated
    assert state.work == pytest.approx(total, rel=1e-4)
    assert state.dissipated == pytest.approx(ENERGY * SECTION, rel=0.02)


def test_edges_hold_until_they_carry_nothing() -> None:
    """At half of its strength the bar is cut through, and in one piece."""
    scene, state = make_scene(**RUNS["cohesive"] | {"crack": []})
    breaking = scene.fracture
    assert isinstance(breaking, CohesiveFracturePass)
    cut, broken = [], []
    while not scene.ended(state.state):
        state.advance()
        cut.append(int(breaking.cut_graph.split.sum()))
        broken.append(breaking.graph.broken_count)
    assert cut[broken.index(max(broken))] > 0
    assert any(c > 4 and not b for c, b in zip(cut, broken, strict=True))
    chi = scene.balance.stress.chi.x.array[: scene.domain.cell_count]
    assert not np.any(breaking.graph.split & (chi > 0))
    assert not np.any(breaking.cut_graph.broken & (breaking.graph.integrity == 1))


def test_a_restart_goes_on_as_the_run_would_have(tmp_path: Path) -> None:
    """Cuts are remembered, those of edges that are not broken yet as well."""
    tables = RUNS["cohesive"] | {"output": {"picture": False, "interval": 100.0}, "solver": DIRECT}
    going, _, again = going_stopped_resumed(tables, tmp_path, 8, 5)
    assert_alike(again, going, 1e-9)
    np.testing.assert_allclose(
        again.scene.fracture.criterion.cut_positions, going.scene.fracture.criterion.cut_positions, atol=1e-9
    )
    assert np.count_nonzero(~np.isnan(going.scene.fracture.criterion.cut_positions)) > going.breaks.counts[0]


def test_a_panel_of_concrete_is_as_stiff_as_by_another_program() -> None:
    """Pushed up by 10 micrometres, 20 mm from the end of its arm, Winkler's panel of the study's modulus takes 563.94 N
    by MOOSE, of quadratic hexahedra (github.com/PSAAPGroupLinder/lShapedPanelBenchmark); here more, as cells are
    linear, and less of it as they are finer."""
    study = tomllib.loads((packaged() / "l-panel.toml").read_text())
    seat = {"on": {"box": [[0.4799, 0.2499], [0.4801, 0.2501]]}, "displacement": ["free", 1e-5]}
    stiffness = []
    for h in (0.02, 0.01):
        scene, state = make_scene(
            mesh=study["mesh"] | {"h": h, "h_corner": h, "seat": 0.02}, material=study["material"],
            boundary=[{"on": "bottom", "fix": "xy"}, seat],
            time={"scheme": "quasi-static", "step": 1.0, "end": 1.0}, solver=DIRECT,
        )  # fmt: skip
        march(scene, state)
        stiffness.append(2 * scene.balance.stress.stored_energy() * study["material"]["thickness"] / 1e-5**2)
    found = 563.94 / 1e-5
    assert found < stiffness[1] < stiffness[0] < 1.05 * found
    assert stiffness[1] == pytest.approx(found, rel=0.02)


# --- a beam ----------------------------------------------------------------------------------------------------------

# Openings of the lowest spring, m: the peak is at 3e-5.
OPENINGS = np.concatenate([np.linspace(0, 6e-5, 61)[1:], np.linspace(6e-5, 8e-4, 121)[1:]])


def against_springs(way: Values, load: Values, rows: int) -> tuple[float, float]:
    """Return peak and work of the beam over those of springs on `rows` squares."""
    sinks, expected = load_by_springs(rows, OPENINGS)
    work = np.trapezoid(np.interp(way, np.append(0, sinks), np.append(0, expected)), way)
    return float(load.max() / expected.max()), float(np.trapezoid(load, way) / work)


def test_a_crack_goes_through_a_bent_beam(tmp_path: Path) -> None:
    """With four cells of ligament it goes up from the notch through what the load compresses, within a cell of the
    middle; peak and work are those of springs within 10 and 5 %."""
    scene, _, way, load = bend(tmp_path, 4, 2, 3e-4, 30, notch=True, follow=lambda _: True)
    peak, work = against_springs(way, load, 24)
    assert (peak, work) == (pytest.approx(1, abs=0.1), pytest.approx(1, abs=0.05))
    cuts = scene.fracture.criterion.cut_positions
    edges = np.flatnonzero(~np.isnan(cuts))
    points = scene.fracture.criterion.field_evaluator.cut_points(edges, cuts)
    assert np.abs(points[:, 0]).max() < DEPTH / 8 and points[:, 1].max() > 0.95 * DEPTH


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "notch"), [(1, True), (2, True), (3, True), (1, False), (2, False)])
def test_a_beam_carries_what_springs_carry(tmp_path: Path, seed: int, notch: bool) -> None:
    """12.5 cells of ligament: peak and work within 3 %. A [[crack]] ends at the nearest edge, so that the ligament is
    known to 0.3 h, 2.5 % of the load."""

    def follow(walk: Walk) -> bool:
        return notch or walk.t < 0.2

    _, _, way, load = bend(tmp_path, 12.5, seed, 3e-4, 100, notch=notch, follow=follow)
    peak, work = against_springs(way, load, 40)
    assert peak == pytest.approx(1, abs=0.03)
    assert work == pytest.approx(1, abs=0.03)


# --- what is refused, and told ---------------------------------------------------------------------------------------

SLOW = {"scheme": "quasi-static", "step": 1.0, "end": 1.0}


@pytest.mark.parametrize(
    ("fracture", "time", "message"),
    [
        ({}, SLOW, r'law = "cohesive" needs fracture\.energy'),
        (
            {"energy": 1.0, "branching": True},
            {"scheme": "newmark", "step": 1.0, "end": 1.0},
            r"does not go with fracture\.branching",
        ),
        ({"energy": 1.0, "unilateral": True}, SLOW, r"does not go with fracture\.unilateral: .*remove it"),
        ({"energy": 1.0, "crumbs": False}, SLOW, "remove crumbs"),
        ({"energy": 1.0, "passes": 4}, SLOW, r"fracture\.passes in quasi-static steps: .*remove passes"),
        ({"energy": 1.0, "radius": 0.1}, SLOW, r"does not go with fracture\.radius"),
    ],
)
def test_refused(fracture: dict[str, Any], time: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make_study(fracture={"strength": 1.0, "law": "cohesive"} | fracture, time=time)


@pytest.mark.parametrize(
    ("law", "h", "said"),
    [
        ("cohesive", 0.05, "= 12 h"),
        ("cohesive", 0.1, 'too coarse for law = "cohesive"'),
        ("griffith", 0.05, 'with law = "cohesive"'),
    ],
)
def test_check_says_which_law_acts(law: str, h: float, said: str) -> None:
    """And whether cells are fine enough for it: l_ch = 0.6 m."""
    study = make_study(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": h},
        material={"energy": "linear", "young": YOUNG, "poisson": 0.0, "density": 1.0},
        fracture={"strength": STRENGTH, "energy": ENERGY, "law": law},
        boundary=[{"on": "left", "fix": "xy"}], time=SLOW,
    )  # fmt: skip
    lines = "\n".join(check_study(study))
    assert f"strength 100 Pa; law {law}" in lines and said in lines
    assert ("too coarse" in lines) == (h > 0.075)
