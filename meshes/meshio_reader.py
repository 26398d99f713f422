"""meshio on a file of which all that it names has been looked at: data of XDMF and HDF5, the second file of TetGen."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

from .data import MeshError
from .plain_files import data_elsewhere, is_hdf5, wrong_beside

# endings whose readers wait for more where a file has been cut off: meshio's name of the format, and whether it is text
_WAITING = {
    ".dat": ("tecplot", True),
    ".tec": ("tecplot", True),
    ".off": ("off", True),
    ".mdpa": ("mdpa", False),
}
_PLY_TYPES = {b"char": b"int8", b"uchar": b"uint8", b"ushort": b"uint16", b"uint": b"uint32"}
MAX_PLY_HEAD = 65536  # bytes
MOST_BEYOND = 1000  # times that a file is read beyond its end: no reader that comes to an end does so often


def meshio_mesh(path: Path) -> Any:
    """meshio's mesh. MeshError where the file names one that may not be read; else whatever meshio raises."""
    import meshio

    ending = path.suffix.lower()
    if ending in (".xdmf", ".xmf"):
        return _xdmf_reader(path).read()
    if ending in (".ele", ".node"):
        other = path.stem + {".ele": ".node", ".node": ".ele"}[ending]
        _check(path, other)
        _check_begun(path)
        _check_begun(path.parent / other)
    elif ending == ".msh" and not _begins_as_gmsh(path):
        with _Ending(path.open("rb", buffering=0)) as file:
            return meshio.ansys.read(file)
    elif ending == ".ply":
        with _Ending(io.BytesIO(_with_known_head(path.read_bytes()))) as file:  # type: ignore[arg-type]
            return meshio.read(file, "ply")
    elif ending in _WAITING:
        with _Ending(path.open("rb", buffering=0)) as file:
            kind, text = _WAITING[ending]
            return meshio.read(io.TextIOWrapper(file) if text else file, kind)
    elif is_hdf5(path):
        _check_hdf5(path, path)
    return meshio.read(path)


def _with_known_head(data: bytes) -> bytes:
    """A PLY file with the names of its head that meshio knows: of the corners of faces, and of types."""
    head, mark, rest = data.partition(b"end_header")
    if not mark or len(head) > MAX_PLY_HEAD:
        return data
    lines = [line.split() for line in head.splitlines()]
    for line in lines:
        if line[:1] == [b"property"]:
            line[1:-1] = [_PLY_TYPES.get(word, word) for word in line[1:-1]]
            if line[1:2] == [b"list"] and line[-1] == b"vertex_index":
                line[-1] = b"vertex_indices"
    return b"\n".join(b" ".join(line) for line in lines if line) + b"\n" + mark + rest


def _check(path: Path, name: str) -> None:
    if wrong := wrong_beside(path, name):
        raise MeshError(f"Mesh file '{path}' could not be read: it names the file '{name}', which {wrong}.")


def _check_hdf5(path: Path, h5: Path) -> None:
    import h5py

    with h5py.File(h5) as file:
        if name := data_elsewhere(file):
            raise MeshError(
                f"Mesh file '{path}' could not be read: the data of '{name}' in {h5.name} lie in another file; save "
                "all in one."
            )


def _xdmf_reader(path: Path) -> Any:
    """A reader of meshio's that looks at what each item names before it opens that."""
    from meshio.xdmf.main import XdmfReader

    looked_at: set[str] = set()

    class Reader(XdmfReader):  # type: ignore[misc]
        def _read_data_item(self, item: Any, root: Any = None) -> Any:
            named = "Reference" not in item.attrib and item.get("Format") in ("HDF", "Binary")
            if named and (text := (item.text or "").strip()):
                name = text.rpartition(":")[0] if item.get("Format") == "HDF" else text
                if name not in looked_at:
                    _check(path, name)
                    if item.get("Format") == "HDF":
                        _check_hdf5(path, path.parent / name)
                    looked_at.add(name)
                if item.get("Format") == "Binary":
                    item.text = os.path.abspath(path.parent / name)  # meshio looks in the working folder
            return super()._read_data_item(item, root)

    return Reader(str(path))


def _begins_as_gmsh(path: Path) -> bool:
    with path.open("rb") as file:
        return file.read(1) == b"$"


class _Ending(io.BufferedReader):
    """A file that ends with an error where it is read beyond its end again and again: readers of meshio's wait there
    for what does not come, where a file has been cut off."""

    _beyond = 0

    def _checked(self, data: bytes) -> bytes:
        self._beyond = 0 if data else self._beyond + 1
        if self._beyond > MOST_BEYOND:
            raise EOFError("it ends in the middle of a section")
        return data

    def read(self, size: int | None = -1, /) -> bytes:
        return self._checked(super().read(size))

    def read1(self, size: int = -1, /) -> bytes:
        return self._checked(super().read1(size))

    def readline(self, size: int | None = -1, /) -> bytes:
        return self._checked(super().readline(size))


def _check_begun(path: Path) -> None:
    """MeshError for a file of TetGen without numbers, of which meshio waits for the first line."""
    with path.open(errors="replace") as file:
        if not any(line.strip() and not line.strip().startswith("#") for line in file):
            raise MeshError(f"Mesh file '{path}' could not be read: it holds no numbers.")
