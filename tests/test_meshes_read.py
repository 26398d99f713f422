"""Meshes from file: round trips with their groups, and every file that cannot be used by its message."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

from fracsim.meshes import BUILDERS, MeshData, MeshError
from fracsim.meshes.check import check_mesh
from fracsim.meshes.random_points.outline_file import fill_outline, read_outline
from fracsim.meshes.read import read_mesh
from fracsim.meshes.write import NAMES_ARE_KEPT, write_mesh


def sample(dim: int) -> MeshData:
    return BUILDERS["box"](size=(1.0, 1.0, 2.0)[3 - dim :], h=0.5).build()


def tagged(dim: int, key: str) -> Any:
    """A meshio mesh: the sample, its left and right facets as tags 1 and 2, its cells as tags 5 and 6."""
    mesh = sample(dim)
    cell, facet = ("tetra", "triangle") if dim == 3 else ("triangle", "line")
    left, right = mesh.facet_groups["left"], mesh.facet_groups["right"]
    tags = [halves(mesh) + 5, np.full(len(left), 1, np.int32), np.full(len(right), 2, np.int32)]
    points = np.pad(mesh.points, ((0, 0), (0, 3 - dim)))
    names = {"left": np.array([1, dim - 1]), "body": np.array([5, dim])} if key == "gmsh:physical" else {}
    blocks = [(cell, mesh.cells), (facet, left), (facet, right)]
    return meshio.Mesh(points, blocks, cell_data={key: tags}, field_data=names)


def halves(mesh: MeshData) -> Any:
    up = mesh.points[mesh.cells].mean(axis=1)[:, -1]
    return (up > up.mean()).astype(np.int32)


def assert_same(read: MeshData, wanted: MeshData, left: str, right: str, regions: tuple[str, str]) -> None:
    np.testing.assert_allclose(read.points, wanted.points, atol=1e-12)
    np.testing.assert_array_equal(read.cells, wanted.cells)
    for name, like in ((left, "left"), (right, "right")):
        np.testing.assert_array_equal(read.facet_groups[name], wanted.facet_groups[like])
    for half, name in enumerate(regions):
        np.testing.assert_array_equal(read.regions[name], np.flatnonzero(halves(wanted) == half))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize(
    ("ending", "key"),
    [("vtu", "tags"), ("vtk", "tags"), ("xdmf", "tags"), ("mesh", "medit:ref"), ("bdf", "nastran:ref")],
)
def test_round_trip_with_tags(tmp_path: Path, dim: int, ending: str, key: str) -> None:
    path = tmp_path / f"part.{ending}"
    tagged(dim, key).write(path)
    read = check_mesh(read_mesh(path))
    assert read.notes == ()
    assert_same(read, sample(dim), "tag-1", "tag-2", ("tag-5", "tag-6"))


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("ending", NAMES_ARE_KEPT)
def test_what_is_written_is_read_again(tmp_path: Path, dim: int, ending: str) -> None:
    """All cells, facets and groups, by their names or by the numbers of the note."""
    mesh = sample(dim)
    mesh = replace(mesh, regions={f"half-{half}": np.flatnonzero(halves(mesh) == half) for half in (0, 1)})
    notes = write_mesh(mesh, tmp_path / f"part{ending}")
    names = [*mesh.facet_groups, *mesh.regions]
    kept = {name: name if NAMES_ARE_KEPT[ending] else f"tag-{number}" for number, name in enumerate(names, start=1)}
    assert bool(notes) != NAMES_ARE_KEPT[ending]
    assert all(f"{number} is {name}" in note for note in notes for number, name in enumerate(names, start=1))
    read = check_mesh(read_mesh(tmp_path / f"part{ending}"))
    assert_same(read, mesh, kept["left"], kept["right"], (kept["half-0"], kept["half-1"]))


@pytest.mark.parametrize("dim", [2, 3])
def test_gmsh_2_from_meshio_has_names(tmp_path: Path, dim: int) -> None:
    path = tmp_path / "part.msh"
    mesh = tagged(dim, "gmsh:physical")
    mesh.cell_data["gmsh:geometrical"] = [np.ones_like(tags) for tags in mesh.cell_data["gmsh:physical"]]
    mesh.write(path, file_format="gmsh22")
    assert_same(check_mesh(read_mesh(path)), sample(dim), "left", "tag-2", ("body", "tag-6"))


@pytest.mark.parametrize("binary", [0, 1])
@pytest.mark.parametrize(("version", "everything"), [(2.2, 0), (4.1, 0), (4.1, 1)])
def test_gmsh_files_with_overlapping_groups(tmp_path: Path, version: float, everything: int, binary: int) -> None:
    """As gmsh writes them; `everything` saves cells that are in no group as well."""
    from fracsim.meshes.gmsh_session import session

    path = tmp_path / "part.msh"
    with session() as gmsh:
        gmsh.model.occ.addBox(0, 0, 0, 1, 1, 1)
        gmsh.model.occ.synchronize()
        for tag, faces, name in ((7, [1], "left"), (8, [1, 2], "both sides"), (11, [5], "")):
            gmsh.model.addPhysicalGroup(2, faces, tag, name)
        gmsh.model.addPhysicalGroup(3, [1], 7, "body")
        gmsh.model.addPhysicalGroup(3, [1], 8, "all")
        for option, value in (("MeshSizeMax", 0.6), ("MshFileVersion", version), ("SaveAll", everything)):
            gmsh.option.setNumber(f"Mesh.{option}", value)
        gmsh.option.setNumber("Mesh.Binary", binary)
        gmsh.model.mesh.generate(3)
        gmsh.write(str(path))
    mesh = check_mesh(read_mesh(path))
    left, both = mesh.facet_groups["left"], mesh.facet_groups["both sides"]
    assert set(mesh.facet_groups) == {"left", "both sides", "tag-11"}
    assert np.all(mesh.points[left, 0] == 0) and len(both) == 2 * len(left)
    assert set(np.unique(mesh.points[both, 0])) == {0.0, 1.0}
    assert np.all(mesh.points[mesh.facet_groups["tag-11"], 2] == 0)
    np.testing.assert_array_equal(mesh.regions["body"], np.arange(len(mesh.cells)))
    np.testing.assert_array_equal(mesh.regions["all"], np.arange(len(mesh.cells)))


def test_periodic_gmsh_file_is_a_plain_mesh(tmp_path: Path) -> None:
    from fracsim.meshes.gmsh_session import session

    for version in (2.2, 4.1):
        path = tmp_path / f"periodic{version}.msh"
        with session() as gmsh:
            gmsh.model.occ.addRectangle(0, 0, 0, 1, 1)
            gmsh.model.occ.synchronize()
            gmsh.model.mesh.setPeriodic(1, [2], [4], [1, 0, 0, 1, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1])
            gmsh.option.setNumber("Mesh.MshFileVersion", version)
            gmsh.option.setNumber("Mesh.MeshSizeMax", 0.4)
            gmsh.model.mesh.generate(2)
            gmsh.write(str(path))
        mesh = check_mesh(read_mesh(path))
        assert mesh.dim == 2 and mesh.notes == ()


def test_abaqus_sets_are_groups(tmp_path: Path) -> None:
    path = tmp_path / "part.inp"
    mesh = tagged(3, "x")
    left = sample(3).facet_groups["left"]
    sets = {"grip": [[], np.arange(8), []], "low": [np.arange(10), [], []]}
    meshio.Mesh(mesh.points, mesh.cells, cell_sets=sets, point_sets={"nodes": np.unique(left)}).write(path)
    read = check_mesh(read_mesh(path))
    assert len(read.facet_groups["grip"]) == 8
    np.testing.assert_array_equal(read.regions["low"], np.arange(10))
    np.testing.assert_array_equal(np.unique(read.facet_groups["nodes"]), np.unique(left))


@pytest.mark.parametrize(("kind", "dim"), [("triangle6", 2), ("tetra10", 3)])
def test_second_order_cells_become_straight(tmp_path: Path, kind: str, dim: int) -> None:
    mesh = sample(dim)
    edges = {2: [(0, 1), (1, 2), (2, 0)], 3: [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)]}[dim]
    pairs = mesh.cells[:, edges]
    distinct, place = np.unique(np.sort(pairs.reshape(-1, 2), axis=1), axis=0, return_inverse=True)
    points = np.concatenate([mesh.points, mesh.points[distinct].mean(axis=1)])
    cells = np.concatenate([mesh.cells, len(mesh.points) + place.reshape(len(pairs), -1)], axis=1)
    path = tmp_path / "curved.vtu"
    meshio.Mesh(np.pad(points, ((0, 0), (0, 3 - dim))), [(kind, cells)]).write(path)
    read = check_mesh(read_mesh(path))
    np.testing.assert_array_equal(read.cells, mesh.cells)
    np.testing.assert_array_equal(read.points, mesh.points)
    assert read.notes == (
        f"{len(cells)} cells are of second or higher order; only their corner nodes are kept (straight edges).",
    )


def test_plane_mesh_above_the_ground_is_noted(tmp_path: Path) -> None:
    mesh = tagged(2, "tags")
    mesh.points[:, 2] = 0.25
    mesh.write(tmp_path / "plane.vtu")
    assert read_mesh(tmp_path / "plane.vtu").notes == ("The plane mesh lies at z = 0.25 m; z is left out.",)


def test_several_integer_arrays_are_told(tmp_path: Path) -> None:
    mesh = tagged(2, "tags")
    mesh.cell_data["other"] = mesh.cell_data["tags"]
    mesh.write(tmp_path / "plane.vtu")
    (note,) = read_mesh(tmp_path / "plane.vtu").notes
    assert note == "Groups come from the cell array 'tags'; not used: other."


def test_integer_array_that_numbers_cells_is_no_group(tmp_path: Path) -> None:
    mesh = BUILDERS["box"](size=(1.0, 1.0), h=0.03).build()
    points = np.pad(mesh.points, ((0, 0), (0, 1)))
    numbers = {"id": [np.arange(len(mesh.cells))]}
    meshio.Mesh(points, [("triangle", mesh.cells)], cell_data=numbers).write(tmp_path / "n.vtu")
    assert read_mesh(tmp_path / "n.vtu").regions == {}


# --- files that cannot be used --------------------------------------------------------------------------------------

CUBE = np.array([[x, y, z] for z in (0.0, 1) for y in (0.0, 1) for x in (0.0, 1)])


def test_surface_in_space_is_pointed_to_fill(tmp_path: Path) -> None:
    meshio.Mesh(CUBE, [("triangle", np.array([[0, 1, 3], [0, 4, 5]]))]).write(tmp_path / "s.vtu")
    with pytest.raises(MeshError, match=r"surface of triangles in space.*\[mesh\] surface = "):
        read_mesh(tmp_path / "s.vtu")


@pytest.mark.parametrize(
    ("cells", "message"),
    [
        (
            [("polygon", [[0, 1, 3, 2, 4, 5, 7, 6]]), ("triangle", [[0, 1, 3]])],
            "holds 1 polygon, 1 triangle; only triangles and quadrilaterals can be used",
        ),
        ([("line", [[0, 1], [1, 3]])], r"holds no triangles or tetrahedra \(2 line\)"),
    ],
)
def test_other_cells_are_named_and_counted(tmp_path: Path, cells: list[Any], message: str) -> None:
    meshio.Mesh(CUBE, [(kind, np.array(nodes)) for kind, nodes in cells]).write(tmp_path / "m.vtu")
    with pytest.raises(MeshError, match=message):
        read_mesh(tmp_path / "m.vtu")


@pytest.mark.parametrize(
    ("name", "text", "message"),
    [
        ("gone.msh", None, r"gone.msh' does not exist"),
        ("empty.vtu", "", r"empty.vtu' is empty"),
        ("part.foo", "x", r"part.foo' is of no known kind; known endings: .*\.msh.*\.vtu"),
        ("bad.vtu", "<VTKFile", r"bad.vtu' could not be read: "),
        ("bad.vtk", "hello\nworld\n", r"bad.vtk' could not be read: "),
        ("bad.mesh", "hello", r"bad.mesh' could not be read: "),
        ("bad.xdmf", "<Xdmf><Domain/></Xdmf>", r"bad.xdmf' could not be read: "),
        ("bad.stl", "no solid", r"bad.stl' could not be read: "),
        ("odd.msh", "hello", r"odd.msh' could not be read: "),
        ("cut.msh", "$MeshFormat\n4.1 0 8\n$EndMeshFormat\n$Nodes\n1 2 1 2\n2 1 0 2\n1\n2\n0 0", r"cut.msh'"),
        (
            "cut2.msh",
            "$MeshFormat\n2.2 0 8\n$EndMeshFormat\n$Nodes\n9\n1 0 0 0\n",
            r"cut2.msh., line 6: the file ends within the section .Nodes",
        ),
    ],
)
def test_files_that_cannot_be_read(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], name: str, text: str | None, message: str
) -> None:
    if text is not None:
        (tmp_path / name).write_text(text)
    with pytest.raises(MeshError, match=message):
        read_mesh(tmp_path / name)
    assert capfd.readouterr() == ("", "")


def test_folder_is_not_a_mesh(tmp_path: Path) -> None:
    with pytest.raises(MeshError, match="is a folder"):
        read_mesh(tmp_path)


def test_xdmf_without_its_h5_file(tmp_path: Path) -> None:
    tagged(3, "tags").write(tmp_path / "part.xdmf")
    (tmp_path / "part.h5").unlink()
    with pytest.raises(MeshError, match=r"part.xdmf' could not be read: .*part.h5"):
        read_mesh(tmp_path / "part.xdmf")


def test_coordinates_that_are_no_numbers_reach_the_check(tmp_path: Path) -> None:
    mesh = tagged(3, "tags")
    mesh.points[3, 2] = np.nan
    mesh.write(tmp_path / "nan.vtu")
    with pytest.raises(MeshError, match="1 nodes have coordinates that are not finite numbers: node 3"):
        check_mesh(read_mesh(tmp_path / "nan.vtu"))


@pytest.mark.parametrize("version", ["1e999", "x", "-4.1", "4" * 30])
def test_a_version_that_is_no_number(tmp_path: Path, version: str) -> None:
    """Of Gmsh's own format: a message."""
    (tmp_path / "part.msh").write_text(f"$MeshFormat\n{version} 0 8\n$EndMeshFormat\n")
    with pytest.raises(MeshError, match=r"part.msh' could not be read"):
        read_mesh(tmp_path / "part.msh")


