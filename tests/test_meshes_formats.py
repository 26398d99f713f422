"""Files of many writers: cells, regions, groups and bodies of each, against readers that share no code.

The bar is 0.1 x 0.02 x 0.02 m, 760 tetrahedra on 280 nodes, in two halves; its ends have 26 triangles each.
"""

from __future__ import annotations

import os
import random
import re
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest
from scipy.io import netcdf_file
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from attack.meshes import _read as attacked
from attack.meshes import mutated
from fracsim.meshes import BUILDERS, MeshData, MeshError
from fracsim.meshes.check import check_mesh
from fracsim.meshes.msh import KINDS
from fracsim.meshes.read import read_contents, read_mesh
from fracsim.meshes.surfaces.closed import read_surface
from fracsim.meshes.time_limit import ReaderLimits, read_with_time_limit

FILES = Path(__file__).parent / "meshes"
BAR = 0.1 * 0.02 * 0.02
BRICK = 0.1 * 0.1 * 0.01
HALVES = {"steel": 380, "epoxy": 380}
ENDS = {"left": 26, "right": 26}
Table = dict[str, int]


@pytest.fixture(autouse=True)
def numbers_without_their_type() -> Iterator[None]:
    """meshio writes UGRID by repr, which is np.float64(1.0) with NumPy 2: a file that nothing reads."""
    with np.printoptions(legacy="1.25"):
        yield


# --- the table ------------------------------------------------------------------------------------------------------

EVERY: dict[str, tuple[int, Table, Table, int, float]] = {  # cells, regions, groups, bodies, volume
    "a1_cae_rp.inp": (760, {"Set-steel": 380, "Set-epoxy": 380},
                      {"Set-left": 26, "Set-right": 26, "Surf-right": 26}, 1, BAR * 1e9),
    "a1c_cae_lower.inp": (760, {"Set-steel": 380, "Set-epoxy": 380},
                          {"Set-left": 26, "Set-right": 26, "Surf-right": 26}, 1, BAR * 1e9),
    "a4_twonodes.inp": (760, HALVES, ENDS | {"OTHERS": 138}, 1, BAR),
    "a5_twoparts.inp": (760, dict.fromkeys(("all-Block", "all-Striker", "Block-1", "Striker-1"), 380), {}, 2, BAR),
    "a5b_plate_ball.inp": (1909, {"Plate-1": 712, "Ball-1": 1197}, {}, 2, np.nan),
    "a5d_three_instances.inp": (2136, dict.fromkeys(("Brick-1", "Brick-2", "Brick-3"), 712), {}, 3, 3 * BRICK),
    "a6_comment_in_elements.inp": (760, {"all": 760, "steel": 380}, ENDS, 1, BAR),
    "a7_sets_of_sets.inp": (760, HALVES | {"all": 760, "whole": 760}, ENDS | {"both": 52}, 1, BAR),
    "a8_main.inp": (760, {"all": 760}, ENDS, 1, BAR),
    "a9_c3d4h.inp": (760, {"all": 760, "steel": 380}, ENDS, 1, BAR),
    "e1_cubit_tetra.exo": (760, HALVES, ENDS | {"left_nodes": 26, "right_nodes": 26}, 1, BAR),
    "e2_libmesh_tetra4.e": (760, HALVES, ENDS | {"left_nodes": 26, "right_nodes": 26}, 1, BAR),
    "e6_tet10.e": (760, HALVES, ENDS | {"left_nodes": 26, "right_nodes": 26}, 1, BAR),
    "g22param.msh": (760, {"steel part": 380, "epoxy": 380}, ENDS, 1, BAR),
    "m1_salome.med": (760, {"acier": 380, "résine": 380},
                      dict.fromkeys(("encastré", "Traction", "Top face", "noeuds_gauche"), 26), 1, BAR),
    "m3_gmsh_nogro.med": (760, {"FAM_-10_acier": 380, "FAM_-11_résine": 380},
                          {"FAM_-6_encastré": 26, "FAM_-7_Traction_Top face": 26}, 1, BAR),
    "m4_salome_ascii.med": (760, {"acier": 380, "resine": 380},
                            dict.fromkeys(("encastre", "Traction", "Top face", "noeuds_gauche"), 26), 1, BAR),
    "v1_legacy3.vtk": (760, {"tag-10": 380, "tag-11": 380}, {"tag-1": 26, "tag-2": 26}, 1, BAR),
}  # fmt: skip


@pytest.mark.usefixtures("python_started")
@pytest.mark.parametrize("name", EVERY)
def test_every_file_has_its_cells_regions_groups_and_bodies(name: str) -> None:
    cells, regions, groups, bodies, volume = EVERY[name]
    mesh = check_mesh(read_mesh(FILES / name))
    assert len(mesh.cells) == cells
    assert {key: len(members) for key, members in mesh.regions.items()} == regions
    assert {key: len(facets) for key, facets in mesh.facet_groups.items()} == groups
    assert count_bodies(mesh) == bodies
    corners = corners_of_another_reader(FILES / name)
    np.testing.assert_allclose(sorted_corners(mesh.points[mesh.cells]), sorted_corners(corners), atol=1e-12)
    if np.isfinite(volume):
        assert volumes(corners).sum() == pytest.approx(volume, rel=1e-9)
    if bodies > 1:
        assert any(f"The mesh has {bodies} bodies that share no node" in note for note in mesh.notes)
    elif np.isfinite(volume):
        scale = np.cbrt(volume / BAR)
        for key, x in {"left": 0.0, "right": 0.1, "encastré": 0.0, "Traction": 0.1, "noeuds_gauche": 0.0}.items():
            if key in mesh.facet_groups:
                np.testing.assert_allclose(mesh.points[mesh.facet_groups[key], 0], scale * x, atol=1e-12)


SURFACES = {
    "p2_vertex_index.ply": 1e-9, "q1_vt_vn_blender_default.obj": 1e-9, "q2_vn_only.obj": 1e-9,
    "q3_colour_meshlab.obj": 1e-9, "s2_end_loop.stl": 1.0, "s4_degenerate.stl": 1.0, "s6_tjunction.stl": 1.0,
    "s8_noise.stl": 1.0,
}  # fmt: skip


@pytest.mark.parametrize("name", SURFACES)
def test_surfaces_have_the_volume_of_the_box(name: str) -> None:
    surface = read_surface(FILES / name)
    rel = {"p2_vertex_index.ply": 1e-6, "s8_noise.stl": 1e-5}.get(name, 1e-12)
    assert surface.volume == pytest.approx(60 * 40 * 20 * SURFACES[name], rel=rel)


