"""[fracture] law = "cohesive": a bar in tension against its closed form, and what a cut cell takes against G_c."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.integrate import quad

from fracsim.fracture.cohesive_cracks import (
    CohesiveFracturePass,
    opening_widths,
    remove_normal_stress,
    softening_parameter,
    stress_ratio,
)
from fracsim.scene import Scene
from fracsim.studies import folder as packaged
from fracsim.study.check import check_study
from support.resumed import assert_alike, going_stopped_resumed
from support.scenes import DIRECT, make_scene, make_study, march
from support.tearing import RUNS

Values = npt.NDArray[np.float64]

YOUNG, STRENGTH, ENERGY = 1e4, 100.0, 0.6  # Pa, Pa, J/m^2: l_ch = E G_c / f_t^2 = 0.6 m
LENGTH, SECTION = 0.4, 0.5  # m: shorter than l_ch, so that the bar does not snap back


# --- parts -----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("width", (0.01, 0.1, 0.5))
def test_a_cell_takes_the_fracture_energy(width: float) -> None:
    """int psi (-dchi) = G_c / l by quadrature, chi = carried / r, psi = psi_0 r^2, for cells of any width."""
    start = STRENGTH**2 / (2 * YOUNG)
    b = softening_parameter(np.array([ENERGY]), np.array([width]), np.array([start]))

    def fall(r: float) -> float:
        above, below = (stress_ratio(np.array([x]), b)[0] / x for x in (r * (1 - 1e-5), r * (1 + 1e-5)))
        return float((above - below) / (2e-5 * r))

    taken, _ = quad(lambda r: start * r**2 * fall(r), 1, 1 + 40 * float(b[0]), limit=200)
    assert taken == pytest.approx(ENERGY / width, rel=1e-5)


@pytest.mark.parametrize("d", (2, 3))
def test_the_width_of_a_cell_is_how_its_sides_part(d: int) -> None:
    """The node (nodes) on one side moved by w along the normal of the cut stretch the cell by w / l along it."""
    rng = np.random.default_rng(d)
    corners = rng.uniform(0, 1, (40, d + 1, d))
    first, normal = np.arange(d + 1) == 0, np.eye(d)[0]
    # the cut half way between the first corner and the others: edges (0, k) in a plane of this normal
    corners[:, 0, 0], corners[:, 1:, 0] = 1.0, 0.0
    points = (corners[:, :1] + corners[:, 1:]) / 2
    found = opening_widths(corners, np.tile(first, (40, 1)), points, np.ones((40, d), bool))
    slopes = np.linalg.inv(np.concatenate([np.ones((40, d + 1, 1)), corners], axis=2))[:, 1:, 0] @ normal
    np.testing.assert_allclose(found, 1 / np.abs(slopes))
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


def bar(kind: str, n: int, steps: int, **mesh: Any) -> tuple[Scene, Values, Values, float]:
    """A bar pulled apart: the scene, (steps,) motion of its end in m and stress there in Pa, and what it lost, J."""
    size, peak = mesh.get("size", [LENGTH, SECTION]), LENGTH * STRENGTH / YOUNG
    ramp = {"time": [0.0, 0.25, 0.5, 1.0], "value": [0.0, peak, 3 * peak, 12 * peak]}
    course = [[each, *["free"] * (len(size) - 1)] for each in ramp["value"]]
    scene, state = make_scene(
        mesh={"builder": "box", "size": size, "h": 1 / n, "pattern": kind},
        material={"energy": "linear", "young": YOUNG, "poisson": 0.0, "density": 1.0},
        fracture={"strength": STRENGTH, "energy": ENERGY, "law": "cohesive"},
        boundary=[
            {"on": "left", "fix": "xyz"[: len(size)]},
            {"on": "right", "displacement": {"time": ramp["time"], "value": course}},
        ],
        time={"scheme": "quasi-static", "step": 1 / steps, "end": 1.0},
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
    assert lost == pytest.approx(ENERGY * SECTION, rel=0.01)
    np.testing.assert_allclose(stress, np.interp(way, *closed_form(1 / n)), atol=0.04 * STRENGTH)
    breaking = scene.fracture
    assert isinstance(breaking, CohesiveFracturePass)
    cells = np.flatnonzero(breaking.cut_graph.split)
    area = (scene.domain.volumes[cells] / breaking.softening.opening_widths(cells)).sum()
    assert area == pytest.approx(SECTION, rel=1e-3)
    assert breaking.graph.split[cells].all() and stress[-1] < 1e-3 * STRENGTH


def test_a_bar_in_space() -> None:
    """The same among the tetrahedra of a lattice."""
    _, _, stress, lost = bar("structured", 10, 150, size=[LENGTH, 0.3, 0.3])
    assert stress.max() == pytest.approx(STRENGTH, rel=0.02)
    assert lost == pytest.approx(ENERGY * 0.09, rel=0.03)


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


# --- what is refused, and told ---------------------------------------------------------------------------------------

SLOW = {"scheme": "quasi-static", "step": 1.0, "end": 1.0}


@pytest.mark.parametrize(
    ("fracture", "time", "message"),
    [
        ({}, SLOW, r'law = "cohesive" needs fracture\.energy'),
        ({"energy": 1.0}, {"scheme": "newmark", "step": 1.0, "end": 1.0}, 'choose "quasi-static"'),
        ({"energy": 1.0, "unilateral": True}, SLOW, r"does not go with fracture\.unilateral: .*remove it"),
        ({"energy": 1.0, "crumbs": False}, SLOW, "remove crumbs"),
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