# --- files that have lost cells -------------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", ["tetra", "tetra10"])
def test_file_that_has_lost_cells_is_refused(tmp_path: Path, kind: str) -> None:
    from fracsim.meshes.gmsh_session import session

    path = tmp_path / "part.msh"
    with session() as gmsh:
        gmsh.model.occ.addBox(0, 0, 0, 1, 1, 1)
        gmsh.model.occ.synchronize()
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.3)
        gmsh.model.mesh.generate(3)
        gmsh.model.mesh.setOrder(2 if kind == "tetra10" else 1)
        gmsh.write(str(path))
    mesh = meshio.read(path)
    cells = mesh.cells_dict[kind]
    for share, refused in ((1.0, False), (0.4, True)):
        meshio.Mesh(mesh.points, [(kind, cells[: int(share * len(cells))])]).write(tmp_path / "cut.vtu")
        if not refused:
            assert not any("belong to no cell" in note for note in check_mesh(read_mesh(tmp_path / "cut.vtu")).notes)
            continue
        lost = len(mesh.points) - len(np.unique(cells[: int(share * len(cells))]))
        with pytest.raises(MeshError, match=rf"holds {len(mesh.points)} nodes, and {lost} of them belong to no cell"):
            read_mesh(tmp_path / "cut.vtu")