# --- readers that share no code -------------------------------------------------------------------------------------


def volumes(corners: Any) -> Any:
    a, b, c, d = np.moveaxis(corners, 1, 0)
    return np.abs(np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a)) / 6


def sorted_corners(corners: Any) -> Any:
    """(m, 12) corners of tetrahedra in an order that does not depend on the reader."""
    whole = np.round(corners * 1e9)
    order = np.lexsort((whole[..., 2], whole[..., 1], whole[..., 0]), axis=1)
    rows = np.take_along_axis(corners, order[..., None], axis=1).reshape(len(corners), -1)
    return rows[np.lexsort(np.round(rows.T * 1e9))]


def count_bodies(mesh: MeshData) -> int:
    ends = mesh.cells[:, [0, 1, 2]].ravel(), mesh.cells[:, [1, 2, 3]].ravel()
    graph = coo_array((np.ones(len(ends[0])), ends), shape=(len(mesh.points),) * 2)
    return int(connected_components(graph, directed=False)[0])


def corners_of_another_reader(path: Path) -> Any:
    readers: dict[str, Callable[[Path], Any]] = {
        ".inp": by_lines, ".exo": by_netcdf, ".e": by_netcdf, ".msh": by_gmsh, ".med": by_h5py, ".vtk": by_words,
    }  # fmt: skip
    return readers[path.suffix](path)


def by_lines(path: Path) -> Any:
    """Tetrahedra of an Abaqus deck: a line is a node or an element; parts are placed by the lines of instances."""
    text = re.sub(
        r"(?im)^\*include, *input=(.*)$", lambda found: (path.parent / found[1].strip()).read_text(), path.read_text()
    )
    parts: dict[str, tuple[dict[int, list[float]], list[list[int]]]] = {"": ({}, [])}
    placed: list[tuple[str, list[float]]] = []
    part, state = "", ""
    for line in text.lower().splitlines():
        if line.startswith("**") or not line.strip():
            continue
        if line.startswith("*"):
            words = [word.strip() for word in line[1:].split(",")]
            state = words[0]
            names = dict(word.split("=") for word in words[1:] if "=" in word)
            if state == "part":
                part = names["name"]
                parts[part] = {}, []
            elif state in ("end part", "assembly", "end assembly"):
                part = ""
            elif state == "instance":
                placed.append((names["part"], [0.0, 0.0, 0.0]))
        elif state == "node":
            number, *place = line.split(",")
            parts[part][0][int(number)] = [float(x) for x in place]
        elif state == "element":
            parts[part][1].append([int(node) for node in line.split(",")[1:5]])
        elif state == "instance":
            placed[-1] = placed[-1][0], [float(x) for x in line.split(",")[:3]]
    corners = [
        [[parts[name][0][node] for node in nodes] for nodes in parts[name][1]] + np.array(move)
        for name, move in placed or [("", [0.0, 0.0, 0.0])]
    ]
    return np.concatenate(corners)


def by_netcdf(path: Path) -> Any:
    if path.read_bytes()[:3] == b"CDF":
        with netcdf_file(path, mmap=False) as file:
            raw = {name: values[:].copy() for name, values in file.variables.items()}
    else:
        with h5py.File(path) as file:
            raw = {name: values[()] for name, values in file.items() if isinstance(values, h5py.Dataset)}
    points = np.stack([raw[f"coord{axis}"] for axis in "xyz"], axis=1)
    return points[np.concatenate([raw["connect1"], raw["connect2"]])[:, :4] - 1]


def by_gmsh(path: Path) -> Any:
    """By gmsh's own reader, with the counts of its groups."""
    from fracsim.meshes.gmsh_session import session

    with session() as gmsh:
        gmsh.merge(str(path))
        tags, coordinates, _ = gmsh.model.mesh.getNodes()
        place = dict(zip(tags.tolist(), coordinates.reshape(-1, 3), strict=True))
        nodes = [gmsh.model.mesh.getElementsByType(kind)[1].reshape(-1, n)[:, :4] for kind, n in ((4, 4), (11, 10))]
        return np.array([[place[node] for node in cell] for cell in np.concatenate(nodes).tolist()])


def by_h5py(path: Path) -> Any:
    with h5py.File(path) as file:
        (step,) = file["ENS_MAA/Mesh_1"].values()
        points = step["NOE/COO"][()].reshape(3, -1).T
        return points[step["MAI/TE4/NOD"][()].reshape(4, -1).T - 1]


def by_words(path: Path) -> Any:
    """Of a legacy VTK file in text."""
    words = path.read_text().split()
    at = words.index("POINTS")
    points = np.array(words[at + 3 : at + 3 + 3 * int(words[at + 1])], float).reshape(-1, 3)
    at = words.index("CELLS") + 3
    cells = []
    for _ in range(int(words[at - 2])):
        size = int(words[at])
        if size == 4:
            cells.append([int(node) for node in words[at + 1 : at + 5]])
        at += size + 1
    return points[cells]


# --- MED: groups against its families by hand -------------------------------------------------------------------------


def test_groups_of_med_are_those_of_its_families() -> None:
    contents = read_contents(FILES / "m1_salome.med")
    with h5py.File(FILES / "m1_salome.med") as file:
        (step,) = file["ENS_MAA/Mesh_1"].values()
        families = {key: step[f"MAI/{key}/FAM"][()] for key in ("TE4", "TR3")}
        of_nodes = step["NOE/FAM"][()]
    for name, number in {"acier": -10, "résine": -11, "encastré": -6, "Traction": -7, "Top face": -7}.items():
        for i, key in enumerate(families):
            np.testing.assert_array_equal(contents.sets[name][i], np.flatnonzero(families[key] == number))
    np.testing.assert_array_equal(contents.point_sets["noeuds_gauche"], np.flatnonzero(of_nodes == 1))


def med(path: Path, change: Callable[[Any], None]) -> Path:
    path.write_bytes((FILES / "m1_salome.med").read_bytes())
    with h5py.File(path, "r+") as file:
        change(file)
    return path


def _second_mesh(file: Any) -> None:
    file.copy("ENS_MAA/Mesh_1", "ENS_MAA/Mesh_2")


def _wrong_node(file: Any) -> None:
    (step,) = file["ENS_MAA/Mesh_1"].values()
    step["MAI/TE4/NOD"][7] = 281


