"""Mesh files with groups, in any format of meshio."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .data import MeshData, MeshError
from .plain_files import NotAPlainFileError, atomic_replacement_of_all


def write_mesh(mesh: MeshData, path: Path) -> None:
    """Save cells, facets and groups; groups become cell data `group` (0: none), with names in `field_data`.

    A facet that is in several groups is saved with the last of them.

    Raises:
        MeshError: the format is unknown, or the file cannot be written.
    """
    import meshio

    cell, facet = ("triangle", "line") if mesh.dim == 2 else ("tetra", "triangle")
    names = [*mesh.facet_groups, *mesh.regions]
    facets = [np.asarray(nodes) for nodes in mesh.facet_groups.values()]
    region = np.zeros(len(mesh.cells), int)
    for name, cells in mesh.regions.items():
        region[cells] = names.index(name) + 1
    tags = [np.full(len(nodes), number) for number, nodes in enumerate(facets, start=1)]
    blocks = [(cell, mesh.cells), *((facet, nodes) for nodes in facets)]
    # formats of meshio have three coordinates
    points = np.pad(mesh.points, ((0, 0), (0, 3 - mesh.dim)))
    values = [region, *tags]
    # gmsh reads physical groups; in other formats one array has all groups
    data = {"gmsh:physical": values, "gmsh:geometrical": values} if path.suffix == ".msh" else {"group": values}
    field_data = {
        name: np.array([number, mesh.dim if name in mesh.regions else mesh.dim - 1])
        for number, name in enumerate(names, start=1)
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        options = {"file_format": "gmsh22"} if path.suffix == ".msh" else {}
        with atomic_replacement_of_all(path) as new:  # XDMF and TetGen have two files
            meshio.Mesh(points, blocks, cell_data=data, field_data=field_data).write(new, **options)
    except NotAPlainFileError as error:
        raise MeshError(f"{path} {error.strerror}; give another name") from None
    except OSError as error:
        raise MeshError(f"cannot save the mesh as {path}: {error.strerror or 'it cannot be written there'}") from None
    except (SystemExit, Exception):  # meshio raises whatever its writers raise
        allowed = ", ".join(sorted(meshio.extension_to_filetypes))
        is_known = any(path.name.lower().endswith(ending) for ending in meshio.extension_to_filetypes)
        why = "this mesh does not fit that format" if is_known else f"its ending is of no known format ({allowed})"
        raise MeshError(f"cannot save the mesh as {path}: {why}; save it as .msh, .vtu or .xdmf") from None
