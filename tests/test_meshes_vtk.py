"""Files of VTK and Exodus, each against a reader that shares no code: netCDF by hand, h5py, meshio, or as written."""

from __future__ import annotations

import os
import re
import shutil
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest
from scipy.io import netcdf_file

from fracsim.meshes import BUILDERS, MeshError
from fracsim.meshes.check import check_mesh
from fracsim.meshes.exodus import missing_bytes
from fracsim.meshes.read import read_contents, read_mesh

HERE = Path(__file__).parent / "meshes"
EXODUS = ["e1_cubit_tetra.exo", "e2_libmesh_tetra4.e", "e6_tet10.e"]
SIDES = np.array([[0, 1, 3], [1, 2, 3], [0, 3, 2], [0, 2, 1]])  # of a tetrahedron of Exodus
VOLUME = 0.1 * 0.02 * 0.02  # of the bar


def by_hand(path: Path) -> dict[str, Any]:
    """The variables of a netCDF file."""
    if path.read_bytes()[:3] == b"CDF":
        with netcdf_file(path, mmap=False) as file:
            return {name: values[:].copy() for name, values in file.variables.items()}
    with h5py.File(path) as file:
        return {name: values[()] for name, values in file.items()}


def names(rows: Any) -> list[str]:
    return [row.tobytes().rstrip(b"\0").decode() for row in rows]


def volumes(points: Any, cells: Any) -> Any:
    a, b, c, d = (points[cells[:, i]] for i in range(4))
    return np.einsum("ij,ij->i", np.cross(b - a, c - a), d - a) / 6


def sorted_rows(rows: Any) -> Any:
    rows = np.sort(rows, axis=1)
    return rows[np.lexsort(rows.T)]


@pytest.mark.parametrize("name", EXODUS)
def test_exodus_is_as_netcdf_has_it(name: str) -> None:
    raw, mesh = by_hand(HERE / name), read_mesh(HERE / name)
    cells = np.concatenate([raw["connect1"], raw["connect2"]]) - 1
    points = np.stack([raw[f"coord{axis}"] for axis in "xyz"], axis=1)
    np.testing.assert_array_equal(mesh.points[mesh.cells], points[cells[:, :4]])
    assert len(mesh.cells) == 760 and abs(volumes(mesh.points, mesh.cells).sum() / VOLUME - 1) < 1e-9
    assert list(mesh.regions) == names(raw["eb_names"]) == ["steel", "epoxy"]
    np.testing.assert_array_equal(mesh.regions["epoxy"], np.arange(len(raw["connect1"]), 760))
    for i, side in enumerate(names(raw["ss_names"]), start=1):
        facets = cells[raw[f"elem_ss{i}"][:, None] - 1, SIDES[raw[f"side_ss{i}"] - 1]]
        places = mesh.points[np.unique(mesh.facet_groups[side])]
        assert len(mesh.facet_groups[side]) == len(facets)
        np.testing.assert_array_equal(np.sort(places, axis=0), np.sort(points[np.unique(facets)], axis=0))
    nodes = read_contents(HERE / name).point_sets
    for i, key in enumerate(names(raw["ns_names"]), start=1):
        np.testing.assert_array_equal(nodes[key], np.sort(raw[f"node_ns{i}"]) - 1)
        assert len(mesh.facet_groups[key]) == 26  # the same face as the side set


