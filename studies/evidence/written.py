"""Runs on meshes that no builder makes: python -m fracsim.studies.evidence.written NAME -o figures.json.

Writes mesh.msh and trial.toml into the folder it is started in, then does what
`fracsim run trial.toml -o run --overwrite` does.
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from . import contacts, extremes

FILE: dict[str, Any] = {"file": "mesh.msh"}


def triangle() -> tuple[Any, dict[str, Any]]:
    """One cell of 2D, pulled at a corner until it breaks."""
    return _cell(2), _pulled_apart(2)


def tetrahedron() -> tuple[Any, dict[str, Any]]:
    """One cell of 3D, pulled at a corner until it breaks."""
    return _cell(3), _pulled_apart(3)


def two_densities() -> tuple[Any, dict[str, Any]]:
    """A bar with one half 1e4 times as dense as the other, thrown by its light end and torn."""
    study = extremes.thrown(2e-3, steps=100)
    study["material"]["heavy"] = {"density": 1e7}
    return _halves(), study | {"mesh": dict(FILE)}


def two_densities_hanging() -> tuple[Any, dict[str, Any]]:
    """The same bar hanging from its side: the support has to carry the weight."""
    study = extremes.hanging(FILE, {"young": 1e9})
    study["material"]["heavy"] = {"density": 1e7}
    return _halves(), study


MESHES: dict[str, Callable[[], tuple[Any, dict[str, Any]]]] = {
    "triangle": triangle,
    "tetrahedron": tetrahedron,
    "two-densities": two_densities,
    "two-densities-hanging": two_densities_hanging,
    **contacts.MESHES,
}


def _cell(d: int) -> Any:
    from ...meshes.data import MeshData
    from ...meshes.topology import facets_of

    points, cells = np.vstack([np.zeros(d), np.eye(d)]), np.arange(d + 1)[None]
    opposite = facets_of(cells)[0]
    base = next(facet for facet in opposite if d not in facet)
    return MeshData(points, cells, {"base": base[None]})


def _pulled_apart(d: int) -> dict[str, Any]:
    corner: list[float | str] = [0.0] * (d - 1)
    study = extremes.bare("one cell pulled apart", FILE, None, 20)
    study["boundary"] = [
        {"on": "base", "fix": "xyz"[:d]},
        {"on": {"point": [*corner, 1.0], "normal": [*corner, 1.0]}, "velocity": [*corner, 1.0]},
    ]
    study["time"] = {"step": 0.01, "end": 0.2}
    return extremes.breaking(study, 1e5)


def _halves() -> Any:
    from ...meshes.builders.box import Box

    made = Box(size=(1.0, 0.25, 0.25), h=0.125).build()
    heavy = np.flatnonzero(made.points[made.cells][:, :, 0].mean(axis=1) < 0.5)
    light = np.setdiff1d(np.arange(len(made.cells)), heavy)
    return replace(made, regions={"heavy": heavy, "light": light})


def run_written(make: Callable[[], tuple[Any, dict[str, Any]]]) -> None:
    """Write mesh and study, then run; ends the process with the exit code of the run."""
    import tomli_w
    from mpi4py import MPI

    from ... import cli
    from ...meshes.write import write_mesh

    if MPI.COMM_WORLD.rank == 0:
        mesh, study = make()
        write_mesh(mesh, Path(FILE["file"]))
        Path("trial.toml").write_text(tomli_w.dumps(study), encoding="utf-8")
    MPI.COMM_WORLD.barrier()
    sys.argv = ["fracsim", "run", "trial.toml", "-o", "run", "--overwrite"]
    cli.main()


if __name__ == "__main__":
    run_written(MESHES[sys.argv[1]])
