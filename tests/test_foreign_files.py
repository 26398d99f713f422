"""A mesh file is data: it runs nothing, and leads to no file but plain ones beside it."""

from __future__ import annotations

import contextlib
import os
import socket
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import meshio
import numpy as np
import pytest
import tomli_w

from cases import BAR, fracsim_here, write_study
from fracsim.meshes import BUILDERS, MeshData, MeshError
from fracsim.meshes.gmsh_session import session
from fracsim.meshes.read import read_contents, read_mesh
from fracsim.meshes.surfaces.closed import read_surface
from fracsim.meshes.write import write_mesh

# a box that gmsh meshes, once it has run a command of the shell
SCRIPT = (
    'SystemCall "id > PWNED";\nSetFactory("OpenCASCADE"); Box(1)={0,0,0,0.2,0.1,0.1}; Mesh.MeshSizeMax=0.05; Mesh 3;\n'
)
HIDDEN = SCRIPT + "/*\n$MeshFormat\n4.1 0 8\n*/\n"


def sample() -> MeshData:
    return BUILDERS["box"](size=(1.0, 1.0, 1.0), h=0.5).build()


@pytest.fixture
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working folder, in which a command of the shell would leave its file."""
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.fixture
def gmsh_41(here: Path) -> bytes:
    """A mesh as gmsh writes it."""
    with session() as gmsh:
        gmsh.model.occ.addBox(0, 0, 0, 1, 1, 1)
        gmsh.model.occ.synchronize()
        gmsh.model.mesh.generate(3)
        gmsh.write("part.msh")
    return (here / "part.msh").read_bytes()


@pytest.mark.parametrize("name", ["evil.msh", "evil.MSH"])
@pytest.mark.parametrize("key", ["file", "surface", "shell"])
def test_a_script_named_as_a_mesh_is_not_run(here: Path, name: str, key: str) -> None:
    (here / name).write_text(HIDDEN)
    more = {"file": {}, "surface": {"h": 0.1}, "shell": {"thickness": 0.01}}[key]
    data = BAR | {"mesh": {key: str(here / name), **more}}
    if key == "shell":
        with pytest.raises(MeshError, match="is no mesh of Gmsh"):
            read_contents(here / name)
    else:
        done = fracsim_here("check", write_study(here / "bar.toml", data))
        assert (
            done.returncode == 2
            and "could not be read: it is no mesh of Gmsh, for it begins with b'SystemCall \"id" in done.stderr
        )
    assert not (here / "PWNED").exists()


@pytest.mark.parametrize("before", ["\n", " ", "// $MeshFormat\n", "\ufeff", "$PostFormat\n", "\x00"])
def test_what_gmsh_takes_for_a_script_is_refused(here: Path, gmsh_41: bytes, before: str) -> None:
    """The first line decides, not the first 64 kB."""
    (here / "evil.msh").write_bytes(before.encode() + SCRIPT.encode() + b"/*\n" + gmsh_41 + b"*/\n")
    with pytest.raises(MeshError, match="begins with"):
        read_mesh(here / "evil.msh")
    assert not (here / "PWNED").exists()


def test_options_beside_a_mesh_are_not_run(here: Path, gmsh_41: bytes) -> None:
    """gmsh runs what lies in part.msh.opt as it merges part.msh."""
    assert gmsh_41.startswith(b"$MeshFormat")
    for name in ("part.msh.opt", "part.opt", ".gmshrc", ".gmsh-options"):
        (here / name).write_text('SystemCall "id > PWNED";\n')
    assert len(read_mesh(here / "part.msh").cells) > 5
    assert not (here / "PWNED").exists()


def test_a_mesh_with_comments_before_it_is_read(here: Path, gmsh_41: bytes) -> None:
    (here / "said.msh").write_bytes(b"$Comments\n" + SCRIPT.encode() + b"$EndComments\n" + gmsh_41)
    assert len(read_mesh(here / "said.msh").cells) == len(read_mesh(here / "part.msh").cells)
    assert not (here / "PWNED").exists()


# --- what is no plain file ------------------------------------------------------------------------------------------


def pipe(path: Path) -> None:
    os.mkfifo(path)


def device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def listening(path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as made:
        made.bind(path.name)


KINDS: dict[str, tuple[Callable[[Path], Any], str]] = {
    "pipe": (pipe, "is a named pipe, not a file"),
    "device": (device, "is a device, not a file"),
    "folder": (Path.mkdir, "is a folder, not a file"),
    "socket": (listening, "is a socket, not a file"),
}


@pytest.mark.parametrize("kind", KINDS)
def test_what_is_no_file_is_named_and_not_waited_for(here: Path, kind: str) -> None:
    """As a study, a mesh, a surface, an outline, the mesh of an obstacle."""
    make, said = KINDS[kind]
    for name in ("study.toml", "part.msh", "part.vtu", "part.stl", "part.csv"):
        make(here / name)
    done = fracsim_here("check", here / "study.toml")
    assert done.returncode == 2 and done.stderr == f"fracsim: the study file {here / 'study.toml'} {said}\n"
    meshes: list[dict[str, Any]] = [{"file": "part.msh"}, {"file": "part.vtu"}, {"surface": "part.stl", "h": 0.1},
                                    {"outline": "part.csv", "h": 0.1}]  # fmt: skip
    for mesh in meshes:
        (name, file), *_ = mesh.items()
        (here / "bar.toml").write_text(tomli_w.dumps(BAR | {"mesh": mesh}))
        done = fracsim_here("check", here / "bar.toml")
        assert done.returncode == 2 and f'mesh.{name} = "{(here / file).resolve()}" {said}\n' in done.stderr
    obstacle = {"name": "ball", "shape": "mesh", "at": [0.0, 0.0, 1.0], "file": "part.stl"}
    done = fracsim_here("check", write_study(here / "bar.toml", BAR | {"obstacle": [obstacle]}))
    assert done.returncode == 2 and f'obstacle.0.file = "{(here / "part.stl").resolve()}" {said}' in done.stderr


# --- files that a mesh file names -----------------------------------------------------------------------------------


def xdmf(folder: Path) -> Path:
    """A mesh as meshio writes it, with its data in part.h5."""
    write_mesh(sample(), folder / "part.xdmf")
    return folder / "part.xdmf"


def named(path: Path, before: str, after: str) -> None:
    """Another name in a file."""
    text = path.read_text()
    assert before in text
    path.write_text(text.replace(before, after))


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("../part.h5", "which lies outside the folder"),
        ("/tmp/part.h5", "which lies outside the folder"),
        ("pipe.h5", "which is a named pipe, not a file"),
        ("none.h5", "which does not exist"),
    ],
)
def test_xdmf_names_plain_files_beside_it(here: Path, name: str, said: str) -> None:
    path = xdmf(here)
    assert len(read_mesh(path).cells) == len(sample().cells)
    pipe(here / "pipe.h5")
    named(path, "part.h5:", f"{name}:")
    with pytest.raises(MeshError, match=f"names the file '{name}', {said}"):
        read_mesh(path)


def test_binary_data_of_xdmf_lie_beside_it(here: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """And not in the working folder, where meshio looks for them; a pipe there is not waited for."""
    mesh, other = sample(), here / "other"
    meshio.Mesh(mesh.points, [("tetra", mesh.cells)]).write("part.xdmf", data_format="Binary")
    other.mkdir()
    monkeypatch.chdir(other)
    for each in here.glob("part*.bin"):
        pipe(other / each.name)
    np.testing.assert_array_equal(read_mesh(here / "part.xdmf").points, mesh.points)
    first = sorted(here.glob("part*.bin"))[0]
    first.unlink()
    pipe(first)
    with pytest.raises(MeshError, match="which is a named pipe, not a file"):
        read_mesh(here / "part.xdmf")


@pytest.mark.parametrize("how", ["external link", "external data", "virtual data", "link behind a link"])
@pytest.mark.parametrize("ending", ["xdmf", "h5m"])
def test_hdf5_has_its_data_in_itself(here: Path, how: str, ending: str) -> None:
    path, mesh = here / f"part.{ending}", sample()
    meshio.Mesh(mesh.points, [("tetra", mesh.cells)]).write(path)
    assert len(read_mesh(path).cells) == len(mesh.cells)
    h5 = path if ending == "h5m" else here / "part.h5"
    os.rename(h5, here / "whole.h5")
    pipe(here / "raw")
    with h5py.File(here / "whole.h5") as whole, h5py.File(h5, "w") as file:
        first = next(iter(whole))
        for name in whole:
            whole.copy(name, file)
        if how == "external link":
            del file[first]
            file[first] = h5py.ExternalLink("whole.h5", first)
        elif how == "link behind a link":
            del file[first]
            file["far"] = h5py.ExternalLink("whole.h5", first)
            file[first] = h5py.SoftLink("/far")
        elif how == "external data":
            file.create_dataset("more/a", (4,), float, external=[("raw", 0, 32)])
        else:
            layout = h5py.VirtualLayout((4,), float)
            layout[:] = h5py.VirtualSource("whole.h5", "a", (4,))
            file.create_virtual_dataset("more", layout)
    with pytest.raises(MeshError, match=r"the data of '/.*' in part\..* lie in another file. Save all in one"):
        read_mesh(path)


def abaqus(folder: Path, name: str) -> Path:
    """A deck whose mesh is in another file."""
    folder.mkdir(exist_ok=True)
    mesh = sample()
    meshio.Mesh(mesh.points, [("tetra", mesh.cells)]).write(folder / "mesh.inp")
    (folder / "main.inp").write_text(f"*HEADING\n*Include, input={name}\n")
    return folder / "main.inp"


def test_an_abaqus_deck_includes_plain_files_beside_it(here: Path) -> None:
    """Beside the deck only: files of the same name in the working folder are another's."""
    deck = abaqus(here / "deck", "mesh.inp")
    pipe(here / "mesh.inp")  # in the working folder
    assert len(read_mesh(deck).cells) == len(sample().cells)
    pipe(here / "deck" / "pipe.inp")
    (here / "deck" / "link.inp").symlink_to("/etc/passwd")
    for name, said in {
        "/etc/passwd": "which lies outside the folder",
        "../mesh.inp": "which lies outside the folder",
        "pipe.inp": "which is a named pipe, not a file",
        "link.inp": "which is a link",
        "main.inp": "a second time",
        "none.inp": "which does not exist",
    }.items():
        for line in ("*INCLUDE, INPUT=", "* include ,\n input = ", "*Node, input=", "*nset, nset=a, INPUT="):
            deck.write_text(f"*HEADING\n{line}{name}\n")
            with pytest.raises(MeshError, match=rf"main\.inp', line 2: .*{said}"):
                read_mesh(deck)