def exodus(path: Path, version: int = 2, results: bool = False) -> Path:
    """Two tetrahedra in two blocks, numbers 7 and 3, of which the second has no name; a side set and a node set."""
    with netcdf_file(path, "w", version=version) as file:
        file.api_version = file.version = np.float32(5.1)
        file.floating_point_word_size, file.file_size, file.maximum_name_length = map(np.int32, (8, 1, 100))
        sizes = {"time_step": None, "len_string": 33, "len_name": 101, "num_dim": 3, "num_nodes": 5, "num_elem": 2}
        sizes |= {"num_el_blk": 2, "num_el_in_blk1": 1, "num_nod_per_el1": 4, "num_el_in_blk2": 1}
        sizes |= {"num_nod_per_el2": 4, "num_side_sets": 1, "num_side_ss1": 1, "num_node_sets": 1, "num_nod_ns1": 3}
        for name, size in (sizes | ({"num_nod_var": 3} if results else {})).items():
            file.createDimension(name, size)

        def put(variable_name: str, kind: str, dimensions: str, values: Any, **attributes: Any) -> None:
            variable = file.createVariable(variable_name, kind, tuple(dimensions.split()))
            variable[:] = values
            for key, value in attributes.items():
                setattr(variable, key, value)

        points = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1], [1, 1, 1]]
        for axis, values in zip("xyz", np.array(points, float).T, strict=True):
            put(f"coord{axis}", "d", "num_nodes", values)
        put("eb_status", "i", "num_el_blk", [1, 1])
        put("eb_prop1", "i", "num_el_blk", [7, 3], name="ID")
        put("eb_names", "c", "num_el_blk len_name", text([LONG, ""], 101))
        put("connect1", "i", "num_el_in_blk1 num_nod_per_el1", [[1, 2, 3, 4]], elem_type="TETRA")
        put("connect2", "i", "num_el_in_blk2 num_nod_per_el2", [[2, 3, 4, 5]], elem_type="TETRA")
        for kind, number in (("side_sets", 2), ("node_sets", 1)):
            put(f"{kind[0]}s_status", "i", f"num_{kind}", [1])
            put(f"{kind[0]}s_prop1", "i", f"num_{kind}", [number], name="ID")
        put("elem_ss1", "i", "num_side_ss1", [1])
        put("side_ss1", "i", "num_side_ss1", [4])
        put("node_ns1", "i", "num_nod_ns1", [1, 2, 4])
        if results:
            put("name_nod_var", "c", "num_nod_var len_name", text(["displ_x", "displ_y", "displ_z"], 101))
            put("time_whole", "d", "time_step", [1.0])
            for i in range(3):
                put(f"vals_nod_var{i + 1}", "d", "time_step num_nodes", [[5.0] * 5])
    return path


LONG = "é a name of a block that goes on for more than 64 letters, and then some"


def text(words: list[str], size: int) -> Any:
    return np.array([list(word.encode().ljust(size, b"\0")) for word in words], np.uint8).view("S1")


def test_exodus_without_names_has_numbers(tmp_path: Path) -> None:
    mesh = read_mesh(exodus(tmp_path / "two.exo"))
    nodes = {name: sorted(mesh.cells[cells].ravel().tolist()) for name, cells in mesh.regions.items()}
    assert nodes == {LONG: [0, 1, 2, 3], "block-3": [1, 2, 3, 4]}
    np.testing.assert_array_equal(mesh.facet_groups["side-2"], [[0, 2, 1]])
    np.testing.assert_array_equal(np.sort(mesh.facet_groups["nodes-1"]), [[0, 1, 3]])
    assert mesh.notes == ()


def test_exodus_results_do_not_move_the_nodes(tmp_path: Path) -> None:
    mesh = read_mesh(exodus(tmp_path / "moved.g", results=True))
    assert mesh.points.max() == 1.0
    assert mesh.notes == ("Not used: results on nodes (displ_).",)


@pytest.mark.parametrize("version", [1, 2])
def test_netcdf_that_was_cut_off_is_refused(tmp_path: Path, version: int) -> None:
    """netCDF's library reads zeros beyond the end of a file."""
    whole = exodus(tmp_path / "whole.exo", version, results=True)
    assert missing_bytes(whole) is not None and -4 < int(missing_bytes(whole) or 0) <= 0
    (tmp_path / "cut.exo").write_bytes(whole.read_bytes()[:-9])
    with pytest.raises(MeshError, match=r"cut.exo' could not be read: it is \d bytes shorter than its header says"):
        read_mesh(tmp_path / "cut.exo")
    (tmp_path / "odd.exo").write_bytes(whole.read_bytes()[:100])
    with pytest.raises(MeshError, match="its netCDF header is damaged"):
        read_mesh(tmp_path / "odd.exo")
    (tmp_path / "odd.g").write_text("solid part")
    with pytest.raises(MeshError, match=r"begins with b'solid pa', not as netCDF does.*Cubit"):
        read_mesh(tmp_path / "odd.g")


