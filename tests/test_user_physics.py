"""Physics of the user: energies against closed forms, criteria and laws against built-in ones, loads, plug-ins."""

from __future__ import annotations

import csv
import json
import re
import tomllib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import pytest
import ufl
from scipy.optimize import brentq

import fracsim as package
from cases import STRIP, changed, fracsim_here, swept_here
from fracsim.errors import InputError
from fracsim.forms.schemes import SCHEMES, EndOfStepScheme, QuasiStatic
from fracsim.simulation import Simulation, load
from fracsim.study import plugins
from fracsim.study.scheme_check import check_scheme
from support.scenes import DIRECT
from support.spring import Spring

DOCS = Path(__file__).parent.parent / "docs" / "python.md"
YOUNG, POISSON = 1e6, 0.3
MU, LAMBDA = YOUNG / (2 * (1 + POISSON)), YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
BULK = LAMBDA + 2 / 3 * MU
Law = Callable[[float, float, float], float]


@pytest.fixture(scope="module")
def page() -> dict[str, Any]:
    """What the block of the page defines: Yeoh, MooneyRivlin, tresca, softening."""
    block = next(text for text in re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL) if "Yeoh" in text)
    names: dict[str, Any] = {"np": np}
    exec(block.split("strip = {")[0], names)
    return names


# --- energies -------------------------------------------------------------------------------------------------------


def invariants(stretches: tuple[float, float, float]) -> tuple[float, float, float]:
    """I1' - 3, I2' - 3 and J of principal stretches."""
    a, b, c = (s**2 for s in stretches)
    J = np.sqrt(a * b * c)
    return J ** (-2 / 3) * (a + b + c) - 3, J ** (-4 / 3) * (a * b + b * c + c * a) - 3, J


def yeoh(*stretches: float) -> float:
    """psi of Yeoh with c20 = -0.1 mu and c30 = 0.05 mu."""
    i, _, J = invariants(stretches)  # type: ignore[arg-type]
    return MU / 2 * i - 0.1 * MU * i**2 + 0.05 * MU * i**3 + BULK / 2 * (J - 1) ** 2


def mooney_rivlin(*stretches: float) -> float:
    """psi of Mooney and Rivlin with c01 = 0.3 mu/2."""
    i1, i2, J = invariants(stretches)  # type: ignore[arg-type]
    return MU / 2 * (0.7 * i1 + 0.3 * i2) + BULK / 2 * (J - 1) ** 2


def uniaxial(psi: Any, stretch: float, dim: int) -> tuple[float, float]:
    """(nominal stress, lateral stretch) of a bar that is free sideways: d psi / d lateral = 0; 2D is plane strain."""
    t = 1e-5

    def at(first: float, side: float) -> float:
        return float(psi(first, side, side if dim == 3 else 1.0))

    side = brentq(lambda s: at(stretch, s + t) - at(stretch, s - t), 0.4, 1.2, xtol=1e-12)
    return (at(stretch + t, side) - at(stretch - t, side)) / (2 * t), side


def rod(dim: int) -> dict[str, Any]:
    """A cell or two on rollers, pulled without inertia; the driven end is given in Python."""
    axes = "xyz"[:dim]
    planes = [{"point": [0.0] * dim, "normal": [float(axis == other) for other in axes]} for axis in axes]
    return {
        "title": "rod",
        "mesh": {"builder": "box", "size": [1.0] * dim, "h": 1.0},
        "material": {"young": YOUNG, "poisson": POISSON, "density": 1000.0},
        "boundary": [{"on": plane, "fix": axis} for plane, axis in zip(planes, axes, strict=True)],
        "time": {"scheme": "quasi-static", "step": 0.25, "end": 1.0},
        "solver": DIRECT,
        "probe": [{"name": "grip", "on": "right"}, {"name": "side", "point": [1.0] * dim}],
    }


@pytest.mark.parametrize("stretch", (1.6, 0.7))
@pytest.mark.parametrize(
    ("name", "parameters", "psi", "dim"),
    [("Yeoh", {"c20": -0.1 * MU, "c30": 0.05 * MU}, yeoh, 3), ("MooneyRivlin", {}, mooney_rivlin, 2)],
)
def test_uniaxial_stress_is_that_of_the_closed_form(
    page: dict[str, Any], name: str, parameters: dict[str, float], psi: Any, dim: int, stretch: float
) -> None:
    """Of a rod that is free sideways, psi of principal stretches alone: force on the unit area, and lateral stretch."""
    stress, side = uniaxial(psi, stretch, dim)
    driven = {"on": "right", "displacement": lambda t: [(stretch - 1) * t] + [0.0] * (dim - 1), "components": "x"}
    energy = page[name](MU, LAMBDA, **parameters)
    with Simulation(rod(dim), energy=energy, boundary=[driven]) as simulation:
        while not simulation.ended:
            row = simulation.step()
    assert row["reaction_grip_x"] == pytest.approx(stress, rel=1e-6)
    assert row["probe_side_y"] == pytest.approx(side - 1, rel=1e-6)


