"""Mesh files of all formats, changed at random: bodies, surfaces to be filled, outlines, shells and obstacles.

A file is refused with a message, or makes a body: no traceback, crash or hang.
"""

from __future__ import annotations

import os
import random
import re
import shutil
import warnings
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path

import meshio
import numpy as np

from cases import BAR, STRIP, changed
from fracsim.errors import Exit
from fracsim.meshes import MeshError
from fracsim.meshes.gmsh_session import session
from fracsim.meshes.read import read_contents, read_mesh

from .corpus import STUDIES, Data, write
from .trial import Wrong, call, expect

WRITTEN = {"m2a.msh": "gmsh22", "m2b.msh": "gmsh22", "a.vtu": None, "z.vtu": None, "a.vtk": "vtk42", "b.vtk": "vtk51",
           "a.xdmf": None, "a.inp": None, "a.med": None, "a.mesh": None, "a.bdf": "nastran", "a.su2": None,
           "a.vol": "netgen", "a.ele": "tetgen", "a.avs": "avsucd", "a.h5m": None, "a.dat": "tecplot",
           "a.f3grid": None, "a.ugrid": None}  # fmt: skip
WRITTEN_SURFACES = {"a.stl": None, "b.stl": None, "a.obj": None, "a.ply": None, "b.ply": None, "a.off": None,
                    "s.vtu": None}  # fmt: skip
BINARY = {"m2a.msh": False, "m2b.msh": True, "a.vtk": False, "b.vtk": True, "a.vtu": False, "a.stl": False,
          "b.stl": True, "a.ply": False, "b.ply": True}  # fmt: skip
SAMPLES = Path(__file__).parents[1] / "meshes"  # as several programs write them
INCLUDED = (".inc",)
SURFACE_ENDINGS = (".stl", ".obj", ".ply", ".off", ".vtp")
# Files of these formats do not say how many cells they have, so that one can go unseen.
UNCOUNTED = (".inp", ".inc", ".bdf", ".nas", ".unv", ".obj", ".xdmf", ".f3grid", ".stl")
NUMBERS = (b"nan", b"-1", b"0", b"1e300", b"99999999999", b"", b"x", b"-1e-300", b"4294967295", b"2147483648", b"1e999")
PYTHON = r"np\.\w+\(|object has no attribute|invalid literal|could not convert|not in range|<class '|Error: "
HELD = [{"on": {"point": [0.0, 0.0, 0.0], "normal": [1.0, 0.0, 0.0]}, "fix": "xyz"}]


@dataclass(frozen=True)
class Good:
    """A file that is read: a folder with all that it leads to.

    Attributes:
        cells: how many tetrahedra or triangles are read.    size: the largest extent [m].
    """

    folder: Path
    name: str
    surface: bool
    cells: int
    size: float


_GOOD: list[Good] = []


def prepare(folder: Path) -> None:
    """One good file of each format that can be written here, and those of other programs."""
    top = folder / "meshes"
    shutil.rmtree(top, ignore_errors=True)
    top.mkdir()
    box = _box()
    surface = meshio.Mesh(box.points, [("triangle", _skin(box.cells[0].data))])
    for names, mesh in ((WRITTEN, box), (WRITTEN_SURFACES, surface)):
        for name, kind in names.items():
            how = {"binary": BINARY[name]} if name in BINARY else {}
            with (
                suppress(Exception),
                warnings.catch_warnings(),
            ):  # what this meshio cannot write, or lacks a library for
                warnings.simplefilter("ignore")
                with np.printoptions(legacy="1.25"):  # UGRID is written by repr
                    meshio.write(_folder(top, name) / name, mesh, file_format=kind, **how)
    _write_with_vtk(top, box, surface)
    _write_with_gmsh(top)
    _write_vtkhdf(_folder(top, "a.vtkhdf") / "a.vtkhdf", box)
    for path in SAMPLES.iterdir():
        if path.suffix not in INCLUDED:
            beside = [each for each in SAMPLES.iterdir() if each.suffix in INCLUDED and each.stem[:3] == path.stem[:3]]
            for each in (path, *beside):
                shutil.copy(each, _folder(top, path.name) / each.name)
    corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 0.25), (0.0, 0.25)]
    (_folder(top, "outline.csv") / "outline.csv").write_text("".join(f"{x}, {y}\n" for x, y in corners))
    _GOOD[:] = [good for each in sorted(top.iterdir()) if (good := _good(each))]
    print(f"  meshes: {', '.join(good.name for good in _GOOD)}", flush=True)