@pytest.mark.parametrize("ending", ["ele", "node"])
def test_the_second_file_of_tetgen_is_a_plain_one(here: Path, ending: str) -> None:
    mesh = sample()
    meshio.Mesh(mesh.points, [("tetra", mesh.cells)]).write("part.ele")
    assert len(read_mesh(here / f"part.{ending}").cells) == len(mesh.cells)
    other = here / f"part.{'node' if ending == 'ele' else 'ele'}"
    other.unlink()
    pipe(other)
    with pytest.raises(MeshError, match=f"names the file '{other.name}', which is a named pipe, not a file"):
        read_mesh(here / f"part.{ending}")


CUT = ("msh", "tec", "dat", "off", "mdpa", "ply", "ele", "node")  # what meshio waits for the end of


@pytest.mark.timeout(60)
@pytest.mark.parametrize("ending", CUT)
def test_a_file_that_was_cut_off_ends(here: Path, ending: str) -> None:
    """meshio reads on for ever where a section is not closed; whole files are read as before."""
    mesh, path, kind = sample(), here / f"part.{ending}", "ansys" if ending == "msh" else None
    made = meshio.Mesh(mesh.points, [("tetra", mesh.cells)])
    if ending in ("off", "ply"):
        made = meshio.Mesh(mesh.points, [("triangle", np.concatenate(list(mesh.facet_groups.values())))])
    made.write(path, file_format=kind, **({"binary": False} if kind else {}))
    whole = path.read_bytes()
    if kind is None:
        assert len(read_contents(path).points) == len(mesh.points)
    for share in (0.02, 0.1, 0.3, 0.6, 0.9):
        path.write_bytes(whole[: int(share * len(whole))])
        with contextlib.suppress(MeshError):
            read_contents(path)


