"""The command line as a user meets it: commands, exit codes, and what each command imports."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import dolfinx
import meshio
import numpy as np
import pytest

import fracsim as package
from cases import BAR, STRIP, changed, fracsim, mpirun, study, write_study
from fracsim.errors import Exit
from fracsim.meshes.topology import boundary_facets
from fracsim.study.check import check_study
from fracsim.study.mesh_source import build_mesh
from fracsim.study.reader import validate

HEAVY = ("dolfinx", "gmsh", "petsc4py", "mpi4py", "pyvista", "meshio", "ufl", "basix", "h5py", "matplotlib")
# what some of them would bring along, and the rooms of the program that solve, write and draw
NOT_CHECKED = ("vtkmodules", "pandas", "sympy", "numba", "ffcx", "cffi", "jinja2", "setuptools", "scipy.spatial")
NOT_CHECKED += tuple(f"fracsim.{room}" for room in ["scene", "deformable_run", "fracture", "output", "report"])


# --- check ----------------------------------------------------------------------------------------------------------


def test_check_imports_nothing_heavy() -> None:
    """Which is what makes it quick: nothing is computed, and its time is that of its imports."""
    code = f"""
import sys; sys.argv = ['fracsim', 'check', 'loaf']
from fracsim.cli import main
try: main()
finally: print('heavy:', [name for name in {(*HEAVY, *NOT_CHECKED)!r} if name in sys.modules])
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert result.stdout.splitlines()[-1] == "heavy: []"
    assert "mesh        loaf: 3D, about" in result.stdout