def _short(file: Any) -> None:
    (step,) = file["ENS_MAA/Mesh_1"].values()
    values = step["MAI/TE4/NOD"][:-4]
    del step["MAI/TE4/NOD"]
    step["MAI/TE4"].create_dataset("NOD", data=values).attrs["NBR"] = 760


def _no_nodes(file: Any) -> None:
    (step,) = file["ENS_MAA/Mesh_1"].values()
    del step["NOE/COO"]


def _structured(file: Any) -> None:
    file["ENS_MAA/Mesh_1"].attrs["TYP"] = 1


def test_tetrahedra_in_the_order_of_med_are_turned(tmp_path: Path) -> None:
    """Salome and gmsh write them mirrored: that is no fault to tell of."""

    def mirror(file: Any) -> None:
        (step,) = file["ENS_MAA/Mesh_1"].values()
        nodes = step["MAI/TE4/NOD"][()].reshape(4, -1)
        step["MAI/TE4/NOD"][...] = nodes[[1, 0, 2, 3]].ravel()

    mesh = check_mesh(read_mesh(med(tmp_path / "part.med", mirror)))
    assert len(mesh.cells) == 760 and mesh.notes == ()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_second_mesh, r"it holds 2 meshes \(Mesh_1, Mesh_2\); export one of them alone"),
        (_wrong_node, "a cell of its list TE4 has the node 281, and there are 280"),
        (_short, r"the list of cells TE4 .* is damaged, or not as MED has it"),
        (_no_nodes, r"the list of nodes .* is damaged"),
        (_structured, "its mesh 'Mesh_1' is a structured grid"),
    ],
)
def test_med_that_cannot_be_used(tmp_path: Path, change: Callable[[Any], None], message: str) -> None:
    with pytest.raises(MeshError, match=message + r".*Supported: one unstructured mesh of MED 3 or later; in Salome"):
        read_mesh(med(tmp_path / "part.med", change))


# --- gmsh, version 2 --------------------------------------------------------------------------------------------------


def test_types_of_gmsh_are_those_of_gmsh() -> None:
    from fracsim.meshes.gmsh_session import session

    words = {"Point": "vertex", "Line": "line", "Triangle": "triangle", "Tetrahedron": "tetra", "Pyramid": "pyramid"}
    words |= {"Quadrilateral": "quad", "Hexahedron": "hexahedron", "Prism": "wedge"}
    with session() as gmsh:
        for number, (kind, nodes) in KINDS.items():
            name, _, order, count, *_ = gmsh.model.mesh.getElementProperties(number)
            assert count == nodes
            assert kind == words[name.split()[0]] + (str(nodes) if order > 1 else "")


@pytest.mark.parametrize("binary", [0, 1])
@pytest.mark.parametrize("incomplete", [0, 1])
def test_wedges_and_hexahedra_of_gmsh_in_version_2(tmp_path: Path, binary: int, incomplete: int) -> None:
    """A swept box of second order: prisms of 15 or 18 nodes; its volume in closed form."""
    from fracsim.meshes.gmsh_session import session

    path = tmp_path / "swept.msh"
    with session() as gmsh:
        square = gmsh.model.occ.addRectangle(0, 0, 0, 2, 1)
        gmsh.model.occ.extrude([(2, square)], 0, 0, 0.5, numElements=[2], recombine=True)
        gmsh.model.occ.synchronize()
        gmsh.model.addPhysicalGroup(3, [1], 4, "Körper 1")
        gmsh.model.addPhysicalGroup(2, [square], 5)
        options = {"MshFileVersion": 2.2, "Binary": binary, "SecondOrderIncomplete": incomplete, "MeshSizeMax": 0.6}
        for option, value in options.items():
            gmsh.option.setNumber(f"Mesh.{option}", value)
        gmsh.model.mesh.generate(3)
        gmsh.model.mesh.setOrder(2)
        gmsh.write(str(path))
        kind = 18 if incomplete else 13
        wedges = len(gmsh.model.mesh.getElementsByType(kind)[0])
    contents = read_contents(path)
    assert sum(len(block.nodes) for block in contents.blocks if block.shape == "wedge") == wedges > 0
    mesh = check_mesh(read_mesh(path))
    assert volumes(mesh.points[mesh.cells]).sum() == pytest.approx(1.0)
    assert list(mesh.regions) == ["Körper 1"] and len(mesh.regions["Körper 1"]) == 3 * wedges
    assert np.all(mesh.points[mesh.facet_groups["tag-5"], 2] == 0)