def test_a_surface_names_materials_that_nobody_opens(here: Path) -> None:
    """A library of materials of an OBJ; the file of a texture in a PLY."""
    pipe(here / "skin.mtl")
    corners, faces = [(0, 0, 0), (1, 0, 0), (0, 1, 0), (0, 0, 1)], [(1, 3, 2), (1, 2, 4), (1, 4, 3), (2, 3, 4)]
    lines = ["mtllib skin.mtl", "usemtl skin", *("v {} {} {}".format(*each) for each in corners)]
    (here / "part.obj").write_text("\n".join([*lines, *("f {} {} {}".format(*each) for each in faces)]) + "\n")
    assert read_surface(here / "part.obj").volume == pytest.approx(1 / 6)
    body = b"".join(struct.pack("<fff", *each) for each in corners)
    body += b"".join(struct.pack("<Biii", 3, *(corner - 1 for corner in each)) for each in faces)
    head = "ply\nformat binary_little_endian 1.0\ncomment TextureFile skin.mtl\nelement vertex 4\n"
    head += "property float x\nproperty float y\nproperty float z\nelement face 4\n"
    (here / "part.ply").write_bytes(f"{head}property list uchar int vertex_indices\nend_header\n".encode() + body)
    assert read_surface(here / "part.ply").volume == pytest.approx(1 / 6)
