"""The rooms of fracsim/ import one way: what lies below knows nothing of what lies above it.

Imports are read from the source, those inside functions and under TYPE_CHECKING as well.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import fracsim
import fracsim.forms
import fracsim.meshes
from conftest import OF_DOLFINX

pytestmark = pytest.mark.any_release

ROOT, FORMS = Path(fracsim.__file__).parent, Path(fracsim.forms.__file__).parent
MESHES = Path(fracsim.meshes.__file__).parent
ARCHITECTURE = Path(__file__).parent.parent / "docs" / "architecture.md"
# rooms of a floor do not know one another; they may use the floors before theirs
FLOORS = ({"mesh"}, {"mechanics"}, {"contact", "fracture", "solvers"}, {"timestepping"}, {"rigid"}, {"output"})
LAYERS = tuple(room for floor in FLOORS for room in sorted(floor))
BELOW = {"array_types", "errors", "forms", "meshes"}  # what any of them may use
# modules that the study room uses: those without DOLFINx
WITHOUT_DOLFINX = {
    "mesh.free_motion",
    "mesh.selectors",
    "mesh.crack_planes",
    "mechanics.time_functions",
}
WITHOUT_DOLFINX |= {"mesh.small_matrices", "mechanics.stability_limit", "rigid.instance_placement"}
CONTACT = "closest_point laws obstacle pose shape_base shapes triangle_mesh_shape"
WITHOUT_DOLFINX |= {f"contact.{name}" for name in CONTACT.split()}
# a sweep asks the schema and who owns a folder; colours and pictures read files
OF_REPORT = {
    "frames": {"output.fields_file", "output.surface.vtk_files"},
    "colour_maps": {"output.fields_file"},
    "sweep": {"study.check", "study.plugins", "study.reader", "output.lock", "output.file_ownership"},
}


def imports(path: Path, package: str) -> set[str]:
    """Absolute names of the modules that a file imports; `package`: the one that it is in."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name for alias in node.names}
        elif isinstance(node, ast.ImportFrom):
            base = package.split(".")[: len(package.split(".")) + 1 - node.level] if node.level else []
            name = ".".join([*base, *([node.module] if node.module else [])])
            # `from . import x` names modules, or what the package itself defines
            found |= {name} if node.module else {f"{name}.{alias.name}" for alias in node.names}
    return found


def own(room: str) -> dict[str, set[str]]:
    """File of a room -> what it imports of fracsim, without "fracsim."."""
    result = {}
    for path in sorted((ROOT / room).rglob("*.py")):
        package = ".".join(["fracsim", *path.relative_to(ROOT).parent.parts])
        names = {name for name in imports(path, package) if name.split(".")[0] == "fracsim"}
        file = path.relative_to(ROOT).as_posix()
        result[file] = {name.removeprefix("fracsim").strip(".") for name in names}
    assert result
    return result


def rooms_of(names: set[str]) -> set[str]:
    """First parts; "" and __version__ are the package itself, which imports nothing."""
    return {name.split(".")[0] for name in names} - {"", "__version__"}


@pytest.mark.parametrize("room", LAYERS)
def test_physics_knows_nothing_above_it(room: str) -> None:
    number = next(i for i, floor in enumerate(FLOORS) if room in floor)
    allowed = BELOW | {room}.union(*FLOORS[:number])
    beyond = {file: rooms_of(names) - allowed for file, names in own(room).items()}
    assert not {file: names for file, names in beyond.items() if names}


def test_forms_need_ufl_alone() -> None:
    for path in sorted(FORMS.rglob("*.py")):
        package = ".".join(["fracsim", "forms", *path.relative_to(FORMS).parent.parts])
        for name in imports(path, package):
            first = name.split(".")[0]
            assert name.startswith("fracsim.forms") or first == "ufl" or first in sys.stdlib_module_names, (path, name)


