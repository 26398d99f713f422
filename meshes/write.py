"""Mesh files with cells, facets and their groups, VTKHDF written by h5py and the others by meshio."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from .data import MeshData, MeshError
from .plain_files import NotAPlainFileError, atomic_replacement_of_all
from .vtkhdf import write_vtkhdf

# Endings of formats that keep cells, facets and groups, and whether groups keep their names. meshio has others, which
# lose some of these.
NAMES_ARE_KEPT = {
    ".msh": True, ".vol": True, ".vtu": False, ".vtk": False, ".xdmf": False, ".xmf": False, ".mesh": False,
    ".meshb": False, ".vtkhdf": True,
}  # fmt: skip


def write_mesh(mesh: MeshData, path: Path) -> tuple[str, ...]:
    """Save cells, facets and groups; returns notes on what the format does not keep.

    Groups become cell data `group` (0: none), with names in `field_data`. A facet that is in several groups is saved
    with the last of them.

    Raises:
        MeshError: the format is unknown or would lose cells or groups, or the file cannot be written.
    """
    import meshio

    ending = path.suffix.lower()
    if ending not in NAMES_ARE_KEPT:
        is_known = any(path.name.lower().endswith(suffix) for suffix in meshio.extension_to_filetypes)
        why = "such files would lose cells, facets or groups" if is_known else "its ending is of no known format"
        raise MeshError(f"cannot save the mesh as {path}: {why}; save it as .msh, or as {', '.join(NAMES_ARE_KEPT)}")
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
    data = {"gmsh:physical": values, "gmsh:geometrical": values} if ending == ".msh" else {"group": values}
    field_data = {
        name: np.array([number, mesh.dim if name in mesh.regions else mesh.dim - 1])
        for number, name in enumerate(names, start=1)
    }
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        options = {"file_format": "gmsh22"} if path.suffix == ".msh" else {}
        with atomic_replacement_of_all(path) as new:  # XDMF has two files
            if ending == ".vtkhdf":
                write_vtkhdf(new, points, [mesh.cells, *facets], values, names)
                return ()
            meshio.Mesh(points, blocks, cell_data=data, field_data=field_data).write(new, **options)
    except NotAPlainFileError as error:
        raise MeshError(f"{path} {error.strerror}; give another name") from None
    except OSError as error:
        raise MeshError(f"cannot save the mesh as {path}: {error.strerror or 'it cannot be written there'}") from None
    except (SystemExit, Exception) as error:  # meshio raises whatever its writers raise
        raise MeshError(f"cannot save the mesh as {path}: {error}; save it as .msh") from None
    if NAMES_ARE_KEPT[ending] or not names:
        return ()
    numbers = ", ".join(f"{number} is {name}" for number, name in enumerate(names, start=1))
    return (f"files {ending} have numbers in place of the names of groups ({numbers}); .msh has the names",)