def test_few_nodes_without_a_cell_are_counted(tmp_path: Path) -> None:
    """A reference point, and corners of the geometry that hold a cell of their own."""
    mesh = sample(3)
    points = np.concatenate([mesh.points, np.full((12, 3), 9.0)])
    blocks = [("tetra", mesh.cells), ("vertex", len(mesh.points) + np.arange(10)[:, None])]
    meshio.Mesh(points, blocks).write(tmp_path / "part.vtu")
    read = check_mesh(read_mesh(tmp_path / "part.vtu"))
    np.testing.assert_array_equal(read.points, mesh.points)
    assert read.notes == (f"12 of {len(points)} nodes belong to no cell and were removed.",)


def test_a_file_that_ends_gmsh_is_a_message(tmp_path: Path) -> None:
    """Of Gmsh's format 4.1, with no node by its head and 50,000 by its block: gmsh writes far past its arrays."""
    places = "".join(f"{k}.0 {k % 2}.0 {k % 3}.0\n" for k in range(50_000))
    numbers = "".join(f"{k}\n" for k in range(1, 50_001))
    nodes = f"$Nodes\n1 0 1 50000\n3 0 0 50000\n{numbers}{places}$EndNodes\n"
    (tmp_path / "part.msh").write_text(
        f"$MeshFormat\n4.1 0 8\n$EndMeshFormat\n{nodes}$Elements\n1 1 1 1\n3 0 4 1\n1 1 2 3 4\n$EndElements\n"
    )
    with pytest.raises(MeshError, match=r"part.msh' could not be read: gmsh died .signal \d+.*the file is damaged"):
        read_mesh(tmp_path / "part.msh")


