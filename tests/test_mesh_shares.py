"""Meshes of which each rank reads a share, against the same files read and checked on rank 0."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from cases import BAR, fracsim, write_study
from fracsim.errors import Exit
from fracsim.mesh.domain import distribute
from fracsim.meshes import MeshData, MeshError
from fracsim.meshes.check import check_mesh
from fracsim.meshes.data import mesh_fingerprint
from fracsim.meshes.read import read_mesh
from fracsim.meshes.vtkhdf import FileMesh, find_file_mesh
from fracsim.scene import build_scene
from fracsim.study.mesh_source import build_mesh
from support import torn
from support.ranks import Arrays, run_on_ranks
from support.scenes import make_study
from support.shared import CASES, FAULTS, NOTED, Parts, read_by_all, share_of, write_case

RANKS = (1, 2, 3)
MENDED = {"inverted", "orphan", "repeated facet", "facet without a group", "two groups of one name"}
Results = Callable[[int], Arrays]


def checked(path: Path) -> MeshData:
    """The mesh as rank 0 reads and checks it."""
    return check_mesh(read_mesh(path))


def assert_equal(mesh: MeshData | None, whole: MeshData) -> None:
    """All arrays, their types and the order of groups."""
    assert mesh is not None
    for one, two in ((mesh.points, whole.points), (mesh.cells, whole.cells)):
        assert one.dtype == two.dtype
        np.testing.assert_array_equal(one, two)
    for groups, expected in ((mesh.facet_groups, whole.facet_groups), (mesh.regions, whole.regions)):
        assert list(groups) == list(expected)
        for name, rows in expected.items():
            np.testing.assert_array_equal(groups[name], rows)


# --- one rank ---


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", NOTED)
def test_a_sound_mesh_is_that_of_rank_0(tmp_path: Path, dim: int, name: str) -> None:
    """Arrays, groups, regions and notes, with names; also those that bodies, cracks and hinges have."""
    path = write_case(tmp_path, dim, name)
    whole, domain = checked(path), read_by_all(path)
    assert domain.notes == whole.notes
    assert bool(whole.notes) == (name != "nothing")
    assert "hö her" in whole.regions
    assert_equal(domain.input_mesh, whole)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_domain_of_shares_is_that_of_the_whole_mesh(tmp_path: Path, dim: int) -> None:
    """Groups of facets, regions of cells and the bounding box of the distributed mesh."""
    path = write_case(tmp_path, dim, "inner facets")
    domain, whole = read_by_all(path), distribute(MPI.COMM_SELF, checked(path))
    assert domain.region_names == whole.region_names
    np.testing.assert_array_equal(domain.cell_region, whole.cell_region)
    np.testing.assert_array_equal(domain.nodes, whole.nodes)
    assert list(domain.facets.groups) == list(whole.facets.groups)
    for name, facets in whole.facets.groups.items():
        np.testing.assert_array_equal(domain.facets.groups[name], facets)
    np.testing.assert_array_equal(domain.bounds.upper, whole.bounds.upper)


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", FAULTS)
def test_a_fault_is_left_to_rank_0(tmp_path: Path, dim: int, name: str) -> None:
    """Which refuses the mesh, or mends it; in the latter cases there is something to mend or to tell."""
    path = write_case(tmp_path, dim, name)
    assert share_of(path) is None
    if name in MENDED or (name, dim) == ("z or size", 2):
        checked(path)
        return
    with pytest.raises(MeshError):
        checked(path)


def test_scaled_files(tmp_path: Path) -> None:
    """`mesh.scale` is that of rank 0; a scale that makes a body too large or too small is left to it."""
    path = write_case(tmp_path, 3, "nothing")
    mesh = {"file": str(path), "scale": 0.001}
    scene = build_scene(MPI.COMM_SELF, make_study(mesh=mesh))
    np.testing.assert_array_equal(scene.domain.input_mesh.points, checked(path).points * 0.001)
    assert scene.domain.whole_mesh is None and scene.domain.bounds.diagonal == pytest.approx(0.001 * 3**0.5)
    assert share_of(path, scale=1e-40) is None and share_of(path, scale=1e40) is None


@pytest.mark.parametrize("keys", [{"order": 2}, {"join": True}])
def test_what_needs_the_whole_mesh_is_read_by_rank_0(tmp_path: Path, keys: dict[str, Any]) -> None:
    path = write_case(tmp_path, 2, "nothing")
    scene = build_scene(MPI.COMM_SELF, make_study(mesh={"file": str(path)} | keys))
    assert scene.domain.whole_mesh is not None


def test_random_changes_of_a_file(tmp_path: Path) -> None:
    """Bytes of the arrays set at random: what is shared is what rank 0 reads; most of it is refused."""
    path, generator = write_case(tmp_path, 3, "nothing"), np.random.default_rng(1)
    file, data = find_file_mesh(path), path.read_bytes()
    assert file is not None and file.tags is not None
    shared = 0
    for array in [file.points, file.connectivity, file.offsets, file.types, file.tags] * 5:
        changed = bytearray(data)
        width = np.dtype(array.dtype).itemsize
        number = array.offset + width * int(generator.integers(np.prod(array.shape)))
        # low bytes, or the result is as good as always far out of range
        changed[number + int(generator.integers(min(width, 2)))] = int(generator.integers(256))
        path.write_bytes(changed)
        share = share_of(path)
        if share is None:
            continue
        shared += 1
        domain, whole = read_by_all(path), checked(path)
        assert domain.notes == whole.notes
        assert_equal(domain.input_mesh, whole)
    assert 3 < shared < 20


def test_files_of_other_forms_are_left_to_rank_0(tmp_path: Path) -> None:
    """Compressed, of another type, with other arrays, cut off, or no file of a mesh at all."""
    path = write_case(tmp_path, 2, "nothing")

    def is_left(change: Callable[[h5py.File], None]) -> bool:
        other = tmp_path / "other.vtkhdf"
        other.write_bytes(path.read_bytes())
        with h5py.File(other, "a") as file:
            change(file)
        return find_file_mesh(other) is None

    def rewrite(name: str, **options: Any) -> Callable[[h5py.File], None]:
        def change(file: h5py.File) -> None:
            values = file[f"VTKHDF/{name}"][()]
            del file[f"VTKHDF/{name}"]
            file.create_dataset(f"VTKHDF/{name}", data=options.pop("data", values), **options)

        return change

    assert not is_left(lambda file: None)
    assert not is_left(lambda file: file.__delitem__("group_names"))
    assert is_left(rewrite("Points", compression="gzip"))
    assert is_left(rewrite("Points", dtype="<f4"))
    assert is_left(rewrite("Points", data=np.zeros((3, 3))))
    assert is_left(rewrite("NumberOfCells", data=np.array([3, 4])))
    assert is_left(lambda file: file.create_dataset("VTKHDF/CellData/other", data=[1]))
    assert is_left(lambda file: file.create_dataset("VTKHDF/PointData/held", data=[1]))
    assert is_left(lambda file: file.__setitem__("VTKHDF/Steps", h5py.SoftLink("/VTKHDF/Points")))
    assert is_left(lambda file: file["VTKHDF"].attrs.__setitem__("Type", "PolyData"))
    (tmp_path / "cut.vtkhdf").write_bytes(path.read_bytes()[:-500])
    (tmp_path / "text.vtkhdf").write_text("no HDF5")
    for name in ("cut.vtkhdf", "text.vtkhdf", "missing.vtkhdf"):
        assert find_file_mesh(tmp_path / name) is None
    (tmp_path / "part.msh").write_bytes(path.read_bytes())
    assert find_file_mesh(tmp_path / "part.msh") is None


def test_a_file_that_is_cut_off_after_it_was_found(tmp_path: Path) -> None:
    from fracsim.mesh.mesh_shares import read_share

    path = write_case(tmp_path, 2, "nothing")
    file = find_file_mesh(path)
    assert isinstance(file, FileMesh)
    path.write_bytes(path.read_bytes()[: file.points.offset + 100])
    assert read_share(MPI.COMM_SELF, file) is None
    path.unlink()
    assert read_share(MPI.COMM_SELF, file) is None


def test_more_groups_than_are_meant_as_groups(tmp_path: Path) -> None:
    """More than a thousand numbers in all are those of cells: rank 0 finds no groups."""
    parts = Parts.of_box(3)
    parts.add_copy(3.0)
    for count in (1000, 994):
        parts.cell_tags = 7 + np.arange(len(parts.cells)) % count
        path = parts.write(tmp_path / f"{count}.vtkhdf")
        assert len(parts.cells) > 1000 and (share_of(path) is None) == (count == 1000)
        assert len(checked(path).regions) == (0 if count == 1000 else 994)


# --- several ranks ---


@pytest.fixture(scope="module")
def results(tmp_path_factory: pytest.TempPathFactory) -> Results:
    """Arrays of support/shared.py on a rank count, run once."""
    folder = tmp_path_factory.mktemp("shares")
    return cache(lambda ranks: run_on_ranks("support.shared", ranks, folder, seconds=300))


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", RANKS)
def test_all_ranks_refuse_a_fault(results: Results, ranks: int) -> None:
    """Wherever it is: on every rank, and no rank waits for another."""
    for dim, name in CASES:
        assert bool(results(ranks)[f"refused-{dim}-{name}"]) == (name in FAULTS), (dim, name)


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", RANKS)
@pytest.mark.parametrize("name", NOTED)
def test_notes_and_mesh_on_ranks(results: Results, tmp_path: Path, ranks: int, name: str) -> None:
    """Those of rank 0 alone: checkpoints of any number of ranks fit."""
    for dim in (2, 3):
        whole = checked(write_case(tmp_path, dim, name))
        assert tuple(results(ranks)[f"notes-{dim}-{name}"].tolist()) == whole.notes
        assert set(results(ranks)[f"mesh-{dim}-{name}"].tolist()) == {mesh_fingerprint(whole)}


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", RANKS)
@pytest.mark.parametrize("name", ["plate", "block"])
def test_the_same_crack_from_a_file_that_ranks_share(results: Results, ranks: int, name: str) -> None:
    """Edges, pieces and history are those of the mesh that rank 0 builds, on one rank to the last digit."""
    built = torn.run(name)
    assert len(built[f"{name}-broken"]) > 5
    for quantity in ("broken", "pieces", "u", "chi", "energy", "mass", "history"):
        read, expected = results(ranks)[f"run-{name}-{quantity}"], built[f"{name}-{quantity}"]
        if ranks == 1 or quantity in ("broken", "pieces"):
            np.testing.assert_array_equal(read, expected)
        elif quantity == "history":
            for column in (slice(0, 1), slice(1, 2), slice(2, 3), slice(3, None)):
                scale = np.abs(expected[:, column]).max()
                np.testing.assert_allclose(read[:, column], expected[:, column], atol=1e-7 * scale)
        else:
            np.testing.assert_allclose(read, expected, atol=1e-7 * np.abs(expected).max())


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", RANKS)
def test_no_rank_has_more_than_its_share(results: Results, ranks: int) -> None:
    """Of points and cells; the whole mesh is gathered for no surface, checkpoint, or contact of a body with itself."""
    for name in ("plate", "block"):
        shares = results(ranks)[f"shares-{name}"]
        assert len(shares) == ranks and np.all(shares.max(axis=0) - shares.min(axis=0) <= 1)
    kinds = ("none", "surface", "smooth", "contact")
    gathered, broken = np.array([results(ranks)[f"gathered-{kind}"].tolist() for kind in kinds]).T
    assert gathered.tolist() == [0, 0, 0, 0]
    assert broken[0] > 5 and set(broken[:3]) == {broken[0]} and broken[3] > 5


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", RANKS)
def test_frames_have_the_mesh_of_the_file(results: Results, ranks: int) -> None:
    """In its order, although no rank has it."""
    mesh = build_mesh(make_study(**torn.RUNS["block"]).mesh)
    np.testing.assert_array_equal(results(ranks)["fields-points"], mesh.points)
    np.testing.assert_array_equal(results(ranks)["fields-cells"], mesh.cells)


def outcome(folder: Path, mesh: Path, ranks: int) -> tuple[int, str]:
    """Exit code and messages of a run of two steps."""
    study = write_study(folder / "bar.toml", BAR | {"mesh": {"file": str(mesh)}}, time={"end": 0.02})
    done = fracsim("run", study, "-o", folder / f"out-{ranks}", ranks=ranks)
    lines = [line for line in done.stderr.splitlines() if line.startswith("fracsim:")]
    assert "Traceback" not in done.stderr
    return done.returncode, "\n".join(lines)


@pytest.mark.ranks
@pytest.mark.parametrize("name", ["nan", "node", "inverted", "cut off"])
def test_a_damaged_file_has_one_message(tmp_path: Path, name: str) -> None:
    """The same on one and on two ranks; an inverted cell is turned with a note."""
    path = write_case(tmp_path, 3, "nothing" if name == "cut off" else name)
    if name == "cut off":
        path.write_bytes(path.read_bytes()[:-1000])
    codes, messages = zip(*(outcome(tmp_path, path, ranks) for ranks in (1, 2)), strict=True)
    assert messages[0] == messages[1] and len(messages[0].splitlines()) == 1
    assert set(codes) == {0 if name == "inverted" else int(Exit.BAD_INPUT)}
    said = {"nan": "1 nodes have coordinates that are not finite", "node": "a cell has the node",
            "inverted": "1 of", "cut off": "could not be read"}  # fmt: skip
    assert said[name] in messages[0]
