"""MED files of Salome and gmsh, version 3 and later, which are HDF5.

Format: "MED file format" of the MED library, HDF5 structure. A cell or node belongs to one family; a family belongs to
any number of groups. Families of cells have negative numbers, those of nodes positive ones; 0 is in no group.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NoReturn

import h5py
import numpy as np

from .cell_sets import add_to_set, members_by_tag
from .data import Indices, MeshError, Points
from .file_text import decode_text, excerpt, refuse_file
from .mesh_conversion import Block, MeshFileContents
from .plain_files import HDF5_SIGNATURE, find_external_data

# Geometric type -> cell type and its number of nodes. 0: cells that cannot be used, which are refused by this name if
# they are part of the body, and left out otherwise.
KINDS = {
    "PO1": ("vertex", 1), "SE2": ("line", 2), "SE3": ("line3", 3), "SE4": ("line4", 4), "TR3": ("triangle", 3),
    "TR6": ("triangle6", 6), "TR7": ("triangle7", 7), "QU4": ("quad", 4), "QU8": ("quad8", 8), "QU9": ("quad9", 9),
    "TE4": ("tetra", 4), "T10": ("tetra10", 10), "PY5": ("pyramid", 5), "P13": ("pyramid13", 13), "PE6": ("wedge", 6),
    "P15": ("wedge15", 15), "P18": ("wedge18", 18), "HE8": ("hexahedron", 8), "H20": ("hexahedron20", 20),
    "H27": ("hexahedron27", 27), "POG": ("polygon", 0), "PG2": ("polygon", 0), "POE": ("polyhedron", 0),
    "OCT": ("hexagonal prism", 0),
}  # fmt: skip
SUPPORTED = (
    "one unstructured mesh of MED 3 or later; in Salome select the mesh and File > Export > MED, in gmsh File > Export "
    "as .med or .msh"
)


def read_med(path: Path) -> MeshFileContents:
    """Nodes, cells and groups of the one mesh of a MED file.

    Raises:
        MeshError: the file is damaged, holds no mesh or several ones; the message names the place in the file.
    """
    # Not by gmsh, whose build in Debian lacks the MED library; not by meshio 5.3, which refuses accents in names and
    # families without groups.
    with path.open("rb") as file:
        head = file.read(len(HDF5_SIGNATURE))
    if head != HDF5_SIGNATURE:
        _refuse(path, f"it begins with `{excerpt(head)}`, not as HDF5 does; MED files before version 3 are not read")
    where = ["its HDF5"]  # what is being read, for the message
    try:
        with h5py.File(path) as file:
            if name := find_external_data(file):
                _refuse(path, f"the data of '{name}' lie in another file; save all in one")
            return _contents(path, file, where)
    except (OSError, KeyError, RuntimeError, ValueError, TypeError, AttributeError, IndexError, OverflowError) as error:
        if isinstance(error, MeshError):
            raise
        _refuse(path, f"{where[0]} is damaged, or not as MED has it")


def _refuse(path: Path, reason: str) -> NoReturn:
    refuse_file(path, reason, f"Supported: {SUPPORTED}.")


def _contents(path: Path, file: Any, where: list[str]) -> MeshFileContents:
    """The arrays of an open file; `where[0]` is set to what is being read."""
    meshes = list(file["ENS_MAA"]) if "ENS_MAA" in file else []
    if len(meshes) != 1:
        count = f"{len(meshes)} meshes ({', '.join(meshes[:5])}); export one of them alone"
        _refuse(path, f"it holds {count if meshes else 'no mesh (no group ENS_MAA)'}")
    (name,) = meshes
    mesh = file["ENS_MAA"][name]
    if int(mesh.attrs.get("TYP", 0)) != 0:
        _refuse(path, f"its mesh '{name}' is a structured grid")
    steps = [key for key in mesh if isinstance(mesh[key], h5py.Group) and "NOE" in mesh[key]]
    if not steps:
        _refuse(path, f"its mesh '{name}' has no nodes (no group NOE)")
    time_step = mesh[steps[0]]
    notes = [f"The mesh has {len(steps)} steps in time; the first one is read."] if len(steps) > 1 else []
    where[0] = f"the list of nodes (ENS_MAA/{name}/{steps[0]}/NOE)"
    points = _points(path, time_step["NOE"], int(mesh.attrs.get("ESP", 3)))
    blocks, families = [], []
    for key in time_step.get("MAI", ()):
        where[0] = f"the list of cells {key} (ENS_MAA/{name}/{steps[0]}/MAI/{key})"
        block, family = _block(path, key, time_step["MAI"][key], len(points))
        blocks.append(_oriented(block, points))
        families.append(family)
    where[0] = f"the list of families (FAS/{name})"
    cell_groups, node_groups = _groups_of_families(file, name)
    sets: dict[str, list[Indices]] = {}
    for i, family in enumerate(families):
        for group, members in _groups(family, cell_groups, "family"):
            add_to_set(sets, blocks, group, i, members)
    where[0] = "the list of families of nodes"
    family = _integers(time_step["NOE"]["FAM"], len(points)) if "FAM" in time_step["NOE"] else np.zeros(0, np.int64)
    point_sets = dict(_groups(family, node_groups, "nodes"))
    if fields := list(file["CHA"]) if "CHA" in file else []:
        notes.append(f"Not used: results ({', '.join(fields)}).")
    return MeshFileContents(points, blocks, sets, point_sets, notes=tuple(notes))


def _points(path: Path, nodes: Any, dim: int) -> Points:
    """(n, dim) coordinates of a group of nodes."""
    values = np.asarray(nodes["COO"][()], np.float64)
    declared = int(nodes["COO"].attrs.get("NBR", len(values) // max(dim, 1)))
    if dim not in (2, 3) or values.shape != (dim * declared,):
        _refuse(
            path,
            f"it declares {declared} nodes of {dim} coordinates (2 or 3 are needed), and has {values.size} numbers",
        )
    return np.ascontiguousarray(values.reshape(dim, -1).T)  # all x, then all y, ...


def _block(path: Path, key: str, group: Any, node_count: int) -> tuple[Block, Indices]:
    """The cells of one geometric type and the family of each."""
    kind, size = KINDS.get(key, (f"cells of the kind {key}", 0))
    stored = group["NOD"]
    if not size:
        count = max(len(group["INN"]) - 1, 0) if "INN" in group else int(stored.attrs.get("NBR", 1))
        return Block(kind, np.zeros((count, 0), np.int64)), np.zeros(count, np.int64)
    declared = int(stored.attrs.get("NBR", len(stored) // size))
    nodes = _integers(stored, size * declared) - 1
    if len(nodes) and not (nodes.min() >= 0 and nodes.max() < node_count):
        wrong = int(nodes[(nodes < 0) | (nodes >= node_count)][0]) + 1
        _refuse(path, f"a cell of its list {key} has the node {wrong}, and there are {node_count}")
    family = _integers(group["FAM"], declared) if "FAM" in group else np.zeros(declared, np.int64)
    return Block(kind, np.ascontiguousarray(nodes.reshape(size, -1).T)), family


def _oriented(block: Block, points: Points) -> Block:
    """The block with its first two nodes exchanged if it is of tetrahedra that are all in MED's mirrored order."""
    if block.shape != "tetra" or not len(block.nodes) or points.shape[1] != 3:
        return block
    corners = points[block.corners]
    if np.all(np.linalg.det(corners[:, 1:] - corners[:, :1]) < 0):
        return Block(block.kind, np.concatenate([block.nodes[:, [1, 0]], block.nodes[:, 2:]], axis=1))
    return block