def test_a_study_is_read_without_dolfinx() -> None:
    """What it uses of the rooms with DOLFINx are modules without it, which import only one another."""
    modules = {name for names in own("study").values() for name in names if rooms_of({name}) & set(LAYERS)}
    assert modules <= WITHOUT_DOLFINX
    for module in WITHOUT_DOLFINX:
        path = ROOT / Path(*module.split(".")).with_suffix(".py")
        used = imports(path, f"fracsim.{module.rpartition('.')[0]}")
        assert not {name.split(".")[0] for name in used} & {"dolfinx", "petsc4py", "mpi4py", "ufl"}
        inner = {name for name in used if rooms_of({name.removeprefix("fracsim.")}) & set(LAYERS)}
        assert {name.removeprefix("fracsim.") for name in inner} <= WITHOUT_DOLFINX


def test_tests_for_any_release_import_no_dolfinx() -> None:
    """Their modules are imported, in a process of their own; conftest has them import none later."""
    tests = Path(__file__).parent
    mark = "\npytestmark = pytest.mark.any_release\n"
    marked = [path.stem for path in sorted(tests.glob("test_*.py")) if mark in path.read_text(encoding="utf-8")]
    assert len(marked) > 10
    code = f"import sys; sys.modules |= dict.fromkeys({OF_DOLFINX}); import {', '.join(marked)}"
    subprocess.run([sys.executable, "-c", code], cwd=tests, check=True, capture_output=True)


def test_reports_read_files() -> None:
    allowed = {"errors", "meshes", "report"}
    for file, names in own("report").items():
        exceptions = {name for name in names if rooms_of({name}) - allowed}
        assert exceptions == OF_REPORT.get(Path(file).stem, set()), file


def test_the_study_is_for_the_way_in_alone() -> None:
    """cli, Python's interface, run with what it watches, and scene; and those reports that are named above."""
    of_root = {path.name: {name[8:] for name in imports(path, "fracsim")} for path in ROOT.glob("*.py")}
    ways_in = {file for file, names in of_root.items() if "study" in rooms_of(names)}
    rooms = [path.name for path in ROOT.iterdir() if (path / "__init__.py").exists()]
    readers = {room for room in rooms if "study" in rooms_of(set().union(*own(room).values()))}
    assert ways_in == {"cli.py", "deformable_run.py", "monitors.py", *PYTHON}
    assert readers == {"study", "scene", "report"}


# --- the drawing of docs/architecture.md ---

RUN = ("deformable_run.py", "rigid_run.py", "monitors.py")  # the files of the room "run"
PYTHON = ("simulation.py", "simulation_inputs.py")  # those of the interface of Python
CLI = ("cli.py", "doctor.py", "__main__.py")  # those of the command line
EVERYWHERE = {"array_types", "errors", "studies"}  # below all rooms, and the folder of packaged studies


def arrows() -> set[tuple[str, str]]:
    """Arrows of the first drawing of the page, from a room to one that it imports."""
    drawing = re.search(r"```mermaid\n(.*?)```", ARCHITECTURE.read_text(), re.DOTALL)
    assert drawing is not None
    lines = re.sub(r'\["[^"]*"\]', "", drawing.group(1)).splitlines()[1:]
    return {(line.split()[0], line.split()[2]) for line in lines}


def reachable(arrows: set[tuple[str, str]], start: str) -> set[str]:
    """Rooms that arrows lead to from a room."""
    found, new = set[str](), {start}
    while new:
        found, new = found | new, {end for first, end in arrows if first in new} - found - new
    return found - {start}


def imported_rooms() -> dict[str, set[str]]:
    """Room -> rooms that it imports, from the source."""
    folders = [path.name for path in ROOT.iterdir() if (path / "__init__.py").exists()]
    result = {room: rooms_of(set().union(*own(room).values())) for room in folders}
    files_of = {"run": RUN, "cli": CLI, "python": PYTHON, "process": ("process.py",)}
    for room, names in files_of.items():
        result[room] = set().union(*(of_fracsim(ROOT / name, "fracsim") for name in names))
    for room, folder in (("forms", FORMS), ("meshes", MESHES)):
        files = [
            (path, ".".join(["fracsim", room, *path.relative_to(folder).parent.parts])) for path in folder.rglob("*.py")
        ]
        result[room] = set().union(*(of_fracsim(path, package) for path, package in files))
    room_of = {name.removesuffix(".py"): room for room, names in files_of.items() for name in names}
    return {room: {room_of.get(name, name) for name in names} - {room} for room, names in result.items()}


