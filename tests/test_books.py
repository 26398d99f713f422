"""What a run says of energies, forces and cracks is what the body has: at rest, of some thickness, where cracks end."""

from __future__ import annotations

import contextlib
import copy
import csv
import io
import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.deformable_run import Run
from fracsim.output.frame_files import FieldEvaluator
from fracsim.report.runs import flatten_tables
from fracsim.scene import build_scene
from fracsim.study.check import check_study
from support.scenes import make_scene, make_study

FAR = {"name": "ball", "shape": "sphere", "radius": 0.2}


@pytest.mark.parametrize("energy", ("linear", "corotated", "stvk", "neo-hookean"))
@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("scheme", ("explicit", "backward-euler", "generalized-alpha"))
def test_a_body_at_rest_holds_no_energy(energy: str, dim: int, scheme: str) -> None:
    """An obstacle flies towards it and has not arrived: no energy, force, stress or acceleration, from the start on."""
    ball = FAR | {"at": [0.5] * (dim - 1) + [3.0], "velocity": [0.0] * (dim - 1) + [-1.0], "mass": 0.1}
    scene, walk = make_scene(
        mesh={"builder": "box", "size": [1.0] * dim, "h": 0.5},
        material={"energy": energy, "young": 1e3, "poisson": 0.25, "density": 1.0},
        obstacle=[ball], time={"scheme": scheme, "step": 1e-3, "end": 0.01},
    )  # fmt: skip
    _, *fields = FieldEvaluator(scene.balance.stress, ["energy_density", "stress"])(walk.state, None)
    assert all(np.abs(field.values).max() < 1e-9 for field in fields)  # moduli are 1e3
    assert abs(scene.balance.stress.stored_energy()) < 1e-9 and np.abs(walk.a).max() < 1e-9
    for _ in range(2):
        assert abs(walk.advance().elastic) < 1e-9


def test_flow_that_is_predicted_turns_with_its_elastic_part() -> None:
    """While a step is solved F_p stands for another: the rotation is that of F_e as it is then, by the singular vectors
    of F F_p^-1, where a step is begun from another displacement."""
    scene, walk = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0, 1.0], "h": 1.0},
        material={"energy": "corotated", "young": 1e3, "poisson": 0.25, "density": 1.0},
        plasticity={"yield_stress": 1.0}, obstacle=[FAR | {"at": [0.5, 0.5, 9.0]}],
        boundary=[{"on": "bottom", "fix": "xyz"}, {"on": "top", "velocity": [0.3, 0.0, 0.1]}],
        time={"scheme": "backward-euler", "step": 0.01, "end": 1.0},
    )  # fmt: skip
    walk.advance()
    balance, plastic, stress = scene.balance, scene.balance.stress.material.plastic, scene.balance.stress
    known = plastic.inverse_rows.copy()
    balance.set_displacement(walk.u + 0.1 * np.random.default_rng(1).normal(size=len(walk.u)))
    balance.begin_step(walk.t + 0.3, 0.3, walk.u, walk.v, walk.a)
    assert np.abs(plastic.inverse_rows - known).max() > 1e-3
    corners = scene.domain.nodes[scene.domain.cell_nodes]
    moved = corners + balance.u.x.array.reshape(-1, 3)[scene.domain.cell_nodes]
    sides: list[Any] = [np.swapaxes(x[:, 1:] - x[:, :1], 1, 2) for x in (moved, corners)]
    F_e = sides[0] @ np.linalg.inv(sides[1]) @ plastic.inverse_rows.reshape(-1, 3, 3)
    left, _, right = np.linalg.svd(F_e)
    np.testing.assert_allclose(stress.rotation_field.x.array.reshape(-1, 3, 3)[: len(F_e)], left @ right, atol=1e-12)


# --- a body of some thickness is so many of one metre ---

