"""Runs on meshes that no builder makes: python -m fracsim.studies.evidence.custom_meshes NAME -o figures.json.

Writes mesh.msh and trial.toml into the current folder, then does what `fracsim run trial.toml -o run --overwrite` does.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from . import contact_studies, stability_studies

MESH_TABLE: dict[str, Any] = {"file": "mesh.msh"}


def triangle() -> tuple[Any, dict[str, Any]]:
    """Mesh and study of one 2D cell, pulled at a corner until it breaks."""
    return _single_cell_mesh(2), _single_cell_study(2)


def tetrahedron() -> tuple[Any, dict[str, Any]]:
    """Mesh and study of one 3D cell, pulled at a corner until it breaks."""
    return _single_cell_mesh(3), _single_cell_study(3)


def two_densities() -> tuple[Any, dict[str, Any]]:
    """Mesh and study of a bar, one half 1e4 times as dense as the other, pulled at its light end until it breaks."""
    study = stability_studies.accelerated_bar(2e-3, steps=100)
    study["material"]["heavy"] = {"density": 1e7}
    return _two_density_mesh(), study | {"mesh": dict(MESH_TABLE)}


def two_densities_hanging() -> tuple[Any, dict[str, Any]]:
    """Mesh and study of the same bar hanging from its side; the support carries the weight."""
    study = stability_studies.hanging_body(MESH_TABLE, {"young": 1e9})
    study["material"]["heavy"] = {"density": 1e7}
    return _two_density_mesh(), study


CUSTOM_STUDIES: dict[str, Callable[[], tuple[Any, dict[str, Any]]]] = {
    "triangle": triangle,
    "tetrahedron": tetrahedron,
    "two-densities": two_densities,
    "two-densities-hanging": two_densities_hanging,
    **contact_studies.MESH_STUDIES,
}


def _single_cell_mesh(d: int) -> Any:
    """Mesh of one simplex in d dimensions."""
    from ...meshes.data import MeshData
    from ...meshes.topology import facets_of

    points, cells = np.vstack([np.zeros(d), np.eye(d)]), np.arange(d + 1)[None]
    opposite = facets_of(cells)[0]
    base = next(facet for facet in opposite if d not in facet)
    return MeshData(points, cells, {"base": base[None]})


def _single_cell_study(d: int) -> dict[str, Any]:
    """Study of one simplex in d dimensions."""
    corner: list[float | str] = [0.0] * (d - 1)
    study = stability_studies.base_study("one cell pulled apart", MESH_TABLE, None, 20)
    study["boundary"] = [
        {"on": "base", "fix": "xyz"[:d]},
        {"on": {"point": [*corner, 1.0], "normal": [*corner, 1.0]}, "velocity": [*corner, 1.0]},
    ]
    study["time"] = {"step": 0.01, "end": 0.2}
    return stability_studies.with_fracture(study, 1e5)


def _two_density_mesh() -> Any:
    """Mesh of a bar with the regions heavy and light."""
    from ...meshes.builders.box import Box

    mesh = Box(size=(1.0, 0.25, 0.25), h=0.125).build()
    heavy = np.flatnonzero(mesh.points[mesh.cells][:, :, 0].mean(axis=1) < 0.5)
    light = np.setdiff1d(np.arange(len(mesh.cells)), heavy)
    return replace(mesh, regions={"heavy": heavy, "light": light})


def run_custom_mesh(make: Callable[[], tuple[Any, dict[str, Any]]]) -> None:
    """Write mesh and study, then run; ends the process with the exit code of the run."""
    import tomli_w
    from mpi4py import MPI

    from ... import cli
    from ...meshes.write import write_mesh

    if MPI.COMM_WORLD.rank == 0:
        mesh, study = make()
        write_mesh(mesh, Path(MESH_TABLE["file"]))
        Path("trial.toml").write_text(tomli_w.dumps(study), encoding="utf-8")
    MPI.COMM_WORLD.barrier()
    sys.argv = ["fracsim", "run", "trial.toml", "-o", "run", "--overwrite"]
    cli.main()


if __name__ == "__main__":
    run_custom_mesh(CUSTOM_STUDIES[sys.argv[1]])