def _folder(top: Path, name: str) -> Path:
    (top / name).mkdir(exist_ok=True)
    return top / name


def _good(folder: Path) -> Good | None:
    """A file by its folder; None where it was not written, or is not read."""
    name = folder.name
    if name == "outline.csv":
        return Good(folder, name, False, 0, 1.0)
    surface = name.endswith(SURFACE_ENDINGS) or name == "s.vtu"
    if not (folder / name).exists():
        return None
    try:
        cells, points = _read(folder / name, surface)
    except MeshError as error:
        print(f"  not read: {name}: {str(error)[:300]}", flush=True)
        return None
    return Good(folder, name, surface, len(cells), float(np.ptp(points, axis=0).max()))


def _read(path: Path, surface: bool) -> tuple[np.ndarray, np.ndarray]:
    """The cells and points of a body, or the triangles and points of a surface."""
    if not surface:
        mesh = read_mesh(path)
        return mesh.cells, mesh.points
    contents = read_contents(path)
    flat = [block.nodes for block in contents.blocks if block.dim == 2 and block.nodes.shape[1] > 2]
    return np.concatenate([rows[:, :3] for rows in flat] or [np.zeros((0, 3))]), contents.points


def _write_with_vtk(top: Path, box: meshio.Mesh, surface: meshio.Mesh) -> None:
    """XML in all its encodings, in pieces and as polygons."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, numpy_to_vtkIdTypeArray
    from vtkmodules.vtkCommonCore import vtkPoints
    from vtkmodules.vtkCommonDataModel import vtkCellArray, vtkPolyData, vtkUnstructuredGrid
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

    def cells_of(rows: np.ndarray) -> vtkCellArray:
        cells = vtkCellArray()
        cells.SetData(rows.shape[1], numpy_to_vtkIdTypeArray(rows.ravel().astype(np.int64), deep=True))
        return cells

    def grid_of(rows: np.ndarray) -> vtkUnstructuredGrid:
        grid, points = vtkUnstructuredGrid(), vtkPoints()
        used, numbers = np.unique(rows, return_inverse=True)
        points.SetData(numpy_to_vtk(box.points[used], deep=True))
        grid.SetPoints(points)
        grid.SetCells(10, cells_of(numbers.reshape(rows.shape)))
        return grid

    polygons, points = vtkPolyData(), vtkPoints()
    points.SetData(numpy_to_vtk(surface.points, deep=True))
    polygons.SetPoints(points)
    polygons.SetPolys(cells_of(surface.cells[0].data))
    rows = box.cells[0].data
    for name, writer, data in (
        ("ascii.vtu", vtkXMLUnstructuredGridWriter(), grid_of(rows)),
        ("binary.vtu", vtkXMLUnstructuredGridWriter(), grid_of(rows)),
        ("raw.vtu", vtkXMLUnstructuredGridWriter(), grid_of(rows)),
        ("zlib.vtu", vtkXMLUnstructuredGridWriter(), grid_of(rows)),
        ("lzma.vtu", vtkXMLUnstructuredGridWriter(), grid_of(rows)),
        ("ascii.vtp", vtkXMLPolyDataWriter(), polygons),
        ("zlib.vtp", vtkXMLPolyDataWriter(), polygons),
    ):
        mode = name.partition(".")[0]
        {"ascii": writer.SetDataModeToAscii, "binary": writer.SetDataModeToBinary}.get(
            mode, writer.SetDataModeToAppended
        )()
        writer.SetEncodeAppendedData(mode == "zlib")
        writer.SetCompressorType({"zlib": 1, "lzma": 3}.get(mode, 0))  # vtkXMLWriter::CompressorType
        writer.SetInputData(data)
        writer.SetFileName(str(_folder(top, name) / name))
        writer.Write()
    folder = _folder(top, "a.pvtu")
    for i, part in enumerate((rows[:6], rows[6:])):
        writer = vtkXMLUnstructuredGridWriter()
        writer.SetInputData(grid_of(part))
        writer.SetFileName(str(folder / f"a_{i}.vtu"))
        writer.Write()
    (folder / "a.pvtu").write_text(
        '<VTKFile type="PUnstructuredGrid" version="1.0" byte_order="LittleEndian" header_type="UInt32">\n'
        '<PUnstructuredGrid GhostLevel="0"><PPoints><PDataArray type="Float64" Name="Points" NumberOfComponents="3"/>'
        '</PPoints>\n<Piece Source="a_0.vtu"/>\n<Piece Source="a_1.vtu"/>\n</PUnstructuredGrid></VTKFile>\n'
    )


def _write_with_gmsh(top: Path) -> None:
    """Formats as gmsh writes them, with a physical group of each dimension."""
    with session() as gmsh:
        gmsh.model.occ.addBox(0, 0, 0, 1, 0.25, 0.25)
        gmsh.model.occ.synchronize()
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.25)
        gmsh.model.mesh.generate(3)
        gmsh.model.addPhysicalGroup(3, [1], name="body")
        gmsh.model.addPhysicalGroup(2, [1], name="left")
        for name, version, binary in (
            ("g2a.msh", 2.2, 0), ("g2b.msh", 2.2, 1), ("g4a.msh", 4.1, 0), ("g4b.msh", 4.1, 1), ("g.unv", 0, 0),
            ("g.bdf", 0, 0), ("g.inp", 0, 0), ("g.mesh", 0, 0), ("g.vtk", 0, 1), ("g.med", 0, 0),
        ):  # fmt: skip
            if version:
                gmsh.option.setNumber("Mesh.MshFileVersion", version)
            gmsh.option.setNumber("Mesh.Binary", binary)
            gmsh.option.setNumber("Mesh.SaveGroupsOfNodes", 1)
            with suppress(Exception):  # without MED
                gmsh.write(str(_folder(top, name) / name))


def _write_vtkhdf(path: Path, box: meshio.Mesh) -> None:
    """By the specification of VTKHDF 1.0."""
    import h5py

    rows = box.cells[0].data
    with h5py.File(path, "w") as file:
        group = file.create_group("VTKHDF")
        group.attrs["Version"] = [1, 0]
        group.attrs.create("Type", b"UnstructuredGrid", dtype="S16")
        for name, value in (
            ("NumberOfPoints", [len(box.points)]), ("NumberOfCells", [len(rows)]),
            ("NumberOfConnectivityIds", [rows.size]), ("Points", box.points), ("Connectivity", rows.ravel()),
            ("Offsets", 4 * np.arange(len(rows) + 1)), ("Types", np.full(len(rows), 10, np.uint8)),
        ):  # fmt: skip
            group.create_dataset(name, data=np.asarray(value))


def _box() -> meshio.Mesh:
    """A bar of 2 x 1 x 1 cubes of six tetrahedra, with two regions."""
    axes = np.linspace(0, 1, 3), np.linspace(0, 0.25, 2), np.linspace(0, 0.25, 2)
    points = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    ways = [(0, 4, 6, 7), (0, 6, 2, 7), (0, 2, 3, 7), (0, 3, 1, 7), (0, 1, 5, 7), (0, 5, 4, 7)]
    cells = [[4 * cube + each for each in way] for cube in range(2) for way in ways]
    tags = np.repeat([1, 2], 6)
    return meshio.Mesh(
        points, [("tetra", np.array(cells))],
        cell_data={"gmsh:physical": [tags], "gmsh:geometrical": [tags], "medit:ref": [tags], "cell_tags": [tags]},
    )  # fmt: skip


def _skin(cells: np.ndarray) -> np.ndarray:
    """Triangles that one cell has, normals outwards."""
    faces = np.concatenate([cells[:, each] for each in ([1, 2, 3], [0, 3, 2], [0, 1, 3], [0, 2, 1])])
    _, first, count = np.unique(np.sort(faces, axis=1), axis=0, return_index=True, return_counts=True)
    return faces[first[count == 1]]


def attack(number: int, chance: random.Random, place: Path) -> str:
    """One file; every twentieth as it is."""
    os.chdir(place)
    good = chance.choice(_GOOD)
    for path in good.folder.iterdir():
        shutil.copy(path, place / path.name)
    whole = number % 20 == 0
    if not whole:
        target = place / chance.choice(sorted(path.name for path in good.folder.iterdir()))
        target.write_bytes(mutated(target.read_bytes(), chance))
    try:
        return _tried(good, write(place / "study.toml", _study(good, chance)), whole)
    except Wrong as wrong:
        raise Wrong(f"{good.name}: {wrong}") from None


def _tried(good: Good, study: Path, whole: bool) -> str:
    """Check, run and count."""
    checked = call("check", study).expect(Exit.DONE, Exit.BAD_INPUT)
    ran = call("run", study, "-o", study.parent / "out", "--wall-limit", 3)
    ran.expect(Exit.DONE, Exit.BAD_INPUT, Exit.NOT_CONVERGED, Exit.STOPPED)
    expect(not ran.code or "fracsim: " in ran.said, "no message")
    expect("PETSC ERROR" not in ran.said, "PETSc's words")
    for said in (checked, ran):
        strange = re.search(PYTHON, said.said)
        expect(not strange, f"words of Python: {said.said[-1500:]}")
    if good.cells and not ran.code:
        _expect_no_fewer(good, study.with_name(good.name), ran.said)
    if whole:
        expect(ran.code != Exit.BAD_INPUT or good.surface, f"refused as it is: {ran.said[-1500:]}")
    ends = {0: "ran", 2: "refused", 3: "did not converge", 4: "reached its wall limit"}
    return ends[ran.code] + (" by run alone" if ran.code == 2 and not checked.code else "")


def _expect_no_fewer(good: Good, path: Path, said: str) -> None:
    """Of a file that was read: as many cells as before, or nine of ten nodes where its format does not count them."""
    if "on nodes of the body are no facets of its cells" in said or "Element numbers left out" in said:
        return
    cells, points = _read(path, good.surface)
    least = good.cells if path.suffix not in UNCOUNTED else 0.5 * good.cells
    expect(len(cells) >= least, f"{len(cells)} cells instead of {good.cells}, exit 0: {said[-800:]}")
    used = len(np.unique(cells)) / max(len(points), 1)
    expect(used > 0.9 or len(points) - len(np.unique(cells)) <= 3, f"{used:.0%} of nodes are in cells")


def _study(good: Good, chance: random.Random) -> Data:
    name = good.name
    if name == "outline.csv":
        held = [{"on": {"point": [0.0, 0.0], "normal": [1.0, 0.0]}, "fix": "xy"}]
        return changed(STRIP, mesh=None, boundary=held, probe=None, time={"end": 0.01}) | {
            "mesh": {"outline": name, "h": 0.1}
        }
    if not good.surface:
        return changed(BAR, mesh=None, boundary=HELD, probe=None, time={"end": 0.02}) | {"mesh": {"file": name}}
    match chance.randrange(3):
        case 0:
            filled = {"surface": name, "h": good.size / 5, "time_limit": 10, "repair": chance.random() < 0.5}
            return changed(BAR, mesh=None, boundary=HELD, probe=None, time={"end": 0.02}) | {"mesh": filled}
        case 1:
            ball = [{"name": "it", "shape": "mesh", "file": name, "at": [0.0, 0.0, 0.3], "velocity": [0.0, 0.0, -1.0]}]
            return changed(BAR, obstacle=ball, time={"end": 0.02})
        case _:
            shell = {"mesh": {"shell": name, "thickness": 2e-3}, "time": {"scheme": "rigid", "step": 0.01, "end": 0.03}}
            return {key: each for key, each in STUDIES["rigid"].items() if key != "brittle"} | shell


def mutated(data: bytes, chance: random.Random) -> bytes:
    """A file, changed in one to five places."""
    for _ in range(chance.choice((1, 2, 3, 5))):
        data = _changed(data, chance)
    return data


def _changed(data: bytes, chance: random.Random) -> bytes:
    if not data:
        return data
    at = chance.randrange(len(data))
    size = min(chance.choice((1, 4, 64, 1000)), len(data) - at)
    numbers = [each.span() for each in re.finditer(rb"[-+0-9.eE]+", data[:200_000])] if chance.random() < 0.5 else []
    if numbers:
        begin, end = chance.choice(numbers[: chance.choice((20, len(numbers)))])  # sizes stand at the head
        number = chance.choice((*NUMBERS, None))
        if number is None:  # a count that is too small by one
            number = str(int(data[begin:end]) - 1).encode() if data[begin:end].isdigit() else b"7"
        return data[:begin] + number + data[end:]
    lines = data.split(b"\n")
    match chance.randrange(8):
        case 0:
            return data[:at]
        case 1:
            return data[:at] + bytes([data[at] ^ (1 << chance.randrange(8))]) + data[at + 1 :]
        case 2:
            return data[:at] + chance.randbytes(size) + data[at + size :]
        case 3:
            return data[:at] + data[at + size :]
        case 4:
            return data[:at] + data[at : at + size] + data[at:]
        case 5:
            return data[:at] + bytes(size) + data[at + size :]
        case 6:
            one, other = chance.randrange(len(lines)), chance.randrange(len(lines))
            lines[one], lines[other] = lines[other], lines[one]
            return b"\n".join(lines)
        case _:
            del lines[chance.randrange(len(lines))]
            return b"\n".join(lines)
