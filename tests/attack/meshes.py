"""Mesh files of all formats, changed at random: bodies, surfaces to be filled, outlines, shells and obstacles.

A file is refused with a message, or makes a body: no traceback, crash or hang.
"""

from __future__ import annotations

import os
import random
import re
import warnings
from pathlib import Path

import meshio
import numpy as np

from cases import BAR, STRIP, changed
from fracsim.errors import Exit

from .corpus import STUDIES, Data, write
from .trial import Wrong, call, expect

BODIES = {"m2a.msh": "gmsh22", "m2b.msh": "gmsh22", "m4a.msh": "gmsh", "m4b.msh": "gmsh", "a.vtu": None, "z.vtu": None,
          "a.vtk": "vtk42", "b.vtk": "vtk51", "a.xdmf": None, "a.inp": None, "a.med": None, "a.e": None, "a.mesh": None,
          "a.bdf": "nastran", "a.su2": None, "a.vol": "netgen", "a.ele": "tetgen", "a.avs": "avsucd", "a.h5m": None,
          "a.dat": "tecplot", "a.f3grid": None, "a.ugrid": None}  # fmt: skip
SURFACES = {"a.stl": None, "b.stl": None, "a.obj": None, "a.ply": None, "b.ply": None, "a.off": None, "s.vtu": None}
BINARY = {"m2a.msh": False, "m2b.msh": True, "m4a.msh": False, "m4b.msh": True, "a.vtk": False, "b.vtk": True,
          "a.vtu": False, "a.stl": False, "b.stl": True, "a.ply": False, "b.ply": True}  # fmt: skip
NUMBERS = (b"nan", b"-1", b"0", b"1e300", b"99999999999", b"", b"x", b"-1e-300", b"4294967295", b"2147483648", b"1e999")
_GOOD = Path("/nowhere")
_NAMES: list[str] = []
HELD = [{"on": {"point": [0.0, 0.0, 0.0], "normal": [1.0, 0.0, 0.0]}, "fix": "xyz"}]


def prepare(folder: Path) -> None:
    """One good file of each format that can be written here."""
    global _GOOD
    _GOOD = folder / "meshes"
    _GOOD.mkdir(exist_ok=True)
    box = _box()
    surface = meshio.Mesh(box.points, [("triangle", _skin(box.cells[0].data))])
    for names, mesh in ((BODIES, box), (SURFACES, surface)):
        for name, kind in names.items():
            how = {"binary": BINARY[name]} if name in BINARY else {}
            try:
                with warnings.catch_warnings():
                    warnings.simplefilter("ignore")
                    meshio.write(_GOOD / name, mesh, file_format=kind, **how)
            except Exception:  # what this meshio cannot write, or lacks a library for
                (_GOOD / name).unlink(missing_ok=True)
    corners = [(0.0, 0.0), (1.0, 0.0), (1.0, 0.25), (0.0, 0.25)]
    (_GOOD / "outline.csv").write_text("".join(f"{x}, {y}\n" for x, y in corners))
    _NAMES[:] = sorted(path.name for path in _GOOD.iterdir() if path.name in {*BODIES, *SURFACES, "outline.csv"})
    print(f"  meshes: {', '.join(_NAMES)}", flush=True)


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
    name = chance.choice(_NAMES)
    for path in _GOOD.iterdir():  # with what it leads to
        if path.stem == Path(name).stem:
            (place / path.name).write_bytes(path.read_bytes())
    whole = number % 20 == 0
    beside = [path for path in place.iterdir() if path.stem == Path(name).stem]
    if not whole:
        target = chance.choice(beside)
        target.write_bytes(mutated(target.read_bytes(), chance))
    study = write(place / "study.toml", _study(name, chance))
    checked = call("check", study).expect(Exit.DONE, Exit.BAD_INPUT)
    ran = call("run", study, "-o", place / "out", "--wall-limit", 3)
    try:
        ran.expect(Exit.DONE, Exit.BAD_INPUT, Exit.NOT_CONVERGED, Exit.STOPPED)
        expect(not ran.code or "fracsim: " in ran.said, "no message")
        expect("PETSC ERROR" not in ran.said, "PETSc's words")
    except Wrong as wrong:
        raise Wrong(f"{name}: {wrong}") from None
    ends = {0: "ran", 2: "refused", 3: "did not converge", 4: "reached its wall limit"}
    return ends[ran.code] + (" by run alone" if ran.code == 2 and not checked.code else "")


def _study(name: str, chance: random.Random) -> Data:
    if name == "outline.csv":
        held = [{"on": {"point": [0.0, 0.0], "normal": [1.0, 0.0]}, "fix": "xy"}]
        return changed(STRIP, mesh=None, boundary=held, probe=None, time={"end": 0.01}) | {
            "mesh": {"outline": name, "h": 0.1}
        }
    if name not in SURFACES:
        return changed(BAR, mesh=None, boundary=HELD, probe=None, time={"end": 0.02}) | {"mesh": {"file": name}}
    match chance.randrange(3):
        case 0:
            filled = {"mesh": {"surface": name, "h": 0.2, "time_limit": 10, "repair": chance.random() < 0.5}}
            return changed(BAR, mesh=None, boundary=HELD, probe=None, time={"end": 0.02}) | filled
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
        return data[:begin] + chance.choice(NUMBERS) + data[end:]
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