THICK = 2.0**-7  # m: products with it are exact, so that both bodies take the same steps
PLATE = {
    "mesh": {"builder": "box", "size": [1.0, 0.5], "h": 0.25, "pattern": "unstructured"},
    "material": {"energy": "stvk", "young": 1e6, "poisson": 0.3, "density": 1000.0},
    "damping": {"mass": 5.0, "stiffness": 1e-4},
    "fracture": {"strength": 6e4},
    "plasticity": {"yield_stress": 3e4},
    "load": {"gravity": [0.0, -9.81]},
    "boundary": [{"on": "left", "fix": "xy"}, {"on": "right", "force": [6e5, 0.0]}],
    "obstacle": [
        {"name": "ram", "shape": "sphere", "radius": 0.1, "at": [0.5, 0.61], "velocity": [0.5, -3.0], "friction": 0.3},
        {"name": "ball", "shape": "box", "size": [0.2, 0.1], "at": [0.7, -0.06], "velocity": [0.0, 4.0], "mass": 20.0},
    ],
    "crack": [{"segment": [[-0.1, 0.24], [0.2, 0.24]]}],
    "probe": [{"name": "grip", "on": "left"}, {"name": "end", "point": [1.0, 0.25]}],
    "time": {
        "scheme": "newmark", "step": 2e-3, "end": 0.05, "until": {"drop": 0.999, "of": "ram"},
    },
    "output": {"interval": 0.01, "picture": False, "fields": ["stress", "energy_density", "damage"]},
}  # fmt: skip
PER_METRE = {  # what is J, N or kg by its name, as docs/output.md lists columns and figures; all else is the same
    "history": ("kinetic", "elastic", "dissipated", "external_work", "reaction_", "contact_", "work_"),
    "pieces": ("mass",),
    "summary": ("dust_mass", "external_work", "dissipated", "peak_reactions", "load.peak"),
}
NOT_COMPARED = ("wall", "cpu", "seconds", "peak_memory", "versions", "title", "load.peak_time")


def written(thickness: float | None, out: Path) -> dict[str, dict[str, Any]]:
    """Figures of a run by file and name."""
    share, tables = thickness or 1.0, copy.deepcopy(PLATE)
    tables["boundary"][1]["force"][0] *= share
    tables["obstacle"][1]["mass"] *= share
    if thickness is not None:
        tables["material"]["thickness"] = thickness
    scene = build_scene(MPI.COMM_SELF, make_study(**tables))
    Run(scene, out)()
    found: dict[str, dict[str, Any]] = {}
    for name in ("history", "pieces"):
        with (out / f"{name}.csv").open(newline="") as file:
            rows = list(csv.DictReader(file))
        found[name] = {key: np.array([float(row[key]) for row in rows]) for key in rows[0]}
    flat = flatten_tables(json.loads((out / "summary.json").read_text()))
    found["summary"] = {key: np.array(value) for key, value in flat.items() if not isinstance(value, str | list)}
    return found


def test_figures_of_a_plate_are_those_of_its_thickness(tmp_path: Path) -> None:
    """J, N and kg of a plate of 1/128 m are 1/128 of those of a plate of 1 m, where loads and masses of a metre are the
    same; lengths, times, counts, rates and ratios are equal."""
    metre = written(None, tmp_path / "metre")
    plate = written(THICK, tmp_path / "plate")
    seen = set()
    for file, names in PER_METRE.items():
        assert metre[file].keys() == plate[file].keys()
        for name, values in metre[file].items():
            if name.startswith(NOT_COMPARED):
                continue
            factor = THICK if name.startswith(names) else 1.0
            seen |= {head for head in names if name.startswith(head)}
            size = np.abs(values).max()
            np.testing.assert_allclose(plate[file][name], factor * values, rtol=1e-10, atol=1e-12 * factor * size)
            assert factor == 1 or name == "dust_mass" or np.any(values), name
    assert seen == {name for names in PER_METRE.values() for name in names}


def test_a_gain_is_told_for_the_thickness(tmp_path: Path) -> None:
    """A thin plate spun too fast for its steps: the gain told at the end is that of the rows of history.csv."""
    scene = build_scene(
        MPI.COMM_SELF,
        make_study(
            mesh={"builder": "box", "size": [1.0, 0.25], "h": 0.25}, initial={"spin": [40.0]},
            material={"energy": "stvk", "young": 1e6, "poisson": 0.3, "density": 1000.0, "thickness": 0.006},
            time={"scheme": "newmark", "step": 0.02, "end": 0.8}, output={"picture": False},
        ),
    )  # fmt: skip
    said = io.StringIO()
    with contextlib.redirect_stderr(said):
        Run(scene, tmp_path / "out")()
    rows = np.genfromtxt(tmp_path / "out" / "history.csv", delimiter=",", names=True)
    held = rows["kinetic"] + rows["elastic"] + rows["dissipated"] - rows["external_work"]
    told = re.search(r"gained (\S+) J of energy from nowhere", said.getvalue())
    assert told is not None
    assert float(told[1]) == pytest.approx(np.max(held - np.minimum.accumulate(held)), rel=0.01)


def test_loads_are_told_for_the_thickness() -> None:
    """`fracsim check`: the force as it was given, the area that it acts on, and the weight of 3.906 kg."""
    tables = copy.deepcopy(PLATE)
    tables["material"]["thickness"] = THICK
    lines = "\n".join(check_study(make_study(**tables)))
    assert '"right": 0.003906 m^2, (6e+05, 0) N' in lines and "(0, -38.32) N on the body" in lines