@pytest.mark.parametrize("command", ["list", "check"])
def test_no_reader_of_mesh_files_is_imported_where_none_is_read(command: str) -> None:
    code = f"""
import sys; sys.argv = {["fracsim", command, *(["bar-2d"] if command == "check" else [])]!r}
from fracsim.cli import main
try: main()
finally: print([name for name in sys.modules if name in ("fracsim.meshes.read", "fracsim.meshes.surfaces.closed")])
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert result.stdout.splitlines()[-1] == "[]"


def test_check_tells_what_is_built_and_what_is_not() -> None:
    lines = check_study(study(BAR))
    assert lines[0] == "mesh        box: 3D, about 24 cells; groups left, right, front, back, bottom, top"
    assert "fracture    off: no damage field, no graph, no average" in lines
    assert "plasticity  off: no plastic strain, no flow" in lines
    assert "damping     off" in lines
    assert "time        generalized-alpha, 3 steps of 0.01 s, halved where a step fails" in lines
    assert "probes      grip (reaction)" in lines


def test_check_tells_the_size_of_a_builders_body() -> None:
    """No volume: builders are not built."""
    lines = check_study(study(BAR, mesh={"size": [0.4, 0.2, 0.1], "origin": [1.0, 0.0, 0.0]}))
    assert lines[1] == "size        0.4 x 0.2 x 0.1 m, from (1, 0, 0) to (1.4, 0.2, 0.1)"


@pytest.mark.parametrize("source", ["file", "surface"])
def test_check_tells_the_size_of_a_file_in_its_own_unit(tmp_path: Path, source: str) -> None:
    """A bar of 400 x 200 x 100 mm: sides and places in metres, for its boundary as well; a surface is not filled."""
    points = build_mesh(study(BAR, mesh={"size": [400.0, 200.0, 100.0], "h": 50.0}).mesh)
    cells = [("tetra", points.cells)] if source == "file" else [("triangle", boundary_facets(points.cells))]
    path = tmp_path / "bar.vtu"
    meshio.Mesh(points.points, cells).write(path)
    held = [{"on": {"box": [[0.0, 0.0, 0.0], [0.0, 0.2, 0.1]]}, "fix": "xyz"}]
    mesh = {source: str(path), "scale": 1e-3} | ({"h": 0.05} if source == "surface" else {})
    lines = check_study(validate(changed(BAR, boundary=held, probe=[]) | {"mesh": mesh}, "test.toml"))
    assert lines[1] == "size        0.4 x 0.2 x 0.1 m, from (0, 0, 0) to (0.4, 0.2, 0.1); volume 0.008 m^3"
    count = f"{len(points.cells):,} cells" if source == "file" else "about 696 cells"  # 0.008 / (0.092 * 0.05^3)
    assert count in lines[0]


def test_check_tells_what_contact_costs(tmp_path: Path) -> None:
    """Of a mesh file its facets: 2 (4 2 + 4 2 + 2 2) squares of two triangles; of a builder no more than there are."""
    box = {"builder": "box", "size": [0.4, 0.2, 0.2], "h": 0.1}
    floor = {"name": "floor", "shape": "plane", "at": [0.0, 0.0, -1.0], "normal": [0.0, 0.0, 1.0]}
    made = build_mesh(study(BAR, mesh=box).mesh)
    meshio.Mesh(made.points, [("tetra", made.cells)]).write(tmp_path / "bar.vtu")
    for mesh, facets in ((box, "58 facets or more"), ({"file": str(tmp_path / "bar.vtu")}, "80 facets")):
        data = BAR | {"mesh": mesh, "boundary": [], "probe": [], "obstacle": [floor], "contact": {"friction": 0.3}}
        told = {line.split()[0]: line for line in check_study(validate(data, "test.toml"))}
        assert f"acts on the points of {facets}, and of cracks" in told["acts"]
        assert "nothing is gathered" in told["acts"]
        assert "friction 0.3; each rank detects contact of its part" in told["contact"]
        assert f"its surface has {facets}" in told["its"]


@pytest.mark.parametrize(
    ("itself", "scheme", "breaks", "is_noted"),
    [(True, "backward-euler", True, True), ("pieces", "backward-euler", True, False),
     (True, "backward-euler", False, False), (True, "explicit", True, False)],
)  # fmt: skip
def test_check_notes_what_contact_inside_fragments_costs(
    itself: bool | str, scheme: str, breaks: bool, is_noted: bool
) -> None:
    tables: dict[str, Any] = {"contact": {"itself": itself}} | ({"fracture": {"strength": 1e3}} if breaks else {})
    lines = check_study(study(BAR, **tables, time={"scheme": scheme, "step": 1e-4, "end": 1e-3}))
    assert ('contact.itself = "pieces" leaves it out' in "\n".join(lines)) == is_noted


@pytest.mark.parametrize(
    ("step", "scheme", "energy", "strength", "told"),
    [(1e-2, "newmark", "neo-hookean", np.inf, True), (1e-4, "newmark", "neo-hookean", np.inf, False),
     (1e-2, "newmark", "linear", np.inf, False), (1e-2, "generalized-alpha", "neo-hookean", np.inf, False),
     (1e-2, "generalized-alpha", "neo-hookean", 1.5e5, True), (1e-2, "generalized-alpha", "neo-hookean", 2e4, False),
     (1e-4, "generalized-alpha", "neo-hookean", 1.5e5, False), (1e-2, "backward-euler", "neo-hookean", 1.5e5, False)],
)  # fmt: skip
def test_check_tells_where_schemes_may_gain_energy(
    step: float, scheme: str, energy: str, strength: float, told: bool
) -> None:
    """Rubber, h = 0.125 m, c = 32 m/s: an edge is passed in 4 ms."""
    rubber = {"energy": energy, "young": 1e6, "poisson": 0.3, "density": 1e3}
    bar = {"builder": "box", "size": [1.0, 0.25, 0.25], "h": 0.125}
    data = {"title": "bar", "mesh": bar, "material": rubber, "time": {"scheme": scheme, "step": step, "end": 1.0}}
    data["fracture"] = {"strength": strength}
    assert any('scheme = "backward-euler" does not' in line for line in check_study(validate(data, "bar"))) == told


def test_check_tells_of_fracture() -> None:
    lines = check_study(study(STRIP, fracture={"radius": 0.1}))
    assert "fracture    degraded energy (chi), strength 20000 Pa, average over 0.1 m (linear)" in lines
    assert "material    neo-hookean, plane strain" in lines


def test_check_tells_of_plasticity() -> None:
    lines = check_study(study(STRIP, plasticity={"yield_stress": 1e4, "hardening": -5.0, "flow_rate": 20.0}))
    assert "plasticity  von-mises stress above 10000 Pa, flow rate 20 1/s, hardening -5 Pa, extrapolated" in lines


# --- a scene costs only what it uses --------------------------------------------------------------------------------


def test_a_scene_builds_nothing_that_its_study_does_not_ask_for(tmp_path: Path) -> None:
    """Implicit and explicit without fracture and contact; then with fracture, but without brittle surfaces and radius:
    R = 0 is local, so that there is no matrix of an average. SciPy takes a quarter of a second: also the surface of a
    body that is whole is drawn without it."""
    write_study(tmp_path / "local.toml", STRIP, fracture={"radius": 0.0}, time={"end": 0.005})
    for scheme in (schemes := ("backward-euler", "explicit")):
        write_study(tmp_path / f"{scheme}.toml", BAR, time={"scheme": scheme})
    code = f"""