def _integers(stored: Any, count: int) -> Indices:
    """(count,) a stored list of integers; ValueError of another length or type."""
    values = stored[()]
    if values.dtype.kind not in "iu" or values.shape != (count,):
        raise ValueError(stored.name)
    integers: Indices = values.astype(np.int64)
    return integers


def _groups(family: Indices, names: dict[int, list[str]], word: str) -> Iterator[tuple[str, Indices]]:
    """Names and members of groups, from the family of each cell or node.

    Args:
        family: (n,) family number of each cell or node.
        names: family number -> names of its groups.
        word: begins the name of a family that `names` lacks.
    """
    parts: dict[str, list[Indices]] = {}
    for number, members in members_by_tag(family):
        for group in names.get(number) or [f"{word}-{abs(number)}"]:
            parts.setdefault(group, []).append(members)
    for group, members_of_families in parts.items():
        yield group, np.unique(np.concatenate(members_of_families))


def _groups_of_families(file: Any, mesh: str) -> tuple[dict[int, list[str]], dict[int, list[str]]]:
    """Names of the groups of each family of cells, and of nodes; a family without groups has its own name."""
    of_cells: dict[int, list[str]] = {}
    of_nodes: dict[int, list[str]] = {}
    families = file["FAS"][mesh] if "FAS" in file and mesh in file["FAS"] else {}
    for key, names in (("ELEME", of_cells), ("NOEUD", of_nodes)):
        for family in families.get(key, ()):
            entry = families[key][family]
            groups = [_name(row) for row in entry["GRO"]["NOM"][()]] if "GRO" in entry else []
            names[int(entry.attrs["NUM"])] = [group for group in groups if group] or [family.strip()]
    return of_cells, of_nodes


def _name(row: Any) -> str:
    """The name of a group, stored as 80 bytes or as signed numbers of one byte."""
    data = bytes(row) if isinstance(row, bytes) else np.asarray(row).astype(np.int8).tobytes()
    return decode_text(data.split(b"\0")[0]).strip()
