"""Abaqus input files: cells, sets, surfaces and places of instances, against counts by hand and closed forms."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from fracsim.meshes import MeshData, MeshError
from fracsim.meshes.check import check_mesh
from fracsim.meshes.mesh_conversion import MeshFileContents
from fracsim.meshes.read import read_contents, read_mesh
from fracsim.meshes.topology import signed_measures

pytestmark = pytest.mark.any_release

Write = Callable[[str], Path]

# A unit cube of six tetrahedra about the diagonal from node 1 to node 7; nodes in the order of C3D8.
CORNERS = [(0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1)]
TETRAHEDRA = [(1, 2, 3, 7), (1, 3, 4, 7), (1, 4, 8, 7), (1, 8, 5, 7), (1, 5, 6, 7), (1, 6, 2, 7)]
NODES = "".join(f"{i}, {x}., {y}., {z}.\n" for i, (x, y, z) in enumerate(CORNERS, 1))
ELEMENTS = "".join(f"{i}, {', '.join(map(str, nodes))}\n" for i, nodes in enumerate(TETRAHEDRA, 1))
CUBE = f"*Node\n{NODES}*Element, type=C3D4\n{ELEMENTS}"
TWO = (
    "*Part, name=Block\n" + CUBE + "*Nset, nset=foot\n1, 2, 3, 4\n*End Part\n*Assembly, name=A\n"
    "*Instance, name=Block-1, part=Block\n*End Instance\n*Instance, name=Block-2, part=Block\n{place}*End Instance\n"
    "{sets}*End Assembly\n"
)  # fmt: skip


@pytest.fixture
def deck(tmp_path: Path) -> Write:
    def write(text: str, name: str = "deck.inp") -> Path:
        (tmp_path / name).write_text(text, encoding="utf-8")
        return tmp_path / name

    return write


def read(path: Path) -> MeshData:
    return check_mesh(read_mesh(path))


def volume(mesh: MeshData, region: str | None = None) -> float:
    cells = mesh.cells if region is None else mesh.cells[mesh.regions[region]]
    return float(signed_measures(mesh.points, cells).sum())


def corners_of(contents: MeshFileContents, name: str) -> set[tuple[int, ...]]:
    """Facets of a group as node numbers of the file."""
    found = set()
    for block, rows in zip(contents.blocks, contents.sets[name], strict=True):
        found |= {tuple(sorted(row)) for row in (block.nodes[rows] + 1).tolist()}
    return found


def test_keywords_comments_blanks_and_continuations(deck: Write) -> None:
    """Of any writer: letter case, blanks, comments within data, lines cut at commas, free text, CR LF."""
    lines = ELEMENTS.splitlines(keepends=True)
    text = (
        "** a remark\n*HEADING\nfree text, 1, 2 *not a keyword\n  *node , NSET = all nodes\n** 9, 9., 9., 9.\n"
        + NODES.replace(".,", ".00E+00 ,")
        + "\n** more\n*ELEMENT,\n** within\n TYPE = c3d4h,\nelset=Körper\n"
        + "".join(lines[:3]) + "** the other half\n\n" + lines[3] + "5, 1, 5,\n  6, 7\n" + lines[5]
        + "*Solid Section, elset=Körper, material=Stahl\n,\n*STEP\n*STATIC\n0.1, 1.\n*END STEP\n"
    )  # fmt: skip
    for ending in ("\n", "\r\n"):
        mesh = read(deck(text.replace("\n", ending)))
        assert len(mesh.cells) == 6 and len(mesh.points) == 8 and mesh.notes == ()
        assert volume(mesh) == pytest.approx(1, abs=1e-14)
        assert len(mesh.regions["Körper"]) == 6
        assert len(mesh.facet_groups["all nodes"]) == 12


DATA = Path(__file__).parent / "meshes"


def areas(mesh: MeshData, name: str) -> float:
    a, b, c = np.moveaxis(mesh.points[mesh.facet_groups[name]], 1, 0)
    return float(np.linalg.norm(np.cross(b - a, c - a), axis=1).sum() / 2)


def test_a_deck_of_abaqus_cae_with_a_reference_point() -> None:
    """A bar of 100 x 20 x 20 mm; its right end as a surface of faces S1 to S4."""
    mesh = read(DATA / "a1_cae_rp.inp")
    assert (len(mesh.points), len(mesh.cells)) == (280, 760)
    assert volume(mesh) == pytest.approx(40000)
    assert {name: len(cells) for name, cells in mesh.regions.items()} == {"Set-steel": 380, "Set-epoxy": 380}
    for name, x in {"Set-left": 0, "Set-right": 100, "Surf-right": 100}.items():
        assert areas(mesh, name) == pytest.approx(400)
        assert np.all(mesh.points[mesh.facet_groups[name], 0] == x)
    assert mesh.notes == (
        "Sets not used, for they hold neither cells nor all nodes of triangles of the boundary: Set-RP.",
        "1 of 281 nodes belong to no cell and were removed.",
    )


def test_a_comment_among_the_elements_ends_nothing() -> None:
    mesh = read(DATA / "a6_comment_in_elements.inp")
    assert (len(mesh.points), len(mesh.cells)) == (280, 760)
    assert volume(mesh) == pytest.approx(0.1 * 0.02 * 0.02)


def test_two_parts_are_two_bodies() -> None:
    mesh = read(DATA / "a5_twoparts.inp")
    assert len(mesh.cells) == 760 and len(mesh.points) == 300
    assert any("2 bodies that share no node" in note for note in mesh.notes)
    assert volume(mesh, "Block-1") == pytest.approx(0.05 * 0.02 * 0.02)
    assert volume(mesh, "Striker-1") == pytest.approx(0.05 * 0.02 * 0.02)


def test_three_instances_of_a_part_are_three_bodies() -> None:
    """Bricks of 0.1 x 0.1 x 0.01 m, one above the other with gaps of 0.1 mm."""
    mesh = read(DATA / "a5d_three_instances.inp")
    assert len(mesh.cells) == 3 * 712
    assert any("3 bodies that share no node" in note for note in mesh.notes)
    for i in range(3):
        assert volume(mesh, f"Brick-{i + 1}") == pytest.approx(1e-4)
        z = mesh.points[np.unique(mesh.cells[mesh.regions[f"Brick-{i + 1}"]]), 2]
        assert (z.min(), z.max()) == pytest.approx((0.0101 * i, 0.0101 * i + 0.01), abs=1e-12)


def test_names_in_latin_letters_of_windows(tmp_path: Path) -> None:
    path = tmp_path / "deck.inp"
    path.write_bytes((CUBE + '*Elset, elset="Béton armé, bas", generate\n1, 3\n').encode("cp1252"))
    assert list(read(path).regions) == ["Béton armé, bas"]


@pytest.mark.parametrize(
    ("element_type", "kind", "count"),
    [
        ("C3D4", "tetra", 4), ("c3d4t", "tetra", 4), ("AC3D4", "tetra", 4), ("C3D10M", "tetra10", 10),
        ("C3D10MH", "tetra10", 10), ("C3D8R", "hexahedron", 8), ("C3D8I", "hexahedron", 8), ("C3D6H", "wedge", 6),
        ("C3D5", "pyramid", 5), ("C3D20RH", "hexahedron20", 20), ("CPS3", "triangle", 3), ("CPE6MH", "triangle6", 6),
        ("CPE4R", "quad", 4), ("CPS8R", "quad8", 8), ("S3", "triangle", 3), ("STRI3", "triangle", 3),
        ("STRI65", "triangle6", 6), ("S4R", "quad", 4), ("M3D3", "triangle", 3), ("DC3D4", "tetra", 4),
    ],
)  # fmt: skip
def test_types_of_elements(deck: Write, element_type: str, kind: str, count: int) -> None:
    nodes = "".join(f"{i}, {i}., {i * i}., {i**3}.\n" for i in range(1, count + 1))
    text = ", ".join(map(str, [7, *range(1, count + 1)]))
    if count > 15:  # Abaqus takes 16 numbers a line
        text = ", ".join(map(str, [7, *range(1, 16)])) + ",\n" + ", ".join(map(str, range(16, count + 1)))
    (block,) = read_contents(deck(f"*NODE\n{nodes}*ELEMENT, TYPE={element_type}, ELSET=e\n{text}\n")).blocks
    assert block.kind == kind
    np.testing.assert_array_equal(block.nodes, [np.arange(count)])


def test_elements_used_for_nothing_are_counted(deck: Write) -> None:
    text = CUBE + "*NODE\n20, 5., 5., 5.\n*ELEMENT, TYPE=SPRINGA, ELSET=springs\n50, 1, 20\n51, 2, 20\n"
    text += "*ELEMENT, TYPE=MASS\n52, 20\n*ELEMENT, TYPE=T3D2, ELSET=bars\n60, 1, 2\n*ELEMENT, TYPE=B32\n61, 1, 2, 3\n"
    mesh = read(deck(text))
    assert mesh.notes == (
        "Elements that are not part of the body are not used: 2 SPRINGA, 1 MASS, 1 B32, 1 line.",
        "1 of 9 nodes belong to no cell and were removed.",
    )
    assert not mesh.regions and not mesh.facet_groups


def test_facets_as_elements_and_lines_of_a_plane_mesh(deck: Write) -> None:
    """As gmsh writes them (CPS3, T3D2) and meshio (R3D3); a rigid tool beside the body is left out."""
    tool = "*NODE\n21, 0., 0., 9.\n22, 1., 0., 9.\n23, 0., 1., 9.\n*ELEMENT, TYPE=R3D3, ELSET=tool\n90, 21, 22, 23\n"
    facets = "*ELEMENT, TYPE={}, ELSET=low\n80, 1, 2, 3\n81, 1, 3, 4\n"
    for element_type in ("CPS3", "S3R", "R3D3"):
        mesh = read(deck(CUBE + facets.format(element_type) + tool))
        assert {name: len(rows) for name, rows in mesh.facet_groups.items()} == {"low": 2}
        assert any("not used: 1 triangle." in note for note in mesh.notes)
    plane = (
        "*NODE\n1, 0., 0.\n2, 1., 0.\n3, 1., 1.\n4, 0., 1.\n*ELEMENT, TYPE=CPE3, ELSET=body\n1, 1, 2, 3\n2, 1, 3, 4\n"
    )
    mesh = read(deck(plane + "*ELEMENT, TYPE=T3D2, ELSET=low\n5, 1, 2\n6, 2, 4\n"))  # the second one is a bar
    assert mesh.dim == 2 and mesh.facet_groups["low"].tolist() == [[0, 1]]
    assert any("not used: 1 line" in note for note in mesh.notes)


def test_sets_by_number_range_and_name(deck: Write) -> None:
    text = CUBE + (
        "*NSET, NSET=bottom\n1, 2,\n3, 4\n*NSET, NSET=top, UNSORTED\n8, 7, 6, 5\n*NSET, NSET=ends\nBottom, TOP, 1\n"
        "*ELSET, ELSET=odd, GENERATE\n1, 5, 2\n*ELSET, ELSET=even, GENERATE\n2, 6, 2\n*ELSET, ELSET=all\nodd\neven\n"
        '*ELSET, ELSET="two words"\n1, even\n*ELSET, ELSET=odd\n2\n*ELSET, ELSET=hidden, INTERNAL\n1\n'
        "*NSET, NSET=of cells, ELSET=all\n*NSET, NSET=far, GENERATE\n5, 1000000000000, 1\n"
    )
    contents = read_contents(deck(text))
    assert {name: (rows[0] + 1).tolist() for name, rows in contents.sets.items()} == {
        "odd": [1, 2, 3, 5], "even": [2, 4, 6], "all": [1, 2, 3, 4, 5, 6], "two words": [1, 2, 4, 6],
    }  # fmt: skip
    assert {name: (nodes + 1).tolist() for name, nodes in contents.point_sets.items()} == {
        "bottom": [1, 2, 3, 4], "top": [5, 6, 7, 8], "ends": list(range(1, 9)), "of cells": list(range(1, 9)),
        "far": [5, 6, 7, 8],
    }  # fmt: skip
    assert contents.notes == ("Sets name 999999999992 nodes or elements that are not in the file: far. Is it whole?",)


def test_a_face_of_abaqus_cae_is_a_set_of_nodes_and_of_elements(deck: Write) -> None:
    """CAE writes both under one name: a facet group and a region."""
    mesh = read(deck(CUBE + "*Nset, nset=low\n1, 2, 3, 4\n*Elset, elset=low\n1, 2\n"))
    assert len(mesh.facet_groups["low"]) == 2 and mesh.regions["low"].tolist() == [0, 1]


# Faces of Abaqus' elements as node numbers (Analysis User's Guide, "Three-dimensional solid element library")
FACES = {
    "C3D4": ["123", "124", "234", "134"],
    "C3D6": ["123", "456", "1245", "2356", "1346"],
    "C3D8": ["1234", "5678", "1256", "2367", "3478", "1458"],
    "C3D5": ["1234", "125", "235", "345", "145"],
    "CPS3": ["12", "23", "13"],
    "CPE4": ["12", "23", "34", "14"],
}


@pytest.mark.parametrize("element_type", FACES)
def test_faces_by_their_identifiers(deck: Write, element_type: str) -> None:
    count = int(element_type[-1])
    nodes = "".join(f"{i}, {x}, {y}, {z}\n" for i, (x, y, z) in enumerate(CORNERS[:count], 1))
    text = f"*NODE\n{nodes}*ELEMENT, TYPE={element_type}, ELSET=e\n1, {', '.join(map(str, range(1, count + 1)))}\n"
    for i in range(1, len(FACES[element_type]) + 1):
        text += f"*SURFACE, NAME=face{i}\ne, S{i}\n*SURFACE, TYPE=ELEMENT, NAME=same{i}\n1, s{i}\n"
    contents = read_contents(deck(text + "*SURFACE, NAME=skin\ne,\n"))
    for i, face in enumerate(FACES[element_type], 1):
        wanted = {tuple(int(digit) for digit in face)}
        assert corners_of(contents, f"face{i}") == corners_of(contents, f"same{i}") == wanted
    assert corners_of(contents, "skin") == {tuple(int(digit) for digit in face) for face in FACES[element_type]}


def test_surfaces_free_of_nodes_and_joined(deck: Write) -> None:
    text = CUBE + (
        "*ELSET, ELSET=lower\n1, 2\n*SURFACE, NAME=free\nlower\n*SURFACE, NAME=whole\n,\n"
        "*NSET, NSET=n\n1, 2, 3\n*SURFACE, TYPE=NODE, NAME=points\nn, 1.\n4\n"
        "*SURFACE, NAME=low\n1, S1\n2, S1\n*SURFACE, NAME=both, COMBINE=UNION\nlow, free\n"
        "*SURFACE, TYPE=CYLINDER, NAME=roll\n0., 0., 0.\n"
    )
    mesh = read(deck(text))
    assert {name: len(facets) for name, facets in mesh.facet_groups.items()} == {
        "n": 1, "points": 2, "free": 4, "whole": 12, "low": 2, "both": 4,
    }  # fmt: skip
    assert np.all(mesh.points[mesh.facet_groups["low"], 2] == 0)
    assert mesh.notes[0] == "Surface 'roll' of the kind CYLINDER is not used."


def test_instances_are_bodies_in_their_places(deck: Write) -> None:
    """The second cube is moved by (2, 0, 0), then turned by 90 degrees about the line x = 2, y = 0, parallel to z."""
    place = "2., 0., 0.\n2., 0., 0., 2., 0., 1., 90.\n"
    sets = (
        "*Node\n1, 9., 9., 9.\n*Nset, nset=RP\n1\n*Nset, nset=grip, instance=Block-2\n5, 6, 7, 8\n"
        "*Nset, nset=feet\nBlock-1.foot, Block-2.foot, Block-2.5\n*Elset, elset=one, instance=Block-2\n3\n"
        "*Surface, name=side\nBlock-2.1, S1\n"
    )
    mesh = read(deck(TWO.format(place=place, sets=sets)))
    assert len(mesh.points) == 16 and len(mesh.cells) == 12
    second = np.unique(mesh.cells[mesh.regions["Block-2"]])
    x, y, z = np.array(CORNERS, float).T
    np.testing.assert_allclose(mesh.points[second], np.stack([2 - y, x, z], axis=1), atol=1e-15)
    assert volume(mesh, "Block-1") == pytest.approx(1) and volume(mesh, "Block-2") == pytest.approx(1)
    assert mesh.regions["one"].tolist() == [8]
    groups = {name: len(facets) for name, facets in mesh.facet_groups.items()}
    assert groups == {"foot": 4, "Block-1.foot": 2, "Block-2.foot": 2, "grip": 2, "feet": 4, "side": 1}
    assert set(mesh.facet_groups["side"].ravel()) == {second[0], second[1], second[2]}
    assert "The mesh has 2 bodies that share no node; each needs its own supports." in mesh.notes


def test_coincident_instances_stay_apart(deck: Write) -> None:
    mesh = read(deck(TWO.format(place="1., 0., 0.\n", sets="")))
    assert len(mesh.points) == 16
    assert any("8 nodes coincide with nodes of another body" in note for note in mesh.notes)


def test_a_set_of_the_assembly_is_not_that_of_a_part(deck: Write) -> None:
    sets = "*Nset, nset=Foot, instance=Block-1\n5, 6, 7, 8\n"
    mesh = read(deck(TWO.format(place="3., 0., 0.\n", sets=sets)))
    assert np.all(mesh.points[mesh.facet_groups["Foot"], 2] == 1)
    assert np.all(mesh.points[mesh.facet_groups["Block-1.foot"], 2] == 0)
    assert any("have node sets of the same name: foot" in note for note in mesh.notes)


def test_meshes_within_instances_and_parts_without_any(deck: Write) -> None:
    """Independent instances of CAE hold their own mesh; a file of parts alone holds their bodies."""
    inside = "*Part, name=P\n*End Part\n*Assembly, name=A\n*Instance, name=I, part=P\n1., 0., 0.\n"
    mesh = read(deck(inside + CUBE + "*End Instance\n*End Assembly\n"))
    assert mesh.points.min(axis=0).tolist() == [1, 0, 0] and volume(mesh) == pytest.approx(1)
    mesh = read(deck("*PART, NAME=P\n" + CUBE + "*ENDPART\n"))
    assert len(mesh.cells) == 6 and not mesh.regions


def test_includes_of_whole_blocks_and_of_data(deck: Write) -> None:
    deck(NODES, "nodes.txt")
    deck("*ELEMENT, TYPE=C3D4\n" + ELEMENTS, "elements.inc")
    assert len(read(deck("*NODE\n*INCLUDE, INPUT=nodes.txt\n*INCLUDE, INPUT=elements.inc\n")).cells) == 6
    assert len(read(deck("*NODE, INPUT=nodes.txt\n*Include, Input=elements.inc\n")).cells) == 6


REFUSED = {
    "names a node": (CUBE.replace("6, 1, 6, 2, 7", "6, 1, 6, 2, 99"), 16, "element 6 names node 99, which is not in"),
    "cut element": (CUBE.replace("3, 1, 4, 8, 7", "3, 1, 4, 8"), 13, "element 3 has 3 nodes on this line; C3D4 needs"),
    "long element": (CUBE.replace("3, 1, 4, 8, 7", "3, 1, 4, 8, 7, 6"), 13, "element 3 has 5 nodes on this line"),
    "last line": (CUBE[:-4], 16, "element 6 has 2 nodes|ends within this line"),
    "no line end": (CUBE[:-1], 16, "the file ends within this line, without a line break"),
    "cut node": (CUBE.replace("3, 1., 1., 0.", "3, 1., 1."), 4, "a node has 2 coordinates"),
    "word": (CUBE.replace("3, 1., 1., 0.", "3, 1., x, 0."), 4, "'x' is not a number"),
    "two in a field": (CUBE.replace("3, 1., 1., 0.", "3, 1. 1., , 0."), 4, "'1. 1.' is not a number"),
    "nan": (CUBE.replace("3, 1., 1., 0.", "3, 1., nan, 0."), 4, "finite coordinates"),
    "node twice": (CUBE + "*NODE\n3, 0., 0., 9.\n", 18, "node 3 is defined a second time, at another place"),
    "element twice": (CUBE + "*ELEMENT, TYPE=C3D4\n3, 1, 2, 3, 8\n", 18, "element 3 is defined a second time"),
    "half the elements": (CUBE[: CUBE.index("2, 1, 3, 4, 7")], 10, "4 of 8 nodes belong to no element"),
    "axisymmetric": (CUBE.replace("C3D4", "CAX4R"), 10, "CAX4R are axisymmetric"),
    "misspelt": (CUBE.replace("C3D4", "C3D44"), 10, "type 'C3D44' is not supported. Supported are C3D4"),
    "no type": (CUBE.replace(", type=C3D4", ""), 10, r"write \*ELEMENT, TYPE=C3D4"),
    "generated": (CUBE + "*ELGEN\n1, 5, 1\n", 17, r"\*ELGEN is not supported"),
    "short keyword": (CUBE.replace("*Element", "*Elem"), 10, r"\*ELEM is cut short"),
    "no end": (TWO[: TWO.index("*End Part")], 1, r"\*PART has no \*END PART"),
    "no end of the assembly": (TWO.format(place="", sets="").replace("*End Assembly\n", ""), 21, "ASSEMBLY has no"),
    "no end of an instance": (TWO.format(place="", sets="").replace("*End Instance\n", "", 1), 23, "within"),
    "unknown part": (TWO.format(place="", sets="").replace("part=Block", "part=Blick", 1), 22, "part 'Blick'"),
    "translation": (TWO.format(place="1., 2.\n", sets=""), 25, r"translation \(x, y, z\)"),
    "axis": (TWO.format(place="0., 0., 0.\n1., 1., 1., 1., 1., 1., 30.\n", sets=""), 26, "axis of rotation"),
    "unknown set": (CUBE + "*NSET, NSET=a\nb\n", 17, "there is no node set 'b'"),
    "sets in a ring": (CUBE + "*NSET, NSET=a\nb\n*NSET, NSET=b\na\n", 19, "contains itself"),
    "no such face": (CUBE + "*SURFACE, NAME=s\n1, S5\n", 17, "a tetra has no face 'S5'"),
    "range": (CUBE + "*NSET, NSET=a, GENERATE\n5, 1, 1\n", 18, "GENERATE needs first, last and step"),
    "empty range": (CUBE + "*NSET, NSET=a, GENERATE\n", 17, "The data are missing"),
    "union": (TWO.format(place="", sets="*Surface, name=s, combine=union\nBlock-1.5\n"), 26, "is a number; COMBINE"),
    "data first": ("1, 2, 3\n" + CUBE, 1, "stands before the first keyword"),
    "binary": (CUBE.replace("4, 0.", "4, \0"), 5, "the file is not text"),
    "comma": (CUBE + "*NSET, NSET=a,\n1, 2, 3\n", 18, "Take the comma away"),
    "cylindrical": (CUBE.replace("*Node", "*Node, system=C"), 1, "cylindrical"),
}  # fmt: skip


@pytest.mark.parametrize("what", REFUSED)
def test_damaged_files_are_refused_with_their_line(deck: Write, what: str) -> None:
    text, line, said = REFUSED[what]
    with pytest.raises(MeshError, match=rf"deck\.inp', line {line}: .*({said})"):
        read_mesh(deck(text))


WHOLE = TWO.format(
    place="2., 0., 0.\n2., 0., 0., 2., 0., 1., 90.\n",
    sets="*Node\n1, 9., 9., 9.\n*Nset, nset=RP\n1,\n*Elset, elset=e, internal, instance=Block-2, generate\n1, 5, 2\n"
    "*Surface, type=ELEMENT, name=s\ne, S1\n*Nset, nset=feet\nBlock-1.foot, Block-2.foot\n",
).encode()
SCRAPS = [
    b"",
    b",",
    b"*",
    b"**",
    b"\n",
    b"\0",
    b"nan",
    b"-1",
    b"99999999999999999999",
    b"1e999",
    b'"',
    b"=",
    b".",
    b"\xff",
]
SCRAPS += [b"*Include, input=deck.inp\n", b"*End Part\n", b"Block-1.", b"generate", b"1 2", b"*Node\n", b"\r"]


@settings(max_examples=300, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_changed_files_are_refused_or_read(tmp_path: Path, data: st.DataObject) -> None:
    """No error but MeshError, and where cells are read, those of whole cubes: never a part of a body."""
    text = WHOLE
    for _ in range(data.draw(st.integers(1, 3))):
        begin = data.draw(st.integers(0, len(text)))
        end = min(len(text), begin + data.draw(st.sampled_from([0, 1, 1, 2, 5, 40, len(text)])))
        text = text[:begin] + data.draw(st.sampled_from(SCRAPS)) + text[end:]
    path = tmp_path / "deck.inp"
    path.write_bytes(text)
    try:
        mesh = read_mesh(path)
    except MeshError as error:
        assert str(path) in str(error) and "Traceback" not in str(error)
    else:
        assert len(mesh.cells)


def test_beams_beside_a_body_are_no_lost_cells(deck: Write) -> None:
    nodes = "".join(f"{i}, {i}., 5., 5.\n" for i in range(20, 41))
    beams = "".join(f"{i}, {i}, {i + 1}, {i + 2}\n" for i in range(20, 39, 2))
    mesh = read(deck(f"{CUBE}*NODE\n{nodes}*ELEMENT, TYPE=B32\n{beams}"))
    assert len(mesh.points) == 8 and "not used: 10 B32." in mesh.notes[0]


def test_hexahedra_with_a_surface(deck: Write) -> None:
    """Cut into tetrahedra; the quadrilateral of a face is cut as the cell is."""
    cell = "*ELEMENT, TYPE=C3D8R, ELSET=e\n1, 1, 2, 3, 4, 5, 6, 7, 8\n"
    mesh = read(deck(f"*NODE\n{NODES}{cell}*SURFACE, NAME=up\ne, S2\n*SURFACE, NAME=free\ne\n"))
    assert volume(mesh) == pytest.approx(1)
    assert areas(mesh, "up") == pytest.approx(1) and areas(mesh, "free") == pytest.approx(6)
    assert np.all(mesh.points[mesh.facet_groups["up"], 2] == 1)


def test_a_line_that_was_lost_is_told(deck: Write) -> None:
    assert read(deck(CUBE.replace("3, 1, 4, 8, 7\n", ""))).notes[0] == (
        "Element numbers left out: 1, first 3; are lines of the file lost?"
    )


@pytest.mark.parametrize(
    ("dim", "order", "squares"), [(3, 1, False), (3, 2, False), (2, 1, False), (2, 2, False), (2, 1, True)]
)
def test_files_of_gmsh(tmp_path: Path, dim: int, order: int, squares: bool) -> None:
    """Surfaces as CPS3 and CPS6, lines as T3D2 and T3D3, groups as sets; counts are gmsh's own."""
    from fracsim.meshes.gmsh_session import session

    path = tmp_path / "part.inp"
    with session() as gmsh:
        (gmsh.model.occ.addBox if dim == 3 else gmsh.model.occ.addRectangle)(0, 0, 0, *([1.0] * dim))
        gmsh.model.occ.synchronize()
        side = 1 if dim == 3 else 4
        gmsh.model.addPhysicalGroup(dim - 1, [side], 7, "left")
        gmsh.model.addPhysicalGroup(dim, [1], 8, "Körper")
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.4)
        if squares:
            gmsh.model.mesh.setRecombine(2, 1)
        gmsh.model.mesh.generate(dim)
        gmsh.model.mesh.setOrder(order)
        facets = sum(map(len, gmsh.model.mesh.getElements(dim - 1, side)[1]))
        cells = sum(map(len, gmsh.model.mesh.getElements(dim)[1]))
        gmsh.write(str(path))
    mesh = read(path)
    assert mesh.dim == dim and volume(mesh) == pytest.approx(1)
    assert len(mesh.cells) == cells * (2 if squares else 1)
    assert len(mesh.regions["Körper"]) == len(mesh.cells)
    assert len(mesh.facet_groups["left"]) == facets
    assert np.all(mesh.points[mesh.facet_groups["left"], 0] == 0)