# --- VTK ------------------------------------------------------------------------------------------------------------


def legacy() -> tuple[Any, dict[str, Any], dict[str, Any]]:
    """Points, cells and tags of v1_legacy3.vtk, word by word."""
    words = (HERE / "v1_legacy3.vtk").read_text().split()

    def numbers(word: str, skip: int, count: int) -> Any:
        start = words.index(word) + skip
        return np.array(words[start : start + count], float)

    points = numbers("POINTS", 3, 3 * 280).reshape(-1, 3)
    table, types = numbers("CELLS", 3, 4008).astype(int), numbers("CELL_TYPES", 2, 812)
    tags = numbers("LOOKUP_TABLE", 2, 812).astype(int)
    assert np.array_equal(types, [5] * 52 + [10] * 760)
    cells = {"triangle": table[: 52 * 4].reshape(-1, 4)[:, 1:], "tetra": table[52 * 4 :].reshape(-1, 5)[:, 1:]}
    return points, cells, {"triangle": tags[:52], "tetra": tags[52:]}


def bar() -> meshio.Mesh:
    """The bar with its regions as `region`, its nodes at x = 0 as `held`."""
    points, cells, tags = legacy()
    data = {"held": (points[:, 0] == 0).astype(np.int32), "T": points[:, 1]}
    return meshio.Mesh(points, list(cells.items()), cell_data={"region": list(tags.values())}, point_data=data)


def assert_bar(path: Path, notes: tuple[str, ...] = ("Not used: the point arrays T.",)) -> None:
    (points, cells, tags), mesh = legacy(), check_mesh(read_mesh(path))
    np.testing.assert_allclose(mesh.points, points, atol=1e-12)  # decimals
    assert len(mesh.cells) == 760 and mesh.notes == notes
    np.testing.assert_array_equal(np.sort(mesh.cells), np.sort(cells["tetra"]))
    for region in (10, 11):
        np.testing.assert_array_equal(mesh.regions[f"tag-{region}"], np.flatnonzero(tags["tetra"] == region))
    for side in (1, 2):
        facets = cells["triangle"][tags["triangle"] == side]
        np.testing.assert_array_equal(sorted_rows(mesh.facet_groups[f"tag-{side}"]), sorted_rows(facets))


def test_regions_of_legacy_vtk() -> None:
    """`SCALARS material int 1`."""
    assert_bar(HERE / "v1_legacy3.vtk", ())


@pytest.mark.parametrize(
    ("name", "how"),
    [
        ("a.vtk", {"file_format": "vtk42", "binary": False}),
        ("b.vtk", {"file_format": "vtk42", "binary": True}),
        ("c.vtk", {"file_format": "vtk51", "binary": False}),
        ("d.vtk", {"file_format": "vtk51", "binary": True}),
        ("a.vtu", {"binary": False}),
        ("b.vtu", {"binary": True}),
        ("c.VTU", {"binary": True, "compression": None, "file_format": "vtu"}),
    ],
)
def test_vtk_as_meshio_writes_it(tmp_path: Path, name: str, how: dict[str, Any]) -> None:
    bar().write(tmp_path / name, **how)
    assert_bar(tmp_path / name)
    assert len(read_mesh(tmp_path / name).facet_groups["held"]) == 26


@pytest.mark.parametrize("version", [42, 51])
@pytest.mark.parametrize("binary", [False, True])
def test_legacy_vtk_as_vtk_writes_it(tmp_path: Path, version: int, binary: bool) -> None:
    from vtkmodules.vtkIOLegacy import vtkUnstructuredGridReader, vtkUnstructuredGridWriter

    reader, writer = vtkUnstructuredGridReader(), vtkUnstructuredGridWriter()
    reader.SetFileName(str(HERE / "v1_legacy3.vtk"))
    writer.SetInputConnection(reader.GetOutputPort())
    writer.SetFileName(str(tmp_path / "part.vtk"))
    writer.SetFileVersion(version)
    writer.SetFileType(1 + binary)
    assert writer.Write()
    assert_bar(tmp_path / "part.vtk", ())