def test_an_energy_made_of_the_moduli_fits_every_region(page: dict[str, Any]) -> None:
    """And gives what the built-in one of the same psi gives: Saint Venant-Kirchhoff."""

    def stvk(mu: Any, lmbda: Any) -> Any:
        class Law:
            def psi(self, F: Any) -> Any:
                E = (F.T * F - ufl.Identity(3)) / 2
                return mu * ufl.inner(E, E) + lmbda / 2 * ufl.tr(E) ** 2

        return Law()

    mesh = {"builder": "box", "size": [1.0, 0.25], "h": 0.125}
    tables = changed(STRIP, mesh=mesh, material={"energy": "stvk"}, time={"end": 0.03})
    rows = []
    for own in ({}, {"energy": stvk}):
        with Simulation(tables, **own) as simulation:
            while not simulation.ended:
                rows.append(simulation.step())
    for row, built_in in zip(rows[6:], rows[:6], strict=True):
        for column in ("elastic", "reaction_grip_x", "broken_edges", "probe_tip_x"):
            assert row[column] == pytest.approx(built_in[column], rel=1e-7), column


def law_of(function: Callable[[Any], Any]) -> Any:
    return type("Law", (), {"psi": lambda self, F: function(F)})()


def hooke(strain: Any, mu: float = MU, lmbda: float = LAMBDA) -> Any:
    return mu * ufl.inner(strain, strain) + lmbda / 2 * ufl.tr(strain) ** 2


def green(F: Any) -> Any:
    return (F.T * F - ufl.Identity(3)) / 2


def square(F: Any) -> Any:
    return ufl.inner(green(F), green(F))


FIBRE = ufl.as_vector([1.0, 0.0, 0.0])
BAD_ENERGIES: dict[str, tuple[Any, str]] = {
    "no psi": (3, "has no method psi"),
    "tensor": (law_of(lambda F: F), "has the shape (3, 3); a scalar is needed"),
    "at rest": (law_of(lambda F: hooke(green(F)) + 1.0), "has psi(I) = 1 J/m^3"),
    "stressed": (law_of(lambda F: hooke(green(F)) + 2e4 * ufl.tr(green(F))), "has a stress at rest"),
    "turned": (law_of(lambda F: hooke(ufl.sym(F) - ufl.Identity(3))), "is not objective"),
    "stiff": (law_of(lambda F: hooke(green(F), 2 * MU, 2 * LAMBDA)), "has E = 2e+06 Pa and nu = 0.3 at rest"),
    "negative": (law_of(lambda F: hooke(green(F), MU, -MU)), "is not positive definite at rest"),
    "fibre": (law_of(lambda F: hooke(green(F)) + 1e5 * ufl.inner(FIBRE, green(F) * FIBRE) ** 2), "is not isotropic"),
    "not finite": (law_of(lambda F: hooke(green(F)) + square(F) ** 2 * ufl.ln(1 - 4000 * square(F))), "is not finite"),
    "typing error": (law_of(lambda F: F.no_such_thing), "psi(F) cannot be compiled: AttributeError"),
}


@pytest.mark.parametrize("name", BAD_ENERGIES)
def test_an_energy_that_is_wrong_is_refused(name: str) -> None:
    """With its name, and what is wrong."""
    law, message = BAD_ENERGIES[name]
    with pytest.raises(InputError, match=re.escape(message)) as raised:
        Simulation(rod(2), energy=law, boundary=[{"on": "right", "displacement": lambda t: [t, 0.0]}])
    assert str(raised.value).startswith("the energy ")


# --- criteria, laws of edges ----------------------------------------------------------------------------------------


def steps(tables: dict[str, Any], **parts: Any) -> list[dict[str, float]]:
    with Simulation(tables, **parts) as simulation:
        rows = []
        while not simulation.ended:
            rows.append(simulation.step())
    return rows


def normal_stress(stress: Any, edges: Any, strength: Any) -> Any:
    return np.einsum("nki,nij,nkj->nk", edges, stress, edges) / strength


