"""Checkpoints: the state in the order of the input mesh, so that a run may go on with another number of ranks.

The mesh itself is built again from the study. Nodal and cell values, broken edges (as pairs of input nodes) and the clock are
all there is; a finite-element checkpoint library would store spaces that carry no edges.
"""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from .domain import Domain
from .equilibrium import Equilibrium
from .errors import InputError
from .meshes.data import MeshData
from .parallel import from_root, on_root
from .state import State

_CLOCK = ("t", "step", "dt", "dissipated", "work", "easy")
_NODAL = ("u", "v", "a", "forces")


def checkpoint_path(folder: Path) -> Path:
    return folder / "checkpoint" / "state.h5"


def write_checkpoint(folder: Path, domain: Domain, state: State, equations: Equilibrium, graph: Any = None) -> Path:
    """Write folder/checkpoint/state.h5, the old one in place until the new one is whole (collective)."""
    d = domain.dim
    arrays = {name: domain.gather_nodes(getattr(state, name).reshape(-1, d)) for name in _NODAL}
    if state.drag is not None:
        arrays["drag"] = domain.gather_nodes(state.drag.reshape(-1, d))
    if equations.chi is not None:
        arrays["chi"] = domain.gather_cells(equations.chi.x.array[: domain.cell_count])
        arrays["broken"] = graph.broken_keys()
    path = checkpoint_path(folder)
    on_root(domain.comm, lambda: _write(path, arrays, state, domain))
    return path


def _write(path: Path, arrays: dict[str, Any], state: State, domain: Domain) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    new = path.with_suffix(".new")
    with h5py.File(new, "w") as file:
        for name, values in arrays.items():
            file[name] = values
        for name in _CLOCK:
            file.attrs[name] = getattr(state, name)
        file.attrs["mesh"] = fingerprint(domain.source)
    os.replace(new, path)


def read_checkpoint(folder: Path, domain: Domain, state: State, equations: Equilibrium, graph: Any = None) -> None:
    """Bring a checkpoint into the state, chi and the graph (collective). InputError where there is none that fits."""
    path = checkpoint_path(folder)
    arrays, clock = from_root(domain.comm, lambda: (_read(path, domain.source), None))[0], None
    clock = arrays.pop("clock")
    for name in _CLOCK:
        setattr(state, name, clock[name])
    for name in (*_NODAL, "drag"):
        if name in arrays:
            setattr(state, name, domain.gather_nodes.scatter(arrays[name]).reshape(-1))
    if equations.chi is not None:
        graph.break_edges(graph.flags_of_keys(arrays["broken"]))
        equations.chi.x.array[: domain.cell_count] = domain.gather_cells.scatter(arrays["chi"])
    equations.displace(state.u)


def _read(path: Path, mesh: MeshData) -> dict[str, Any]:
    if not path.exists():
        raise InputError(f"--restart: there is no checkpoint {path}; run without --restart")
    with h5py.File(path) as file:
        if file.attrs["mesh"] != fingerprint(mesh):
            raise InputError(f"--restart: {path} belongs to another mesh; run without --restart")
        arrays = {name: data[()] for name, data in file.items()}
        return arrays | {"clock": {name: file.attrs[name].item() for name in _CLOCK}}


def fingerprint(mesh: MeshData) -> str:
    """A short name of a mesh's nodes and cells."""
    digest = hashlib.sha256(np.ascontiguousarray(mesh.points).tobytes())
    digest.update(np.ascontiguousarray(mesh.cells).tobytes())
    return digest.hexdigest()[:16]
