"""Inputs of a simulation: the study, a mesh that is handed over, and the physics of the user, checked together."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dolfinx.mesh import Mesh
from mpi4py import MPI

from .errors import InputError
from .mesh.given_mesh import GivenMesh, NamedTags, gather_mesh
from .mesh.parallel import on_root
from .meshes.data import MeshData, MeshError
from .meshes.parameters import Builder
from .study import Study
from .study.body import GIVEN_MESH
from .study.plugins import Physics, collect_physics, given_part
from .study.reader import load_study, study_text

StudySource = str | Path | Mapping[str, Any] | Study
Overrides = Sequence[str] | Mapping[str, Any]


def load(study: StudySource, overrides: Overrides = ()) -> Study:
    """Return a validated study, which is immutable.

    Args:
        study: path of a study file, name of a packaged study (`fracsim list`), or the tables of a study as a dict.
        overrides: values by key, as in `{"mesh.h": 0.02}`, or texts as `--set` takes them, as in `["mesh.h=0.02"]`.

    Raises:
        InputError: with one message on the first error.
    """
    if isinstance(study, Study):
        return load_study(tomllib.loads(study_text(study)), overrides) if overrides else study
    return load_study(study, overrides)


@dataclass(frozen=True)
class SimulationInputs:
    """Communicator, study, physics and mesh of a simulation.

    Attributes:
        comm: communicator.
        study: validated study.
        physics: of the user, and plug-ins of the study.
        arrays: mesh that was handed over, on rank 0.
        numbers: mesh of DOLFINx that was handed over, with its numbers, on rank 0.
    """

    comm: MPI.Intracomm
    study: Study
    physics: Physics
    arrays: MeshData | None = None
    numbers: GivenMesh | None = None


def prepare_inputs(
    study: StudySource,
    overrides: Overrides,
    comm: MPI.Intracomm | None,
    mesh: Mesh | MeshData | Builder | None = None,
    facets: NamedTags | None = None,
    regions: NamedTags | None = None,
    **physics: Any,
) -> SimulationInputs:
    """Return what a simulation is made of (collective). The arguments are those of `Simulation`."""
    if not isinstance(mesh, Mesh) and (facets is not None or regions is not None):
        raise InputError("facets and regions are tags of a mesh of DOLFINx: give mesh=... as well")
    if mesh is None:
        loaded = _with_scheme(load(study, overrides), physics.get("scheme"))
        return SimulationInputs(comm or MPI.COMM_WORLD, loaded, _collect(loaded, physics))
    table = {"builder": GIVEN_MESH}
    if isinstance(study, Mapping):
        order = {key: value for key, value in study.get("mesh", {}).items() if key == "order"}
        study = {**study, "mesh": order | table}
    loaded = load(study, overrides)
    if loaded.time.scheme == "rigid":
        raise InputError('time.scheme = "rigid" takes no mesh of DOLFINx: give [mesh] in the study')
    settings = type(loaded.mesh).model_validate(table | {"order": loaded.mesh.order})
    loaded = _with_scheme(loaded.model_copy(update={"mesh": settings}), physics.get("scheme"))
    if isinstance(mesh, Mesh):
        handed_over = gather_mesh(mesh, facets, regions)
        arrays = None if handed_over is None else handed_over.mesh
        return SimulationInputs(mesh.comm, loaded, _collect(loaded, physics), arrays, handed_over)
    ranks = comm or MPI.COMM_WORLD
    arrays = on_root(ranks, lambda: mesh if isinstance(mesh, MeshData) else _built(mesh))
    return SimulationInputs(ranks, loaded, _collect(loaded, physics), arrays)


def _built(builder: Builder) -> MeshData:
    """Return the mesh of a builder. Raises InputError."""
    if not callable(getattr(builder, "build", None)):
        raise InputError(
            f"mesh is a {type(builder).__name__}; a dolfinx.mesh.Mesh, a fracsim.meshes.MeshData, or an object whose "
            "build() returns one is needed"
        )
    try:
        return builder.build()
    except MeshError as error:
        raise InputError(f"mesh: {error}") from None


def _collect(study: Study, physics: dict[str, Any]) -> Physics:
    """Return the physics given in Python and the plug-ins of a study; rigid bodies have none."""
    if study.time.scheme == "rigid" and any(value is not None and value != () for value in physics.values()):
        raise InputError(f'time.scheme = "rigid" has no physics of the user: remove {", ".join(physics)}')
    for name in ("terms", "boundary"):
        if not isinstance(entries := physics.get(name, ()), list | tuple):
            needed = "classes or functions" if name == "terms" else "entries"
            raise InputError(f"{name} is {entries!r}: give a list of {needed}, or leave it out")
    if uncallable := [term for term in physics.get("terms", ()) if not callable(term)]:
        raise InputError(f"terms has {uncallable[0]!r}: give a class derived from fracsim.Term, or a function")
    return collect_physics(study, **physics)


def _with_scheme(study: Study, scheme: Any) -> Study:
    """Return a study with a time scheme given in Python. Raises InputError."""
    if scheme is None:
        return study
    try:
        return study.with_scheme(given_part("schemes", scheme))
    except ValueError as error:
        raise InputError(f"the study does not go with the time scheme: {error}") from None