def test_a_long_outline_is_too_many_cells(tmp_path: Path) -> None:
    """A sliver of no area, whose sides have a hundred billion parts: a message before there is memory for them."""
    (tmp_path / "long.csv").write_text("0, 0\n1e10, 0\n1e10, 1e-9\n")
    with pytest.raises(MeshError, match=r"would make about 2\.0e\+11 cells"):
        fill_outline(read_outline(tmp_path / "long.csv"), 0.1)


def test_an_outline_in_letters_of_windows(tmp_path: Path) -> None:
    (tmp_path / "a.csv").write_bytes("# Körper\n0, 0, Süd\n1, 0\n0, 1\n".encode("cp1252"))
    assert read_outline(tmp_path / "a.csv").groups == ("Süd", "", "")
    (tmp_path / "a.csv").write_text("0, 0\n1, 0\n0, 1\n", encoding="utf-16")
    with pytest.raises(MeshError, match=r"a.csv' is no text; save it as plain text: a line `x, y` for each corner"):
        read_outline(tmp_path / "a.csv")


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("part.odd", r"its ending is of no known format; save it as .msh, or as .*\.xdmf"),
        ("part.stl", r"such files would lose cells, facets or groups; save it as .msh, or as .*\.xdmf"),
        ("link/part.vtu", "Not a directory$|File exists$"),
    ],
)
def test_a_mesh_that_cannot_be_saved(tmp_path: Path, name: str, why: str) -> None:
    (tmp_path / "link").write_text("a file")
    with pytest.raises(MeshError, match=f"cannot save the mesh as {tmp_path / name}: .*{why}"):
        write_mesh(sample(3), tmp_path / name)