@pytest.mark.parametrize("more", ({}, {"radius": 0.2}, {"cap": 0.02}, {"crumbs": False}))
def test_the_built_in_criterion_as_a_function_breaks_the_same_edges(more: dict[str, Any]) -> None:
    tables = changed(STRIP, fracture=more)
    built_in, own = steps(tables), steps(tables, criterion=normal_stress)
    for column in ("broken_edges", "split_cells", "pieces"):
        assert [row[column] for row in own] == [row[column] for row in built_in], column
    assert own[-1]["broken_edges"] > 0 and own[-1]["elastic"] == pytest.approx(built_in[-1]["elastic"], rel=1e-9)


def test_another_criterion_breaks_others() -> None:
    """In a bar twice the greatest shear is the stress along it, under which edges of every direction now fail."""

    def shear(stress: Any, edges: Any, strength: Any) -> Any:
        principal = np.linalg.eigvalsh(stress)
        return (principal[:, -1:] - principal[:, :1]) / strength

    built_in, own = steps(STRIP), steps(STRIP, criterion=shear)
    assert own[-1]["broken_edges"] > built_in[-1]["broken_edges"] > 0


BAD_CRITERIA: dict[str, tuple[Any, str]] = {
    "shape": (lambda stress, edges, strength: stress[:, 0, 0], "returns the shape (20,)"),
    "nan": (lambda stress, edges, strength: strength * np.nan, "no numbers"),
    "no stress": (lambda stress, edges, strength: np.full(strength.shape, 2.0), "without stress"),
    "strength": (lambda stress, edges, strength: normal_stress(stress, edges, 1.0), "infinite strength"),
    "axes": (lambda stress, edges, strength: stress[:, :1, 0] / strength, "is not objective"),
    "sense": (
        lambda stress, edges, strength: np.einsum("nki,nij,nj->nk", edges, stress, edges[:, 0]) / strength, "+n and -n"
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", BAD_CRITERIA)
def test_a_criterion_that_is_wrong_is_refused(name: str) -> None:
    criterion, message = BAD_CRITERIA[name]
    with pytest.raises(InputError, match=re.escape(message)):
        Simulation(STRIP, criterion=criterion)


def test_a_law_of_an_edge_softens_its_cells() -> None:
    """The bar of test_edge_law: at a load of 1.25 edges keep 3/4 of themselves, and chi of a triangle is 5/6."""
    tables: dict[str, Any] = {
        "title": "bar",
        "mesh": {"builder": "box", "size": [1.0, 0.5], "h": 0.25},
        "material": {"energy": "linear", "young": 1.0, "poisson": 0.0, "density": 1.0},
        "boundary": [
            {"on": "left", "fix": "xy"},
            {"on": "right", "displacement": {"time": [0.0, 1.0], "value": [[0.0, "free"], [1.0, "free"]]}},
        ],
        "fracture": {"strength": 0.05, "tie_break": 0.0, "passes": 1},
        "time": {"scheme": "quasi-static", "step": 0.0125, "end": 0.2},
        "solver": DIRECT,
    }
    with Simulation(tables, edge_law=lambda load: np.clip(2 - load, 0, 1)) as simulation:
        for _ in range(5):
            simulation.step()
        np.testing.assert_allclose(simulation.scene.balance.stress.chi.x.array, 5 / 6, atol=1e-9)  # type: ignore[union-attr]
        assert not simulation.damage.x.array.any()


def test_a_bar_whose_edges_soften_carries_what_its_reaction_says(tmp_path: Path) -> None:
    """In steps of 1.3 times the strength external work is that of the reaction, and its peak that of the column."""
    tables: dict[str, Any] = {
        "title": "bar",
        "mesh": {"builder": "box", "size": [0.4, 0.1], "h": 0.05},
        "material": {"energy": "linear", "young": 1e4, "poisson": 0.0, "density": 1.0},
        "boundary": [
            {"on": "left", "fix": "xy"},
            {"on": "right", "displacement": {"time": [0.0, 1.0], "value": [[0.0, "free"], [0.02, "free"]]}},
        ],
        "fracture": {"strength": 100.0},
        "probe": [{"name": "end", "on": "right"}],
        "time": {"scheme": "quasi-static", "step": 0.26, "end": 1.0},
        "output": {"picture": False},
        "solver": DIRECT,
    }
    with Simulation(tables, edge_law=lambda load: np.clip((4 - load) / (3 * load), 0, 1), out=tmp_path) as simulation:
        simulation.run()
    with (tmp_path / "history.csv").open(newline="") as file:
        rows = {name: np.array(column, float) for name, *column in zip(*csv.reader(file), strict=True)}
    load, way = (np.append(0.0, rows[f"{name}_end_x"]) for name in ("reaction", "motion"))
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert summary["peak_reactions"]["reaction_end_x"] == pytest.approx(load.max(), rel=1e-9)
    np.testing.assert_allclose(rows["external_work"][-1], np.trapezoid(load, way), rtol=1e-6)
    np.testing.assert_allclose(rows["external_work"], rows["elastic"] + rows["dissipated"], rtol=1e-5)


@pytest.mark.parametrize(
    ("law", "message"),
    [
        (lambda load: 2 - load, "outside 0 to 1"),
        (lambda load: np.where(load > 2, 0.5, 0.1), "rises with the load"),
        (lambda load: np.full(load.shape, 0.5), "never breaks an edge"),
        (lambda load: np.zeros(3), "returns the shape (3,)"),
        (7, "is no function of the load"),
    ],
)
def test_a_law_of_an_edge_that_is_wrong_is_refused(law: Any, message: str) -> None:
    with pytest.raises(InputError, match=re.escape(message)):
        Simulation(STRIP, edge_law=law)


# --- loads ----------------------------------------------------------------------------------------------------------


def test_a_displacement_of_time_is_that_of_a_table() -> None:
    """To the last bit, but for probes in another order of sums."""
    fixed, driven = STRIP["boundary"]
    table = {"time": [0.0, 0.05], "value": [[0.0, 0.0], [0.05, 0.0]]}
    as_table = steps(changed(STRIP, boundary=[fixed, {"on": driven["on"], "displacement": table}]))
    given = {"on": "right", "displacement": lambda t: np.array([np.interp(t, [0.0, 0.05], [0.0, 0.05]), 0.0])}
    own = steps(changed(STRIP, boundary=[fixed]), boundary=[given])
    for row, other in zip(own, as_table, strict=True):
        assert {**row, "wall_step": 0} == {**other, "wall_step": 0}


def test_a_displacement_of_time_and_place_is_a_patch_test() -> None:
    """u = t H x on the whole boundary: every node has it, and the stress is that of Hooke's law."""
    H = np.array([[0.01, 0.002], [-0.003, 0.005]])
    sides = ("left", "right", "bottom", "top")
    entries = [{"on": side, "displacement": lambda t, x: t * x @ H.T} for side in sides]
    tables = {**rod(2), "boundary": [], "probe": [], "mesh": {"builder": "box", "size": [1.0, 0.6], "h": 0.2}}
    tables["material"] = tables["material"] | {"energy": "linear"}
    with Simulation(tables, boundary=entries) as simulation:
        while not simulation.ended:
            simulation.step()
        nodes = simulation.scene.domain.nodes
        np.testing.assert_allclose(simulation.displacement.x.array.reshape(-1, 2), nodes @ H.T, atol=1e-15)


@pytest.mark.parametrize("kind", ("traction", "pressure", "force"))
def test_a_load_of_time_and_place_has_its_resultant(kind: str) -> None:
    """t (1 + 2 y) Pa on the right end of height 1: the left end takes 2 t N; a force of time is what it says."""
    load_of: dict[str, Any] = {
        "traction": lambda t, x: np.stack([t * (1 + 2 * x[:, 1]), 0 * x[:, 0]], axis=1),
        "pressure": lambda t, x: -t * (1 + 2 * x[:, 1]),
        "force": lambda t: [2 * t, 0.0],
    }
    tables = {**rod(2), "boundary": [{"on": "left", "fix": "xy"}], "probe": [{"name": "wall", "on": "left"}]}
    tables["material"] = tables["material"] | {"energy": "linear"}
    rows = steps(tables, boundary=[{"on": "right", kind: load_of[kind]}])
    assert rows[-1]["reaction_wall_x"] == pytest.approx(-2, rel=1e-9)
    assert rows[1]["reaction_wall_x"] == pytest.approx(-1, rel=1e-9)


@pytest.mark.parametrize(
    ("entry", "message"),
    [
        ({"on": "right", "displacement": [0.1, 0.0]}, "with a function of t"),
        ({"on": "right", "displacement": lambda t: [0.1]}, "at t = 0 s has 1 number; 2 needed"),
        ({"on": "right", "displacement": lambda t: [np.nan, 0.0]}, "at t = 0 s is nan; finite numbers needed"),
        ({"on": "right", "displacement": lambda t, x: x[:, :1]}, "numbers; 2 for each of"),
        ({"on": "right", "traction": lambda t, x: x[:, 0]}, "numbers; 2 for each of"),
        ({"on": "right", "force": lambda t, x: x}, "a force is a resultant"),
        ({"on": "right", "traction": lambda t: [1.0, 0.0], "components": "x"}, "remove components"),
        ({"on": "rihgt", "displacement": lambda t: [0.1, 0.0]}, "rihgt"),
        ({"on": "left", "displacement": lambda t: [0.1, 0.0]}, "both prescribe x"),
    ],
)
def test_a_load_that_is_wrong_is_refused(entry: dict[str, Any], message: str) -> None:
    fixed, driven = STRIP["boundary"]
    tables = changed(STRIP, boundary=[fixed, driven] if entry["on"] == "left" else [fixed])
    with pytest.raises(InputError, match=re.escape(message)):
        Simulation(tables, boundary=[entry])


@pytest.mark.parametrize(
    "pull", [lambda t: [np.nan if 0 < t < 0.2 else 0.0, 0.0], lambda t, x: np.where(0 < t < 0.2, np.inf, 0 * x)]
)
def test_a_load_that_is_not_finite_within_the_run_is_named(pull: Any) -> None:
    """Start and end of the run are finite."""
    tables = changed(STRIP, boundary=STRIP["boundary"][:1], time={"step": 0.1, "end": 0.2})
    for kind in ("displacement", "traction"):
        message = rf"{kind} at t = 0\.\d+ s is (nan|inf); finite numbers needed"
        with (
            pytest.raises(InputError, match=message),
            Simulation(tables, boundary=[{"on": "right", kind: pull}]) as simulation,
        ):
            simulation.step()


# --- terms of the balance -------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def foundation() -> Any:
    """The term of the page."""
    block = next(text for text in re.findall(r"```python\n(.*?)```", DOCS.read_text(), re.DOTALL) if "Term)" in text)
    names: dict[str, Any] = {"fracsim": package, "ufl": ufl}
    exec(block.split("with fracsim")[0], names)
    return names["Foundation"]


def translated(term: Any) -> dict[str, float]:
    """Row of a block that is moved by 0.01 m along x as a whole, so that it has no stress."""
    everywhere = {"box": [[-1.0, -1.0], [2.0, 2.0]]}
    tables = {**rod(2), "boundary": [], "probe": [{"name": "all", "on": everywhere}]}
    moved = {"on": everywhere, "displacement": lambda t: [0.01 * t, 0.0]}
    return steps(tables, boundary=[moved], terms=[term])[-1]


def test_a_term_of_the_user_is_in_the_balance(foundation: Any) -> None:
    """k A u on the ground, and k A u^2 / 2 stored; of springs at nodes k u for each of them."""
    row = translated(lambda body: foundation(body, k=1e4))
    assert row["reaction_all_x"] == pytest.approx(1e4 * 0.01, rel=1e-9)
    assert row["elastic"] == pytest.approx(1e4 * 0.01**2 / 2, rel=1e-6)
    row = translated(Spring.of)
    assert row["reaction_all_x"] == pytest.approx(2.0 * 0.01 * 4, rel=1e-9)


def faulty(base: type, **methods: Any) -> Any:
    return type("Faulty", (base,), methods)


def test_a_term_that_is_wrong_is_refused(foundation: Any) -> None:
    def shear(self: Any, v: Any, w: Any, dx: Any) -> Any:
        return self._k * v[0] * w[1] * self._ds

    faults = {
        "a fracsim.Term or a list is needed": lambda body: 3,
        "has a tangent that is not the derivative": faulty(foundation, tangent_form=lambda self, v, w, dx: 0),
        "has a potential whose derivative is not its force": faulty(foundation, potential=lambda self: 1.0),
        "is not symmetric": faulty(
            foundation,
            virtual_work=lambda self, w, dx: shear(self, self._u, w, dx), tangent_form=shear,
            potential=lambda self: None,
        ),
        "its forms cannot be compiled": faulty(foundation, virtual_work=lambda self, w, dx: self._u.nothing),
        "its parameters are": faulty(foundation, __init__=lambda self, body, colour: None),
        "the mesh has no such facet group": lambda body: foundation(body, group="ceiling"),
    }  # fmt: skip
    for message, term in faults.items():
        with pytest.raises(InputError, match=re.escape(message)):
            translated(term)
    spring = faulty(Spring, add_stiffness=lambda self, K: None)
    with pytest.raises(InputError, match="has a tangent that is not the derivative"):
        translated(lambda body: spring(body.u, body.assembler.owned_dof_count, 2.0))


# --- time schemes ---------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Theta(EndOfStepScheme):
    """u = u_n + dt ((1 - theta) v_n + theta v), v = v_n + dt ((1 - theta) a_n + theta a)."""

    theta: float = 0.5
    inertia: ClassVar[bool] = True
    carries_acceleration: ClassVar[bool] = True

    def rate_coefficients(self, dt: float) -> tuple[float, float]:
        return 1 / (self.theta * dt) ** 2, 1 / (self.theta * dt)

    def reference_displacements(self, dt: float, u: Any, v: Any, a: Any) -> tuple[Any, Any]:
        with_rates = u + dt * (1 - self.theta) * v
        return with_rates + self.theta * dt * (v + (1 - self.theta) * dt * a), with_rates


def test_a_time_scheme_of_the_user_steps() -> None:
    """Free fall: after N steps u = g dt^2 (N^2 / 2 + (theta - 1/2) N), as of no built-in scheme."""
    falling = changed(STRIP, fracture=None, boundary=[], load={"gravity": [0.0, -9.81]}, output={"fields": []})
    falling |= {"time": {"step": 0.01, "end": 0.1, "adapt": False}, "probe": [{"name": "tip", "point": [1.0, 0.25]}]}
    for scheme, theta in ((Theta, 0.5), (Theta(0.75), 0.75)):
        row = steps(falling, scheme=scheme)[-1]
        assert row["probe_tip_y"] == pytest.approx(-9.81 * 0.01**2 * (50 + (theta - 0.5) * 10), rel=1e-8)


def test_built_in_schemes_pass_the_check() -> None:
    for name, scheme in SCHEMES.items():
        if scheme.implicit and name != "rigid":
            check_scheme(scheme(), name)


@pytest.mark.parametrize(
    ("scheme", "message"),
    [
        (Theta(0.3), "is not stable"),
        (Theta(0.0), "division by zero"),
        (faulty(Theta, implicit=False), "is explicit"),
        (faulty(Theta, complete_step=lambda self, dt, x, u, v, a: (x, v, a)), "does not converge"),
        (faulty(Theta, reference_displacements=lambda self, dt, u, v, a: (u, u)), "does not keep a uniform motion"),
        (faulty(Theta, rate_coefficients=lambda self, dt: (1 / dt, 1 / dt)), "in proportion"),
        (object(), "has no inertia"),
    ],
)
def test_a_time_scheme_that_is_wrong_is_refused(scheme: Any, message: str) -> None:
    with pytest.raises(InputError, match=message):
        Simulation(changed(STRIP, fracture=None, output={"fields": []}), scheme=scheme)


def test_a_study_that_does_not_go_with_the_scheme_is_refused() -> None:
    with pytest.raises(InputError, match=r"does not go with the time scheme: \[initial\] sets a velocity"):
        Simulation(changed(STRIP, initial={"velocity": [1.0, 0.0]}), scheme=QuasiStatic)


# --- plug-ins -------------------------------------------------------------------------------------------------------

MORE = '''
from typing import ClassVar

from fracsim.forms.schemes import BackwardEuler


@dataclass(frozen=True)
class Damped(BackwardEuler):
    """Backward Euler under another name, with a parameter."""

    size: float = 1.0


def shaker(on, amplitude):
    return {"on": on, "displacement": lambda t: [amplitude * t, 0.0]}


def nothing(body):
    return []


@dataclass(frozen=True)
class Wedge:
    """A triangle with a right angle at the origin."""

    h: float = 1.0
    name = "wedge"
    groups = ("base",)
    regions = ()

    def bounds(self):
        return (0.0, 0.0), (self.h, self.h)

    def cells_estimate(self):
        return 1

    def build(self):
        from fracsim.meshes import MeshData
        points = np.array([[0.0, 0.0], [self.h, 0.0], [0.0, self.h]])
        return MeshData(points, np.array([[0, 1, 2]]), {"base": np.array([[0, 1]])})
'''


@pytest.fixture
def rubber(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The package of the page, as pip would install it; returns the folder."""
    texts = re.findall(r"```(?:python|toml)\n(.*?)```", DOCS.read_text(), re.DOTALL)
    code = next(text for text in texts if "class Yeoh" in text).split("strip = {")[0]
    site = tmp_path / "site"
    (site / "rubber-1.2.dist-info").mkdir(parents=True)
    (site / "rubber.py").write_text("import numpy as np\n" + code + MORE)
    (site / "rubber-1.2.dist-info" / "METADATA").write_text("Metadata-Version: 2.1\nName: rubber\nVersion: 1.2\n")
    groups = tomllib.loads(next(text for text in texts if "entry-points" in text))["project"]["entry-points"]
    groups |= {"fracsim.builders": {"wedge": "rubber:Wedge"}, "fracsim.edge_laws": {"soft": "rubber:softening"}}
    groups |= {"fracsim.schemes": {"damped": "rubber:Damped"}, "fracsim.loads": {"shaker": "rubber:shaker"}}
    groups |= {"fracsim.terms": {"nothing": "rubber:nothing"}}
    groups["fracsim.energies"] |= {"lost": "rubber:Lost", "mooney-rivlin": "rubber:MooneyRivlin"}
    lines = [f"[{group}]\n" + "".join(f"{name} = {value}\n" for name, value in names.items())
             for group, names in groups.items()]  # fmt: skip
    (site / "rubber-1.2.dist-info" / "entry_points.txt").write_text("\n".join(lines))
    monkeypatch.syspath_prepend(site)
    return tmp_path


def page_study() -> dict[str, Any]:
    """The study of the page, with a strip to tear."""
    texts = re.findall(r"```toml\n(.*?)```", DOCS.read_text(), re.DOTALL)
    tables = tomllib.loads(next(text for text in texts if "[plugin.yeoh]" in text))
    rest = {name: STRIP[name] for name in ("title", "mesh", "boundary", "time", "output")}
    return tables | rest


def test_a_study_names_plugins_of_installed_packages(rubber: Path, page: dict[str, Any]) -> None:
    """The same steps as with the objects in Python; study.toml and the checkpoint record package and version."""
    tables = page_study()
    named = steps(tables)
    plain = {name: value for name, value in changed(tables, fracture={"criterion": "normal-stress"}).items()
             if name != "plugin"}  # fmt: skip
    plain["material"] = plain["material"] | {"energy": "neo-hookean"}
    given = steps(
        plain, energy=lambda mu, lmbda: page["Yeoh"](mu, lmbda, c20=-1e3, c30=100.0), criterion=page["tresca"]
    )
    assert named[-1]["broken_edges"] > 0
    for row, other in zip(named, given, strict=True):
        assert {**row, "wall_step": 0} == {**other, "wall_step": 0}
    with Simulation(tables, rubber / "out") as simulation:
        simulation.step()
        simulation.checkpoint()
    text = (rubber / "out" / "study.toml").read_text()
    assert "# physics: the energy yeoh of rubber 1.2\n# physics: the criterion tresca of rubber 1.2\n" in text
    with Simulation(tables, rubber / "out", restart=True) as simulation:
        assert simulation.state.step == 1
    with pytest.raises(InputError, match=r"the run was with physics: the energy yeoh of rubber 1\.2"):
        Simulation(tables, rubber / "out", restart=True, criterion=normal_stress)


def test_a_sweep_runs_a_case_again_if_a_plugin_has_changed(rubber: Path) -> None:
    import tomli_w

    path, out = rubber / "strip.toml", rubber / "out"
    path.write_text(tomli_w.dumps(page_study()))
    sweep = (path, "--set", "time.end=0.01", "-o", out)
    assert swept_here(*sweep).returncode == 0
    assert "done before" in swept_here(*sweep).stdout
    information = rubber / "site" / "rubber-1.2.dist-info"
    metadata = information / "METADATA"
    metadata.write_text(metadata.read_text().replace("1.2", "1.3"))
    information.rename(rubber / "site" / "rubber-1.3.dist-info")
    again = swept_here(*sweep)
    assert again.returncode == 0 and "done before" not in again.stdout
    assert "# physics: the energy yeoh of rubber 1.3\n" in (out / "end-0.01" / "study.toml").read_text()


def test_the_command_line_knows_plugins(rubber: Path) -> None:
    """`check` and `run`, with a mesh builder too; errors name the plug-in and end with exit code 2."""
    import tomli_w

    path = rubber / "strip.toml"
    path.write_text(tomli_w.dumps(page_study()))
    done = fracsim_here("run", path, "-o", rubber / "out", "--set", "time.end=0.01", "--set", "fracture.edge_law=soft")
    assert done.returncode == 0, done.stderr
    wedge = ("--set", "mesh={builder='wedge', h=0.5}", "--set", "boundary=[{on='base', fix='xy'}]")
    assert fracsim_here("check", path, *wedge).returncode == 0
    done = fracsim_here("run", path, "-o", rubber / "wedge", "--set", "time.end=0.005", *wedge)
    assert done.returncode == 0 and "builder wedge of rubber 1.2" in (rubber / "wedge" / "study.toml").read_text()
    faults = {
        "plugin.yeoh.c40=1.0": "the energy yeoh of rubber 1.2: got an unexpected keyword argument 'c40'; its",
        "material.energy=yeohh": 'material.energy = "yeohh": must be',
        "plugin.yoeh.c20=1.0": "plugin.yoeh has parameters of a plug-in that the study does not name; it names",
        "material.energy=lost": "the energy lost of rubber 1.2 cannot be imported: AttributeError",
        "fracture.energy=10.0": "fracture.criterion is for edges that break one by one",
        'terms=["wind"]': "terms.0: no installed package has the term of the balance wind; installed: nothing",
        "plugin.tresca.c=1.0": "the criterion tresca of rubber 1.2 is no class and has no parameters; remove c",
    }
    for setting, message in faults.items():
        more = ("--set", "plugin={}") if setting == "material.energy=lost" else ()
        done = fracsim_here("run", path, "-o", rubber / "bad", *more, "--set", setting)
        assert done.returncode == 2 and message in done.stderr, (setting, done.stderr)
        assert not (rubber / "bad" / "history.csv").exists()
    unknown = fracsim_here("check", path, "--set", "mesh={builder='wedgy', h=0.5}")
    assert unknown.returncode == 2 and 'mesh.builder = "wedgy" is not a builder' in unknown.stderr


def test_a_study_names_schemes_loads_and_terms(rubber: Path) -> None:
    """With their parameters: the steps are those of the same study without plug-ins."""
    fixed, driven = STRIP["boundary"]
    table = {"time": [0.0, 1.0], "value": [[0.0, 0.0], [1.0, 0.0]]}
    plain = changed(STRIP, boundary=[fixed, {"on": driven["on"], "displacement": table}])
    plain["time"] = plain["time"] | {"scheme": "backward-euler"}
    named = changed(plain, boundary=[fixed], time={"scheme": "damped"})
    named |= {"loads": ["shaker"], "terms": ["nothing"]}
    named["plugin"] = {"shaker": {"on": "right", "amplitude": 1.0}, "damped": {"size": 2.0}}
    for row, other in zip(steps(named), steps(plain), strict=True):
        assert {**row, "wall_step": 0} == {**other, "wall_step": 0}
    with Simulation(named, rubber / "out") as simulation:
        assert simulation.study.time.scheme_object.size == 2.0  # type: ignore[attr-defined]
    text = (rubber / "out" / "study.toml").read_text()
    assert all(
        f"of rubber 1.2\n# physics: the {kind}" in text for kind in ("term of the balance nothing", "load shaker")
    )
    with Simulation(load(rubber / "out" / "study.toml")) as simulation:  # what a run writes can be run
        assert simulation.step()["step"] == 1
    listed = fracsim_here("list").stdout
    assert re.search(r"plug-ins.*\n(.*\n)*? +yeoh +energy", listed), listed
    with pytest.raises(InputError, match=r"the load shaker of rubber 1\.2: missing a required argument: 'amplitude'"):
        Simulation(named | {"plugin": {"shaker": {"on": "right"}}})


def test_two_packages_with_one_name_are_refused(rubber: Path) -> None:
    other = rubber / "site" / "latex-0.1.dist-info"
    other.mkdir()
    (other / "METADATA").write_text("Metadata-Version: 2.1\nName: latex\nVersion: 0.1\n")
    (other / "entry_points.txt").write_text("[fracsim.energies]\nyeoh = latex:Yeoh\n")
    with pytest.raises(InputError, match=r"the energy yeoh is offered by latex 0\.1 and rubber 1\.2"):
        Simulation(page_study())


def test_built_in_names_cost_no_search(monkeypatch: pytest.MonkeyPatch) -> None:
    """Packages are searched for names alone that are not built in."""
    searched: list[str] = []
    monkeypatch.setattr(plugins, "_entry_points", lambda group, name: searched.append(name) or [])
    load("loaf")
    assert not searched
    with pytest.raises(InputError, match="must be"):
        load("loaf", {"material.energy": "putty"})
    assert searched == ["putty"]