def vtkhdf(path: Path) -> Path:
    mesh = bar()
    sizes = np.repeat([3, 4], [len(cells.data) for cells in mesh.cells])
    with h5py.File(path, "w") as file:
        root = file.create_group("VTKHDF")
        root.attrs["Version"] = [1, 0]
        root.attrs.create("Type", b"UnstructuredGrid", dtype=h5py.string_dtype("ascii", 16))
        for name, count in (("Points", len(mesh.points)), ("Cells", len(sizes)), ("ConnectivityIds", sizes.sum())):
            root[f"NumberOf{name}"] = np.array([count], np.int64)
        root["Points"], root["Types"] = mesh.points, np.where(sizes == 3, 5, 10).astype(np.uint8)
        root["Offsets"] = np.concatenate([[0], np.cumsum(sizes)])
        root["Connectivity"] = np.concatenate([cells.data.ravel() for cells in mesh.cells])
        root["CellData/region"] = np.concatenate(mesh.cell_data["region"])
        root["PointData/T"] = mesh.point_data["T"]
    return path


@pytest.mark.parametrize("ending", ["vtkhdf", "hdf"])
def test_vtkhdf(tmp_path: Path, ending: str) -> None:
    assert_bar(vtkhdf(tmp_path / f"part.{ending}"))


def test_vtkhdf_is_all_in_one_file(tmp_path: Path) -> None:
    path = vtkhdf(tmp_path / "part.vtkhdf")
    shutil.copyfile(path, tmp_path / "other.h5")
    with h5py.File(path, "a") as file:
        del file["VTKHDF/Points"]
        file["VTKHDF/Points"] = h5py.ExternalLink("other.h5", "/VTKHDF/Points")
    with pytest.raises(MeshError, match="the data of '/VTKHDF/Points' lie in another file"):
        read_mesh(path)
    with h5py.File(path, "w") as file:
        file["x"] = [1]
    with pytest.raises(MeshError, match="it is HDF5 without the group 'VTKHDF'"):
        read_mesh(path)


CUBE = """<VTKFile type="UnstructuredGrid" version="0.1" byte_order="LittleEndian"><UnstructuredGrid>
<Piece NumberOfPoints="5" NumberOfCells="2">
<Points><DataArray type="Float64" NumberOfComponents="3" format="ascii">
0 0 0  1 0 0  0 1 0  0 0 1  1 1 1</DataArray></Points>
<Cells><DataArray type="Int64" Name="connectivity" format="ascii">0 1 2 3 1 2 3 4</DataArray>
<DataArray type="Int64" Name="offsets" format="ascii">4 8</DataArray>
<DataArray type="UInt8" Name="types" format="ascii">10 10</DataArray></Cells>
<CellData>%s</CellData></Piece></UnstructuredGrid></VTKFile>"""


@pytest.mark.parametrize(
    ("array", "regions"),
    [
        ('<DataArray type="String" Name="Material" format="ascii">115 0 195 169 32 98 0</DataArray>', ["s", "é b"]),
        ('<DataArray type="Float32" Name="region" format="ascii">0 2</DataArray>', ["tag-0", "tag-2"]),
        ('<DataArray type="Float32" Name="region" format="ascii">0.5 2</DataArray>', []),
        ('<DataArray type="Float32" Name="density" format="ascii">1 2</DataArray>', []),
        ('<DataArray type="Int32" Name="a" format="ascii">1 1</DataArray>'
         '<DataArray type="Int8" Name="REGION" format="ascii">4 5</DataArray>', ["tag-4", "tag-5"]),
    ],
)  # fmt: skip
def test_arrays_that_name_regions(tmp_path: Path, array: str, regions: list[str]) -> None:
    (tmp_path / "two.vtu").write_text(CUBE % array)
    mesh = read_mesh(tmp_path / "two.vtu")
    assert list(mesh.regions) == regions
    assert [cells.tolist() for cells in mesh.regions.values()] == [[0], [1]][: len(regions)]
    assert len(mesh.notes) == (not regions or "REGION" in array)