def of_fracsim(path: Path, package: str) -> set[str]:
    """Rooms that a file imports."""
    return rooms_of({name[8:] for name in imports(path, package) if name.split(".")[0] == "fracsim"})


def test_the_drawing_of_the_rooms_is_that_of_the_imports() -> None:
    """All rooms are drawn, imports go along arrows, arrows are imports, and no arrow could be left out."""
    drawn, found = arrows(), imported_rooms()
    assert {room for arrow in drawn for room in arrow} == set(found), "rooms drawn in docs/architecture.md"
    beyond = {room: names - reachable(drawn, room) - EVERYWHERE for room, names in found.items()}
    beyond = {room: names for room, names in beyond.items() if names}
    assert not beyond, "imports against the drawing of docs/architecture.md: move the import, or draw an arrow"
    assert not [(first, second) for first, second in drawn if second not in found[first]], "arrows without an import"
    assert not [arrow for arrow in drawn if arrow[1] in reachable(drawn - {arrow}, arrow[0])], "arrows to leave out"


def test_the_page_of_rooms_has_a_row_for_each_of_them() -> None:
    """`fracsim/NAME`, `forms` and `meshes`; the files of "run" are named below the table."""
    page = ARCHITECTURE.read_text()
    rows = set(re.findall(r"^\| `([\w/]+)` \|", page, re.MULTILINE))
    folders = {f"fracsim/{path.name}" for path in ROOT.iterdir() if (path / "__init__.py").exists()}
    assert folders | {"forms", "meshes", "studies", "tests"} <= rows
    assert all((ARCHITECTURE.parent.parent / row).is_dir() for row in rows)


def test_text_is_read_and_written_with_an_encoding() -> None:
    """VTK's writer of legacy files sets the locale of the process to C, and with it Python's default encoding."""
    root = Path(__file__).parents[1]
    for path in (path for room in ("fracsim", "meshes", "forms") for path in (root / room).rglob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            is_call = isinstance(node, ast.Call) and isinstance(node.func, ast.Attribute)
            if is_call and node.func.attr in ("read_text", "write_text"):
                assert any(key.arg == "encoding" for key in node.keywords), f"{path}, line {node.lineno}"


# words that say nothing of a value; the name of a value says what the value is
FILLERS = {
    "each", "found", "made", "mine", "some", "rest", "those", "every", "these", "here", "there", "now", "then",
    "own", "what", "way", "ways", "of", "known", "given", "seen", "kept", "more", "most", "least", "few", "many",
    "one", "other", "others", "both", "place", "places", "at", "taken", "going", "goes", "comes", "gone", "held",
    "told",
}  # fmt: skip


# keys of the study file
SCHEMA_KEYS = {"contact.py: at", "time_and_output.py: of", "time_and_output.py: every"}


def package_modules() -> list[Path]:
    """All modules of the package: fracsim, forms and meshes."""
    paths = [path for top in (ROOT, FORMS, MESHES) for path in sorted(top.rglob("*.py"))]
    assert len(paths) > 200
    return paths


def test_no_class_name_exists_twice() -> None:
    modules: dict[str, set[str]] = {}
    for path in package_modules():
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ClassDef):
                modules.setdefault(node.name, set()).add(path.as_posix())
    assert not {name: paths for name, paths in modules.items() if len(paths) > 1}


def test_no_module_name_exists_twice() -> None:
    names: dict[str, set[str]] = {}
    for path in ROOT.rglob("*.py"):
        if path.name != "__init__.py":
            names.setdefault(path.stem, set()).add(path.as_posix())
    assert not {name: paths for name, paths in names.items() if len(paths) > 1}


def test_values_are_not_named_by_fillers() -> None:
    fillers = [
        f"{path.name}: {node.id}"
        for path in package_modules()
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if isinstance(node, ast.Name) and isinstance(node.ctx, ast.Store) and node.id in FILLERS
    ]
    assert set(fillers) <= SCHEMA_KEYS, fillers