import sys
from pathlib import Path
from typing import Any
from mpi4py import MPI
from fracsim.study.reader import load_study
from fracsim.deformable_run import Run
from fracsim.scene import build_scene
folder = Path({str(tmp_path)!r})
for scheme in {schemes}:
    scene = build_scene(MPI.COMM_WORLD, load_study(folder / (scheme + ".toml")))
    Run(scene, folder / scheme)()
    assert scene.balance.stress.chi is None and scene.fracture is None
parts = ("mesh.edge_graph", "mesh.mesh_shares", "mesh.split_surface", "fracture", "meshes.read")
parts += ("mechanics.plasticity", "mechanics.return_mapping", "mechanics.tensor_functions", "forms.plasticity")
parts += ("forms.crack_closure", "forms.damage", "rigid", "scene.rigid_scene", "report")
absent = ("scipy", "mujoco", "fracsim.rigid")
contact = ("fracsim.contact", "fracsim.scene.contact")
absent = [name for name in sys.modules if name.startswith(contact) or name in absent]
print([name for name in parts if "fracsim." + name in sys.modules], absent)
scene = build_scene(MPI.COMM_WORLD, load_study(folder / "local.toml"))
run = Run(scene, folder / "local")
run.write_frame()
print([name for name in sys.modules if name == "scipy"])
run()
parts = ("fracture.brittle", "fracture.nonlocal_average", "fracture.energy", "fracture.initial_cracks")
parts = tuple("fracsim." + name for name in parts)
print(hasattr(scene.fracture.criterion, "starts"), [name for name in sys.modules if name.startswith(parts)])
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert [line for line in result.stdout.splitlines() if line.endswith("]")] == ["[] []", "[]", "False []"]


# --- mesh, list, render ---------------------------------------------------------------------------------------------


def test_mesh_saves_a_mesh_that_a_study_can_use(tmp_path: Path) -> None:
    bar, saved = write_study(tmp_path / "bar.toml", BAR), tmp_path / "new" / "bar.msh"
    done = fracsim("mesh", bar, "-o", saved)
    assert done.returncode == Exit.DONE
    assert "cells                    24" in done.stdout and f"saved in {saved}" in done.stdout
    lines = check_study(study({**BAR, "mesh": {"file": str(saved)}}))
    assert lines[0].endswith("3D, 24 cells, 20 nodes, 1 body; groups left, right, front, back, bottom, top")


def test_mesh_formats(tmp_path: Path) -> None:
    strip = write_study(tmp_path / "strip.toml", STRIP)
    assert fracsim("mesh", strip, "-o", tmp_path / "strip.vtu").returncode == Exit.DONE
    assert len(meshio.read(tmp_path / "strip.vtu").cells_dict["triangle"]) == 32
    refused = fracsim("mesh", strip, "-o", tmp_path / "strip.odd")
    assert refused.returncode == Exit.BAD_INPUT
    assert refused.stderr.startswith(f"fracsim: --out: cannot save the mesh as {tmp_path / 'strip.odd'}")
    assert refused.stderr.count("\n") == 1


def test_list() -> None:
    done = fracsim("list")
    assert done.returncode == Exit.DONE
    said = done.stdout
    for word in ("studies", "loaf", "builders", "notched-bar", "energies", "neo-hookean", "schemes", "quasi-static"):
        assert word in said


def test_render_needs_a_run(tmp_path: Path) -> None:
    done = fracsim("render", tmp_path)
    assert done.returncode == Exit.BAD_INPUT
    assert (
        done.stderr
        == f"fracsim: {tmp_path} has no surface.pvd and no fields.h5: it is not the output folder of a run\n"
    )