def test_regions_of_older_legacy_files(tmp_path: Path) -> None:
    (tmp_path / "two.vtk").write_text(
        "# vtk DataFile Version 2.0\ntwo\nASCII\nDATASET UNSTRUCTURED_GRID\nPOINTS 5 float\n0 0 0 1 0 0 0 1 0 0 0 1\n"
        "1 1 1\nCELLS 2 10\n4 0 1 2 3\n4 1 2 3 4\nCELL_TYPES 2\n10 10\nCELL_DATA 2\nSCALARS density float\n"
        "LOOKUP_TABLE default\n1.5 2.5\nSCALARS region int 1\nLOOKUP_TABLE default\n0 1\n"
    )
    mesh = read_mesh(tmp_path / "two.vtk")
    assert {name: cells.tolist() for name, cells in mesh.regions.items()} == {"tag-0": [0], "tag-1": [1]}
    assert mesh.notes == ("Not used: the cell arrays density.",)


def pieces(folder: Path) -> Path:
    """A box as two .vtu, which meet at z = 1, and the .pvtu that names them."""
    box = BUILDERS["box"](size=(1.0, 1.0, 2.0), h=0.5).build()
    upper = box.points[box.cells].mean(axis=1)[:, 2] > 1
    for i in (0, 1):
        nodes, cells = np.unique(box.cells[upper == i], return_inverse=True)
        meshio.Mesh(box.points[nodes], [("tetra", cells.reshape(-1, 4))]).write(folder / f"part_{i}.vtu")
    (folder / "part.pvtu").write_text(
        '<VTKFile type="PUnstructuredGrid"><PUnstructuredGrid GhostLevel="0"><PPoints><PDataArray type="Float64" '
        'NumberOfComponents="3"/></PPoints><Piece Source="part_0.vtu"/><Piece Source="part_1.vtu"/>'
        "</PUnstructuredGrid></VTKFile>"
    )
    return folder / "part.pvtu"


def test_pieces_meet_in_nodes_of_both(tmp_path: Path) -> None:
    box = BUILDERS["box"](size=(1.0, 1.0, 2.0), h=0.5).build()
    mesh = check_mesh(read_mesh(pieces(tmp_path)))
    corners = np.sort(mesh.points[mesh.cells].mean(axis=1).round(9), axis=0)
    np.testing.assert_array_equal(corners, np.sort(box.points[box.cells].mean(axis=1).round(9), axis=0))
    assert len(mesh.points) == len(box.points)
    assert mesh.notes[0] == "9 nodes that 2 pieces have in common were joined, by their places."


def test_pieces_lie_beside_the_file(tmp_path: Path) -> None:
    path = pieces(tmp_path)
    text_of_file = path.read_text()
    os.mkfifo(tmp_path / "pipe.vtu")
    for name, why in (
        ("../part_1.vtu", "lies outside"), ("pipe.vtu", "is a named pipe"), ("x.vtu", "does not exist"),
        ("part.pvtu", "is no .vtu"),
    ):  # fmt: skip
        path.write_text(text_of_file.replace("part_1.vtu", name))
        with pytest.raises(MeshError, match=f"names the file '{name}', which {why}"):
            read_mesh(path)


@pytest.mark.parametrize(
    ("before", "after", "message"),
    [
        ("10 10<", "10 12<", "a cell of the kind hexahedron has 4 nodes instead of 8"),
        ("2 3 4<", "2 3 7<", "a cell has the node 7 of 5 nodes"),
        ("2 3 4<", "2 3<", "could not be read: "),
        (' 1 1 1<', "<", "could not be read: "),
        ('Points="5"', 'Points="500000000000"', "could not be read: "),
        ("</Piece>", "", "could not be read: VTK's reader says: "),
        ("UnstructuredGrid", "ImageData", "it holds data of the type ImageData"),
        ("<VTKFile", "<VTK", "not as a file of VTK does"),
    ],
)  # fmt: skip
def test_damaged_files_are_told_in_one_message(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], before: str, after: str, message: str
) -> None:
    whole = CUBE % ""
    assert before in whole
    (tmp_path / "bad.vtu").write_text(whole.replace(before, after))
    with pytest.raises(MeshError, match=message) as caught:
        read_mesh(tmp_path / "bad.vtu")
    assert "bad.vtu' could not be read: " in str(caught.value) and "Supported: " in str(caught.value)
    assert "vtkXML" not in str(caught.value) and capfd.readouterr() == ("", "")