MSH2 = (FILES / "g22param.msh").read_text()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("$ParametricNodes\n280", "$ParametricNodes\n281", "line 12: 281 nodes are declared, and 280 are there"),
        ("\n1 0 0 0.02 0 1\n", "\n1 0 0 O.02 0 1\n", r"line 13: `1 0 0 O.02 0 1` is not what stands here: a node is"),
        ("\n1 0 0 0.02 0 1\n", "\n1 0 0\n", "line 13: this node has 2 coordinates"),
        ("\n2 0 0 0 0 2\n", "\n1 0 0 0 0 2\n", "node 1 is listed twice"),
        ("$ParametricNodes\n280", "$ParametricNodes\n279", "line 12: 279 nodes are declared, and 280 are there"),
        ("$Elements\n812", "$Elements\n811", r"line \d+: 811 elements are declared, and 812 are there"),
        ("$EndElements\n", "", r"line \d+: the file ends within the section .Elements: it was cut off"),
        ("$Elements\n812", "$Elements\n813", r"line \d+: 813 elements are declared, and 812 are there"),
        ("2.2 0 8", "2.2 0 4", "line 2: `2.2 0 4` is not version"),
        ("$PhysicalNames", "$Physical Names", r"line 4: `.Physical Names` stands outside the sections"),
    ],
)
def test_damaged_gmsh_of_version_2(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in MSH2
    (tmp_path / "part.msh").write_text(MSH2.replace(old, new, 1))
    with pytest.raises(MeshError, match=message):
        read_mesh(tmp_path / "part.msh")


def test_nodes_of_gmsh_with_more_than_coordinates(tmp_path: Path) -> None:
    """Parameters stand in a section of their own."""
    (tmp_path / "part.msh").write_text(MSH2.replace("ParametricNodes", "Nodes"))
    with pytest.raises(MeshError, match="line 13: this node has 5 coordinates; a node is `number x y z`"):
        read_mesh(tmp_path / "part.msh")


def test_elements_of_gmsh_that_do_not_fit(tmp_path: Path) -> None:
    head, elements = MSH2.split("$Elements\n")
    lines = elements.split("\n")
    for line, message in (
        (" 99 2 21 1 1 2 3 4", "of the type 99, which is not supported"),
        (" 4 2 21 1 1 2 3", "has 9 numbers, not 8"),
        (" 4 2 21 1 1 2 3 5000", "has the node 5000, which is not among the"),
        (" 4 2 21 1 1 2 3 4.5", "is not whole"),
    ):
        wrong = [*lines[:1], lines[1].split()[0] + line, *lines[2:]]
        (tmp_path / "part.msh").write_text(head + "$Elements\n" + "\n".join(wrong))
        with pytest.raises(MeshError, match=message):
            read_mesh(tmp_path / "part.msh")


# --- universal files and Nastran --------------------------------------------------------------------------------------


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("ending", ["unv", "bdf"])
def test_what_gmsh_writes(tmp_path: Path, ending: str, order: int) -> None:
    """A bar of two halves, as gmsh has it: cells, groups and their places."""
    from fracsim.meshes.gmsh_session import session

    forms = [0, 1, 2] if ending == "bdf" else [1]
    with session() as gmsh:
        gmsh.model.occ.addBox(0, 0, 0, 0.05, 0.02, 0.02)
        gmsh.model.occ.addBox(0.05, 0, 0, 0.05, 0.02, 0.02)
        gmsh.model.occ.fragment([(3, 1)], [(3, 2)])
        gmsh.model.occ.synchronize()
        (left,) = [tag for _, tag in gmsh.model.getEntitiesInBoundingBox(-1e-3, -1, -1, 1e-3, 1, 1, 2)]
        for number, (dim, tags, name) in enumerate([(3, [1], "steel"), (3, [2], "époxy"), (3, [1, 2], "all")], start=1):
            gmsh.model.addPhysicalGroup(dim, tags, number, name)
        gmsh.model.addPhysicalGroup(2, [left], 9, "encastré")
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.008)
        gmsh.model.mesh.generate(3)
        gmsh.model.mesh.setOrder(order)
        kind, width = {1: (4, 4), 2: (11, 10)}[order]
        cells = gmsh.model.mesh.getElementsByType(kind)[1].reshape(-1, width)[:, :4]
        tags, coordinates, _ = gmsh.model.mesh.getNodes()
        place = np.zeros((int(tags.max()) + 1, 3))
        place[tags] = coordinates.reshape(-1, 3)
        for form in forms:
            gmsh.option.setNumber("Mesh.BdfFieldFormat", form)
            gmsh.write(str(tmp_path / f"part{form}.{ending}"))
    for form in forms:
        mesh = check_mesh(read_mesh(tmp_path / f"part{form}.{ending}"))
        tolerance = 1e-6 if ending == "bdf" else 1e-12  # eight columns
        np.testing.assert_allclose(
            np.sort(mesh.points[mesh.cells].mean(axis=1), axis=0),
            np.sort(place[cells].mean(axis=1), axis=0),
            atol=tolerance,
        )
        if ending == "unv":
            assert {name: len(rows) for name, rows in mesh.regions.items()} == {"steel": 380, "époxy": 380, "all": 760}
            ends = mesh.facet_groups["encastré"]
        else:  # the numbers of gmsh's volumes and surfaces
            assert {name: len(rows) for name, rows in mesh.regions.items()} == {"tag-1": 380, "tag-2": 380}
            ends = mesh.facet_groups["tag-1"]
        assert len(ends) == 26 and np.all(mesh.points[ends, 0] == 0)


def dataset(number: int, *lines: str) -> str:
    return "\n".join(["    -1", f"{number:6}", *lines, "    -1", ""])


def node(number: int, *place: float) -> tuple[str, str]:
    return f"{number:10}         1         1        11", "".join(f"{x:25.16E}" for x in place)


def element(number: int, type_: int, *nodes: int) -> list[str]:
    beam = ["         0         1         1"] if type_ < 40 else []
    rows = ["".join(f"{n:10}" for n in nodes[i : i + 8]) for i in range(0, len(nodes), 8)]
    return [f"{number:10}{type_:10}         2         1         7{len(nodes):10}", *beam, *rows]


PLACES = {1: (0, 0, 0), 2: (1, 0, 0), 3: (0, 1, 0), 4: (0, 0, 1), 15: (1, 1, 1)}
SALOME = {
    "head": dataset(164, "         1  SI: Meters (newton)         2", "    1.0E+0    1.0E+0    1.0E+0", "    2.7E+2"),
    "nodes": dataset(2411, *(line for number, place in PLACES.items() for line in node(number, *place))),
    "elements": dataset(2412, *element(1, 11, 1, 2), *element(2, 41, 1, 2, 3), *element(3, 41, 1, 2, 4),
                        *element(4, 111, 1, 2, 3, 4), *element(5, 111, 2, 3, 4, 15)),
    "groups": dataset(
        2467, "         1         0         0         0         0         0         0         2", "encastré bas",
        "         8         2         0         0         8         3         0         0",
        "         2         0         0         0         0         0         0         1", "vol 1",
        "         8         4         0         0",
        "         3         0         0         0         0         0         0         3", "noeuds",
        "         7         1         0         0         7         2         0         0",
        "         7         3         0         0",
        "         4         0         0         0         0         0         0         1", "arête",
        "         8         1         0         0",
        "         5         0         0         0         0         0         0         2", "",
        "         8         4         0         0         8         5         0         0",
    ),
}  # fmt: skip