# --- usage ----------------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["frobnicate"], "No such command 'frobnicate'"),
        (["run"], "Missing argument 'STUDY.toml'"),
        (["run", "loaf", "--frob"], "No such option: --frob"),
        (["run", "loaf", "--wall-limit", "soon"], "Invalid value for '--wall-limit'"),
        (["run", "loaf", "--wall-limit", "-5"], "--wall-limit -5: must be a number of seconds, 0 or more"),
        (["check", "loaf", "more"], "Got unexpected extra argument"),
        (["check", "loaf", "--set"], "Option '--set' requires an argument"),
        (["mesh", "loaf"], "Missing option '-o' / '--out'"),
        (["check", "nope.toml"], "there is no study file nope.toml"),
    ],
)
def test_bad_usage(arguments: list[str], message: str) -> None:
    done = fracsim(*arguments)
    error = done.stderr
    assert done.returncode == Exit.BAD_INPUT
    assert error.startswith("fracsim: ") and message in error and error.count("\n") == 1


def test_help_and_no_command() -> None:
    asked, bare = fracsim("--help"), fracsim()
    assert asked.returncode == Exit.DONE and bare.returncode == Exit.BAD_INPUT
    assert bare.stdout == asked.stdout
    for command in ("run", "check", "mesh", "render", "list"):
        assert f"  {command} " in asked.stdout


def test_version() -> None:
    """Of both ways to start the program."""
    module = subprocess.run([sys.executable, "-m", "fracsim", "--version"], capture_output=True, text=True, check=True)
    assert fracsim("--version").stdout == module.stdout == f"fracsim {package.__version__}\n"


def test_doctor_names_what_is_there_and_what_lacks(monkeypatch: pytest.MonkeyPatch) -> None:
    done = fracsim("doctor")
    assert done.returncode == Exit.DONE and " lacks" not in done.stdout
    assert re.search(rf"^DOLFINx +{re.escape(dolfinx.__version__)}$", done.stdout, re.MULTILINE)
    monkeypatch.setenv("CC", "/nowhere/cc")
    done = fracsim("doctor")
    assert done.returncode == Exit.BAD_INPUT
    assert re.search(r"^C compiler +lacks: .*/nowhere/cc.*; apt-get install gcc", done.stdout, re.MULTILINE)


def test_interrupted_before_the_first_step(monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("fracsim.study.reader.load_study", interrupt)
    done = fracsim("check", "loaf")
    assert done.returncode == 130
    assert done.stderr.strip() == "fracsim: interrupted before the first step; nothing was written"


# --- faults of the program ------------------------------------------------------------------------------------------


def test_a_fault_on_one_rank_ends_all(tmp_path: Path) -> None:
    """Rank 1 fails inside the first step while rank 0 waits for it in a reduction."""
    bar = write_study(tmp_path / "bar.toml", BAR)
    script = tmp_path / "faulty.py"
    script.write_text(f"""
import sys
from mpi4py import MPI
from fracsim.mesh import parallel
from fracsim.solvers.nonlinear_solver import NonlinearSolver
parallel.FAILURE_WAIT = 1.0
solve = NonlinearSolver.solve
def faulty(self, guess):
    if MPI.COMM_WORLD.rank == 1:
        raise ZeroDivisionError("a fault of rank 1")
    return solve(self, guess)
NonlinearSolver.solve = faulty
sys.argv = ["fracsim", "run", {str(bar)!r}, "-o", {str(tmp_path / "out")!r}]
from fracsim.cli import main
main()
""")
    arguments = [*mpirun(2), sys.executable, str(script)]
    result = subprocess.run(arguments, capture_output=True, text=True, timeout=60, check=False)
    assert result.returncode not in (0, 2, 3, 4)
    assert "ZeroDivisionError: a fault of rank 1" in result.stderr
    assert "timed out" not in result.stderr + result.stdout, "mpirun's own limit ended it"


def test_every_command_works_under_mpirun() -> None:
    """Commands that need no parallel work are done by one rank, and say so once; a run is one of test_restart."""
    result = fracsim("check", "loaf", ranks=2)
    assert result.returncode == 0 and result.stdout.count("mesh        loaf") == 1


def test_the_package_is_light() -> None:
    assert package.__version__
    heavy = (*HEAVY, "numpy", "pydantic", "rich")
    code = f"import sys, fracsim.cli; print([name for name in {heavy!r} if name in sys.modules])"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert result.stdout.strip() == "[]"