# --- decks that were cut at the end of a line -------------------------------------------------------------------------


def test_a_deck_cut_at_any_line_says_so() -> None:
    """The bar without its end: refused, or a note that tells of a cut; never a smaller body without a word."""
    text = (DATA / "a6_comment_in_elements.inp").read_text()
    lines = text.splitlines(keepends=True)
    first = next(i for i, line in enumerate(lines) if line.upper().startswith("*ELEMENT"))
    last = next(i for i in range(first + 1, len(lines)) if lines[i].startswith("*") and lines[i][1] != "*")
    told = {"refused": 0, "noted": 0}
    for end in range(first + 2, last, 7):
        deck = "".join(lines[:end])
        cells = sum(line[:1].isdigit() for line in lines[first:end])
        with TemporaryDirectory() as folder:
            path = Path(folder) / "cut.inp"
            path.write_text(deck)
            try:
                mesh = read(path)
            except MeshError as error:
                assert "belong to no element; *ELEMENT, with which the file ends, seems to be cut short" in str(error)
                told["refused"] += 1
                continue
        assert len(mesh.cells) == cells
        if any("if it was cut off, cells are missing" in note for note in mesh.notes):
            told["noted"] += 1
        else:  # nothing in the file can tell: all nodes are there
            assert len(mesh.points) == 280 and cells > 700
    assert told["refused"] > 90 and told["noted"]


def test_parts_without_an_assembly_are_told(deck: Write) -> None:
    text = TWO.format(place="", sets="")
    whole, cut = read(deck(text)), read(deck(text[: text.index("*Assembly")]))
    assert (len(whole.cells), len(cut.cells)) == (12, 6)
    assert any("*PART and no *ASSEMBLY: if it was cut off, bodies are missing" in note for note in cut.notes)
    assert not any("ASSEMBLY" in note for note in whole.notes)


def test_a_set_whose_last_line_may_be_cut_is_told(deck: Write) -> None:
    text = CUBE + "*NSET, NSET=low\n1, 2, 3, 4"
    assert read(deck(text + "\n")).notes == ()
    assert read(deck(text)).notes == ("The file ends within a line of *NSET, without a line break; is the set whole?",)