@pytest.mark.parametrize("name", ["a.vtk", "b.vtk", "b.vtu", "c.vtkhdf", "e1_cubit_tetra.exo", "e2_libmesh_tetra4.e"])
def test_files_that_were_cut_off_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    if name == "c.vtkhdf":
        vtkhdf(path)
    elif (HERE / name).exists():
        shutil.copyfile(HERE / name, path)
    else:
        kind = {"file_format": "vtk51"} if path.suffix == ".vtk" else {}
        bar().write(path, binary=name[0] == "b", **kind)
    whole = path.read_bytes()
    for share in (0.3, 0.6, 0.9):
        path.write_bytes(whole[: int(share * len(whole))])
        with pytest.raises(MeshError, match=r"could not be read: .*Supported: "):
            read_mesh(path)


def test_a_file_that_crashes_the_reader_is_a_message(tmp_path: Path) -> None:
    """One of which VTK 9.3 dies by signal 11."""
    data = bytearray((HERE / "e1_cubit_tetra.exo").read_bytes())
    at = data.index(b"num_nod_per_el1") + 16
    data[at : at + 4] = (0).to_bytes(4, "big")
    (tmp_path / "bad.exo").write_bytes(data)
    with pytest.raises(MeshError, match=r"bad.exo' could not be read: "):
        read_mesh(tmp_path / "bad.exo")


@pytest.mark.parametrize("mode", ["ascii", "binary", "raw", "base64", "zlib", "lz4", "lzma"])
@pytest.mark.parametrize("ending", ["vtu", "vtp"])
@pytest.mark.parametrize("wide", [False, True])
def test_xml_that_declares_too_few(tmp_path: Path, mode: str, ending: str, wide: bool) -> None:
    """Cells and points, in all encodings: VTK reads as many as declared, and says nothing of the others."""
    from vtkmodules.vtkFiltersGeometry import vtkGeometryFilter
    from vtkmodules.vtkIOLegacy import vtkUnstructuredGridReader
    from vtkmodules.vtkIOXML import vtkXMLPolyDataWriter, vtkXMLUnstructuredGridWriter

    source = vtkUnstructuredGridReader()
    source.SetFileName(str(HERE / "v1_legacy3.vtk"))
    if ending == "vtp":
        skin = vtkGeometryFilter()
        skin.SetInputConnection(source.GetOutputPort())
    writer = vtkXMLPolyDataWriter() if ending == "vtp" else vtkXMLUnstructuredGridWriter()
    writer.SetInputConnection((skin if ending == "vtp" else source).GetOutputPort())
    writer.SetDataMode({"ascii": 0, "binary": 1}.get(mode, 2))
    writer.SetEncodeAppendedData(mode == "base64")
    writer.SetCompressorType({"zlib": 1, "lz4": 2, "lzma": 3}.get(mode, 0))
    writer.SetHeaderType(64 if wide else 32)
    path = tmp_path / f"part.{ending}"
    writer.SetFileName(str(path))
    assert writer.Write()
    data = path.read_bytes()
    read_contents(path)
    for word in ("Cells" if ending == "vtu" else "Polys", "Points"):
        number = re.search(rf'NumberOf{word}="(\d+)"'.encode(), data)
        assert number
        count = int(number[1])
        path.write_bytes(data.replace(number[0], f'NumberOf{word}="{count - 1}"'.encode()))
        with pytest.raises(MeshError, match=rf"part.{ending}' could not be read: .*\b{count - 1} {word}.*holds \d+"):
            read_contents(path)