@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_universal_file_of_salome(tmp_path: Path, end: str) -> None:
    """Groups of Salome's dataset 2467, of which some share elements; by hand."""
    (tmp_path / "part.unv").write_bytes("".join(SALOME.values()).replace("\n", end).encode())
    mesh = check_mesh(read_mesh(tmp_path / "part.unv"))
    np.testing.assert_array_equal(mesh.points, list(PLACES.values()))
    assert {name: rows.tolist() for name, rows in mesh.regions.items()} == {"vol 1": [0], "group-5": [0, 1]}
    assert {name: np.sort(rows).tolist() for name, rows in mesh.facet_groups.items()} == {
        "encastré bas": [[0, 1, 2], [0, 1, 3]], "noeuds": [[0, 1, 2]],
    }  # fmt: skip
    assert "Sets not used, for they hold neither cells nor all nodes of triangles of the boundary: arête." in mesh.notes


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("1.0000000000000000E+00", "1.0000x", "line 12: `1.0000x .*` is not what stands here: a node has a line"),
        ("        15\n", "        16\n", "element 5 has the node 16, which is not among the 5"),
        ("         4       111", "         4       112", "has 4 nodes instead of 6"),
        ("         4       111", "         4       333", "of the type 333, which is not supported"),
        ("\n         1         2         3         4\n", "\n", "this line of element 4 .*has 6 numbers"),
        ("         0         0         2\n", "         0         0        50\n", "50 members ends before"),
        ("  2411", "  2410", "it has no dataset of nodes"),
        ("    -1\n", "", "is not the line `-1` with which a universal file begins"),
    ],
)
def test_damaged_universal_files(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = "".join(SALOME.values())
    assert old in text
    (tmp_path / "part.unv").write_text(text.replace(old, new, 1))
    with pytest.raises(MeshError, match=message):
        read_mesh(tmp_path / "part.unv")


def test_universal_file_that_was_cut(tmp_path: Path) -> None:
    """At the end of any line of its last two datasets."""
    lines = "".join(SALOME.values()).splitlines(keepends=True)
    for end in range(lines.index("  2412\n"), len(lines) - 1):
        (tmp_path / "part.unv").write_text("".join(lines[:end]))
        if "".join(lines[:end]).count("    -1\n") % 2:
            with pytest.raises(MeshError, match="has no line `-1` at its end: the file was cut off"):
                read_mesh(tmp_path / "part.unv")


DECK = """$ of a pre-processor
SOL 101
CEND
TITLE = GRID of a title
BEGIN BULK
$HMNAME COMP                   7"component"
$HMNAME PROP                   7"steel part" 4
$ANSA_NAME_COMMENT;8;PSOLID;Béton;;NO;
$ Femap with NX Nastran Property 9 : foot
PSOLID         7       1
MAT1           1 2.1+11              .3
GRID           1              0.      0.      0.
GRID,2,,1.,0.,0.
grid,3,,0.0,1.0+0,0.0
GRID*                  4                             0.0             0.0
*                  1.0+0
GRID\t15\t\t1.0\t1.0\t1.0
CTETRA         1       7       1       2       3       4
CTETRA  2       8       2       3       4       15
CTRIA3         3       9       1       2       3
CONM2         90       1       0    10.0
ENDDATA
GRID          99              5.      5.      5.
"""


def test_bulk_data_of_nastran_in_all_its_fields(tmp_path: Path) -> None:
    (tmp_path / "part.bdf").write_text(DECK)
    mesh = check_mesh(read_mesh(tmp_path / "part.bdf"))
    np.testing.assert_array_equal(mesh.points, list(PLACES.values()))
    assert {name: rows.tolist() for name, rows in mesh.regions.items()} == {"steel part": [0], "Béton": [1]}
    assert {name: np.sort(rows).tolist() for name, rows in mesh.facet_groups.items()} == {"foot": [[0, 1, 2]]}
    assert mesh.notes == ("Not used: 1 CONM2.",)
    (tmp_path / "part.dat").write_text(DECK)
    assert len(read_mesh(tmp_path / "part.dat").cells) == 2


def test_tetrahedra_of_first_and_second_order_beside_each_other(tmp_path: Path) -> None:
    """gmsh 4.13 leaves out the second one without a word."""
    places = [(0.5, 0, 0), (0.5, 0.5, 0), (0, 0.5, 0), (0, 0, 0.5), (0.5, 0, 0.5), (0, 0.5, 0.5)]
    middles = "".join(f"GRID,{n},,{x},{y},{z}\n" for n, (x, y, z) in enumerate(places, start=20))
    first = "CTETRA         1       7       1       2       3       4"
    assert first in DECK
    second = first + "      20      21+A\n+A            22      23      24      25"
    deck = DECK.replace(first, middles + second)
    (tmp_path / "part.bdf").write_text(deck)
    mesh = check_mesh(read_mesh(tmp_path / "part.bdf"))
    assert len(mesh.cells) == 2 and len(mesh.points) == 5


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("ENDDATA", "", "ends without ENDDATA behind BEGIN BULK: it was cut off"),
        ("GRID,2,,1.", "GRID,2,5,1.", "line 13: GRID 2 is in the coordinate system 5; export the nodes in basic"),
        ("GRID,2,,1.", "GRID,2,,l.", "line 13: `l.` is no coordinate"),
        ("CTETRA  2       8       2", "CTETRA  2       8       22", "element 2 has the node 22, which is not among"),
        ("       3       4       15", "       3       4", "is not the number of a node of CTETRA 2"),
        ("CTETRA  2", "CTETRA  1", "line 19: element 1 is given a second time"),
        ("CTETRA  2", "CTRIAX  2", "line 19: CTRIAX is axisymmetric, which is not supported"),
        ("PSOLID         7", "?#       ", "line 10: `.#` is no name of a bulk data entry"),
        ("PSOLID  ", "INCLUDE 'a.bdf'", "line 10: INCLUDE is not supported; put the mesh into one file"),
    ],
)  # fmt: skip
def test_damaged_bulk_data(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in DECK
    (tmp_path / "part.bdf").write_text(DECK.replace(old, new, 1))
    with pytest.raises(MeshError, match=message):
        read_mesh(tmp_path / "part.bdf")


# --- what meshio reads ------------------------------------------------------------------------------------------------

SCRAPS = re.compile(
    r"Error|Traceback|object has no|must be|invalid literal|out of range|not enough values|np\.|codec|Expected|"
    r"could not convert|unpack|index \d+ is|list index|substring|NoneType|unhashable|'[a-z]+\d+'"
)
MESHIO = {
    "part.su2": None, "part.vol": "netgen", "part.avs": "avsucd", "part.dat": "tecplot",
    "part.ele": "tetgen", "part.xdmf": None, "part.h5m": None, "part.ply": None,
    "part.f3grid": None, "part.xml": "dolfin-xml", "part.cgns": None, "part.mdpa": None, "part.ugrid": None,
    "part.hmf": None,
}  # fmt: skip


@pytest.mark.parametrize("name", MESHIO)
def test_no_text_of_python_reaches_a_user(tmp_path: Path, name: str) -> None:
    """Files of all formats that meshio reads, cut off, and with a word in the place of a number."""
    box = BUILDERS["box"](size=(1.0, 1.0, 1.0), h=0.5).build()
    cells = [("triangle", box.cells[:, :3])] if name.endswith(".ply") else [("tetra", box.cells)]
    if name == "part.ply":
        meshio.Mesh(box.points, cells).write(tmp_path / name, binary=False)
    else:
        meshio.Mesh(box.points, cells).write(tmp_path / name, file_format=MESHIO[name])
    whole = (tmp_path / name).read_bytes()
    read_contents(tmp_path / name)  # is read as it is
    refused = 0
    for part in (0.4, 0.9):
        at = int(part * len(whole))
        number = re.compile(rb"\d+").search(whole, at)
        for data in (whole[:at], whole[: number.start()] + b"what" + whole[number.end() :] if number else whole[:at]):
            (tmp_path / name).write_bytes(data)
            try:
                read_contents(tmp_path / name)
            except MeshError as error:
                refused += 1
                assert str(error).startswith(f"Mesh file '{tmp_path / name}'")
                said = str(error).replace(str(tmp_path), "")
                assert not SCRAPS.search(re.sub("`.*?`", "", said)), said
                assert "export" in said.lower() or "save" in said.lower(), said
    assert refused >= 2


def test_the_line_at_which_a_reader_stopped(tmp_path: Path) -> None:
    box = BUILDERS["box"](size=(1.0, 1.0, 1.0), h=0.5).build()
    path = tmp_path / "part.avs"
    meshio.Mesh(box.points, [("tetra", box.cells)]).write(path, file_format="avsucd")
    lines = path.read_text().split("\n")
    at = next(i for i, line in enumerate(lines) if " tet " in line) + 3
    lines[at] = lines[at].rpartition(" ")[0] + " x7"
    path.write_text("\n".join(lines))
    where = rf"stopped at line {at + 1}: `{re.escape(' '.join(lines[at].split()))}`"
    with pytest.raises(MeshError, match=rf"no file of the format AVS UCD.*{where}"):
        read_mesh(path)


@pytest.mark.usefixtures("python_started")
def test_a_reader_that_does_not_end_is_ended(tmp_path: Path) -> None:
    """Here one that waits for a pipe, which `read_mesh` would refuse before."""
    os.mkfifo(tmp_path / "part.xyz")
    with pytest.raises(MeshError, match=r"part.xyz' could not be read: it did not end within 1 s; the file is damaged"):
        read_with_time_limit(tmp_path / "part.xyz", Path.read_bytes, "it", limits=ReaderLimits(seconds=1.0))
    with pytest.raises(MeshError, match="is a named pipe, not a file"):
        read_mesh(tmp_path / "part.xyz")


# --- Medit and OFF ----------------------------------------------------------------------------------------------------

FREEFEM = """MeshVersionFormatted 1

Dimension
2

Identifier
";1, Date: 26/11/25 14:55 40s"

Geometry
"/home/user/part.mesh.gmsh"

Vertices
5
0 0 4
1 0 1
1 1 1
0 1 3
.5 .5 0

Edges
4
1 2 1
2 3 2
3 4 3
4 1 4

Triangles
4
1 2 5 7
2 3 5 7
3 4 5 8
4 1 5 8

SubDomainFromMesh
1
3 1 1 0

SubDomainFromGeom
1
2 1 1 0

VertexOnGeometricVertex
1
 1 1

End
"""


def test_plane_mesh_of_freefem(tmp_path: Path) -> None:
    """With the sections that FreeFem 4.15 writes behind the cells."""
    (tmp_path / "part.mesh").write_text(FREEFEM)
    mesh = check_mesh(read_mesh(tmp_path / "part.mesh"))
    np.testing.assert_array_equal(mesh.points, [[0, 0], [1, 0], [1, 1], [0, 1], [0.5, 0.5]])
    assert {name: rows.tolist() for name, rows in mesh.regions.items()} == {"tag-7": [0, 1], "tag-8": [2, 3]}
    groups = {name: sorted(rows[0].tolist()) for name, rows in mesh.facet_groups.items()}
    assert groups == {"tag-1": [0, 1], "tag-2": [1, 2], "tag-3": [2, 3], "tag-4": [0, 3]}
    assert mesh.notes == ()


@pytest.mark.parametrize("order", [1, 2])
def test_medit_of_gmsh(tmp_path: Path, order: int) -> None:
    """Numbers of nodes and tetrahedra as gmsh has them, and the volume in closed form."""
    from fracsim.meshes.gmsh_session import session

    with session() as gmsh:
        gmsh.model.occ.addBox(0, 0, 0, 1, 1, 1)
        gmsh.model.occ.synchronize()
        gmsh.model.mesh.generate(3)
        gmsh.model.mesh.setOrder(order)
        gmsh.write(str(tmp_path / "part.mesh"))
        kind, width = {1: (4, 4), 2: (11, 10)}[order]
        count = len(gmsh.model.mesh.getElementsByType(kind)[0])
        nodes = len(gmsh.model.mesh.getNodes()[0])
    contents = read_contents(tmp_path / "part.mesh")
    (cells,) = [block.nodes for block in contents.blocks if block.shape == "tetra"]
    assert cells.shape == (count, width) and len(contents.points) == nodes
    assert volumes(contents.points[cells[:, :4]]).sum() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("Vertices\n5", "Vertices\n6", "line 12: the section Vertices declares 6 entries of 3 numbers, and holds 5"),
        ("1 1 1\n", "1 1\n", "line 16: the section Vertices declares 5 entries of 3 numbers, and holds 4.6"),
        ("1 1 1\n", "1 1 x\n", "line 16: `1 1 x` is not what stands here"),
        ("2 3 5 7", "2 9 5 7", "the triangle number 2 has a node that is not among the 5 vertices"),
        ("2 3 5 7", "2 3.5 5 7", "entry 2 of Triangles has a number that is not whole"),
        ("Dimension\n2", "Dimension\n4", "the dimension is 2 or 3"),
        ("MeshVersionFormatted 1", "hello", "begins with `hello`, not with MeshVersionFormatted"),
        ("Vertices\n", "Corners\n", "it has no section Vertices"),
    ],
)
def test_damaged_medit(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in FREEFEM
    (tmp_path / "part.mesh").write_text(FREEFEM.replace(old, new, 1))
    with pytest.raises(MeshError, match=message):
        read_mesh(tmp_path / "part.mesh")


def test_medit_without_its_end_is_told(tmp_path: Path) -> None:
    (tmp_path / "part.mesh").write_text(FREEFEM.replace("End\n", ""))
    assert read_mesh(tmp_path / "part.mesh").notes == (
        "The file lacks the keyword End: if it was cut off, cells are missing.",
    )


TETRAHEDRON = ["0 0 0", "1 0 0", "0 1 0", "0 0 1"]
FACES = ["3 0 2 1", "3 0 1 3", "3 1 2 3", "3 2 0 3"]


@pytest.mark.parametrize(
    "lines",
    [
        ["OFF", "4 4 6", *TETRAHEDRON, *FACES],
        ["OFF 4 4 0", *TETRAHEDRON, *FACES],  # gmsh
        ["NOFF", "4 4 0", *(f"{point} 0.1 0.2 0.3 " for point in TETRAHEDRON), *FACES],  # MeshLab
        ["# of a program", "COFF", "4 4 0", "", *(f"{point} 9 9 9 255" for point in TETRAHEDRON), *FACES],
        ["OFF", "4 4 0", *TETRAHEDRON, *(f"{face} 255 0 0 # red" for face in FACES)],
    ],
)
def test_off_of_several_writers(tmp_path: Path, lines: list[str]) -> None:
    (tmp_path / "part.off").write_text("\n".join(lines) + "\n")
    assert read_surface(tmp_path / "part.off").volume == pytest.approx(1 / 6)


@pytest.mark.parametrize(
    ("lines", "message"),
    [
        (["OFF", "4 5 0", *TETRAHEDRON, *FACES], "line 10: 4 points and 5 faces are declared, and 8 lines are there"),
        (["OFF", "4 4 0", "0 0", *TETRAHEDRON[1:], *FACES], "line 3: a point has three coordinates"),
        (["OFF", "4 4 0", *TETRAHEDRON, "3 0 2 4", *FACES[1:]], "line 7: a corner is none of the 4 points"),
        (["OFF", "4 4 0", *TETRAHEDRON, "4 0 2 1", *FACES[1:]], "line 7: the corners are too few or too many"),
        (["OFF", "4 4 0", *TETRAHEDRON, "3 O 2 1", *FACES[1:]], "line 7: `3 O 2 1` is not what stands here"),
        (["off"], "line 1: `off` is not OFF"),
        (["OFF"], "line 1: no numbers of points and faces"),
    ],
)
def test_damaged_off(tmp_path: Path, lines: list[str], message: str) -> None:
    (tmp_path / "part.off").write_text("\n".join(lines) + "\n")
    with pytest.raises(MeshError, match=message):
        read_surface(tmp_path / "part.off")


@pytest.mark.filterwarnings("error")
@pytest.mark.parametrize("ending", ["msh", "unv", "bdf", "mesh", "off"])
def test_changed_files_are_read_or_refused(tmp_path: Path, ending: str) -> None:
    """100 of each format: no other error, and no warning of NumPy's."""
    off = "\n".join(["OFF", "4 4 0", *TETRAHEDRON, *FACES, ""])
    whole = {"msh": MSH2, "unv": "".join(SALOME.values()), "bdf": DECK, "mesh": FREEFEM, "off": off}[ending].encode()
    chance, path = random.Random(1), tmp_path / f"part.{ending}"
    refused = 0
    for _ in range(100):
        path.write_bytes(mutated(whole, chance) or b"?")
        try:
            read_contents(path)
        except MeshError as error:
            refused += 1
            assert str(error).startswith(f"Mesh file '{path}'")
    assert refused > 30


PLY = (FILES / "p2_vertex_index.ply").read_text()


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("4 2 0 4 6\n", "", "line 23: the file ends after 13 lines of data, and declares 8 vertex, 6 face"),
        (
            "0.060000 0.000000 0.000000",
            "0.060000 O.000000 0.000000",
            "line 12: `0.060000 O.000000 .* is not what",
        ),
        ("end_header\n", "", "line 1: `ply` does not begin the head of PLY"),
        (
            "property float y\n",
            "property floor y\n",
            "no file of the format PLY.* as PLY, STL or OBJ .Blender, MeshLab",
        ),
        ("4 0 2 3 1", "4 0 2", "line 19: `4 0 2` holds more or fewer numbers than a face has"),
        ("4 0 2 3 1", "3 0 2 3 1", r"line 19: `3 0 2 3 1` holds more .* declares 8 vertex, 6 face"),
        ("element face 6", "element face 5", "line 24: the file declares 8 vertex, 5 face, 13 lines .* and holds 14"),
    ],
)
def test_damaged_ply(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert old in PLY
    (tmp_path / "part.ply").write_text(PLY.replace(old, new, 1))
    with pytest.raises(MeshError, match=message):
        read_surface(tmp_path / "part.ply")


@pytest.mark.parametrize("ending", ["ply", "su2", "ele", "node"])
@pytest.mark.parametrize("less", [1, 2])
def test_numbers_declared_too_small(tmp_path: Path, ending: str, less: int) -> None:
    """Of cells or nodes, in files of formats that meshio reads."""
    box = BUILDERS["box"](size=(1.0, 1.0, 1.0), h=0.5).build()
    count = len(box.points) if ending == "node" else len(box.cells)
    path = tmp_path / f"part.{ending}"
    cells = [("triangle", box.cells[:, :3])] if ending == "ply" else [("tetra", box.cells)]
    meshio.Mesh(box.points, cells).write(path)
    data = path.read_bytes()
    assert len(read_contents(path).blocks[0].nodes) == len(box.cells)
    head = {"ply": b"element face ", "su2": b"NELEM= "}.get(ending, b"\n")
    old, new = (
        head + str(number).encode() + (b"\n" if ending in ("ply", "su2") else b" ") for number in (count, count - less)
    )
    assert data.count(old) == 1
    path.write_bytes(data.replace(old, new))
    with pytest.raises(MeshError, match=rf"part.{ending}'.*{count - less}.*(declared|left behind)"):
        read_contents(path)


@pytest.mark.parametrize(
    ("ending", "kind"), [("ugrid", ""), ("lb8.ugrid", "<i4"), ("b8l.ugrid", ">i8"), ("lr8.ugrid", "<i4")]
)
def test_ugrid_that_declares_too_few(tmp_path: Path, ending: str, kind: str) -> None:
    box = BUILDERS["box"](size=(1.0, 1.0, 1.0), h=0.5).build()
    path = tmp_path / f"part.{ending}"
    meshio.Mesh(box.points, [("tetra", box.cells)]).write(path)
    data = path.read_bytes()
    assert len(read_contents(path).blocks[0].nodes) == len(box.cells)
    heads = []
    for count in (len(box.cells), len(box.cells) - 1):
        head = [len(box.points), 0, 0, count, 0, 0, 0]
        heads.append(np.array(head, kind).tobytes() if kind else " ".join(map(str, head)).encode())
    assert data.count(heads[0]) == 1
    path.write_bytes(data.replace(*heads))
    with pytest.raises(
        MeshError, match=r"ugrid'.*27 points and cells \(47 tetra\), and \d+ bytes are left behind them"
    ):
        read_contents(path)


def test_elements_of_su2_of_unknown_types(tmp_path: Path) -> None:
    box = BUILDERS["box"](size=(1.0, 1.0, 1.0), h=0.5).build()
    path = tmp_path / "part.su2"
    meshio.Mesh(box.points, [("tetra", box.cells)]).write(path)
    lines = path.read_text().split("\n")
    at = next(i for i, line in enumerate(lines) if line.startswith("10 ")) + 2
    for word in ("11", "14"):
        path.write_text("\n".join([*lines[:at], word + lines[at][2:], *lines[at + 1 :]]))
        with pytest.raises(
            MeshError, match=rf"line {at + 1}: an element has the type {word} and 4 numbers behind it; supported"
        ):
            read_contents(path)


# --- never slow -------------------------------------------------------------------------------------------------------


def test_many_properties_are_no_regions(tmp_path: Path) -> None:
    """A property a cell, as of composites: without a name they are no groups, and the time grows linearly."""
    count = 2000
    cells = "".join(f"CTETRA,{i},{i},1,2,3,4\n" for i in range(1, count + 1))
    grids = "".join(f"GRID,{number},,{x},{y},{z}\n" for number, (x, y, z) in PLACES.items())
    (tmp_path / "part.bdf").write_text(f'BEGIN BULK\n$HMNAME PROP 5"five"\n{grids}{cells}ENDDATA\n')
    contents = read_contents(tmp_path / "part.bdf")
    assert {name: rows[0].tolist() for name, rows in contents.sets.items()} == {"five": [4]}
    assert contents.notes == ("Not used: 1999 properties without a name, too many to mean groups of cells.",)


def test_universal_file_with_types_in_turn(tmp_path: Path) -> None:
    """40,000 elements of which no two beside each other are of one type: all are read, in time."""
    begin = time.process_time()
    rows = [line for i in range(20000)
            for line in element(2 * i + 1, 111, 1, 2, 3, 4) + element(2 * i + 2, 41, 1, 2, 3)]  # fmt: skip
    (tmp_path / "part.unv").write_text(SALOME["nodes"] + dataset(2412, *rows))
    blocks = {block.kind: len(block.nodes) for block in read_contents(tmp_path / "part.unv").blocks}
    assert blocks == {"tetra": 20000, "triangle": 20000}
    assert time.process_time() - begin < 20


@pytest.mark.parametrize(("type_", "kind"), [("3 2 0 1", "quad"), ("4 2 0 1", "")])
def test_a_tetrahedron_that_became_a_quadrilateral_is_told(tmp_path: Path, type_: str, kind: str) -> None:
    """Types of four nodes differ by one digit: the number of elements and of numbers is as declared."""
    mesh = BUILDERS["box"](size=(1.0, 1.0, 1.0), h=0.5).build()
    elements = [f"{i} 4 2 0 1 " + " ".join(map(str, row)) for i, row in enumerate(mesh.cells + 1, 1)]
    elements[20] = elements[20].replace("4 2 0 1", type_, 1)
    nodes = [f"{i} {x} {y} {z}" for i, (x, y, z) in enumerate(mesh.points, 1)]
    lines = ["$MeshFormat", "2.2 0 8", "$EndMeshFormat", "$Nodes", str(len(nodes)), *nodes, "$EndNodes"]
    lines += ["$Elements", str(len(elements)), *elements, "$EndElements", ""]
    (tmp_path / "a.msh").write_text("\n".join(lines))
    notes = [note for note in read_mesh(tmp_path / "a.msh").notes if "no facets of its cells" in note]
    assert [note.partition(" on nodes")[0] for note in notes] == ([f"1 {kind}"] if kind else [])


def test_facets_and_shells_beside_the_body_are_not_told(tmp_path: Path) -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [2, 0, 0], [2, 1, 0]], float)
    cells = [("tetra", np.array([[0, 1, 2, 3]])), ("triangle", np.array([[2, 1, 0], [1, 4, 5]]))]
    meshio.write(tmp_path / "a.vtu", meshio.Mesh(points, cells))
    assert not any("no facets" in note for note in read_mesh(tmp_path / "a.vtu").notes)


