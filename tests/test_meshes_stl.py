"""STL of other programs and damaged STL, against the triangles that were written by hand."""

from __future__ import annotations

import struct
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from fracsim.meshes import MeshError, stl
from fracsim.meshes.read import read_contents
from fracsim.meshes.surfaces.closed import read_surface

pytestmark = pytest.mark.any_release

FILES = Path(__file__).parent / "meshes"
TETRAHEDRON = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]], float)
FACES = TETRAHEDRON[[[0, 2, 1], [0, 1, 3], [1, 2, 3], [2, 0, 3]]]


def text(faces: Any = FACES, name: str = "part", end: str = "\n") -> str:
    lines = [f"solid {name}"]
    for face in faces:
        lines += ["  facet normal 0 0 0", "    outer loop"]
        lines += [f"      vertex {x:.6e} {y:.6e} {z:.6e}" for x, y, z in face]
        lines += ["    endloop", "  endfacet"]
    return end.join([*lines, f"endsolid {name}"]) + end


def binary(faces: Any = FACES, head: bytes = b"") -> bytes:
    rows = [struct.pack("<12fH", 0, 0, 0, *face.ravel(), 0) for face in faces]
    return head.ljust(80, b" ") + struct.pack("<I", len(faces)) + b"".join(rows)


@pytest.mark.parametrize(
    "data",
    [
        text().encode(),
        text().upper().encode(),
        text().replace("endloop", "end loop").replace("endfacet", "End  Facet").encode(),
        text(name="vertex 1 of a é").encode("latin-1"),
        text(end="\r\n").encode(),
        text(end="\r").encode(),
        text(FACES[:2]).encode() + text(FACES[2:], "second").encode(),
        binary(),
        binary(head=b"solid made by a program"),
        binary() + b"\0" * 7,
    ],
)
def test_every_writing_gives_the_same_triangles(tmp_path: Path, data: bytes) -> None:
    (tmp_path / "part.stl").write_bytes(data)
    contents = read_contents(tmp_path / "part.stl")
    np.testing.assert_array_equal(contents.points[contents.blocks[0].nodes], FACES)
    assert read_surface(tmp_path / "part.stl").volume == pytest.approx(1 / 6)


def test_end_loop_in_two_words() -> None:
    assert read_surface(FILES / "s2_end_loop.stl").volume == pytest.approx(60.0 * 40.0 * 20.0, rel=1e-12)


@pytest.mark.parametrize(
    ("data", "message"),
    [
        (binary()[:-10], "declares 4 triangles, and has room for 3"),
        (text().encode()[:450], rf"line {1 + text()[:450].count(chr(10))}: .* without `endsolid` behind 2 facets"),
        (text().encode()[:350], rf"line {1 + text()[:350].count(chr(10))}: a facet of STL .* \(1 of them are whole"),
        (text().replace("vertex 0.000000e+00", "vertex 0,0", 1).encode(), "line 4: `vertex 0,0 .*three coordinates"),
        (text().replace("endloop\n", "\n", 1).encode(), "line 8: a facet of STL has"),
        (b"solid nothing\nendsolid nothing\n", r"line 3: a facet of STL has .* \(0 of them"),
        (b"hello", "begins with b'hello'"),
        (b"x" * 500, "declares 2021161080 triangles"),
    ],
)
def test_damaged_files_are_named(tmp_path: Path, data: bytes, message: str) -> None:
    (tmp_path / "part.stl").write_bytes(data)
    with pytest.raises(MeshError, match=message):
        read_surface(tmp_path / "part.stl")


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_text_as_most_write_it_is_read_in_parts(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, end: str) -> None:
    """Without the reader of other texts, which is slow; of 300 facets in two solids, each number at its place."""
    monkeypatch.setattr(stl, "_corners_of_regular_text", partial(stl._corners_of_regular_text, part=1000))
    monkeypatch.setattr(stl, "_corners_of_text", None)
    faces = np.random.default_rng(1).random((300, 3, 3)).round(6)
    (tmp_path / "a.stl").write_text(text(faces[:170], end=end) + text(faces[170:], end=end), newline="")
    np.testing.assert_allclose(read_contents(tmp_path / "a.stl").points.reshape(-1, 3, 3), faces, atol=1e-6)


@pytest.mark.parametrize("place", range(0, 300, 23))
def test_text_in_parts_loses_no_facet(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, place: int) -> None:
    """A facet with a vertex of four numbers, beside one of two, and one that is cut short, wherever they stand."""
    monkeypatch.setattr(stl, "_corners_of_regular_text", partial(stl._corners_of_regular_text, part=1000))
    lines = text(np.random.default_rng(1).random((300, 3, 3))).split("\n")
    first = 1 + 7 * place + 2
    for instead in (
        {first: lines[first] + " 5", first + 1: "vertex 1 2"},
        {first + 2: ""},
        {first + 3: "", first + 4: ""},
        {first: lines[first].replace(".", ",")},
    ):
        damaged = [instead.get(i, line) for i, line in enumerate(lines)]
        (tmp_path / "a.stl").write_text("\n".join(damaged))
        with pytest.raises(MeshError, match="line"):
            read_contents(tmp_path / "a.stl")


@pytest.mark.parametrize("declared", [1, 2, 3, 5])
def test_binary_of_another_number_is_refused(tmp_path: Path, declared: int) -> None:
    """Four triangles, of which fewer or more are declared; a few bytes behind them are of no matter."""
    data = binary()
    (tmp_path / "a.stl").write_bytes(data[:80] + struct.pack("<I", declared) + data[84:])
    with pytest.raises(MeshError, match=f"declares {declared} triangles, and h.* 4"):
        read_contents(tmp_path / "a.stl")
    (tmp_path / "a.stl").write_bytes(data + bytes(12))
    assert len(read_contents(tmp_path / "a.stl").blocks[0].nodes) == 4


def test_coordinates_that_are_rounded_off_are_refused(tmp_path: Path) -> None:
    """A part of 40 mm at 1e5 m measured 16 of 20 mm; whole numbers, and the same part near the origin, are read."""
    path = tmp_path / "part.stl"
    path.write_bytes(binary(0.04 * FACES + [1e5, 0, 0]))
    with pytest.raises(MeshError, match=r"have 32 bits, which round them by up to 0.0039 so far.*of 0.04 that it"):
        read_contents(path)
    for faces in (1.0 * FACES + [1e6, 0, 0], 0.04 * FACES + [1, 0, 0]):
        path.write_bytes(binary(faces))
        np.testing.assert_allclose(read_surface(path).volume, np.ptp(faces, axis=(0, 1)).prod() / 6, rtol=1e-5)
