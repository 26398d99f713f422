"""Gmsh's own format in version 4, by gmsh; in a process of its own, for damaged files have ended gmsh by SIGABRT.

Not by meshio (5.3), which refuses files where only some cells are in a physical group, and keeps one unnamed group of
each.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, NoReturn

import numpy as np

from .data import Indices, MeshError
from .gmsh_session import session
from .mesh_conversion import Block, MeshFileContents
from .text_rows import EXPORT_AGAIN

SHAPES = {"Point": "vertex", "Line": "line", "Triangle": "triangle", "Tetrahedron": "tetra"}
SHAPES |= {"Quadrilateral": "quad", "Hexahedron": "hexahedron", "Prism": "wedge", "Pyramid": "pyramid"}


def read_with_gmsh(path: Path) -> MeshFileContents:
    """Everything in a file that begins as Gmsh's own format: anything else gmsh takes for a script, and runs.

    Raises:
        MeshError: the file is damaged.
    """
    # by a name of its own: of part.msh.opt beside part.msh gmsh would run the commands
    with TemporaryDirectory() as folder, session() as gmsh:
        linked = Path(folder) / "mesh.msh"
        linked.symlink_to(path.resolve())
        try:
            gmsh.merge(str(linked))
        except Exception as error:  # gmsh raises plain Exception with the last line of its log
            _refuse(path, f"gmsh says: {' '.join(str(error).replace(str(linked), path.name).split())[:200]}")
        try:
            return _contents_of_model(gmsh)
        except (ValueError, IndexError, KeyError, TypeError):
            _refuse(path, "its elements do not fit its nodes, or are of a kind that is not supported")


def _refuse(path: Path, why: str) -> NoReturn:
    raise MeshError(f"Mesh file '{path}' could not be read: {why.rstrip('.')}. {EXPORT_AGAIN}")


def _contents_of_model(gmsh: Any) -> MeshFileContents:
    tags, coordinates, _ = gmsh.model.mesh.getNodes()
    position = np.full(int(tags.max(initial=0)) + 1, -1, np.int64)
    position[tags] = np.arange(len(tags))
    blocks: list[Block] = []
    owners: list[tuple[int, int]] = []
    for entity in gmsh.model.getEntities():
        for kind, _, nodes in zip(*gmsh.model.mesh.getElements(*entity), strict=True):
            name, _, order, count, _, _ = gmsh.model.mesh.getElementProperties(kind)
            shape = SHAPES.get(name.split()[0], name)
            blocks.append(Block(shape if order == 1 else f"{shape}{count}", position[nodes].reshape(-1, count)))
            owners.append(entity)
    return MeshFileContents(coordinates.reshape(-1, 3), blocks, _physical_groups(gmsh, blocks, owners))


def _physical_groups(gmsh: Any, blocks: list[Block], owners: list[tuple[int, int]]) -> dict[str, list[Indices]]:
    """Physical groups by name; entities of several dimensions may share one."""
    sets: dict[str, list[Indices]] = {}
    for dim, tag in gmsh.model.getPhysicalGroups():
        name = gmsh.model.getPhysicalName(dim, tag) or f"tag-{tag}"
        entities = set(gmsh.model.getEntitiesForPhysicalGroup(dim, tag).tolist())
        members = sets.setdefault(name, [np.zeros(0, np.int64) for _ in blocks])
        for i, (block, owner) in enumerate(zip(blocks, owners, strict=True)):
            if owner[0] == dim and owner[1] in entities:
                members[i] = np.arange(len(block.nodes))
    return sets
