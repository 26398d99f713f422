"""Checkpoints: the state in the order of the input mesh, so that a run may go on with another number of ranks.

The mesh itself is built again from the study. Nodal and cell values, broken edges (as pairs of input nodes) and the
clock are all there is; a finite-element checkpoint library would store spaces that carry no edges.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import h5py
import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..mechanics.stress import Stress
from ..mesh.domain import Domain
from ..mesh.ranks import Gather, on_root
from ..meshes.data import MeshData
from ..stepping.state import State

if TYPE_CHECKING:
    from ..fracture.brittle.surfaces import BrittleSurfaces
    from ..fracture.record import EdgeRecord

_CLOCK = ("t", "step", "dt", "dissipated", "work", "easy")
_NODAL = ("u", "v", "a", "forces")
_SOMETIMES = ("drag", "out_of_balance")


def checkpoint_path(folder: Path) -> Path:
    return folder / "checkpoint" / "state.h5"


def write_checkpoint(
    folder: Path,
    domain: Domain,
    state: State,
    stress: Stress,
    record: EdgeRecord | None = None,
    surfaces: BrittleSurfaces | None = None,
) -> Path:
    """Write folder/checkpoint/state.h5, the old one in place until the new one is whole (collective).

    `record`: what is remembered of broken edges, in a study with fracture; `surfaces`: in one with brittle cracks.
    """
    d = domain.dim
    arrays = {name: domain.gather_nodes(getattr(state, name).reshape(-1, d)) for name in _NODAL}
    for name in _SOMETIMES:
        if (values := getattr(state, name)) is not None:
            arrays[name] = domain.gather_nodes(values.reshape(-1, d))
    if stress.chi is not None:
        arrays["chi"] = domain.gather_cells(stress.chi.x.array[: domain.cell_count])
    if (plastic := stress.material.plastic) is not None:
        arrays["plastic"] = domain.gather_cells(plastic.memory())
    if record is not None:
        arrays["broken"], arrays["breaks"] = record.gathered() or (None, None)
    if surfaces is not None:
        arrays["starts"] = surfaces.starts
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


def read_checkpoint(
    folder: Path,
    domain: Domain,
    state: State,
    stress: Stress,
    record: EdgeRecord | None = None,
    surfaces: BrittleSurfaces | None = None,
) -> State:
    """The state of a checkpoint, with chi and the record with its graph brought to it (collective).

    InputError where there is no checkpoint that fits.
    """
    path, comm = checkpoint_path(folder), domain.comm
    plastic = stress.material.plastic
    arrays = on_root(comm, lambda: _read(path, domain.source, record is not None, plastic is not None))
    head = None
    if arrays is not None:
        head = arrays.pop("clock"), list(arrays), arrays.get("broken"), arrays.get("breaks"), arrays.get("starts")
    clock, names, broken, breaks, starts = comm.bcast(head)

    def scattered(gather: Gather, name: str) -> npt.NDArray[Any]:
        return gather.scatter(arrays[name] if arrays is not None else None)

    nodal = {name: scattered(domain.gather_nodes, name).reshape(-1) for name in (*_NODAL, *_SOMETIMES) if name in names}
    if record is not None and broken is not None:
        record.graph.break_edges(record.graph.flags_of_keys(broken))
        record.restore(broken, breaks)
    if surfaces is not None and starts is not None:
        surfaces.starts = starts
    if stress.chi is not None and "chi" in names:
        stress.chi.x.array[: domain.cell_count] = scattered(domain.gather_cells, "chi")
    if plastic is not None and "plastic" in names:
        plastic.recall(scattered(domain.gather_cells, "plastic"))
    read: dict[str, Any] = {name: clock[name] for name in _CLOCK} | nodal
    return replace(state, **read)


def _read(path: Path, mesh: MeshData | None, torn_too: bool, bent_too: bool) -> dict[str, Any]:
    """The arrays and the clock; the study can go on with broken edges (`torn_too`), plastic strain (`bent_too`)."""
    if not path.exists():
        raise InputError(f"--restart: there is no checkpoint {path}; run without --restart")
    try:
        with h5py.File(path) as file:
            arrays = {name: data[()] for name, data in file.items()}
            clock, name = {key: file.attrs[key].item() for key in _CLOCK}, file.attrs["mesh"]
    except (OSError, KeyError) as error:
        raise InputError(f"--restart: cannot read {path}: {error}; run without --restart") from None
    if name != fingerprint(mesh):
        raise InputError(f"--restart: {path} belongs to another mesh; run without --restart")
    if len(arrays.get("broken", ())) and not torn_too:
        raise InputError(f"--restart: the body in {path} has broken edges; the study needs its [fracture] table")
    if "plastic" in arrays and arrays["plastic"][:, -1].any() and not bent_too:
        raise InputError(f"--restart: the body in {path} has flowed; the study needs its [plasticity] table")
    return arrays | {"clock": clock}


def fingerprint(mesh: MeshData | None) -> str:
    """A short name of a mesh's nodes and cells (rank 0, where the mesh is)."""
    assert mesh is not None
    digest = hashlib.sha256(np.ascontiguousarray(mesh.points).tobytes())
    digest.update(np.ascontiguousarray(mesh.cells).tobytes())
    return digest.hexdigest()[:16]