def test_a_quadrilateral_of_second_order_in_place_of_a_hexahedron(tmp_path: Path) -> None:
    points = np.array([[x, y, z] for z in range(3) for y in range(2) for x in range(2)], float)
    cube = np.array([0, 1, 3, 2, 4, 5, 7, 6])
    meshio.write(tmp_path / "a.vtu", meshio.Mesh(points, [("hexahedron", cube[None]), ("quad8", 4 + cube[None])]))
    assert any(note.startswith("1 quad8 on nodes of the body") or "belong to no cell" in note
               for note in check_mesh(read_mesh(tmp_path / "a.vtu")).notes)  # fmt: skip


@pytest.mark.parametrize(("name", "format_"), [("a.mdpa", None), ("a.post", "permas"), ("a.f3grid", "flac3d")])
def test_a_lost_line_is_told_where_the_format_has_no_count(tmp_path: Path, name: str, format_: str | None) -> None:
    mesh = BUILDERS["box"](size=(1.0, 1.0, 1.0), h=0.5).build()
    options = {"binary": False} if format_ == "flac3d" else {}
    meshio.write(tmp_path / name, meshio.Mesh(mesh.points, [("tetra", mesh.cells)]), file_format=format_, **options)
    assert not any("left out" in note for note in read_contents(tmp_path / name).notes)
    lines = (tmp_path / name).read_text(encoding="utf-8").splitlines(keepends=True)
    fifth = next(i for i, line in enumerate(lines) if re.match(r"(Z T4 )?\s*5 (0 )?\s*(\d+ ){3}\d+\s*$", line))
    (tmp_path / name).write_text("".join(lines[:fifth] + lines[fifth + 1 :]), encoding="utf-8")
    assert any("Element numbers left out: 1, first 5" in note for note in read_contents(tmp_path / name).notes)


def test_surfaces_with_faces_of_two_corners_can_be_attacked(tmp_path: Path) -> None:
    (tmp_path / "a.obj").write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2\nf 1 2 3\n")
    assert len(attacked(tmp_path / "a.obj", True)[0]) == 1
