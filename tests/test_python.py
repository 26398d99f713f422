"""The interface of Python: light to import, the numbers of the command, fields that follow, meshes handed over."""

from __future__ import annotations

import io
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import ufl
from dolfinx import fem
from dolfinx import mesh as dolfinx_mesh
from mpi4py import MPI

import fracsim as package
from cases import BAR, STRIP, changed, fracsim, write_study
from fracsim.errors import InputError
from fracsim.meshes import BUILDERS
from fracsim.output.progress import PROGRESS_TIMING, ProgressReporter
from fracsim.report.run_output import RunOutput
from fracsim.simulation import Simulation, load, run
from fracsim.study.reader import study_text
from support import given
from support.ranks import Arrays, run_on_ranks

DOCS = Path(__file__).parent.parent / "docs"
NAMES = {"RunOutput", "Simulation", "Term", "load", "open_run", "run"}


def python(code: str, folder: Path) -> str:
    done = subprocess.run([sys.executable, "-c", code], cwd=folder, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    return done.stdout


def test_importing_the_package_is_light(tmp_path: Path) -> None:
    """Its names are listed, none of what they need is imported; a name that is no name is an AttributeError."""
    heavy = ("numpy", "dolfinx", "petsc4py", "mpi4py", "pydantic", "pyvista", "gmsh", "importlib.metadata")
    code = f"""
import sys, fracsim
assert set(fracsim.__all__) <= set(dir(fracsim))
print([name for name in {heavy} if name in sys.modules], hasattr(fracsim, "simulate"))
import fracsim.deformable_run, fracsim.scene, fracsim.study.reader
print([callable(getattr(fracsim, name)) for name in sorted(fracsim.__all__)])
"""
    assert python(code, tmp_path) == "[] False\n[True, True, True, True, True, True]\n"
    assert set(package.__all__) == NAMES


def blocks(page: str) -> list[str]:
    return re.findall(r"```python\n(.*?)```", (DOCS / page).read_text(), re.DOTALL)


def test_the_blocks_of_the_page_run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As printed, one after another; what their comments say of the results holds."""
    monkeypatch.chdir(tmp_path)
    names: dict[str, Any] = {}
    for block in blocks("python.md"):
        exec(block, names)
    assert names["edges"][-1] > 20 and names["largest"] > 0 and names["heaviest"] > 0
    assert names["grid"].n_points == len(names["output"].frames[0].points) < names["skin"].n_points
    assert len(names["numbers"]) == 21 * 6


def test_a_run_is_that_of_the_command_to_the_last_bit(tmp_path: Path) -> None:
    """Each in a process of its own, as the addresses of arrays may change the order of sums within one."""
    bar = write_study(tmp_path / "bar.toml", STRIP, output={"surface": True})
    code = "import fracsim; print(fracsim.run('bar.toml', 'python', overrides={'time.end': 0.04}).outcome)"
    assert python(code, tmp_path) == "done\n"
    done = fracsim("run", bar, "-o", tmp_path / "command", "--set", "time.end=0.04", env=None, cwd=tmp_path)
    assert done.returncode == 0, done.stderr
    ours, theirs = package.open_run(tmp_path / "python"), package.open_run(tmp_path / "command")
    assert list(ours.history) == list(theirs.history) and ours.history["broken_edges"][-1] > 0
    for name in ours.history.keys() - {"wall_step"}:
        np.testing.assert_array_equal(ours.history[name], theirs.history[name], name)
    for name in ours.pieces:
        np.testing.assert_array_equal(ours.pieces[name], theirs.pieces[name], name)
    with h5py.File(ours.folder / "fields.h5") as one, h5py.File(theirs.folder / "fields.h5") as other:
        assert list(one["frames"]) == list(other["frames"])
        for name, frame in one["frames"].items():
            for field in frame:
                np.testing.assert_array_equal(frame[field][()], other["frames"][name][field][()], f"{name} {field}")


@pytest.fixture(scope="module")
def output(tmp_path_factory: pytest.TempPathFactory) -> RunOutput:
    """The strip, run by one call from a dict."""
    tables = changed(STRIP, output={"surface": True, "every": 4})
    return run(tables, tmp_path_factory.mktemp("python") / "out")


def test_output_is_arrays_and_grids(output: RunOutput) -> None:
    """Columns, frames by number and slice, and the fragments of the last frame, whose mass is that of the strip."""
    history, last = output.history, output.frames[-1]
    assert output.outcome == "done" and len(history["step"]) == output.summary["steps"] == 10
    np.testing.assert_allclose(output.frames.times, [0.0, 0.02, 0.04, 0.05])
    assert len(output.frames[1:]) == 3 and len(output.surfaces) == 4
    assert last.cell_data["damage"].max() == 1 and output.frames[0].cell_data["damage"].max() == 0
    assert "origin" in output.surfaces[-1].cell_data
    at_end = output.pieces["time"] == output.pieces["time"][-1]
    assert output.pieces["mass"][at_end].sum() == pytest.approx(1000 * 0.25, rel=1e-12)
    assert at_end.sum() == history["pieces"][-1] == output.summary["pieces"]
    with pytest.raises(InputError, match=r"fracture\.energy writes it"):
        output.tips  # noqa: B018
    text = output._repr_html_()
    assert "strip" in text and "broken_edges" in text and "done" in repr(output)


def test_a_folder_without_a_run_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="is not the output folder of a run"):
        package.open_run(tmp_path)


def test_steps_are_those_of_the_run(output: RunOutput) -> None:
    """Rows, and the fragments and the surface now, without a folder."""
    with Simulation(changed(STRIP, output={"surface": True, "every": 4})) as simulation:
        assert simulation.t == 0 and not simulation.ended
        while not simulation.ended:
            row = simulation.step()
        assert row["step"] == 10
        for name, column in output.history.items():
            if name != "wall_step":  # two processes may differ in the last digit
                np.testing.assert_allclose(simulation.history[name], column, rtol=1e-9, atol=1e-12, err_msg=name)
        surface, fragments = simulation.surface(), simulation.fragments()
        written = output.surfaces[-1]
        assert surface.n_points == written.n_points and surface.n_cells == written.n_cells
        np.testing.assert_allclose(np.sort(surface.points, axis=0), np.sort(written.points, axis=0), atol=1e-6)
        for name in ("piece", "origin", "damage"):  # lines have fields of their own, and come first
            lines = np.asarray(written.celltypes) == 3
            expected = np.concatenate([written.cell_data[name][lines], written.cell_data[name][~lines]])
            np.testing.assert_allclose(surface.cell_data[name], expected, rtol=1e-6, err_msg=name)
        at_end = output.pieces["time"] == output.pieces["time"][-1]
        np.testing.assert_allclose(fragments["mass"], output.pieces["mass"][at_end], rtol=1e-9)
    with pytest.raises(InputError, match="is closed"):
        simulation.step()
    simulation.close()


def test_fields_are_functions_of_dolfinx_that_follow_the_steps() -> None:
    """The same object after a step; in a form of its own the velocity gives the kinetic energy of the row."""
    tables = changed(STRIP, time={"mass": "consistent"})
    with Simulation(tables) as simulation:
        u, v, damage = simulation.displacement, simulation.velocity, simulation.damage
        assert not u.x.array.any() and not damage.x.array.any()
        kinetic = fem.form(500.0 * ufl.inner(v, v) * ufl.dx)
        while not simulation.ended:
            row = simulation.step()
            assert fem.assemble_scalar(kinetic) == pytest.approx(row["kinetic"], rel=1e-9)
        assert u is simulation.displacement
        np.testing.assert_array_equal(u.x.array, simulation.state.u)
        broken = simulation.scene.fracture.graph.broken
        assert damage.x.array.max() == 1 and broken.sum() == row["broken_edges"]


def test_a_simulation_with_a_folder_writes_what_the_run_writes(output: RunOutput, tmp_path: Path) -> None:
    """Stopped half way by a checkpoint, continued by another object, and ended."""
    tables = changed(STRIP, output={"surface": True, "every": 4})
    with Simulation(tables, tmp_path / "out") as first:
        for _ in range(5):
            first.step()
        assert first.checkpoint().is_file()
    assert package.open_run(tmp_path / "out").outcome == "unfinished"
    with Simulation(tables, tmp_path / "out", restart=True) as second:
        assert second.state.step == 5
        second.run()
    done = package.open_run(tmp_path / "out")
    assert done.outcome == "done" and len(done.history["step"]) == 10
    np.testing.assert_allclose(done.frames.times, output.frames.times)
    assert done.history["broken_edges"][-1] == output.history["broken_edges"][-1]
    with Simulation(tables) as third, pytest.raises(InputError, match="needs an output folder"):
        third.checkpoint()


def test_overrides_are_values_or_texts() -> None:
    by_value = load(STRIP, {"time.end": 0.02, "boundary.1.velocity": [2.0, 0.0]})
    by_text = load(STRIP, ["time.end=0.02", "boundary.1.velocity=[2.0, 0.0]"])
    again = load(load(STRIP), {"time.end": 0.02, "boundary.1.velocity": [2.0, 0.0]})
    assert study_text(by_value) == study_text(by_text) == study_text(again) != study_text(load(STRIP))
    assert load(by_value) is by_value
    with pytest.raises(InputError, match="did you mean end"):
        load(STRIP, {"time.ende": 0.02})


@pytest.mark.parametrize(
    ("call", "message"),
    [
        (lambda out: load(None), "study is None: give the path of a study file, the name of a packaged study"),
        (lambda out: load(BAR, "mesh.h=0.1"), "overrides are 'mesh.h=0.1': give values by key"),
        (lambda out: load(BAR, {3: 0.1}), "overrides are {3: 0.1}: give values by key"),
        (lambda out: run(BAR, None), "out is None: give the path of a folder"),
        (lambda out: Simulation(BAR, 3), "out is 3: give the path of a folder"),
        (lambda out: package.open_run(None), "folder is None: give the path of a folder"),
        (lambda out: run(BAR, out, wall_limit=float("nan")), "wall_limit = nan: give a number of seconds"),
        (lambda out: run(BAR, out, wall_limit=-1), "wall_limit = -1: give a number of seconds"),
        (lambda out: run(BAR, out, wall_limit="1h"), "wall_limit = '1h': give a number of seconds"),
        (lambda out: Simulation(BAR, terms=package.Term), "terms is .*Term.*: give a list of classes or functions"),
        (lambda out: Simulation(BAR, terms=[3]), "terms has 3: give a class derived from fracsim.Term"),
        (lambda out: Simulation(BAR, boundary={"on": "right"}), "boundary is {'on': 'right'}: give a list of entries"),
        (lambda out: Simulation(BAR, boundary=None), "boundary is None: give a list of entries, or leave it out"),
    ],
)
def test_an_argument_of_another_type_is_refused(call: Callable[[Path], Any], message: str, tmp_path: Path) -> None:
    """`wall_limit = nan` was no limit; the others ended with an error of Python within the program."""
    with pytest.raises(InputError, match=message):
        call(tmp_path / "out")
    assert not (tmp_path / "out").exists()


def test_a_step_after_the_end_is_refused() -> None:
    with Simulation(BAR) as simulation:
        simulation.run()
        rows = len(simulation.history["step"])
        with pytest.raises(InputError, match=r"at its end, time\.end = 0\.03 s: step while not simulation\.ended"):
            simulation.step()
        assert len(simulation.history["step"]) == rows


def test_names_of_columns_and_numbers_of_frames_are_offered(output: RunOutput) -> None:
    with pytest.raises(KeyError, match=r"history\.csv has no column 'tiem'; it has: step, time, dt"):
        output.history["tiem"]
    with pytest.raises(KeyError, match=r"pieces\.csv has no column 'weight'; it has: time, piece"):
        output.pieces["weight"]
    count = len(output.frames)
    with pytest.raises(IndexError, match=f"there is no frame {count}: the run has {count}, from 0 to {count - 1}"):
        output.frames[count]
    assert output.frames.times[-1] == output.history["time"][-1] and output.history.get("tiem") is None


def test_progress_in_a_notebook_is_a_line(monkeypatch: pytest.MonkeyPatch) -> None:
    """An output cell obeys carriage returns, and has no size."""
    cell = type("OutStream", (io.StringIO,), {"__module__": "ipykernel.iostream"})()
    monkeypatch.setattr(sys, "stderr", cell)
    with ProgressReporter(first=True, end=1.0) as progress:
        progress.set_stage("building the mesh")
    said = cell.getvalue()
    assert said.startswith("\r[0:00] building the mesh") and said.endswith("\n")
    assert max(map(len, re.split("[\r\n]", said))) < PROGRESS_TIMING.terminal_columns


# --- meshes handed over ---------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def alone(tmp_path_factory: pytest.TempPathFactory) -> Arrays:
    return run_on_ranks("support.given", 1, tmp_path_factory.mktemp("given"))


ALONE = """
import fracsim
import numpy as np
from mpi4py import MPI

def criterion(stress, edges, strength):
    if MPI.COMM_WORLD.rank == 1 and simulation is not None:
        raise ArithmeticError("a fault on one rank")
    return np.zeros_like(strength)

simulation = None
simulation = fracsim.Simulation("bar-2d", overrides={"mesh.h": 0.05}, criterion=criterion)
simulation.run()
"""


@pytest.mark.ranks
def test_a_function_that_fails_on_one_rank_ends_all(tmp_path: Path) -> None:
    """Rank 0 would wait for rank 1: both end within seconds, with the traceback of the user's function."""
    (tmp_path / "script.py").write_text(ALONE)
    command = ["timeout", "100", "mpirun", "-n", "2", sys.executable, "script.py"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, text=True)
    assert done.returncode not in (0, 124)
    assert "ArithmeticError: a fault on one rank" in done.stderr


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", (2, 3))
def test_a_mesh_handed_over_breaks_alike_on_any_ranks(alone: Arrays, tmp_path: Path, ranks: int) -> None:
    """With and without ghost cells, and with own physics: the same edges; nodes and cells are where those of the same
    number are."""
    found = run_on_ranks("support.given", ranks, tmp_path)
    assert len(alone["none-broken"]) > 20 and len(alone["physics-broken"]) > 20 and alone["none-soft"] == 100
    for name, values in alone.items():
        mode = found[name.replace("none", "shared_facet")]
        if name.endswith(("nodes", "cells")):  # distances: round-off of centroids
            assert np.max(found[name]) < 1e-15
        else:
            np.testing.assert_allclose(found[name], values, rtol=1e-5, err_msg=name)
            np.testing.assert_allclose(mode, alone[name.replace("none", "shared_facet")], rtol=1e-5, err_msg=name)
        if name.endswith("broken"):
            np.testing.assert_array_equal(found[name], values)


@pytest.mark.parametrize(
    ("fault", "message"),
    [
        ({"mesh": "quadrilateral"}, "cells of the kind quadrilateral"),
        ({"facets": {"left": 5, "right": 7}}, r"facets: no entity has the tag 7 of 'right'; there are \[5, 9\]"),
        ({"regions": "facets"}, "regions: the tags are those of entities of dimension 1; 2 is needed"),
        ({"facets": {"left": 5}}, "right"),
        ({"mesh": None}, "give mesh"),
    ],
)
def test_a_mesh_that_does_not_fit_is_refused(fault: dict[str, Any], message: str) -> None:
    handed = given.plate(dolfinx_mesh.GhostMode.none)
    if "mesh" in fault:
        kind = dolfinx_mesh.CellType.quadrilateral
        handed["mesh"] = fault["mesh"] and dolfinx_mesh.create_unit_square(MPI.COMM_SELF, 2, 2, kind)
    elif fault.get("regions"):
        handed["regions"] = handed["facets"][0], {"soft": 5}
    else:
        handed["facets"] = handed["facets"][0], fault["facets"]
    with pytest.raises(InputError, match=message):
        Simulation(given.STUDY, **handed)


def test_arrays_and_builders_are_meshes_too() -> None:
    """The same steps as with the builder of the study; something else is refused."""
    with Simulation(STRIP) as simulation:
        expected = [simulation.step() for _ in range(3)]
    builder = BUILDERS["box"](size=(1.0, 0.25), h=0.125)
    for mesh in (builder, builder.build()):
        with Simulation(STRIP, mesh=mesh) as simulation:
            for row in expected:
                assert {**simulation.step(), "wall_step": 0} == {**row, "wall_step": 0}
    with pytest.raises(InputError, match="mesh is a int"):
        Simulation(STRIP, mesh=3)


def test_a_study_of_a_given_mesh_needs_the_mesh(tmp_path: Path) -> None:
    """Its study.toml says so on the command line."""
    with Simulation(given.STUDY, tmp_path / "out", **given.plate(dolfinx_mesh.GhostMode.none)) as simulation:
        simulation.step()
    done = fracsim("check", tmp_path / "out" / "study.toml")
    assert done.returncode == 2 and "stands for a mesh that is handed over in Python" in done.stderr
    assert "Traceback" not in done.stderr
    with Simulation(BAR) as simulation, pytest.raises(InputError, match="only a mesh of DOLFINx"):
        simulation.node_numbers  # noqa: B018
