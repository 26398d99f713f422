"""Checkpoints: the state in the order of the input mesh, so that a run may go on with another number of ranks.

The mesh itself is built again from the study. Nodal and cell values, broken edges (as pairs of input nodes) and the
clock are all there is; a finite-element checkpoint library would store spaces that carry no edges.
"""

from __future__ import annotations

import contextlib
import hashlib
import json
import tomllib
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..mechanics.balance import Balance
from ..mesh.domain import Domain
from ..mesh.ranks import Gather, on_root
from ..meshes.data import MeshData
from ..stepping.state import State
from .own_files import CHECKPOINT
from .writing import ROOM, hdf5_file, hdf5_there, replacing, written

if TYPE_CHECKING:
    from ..fracture.brittle.surfaces import BrittleSurfaces
    from ..fracture.record import EdgeRecord

_CLOCK = ("t", "step", "dt", "dissipated", "work", "easy")
_NODAL = ("u", "v", "a", "forces")
_SOMETIMES = ("drag", "out_of_balance")
_ON_EVERY_RANK = ("weakened", "integrity", "broken", "breaks", "starts")
_NOTES = ("study", "monitors")
_TERMS = "term."  # before the names of what terms of the balance remember


@dataclass(frozen=True)
class Notes:
    """What a checkpoint says beside the state: the `study`, as in study.toml, and the `monitors` of the run so far."""

    study: str
    monitors: dict[str, Any]

    def values(self) -> dict[str, Any]:
        """The study's tables."""
        return tomllib.loads(self.study)


def checkpoint_path(folder: Path) -> Path:
    return folder / CHECKPOINT


def read_notes(folder: Path) -> Notes:
    """The notes of a checkpoint (rank 0). InputError where there is none that can be read."""
    with _opened(folder) as file:
        study, monitors = (file["notes"][name].asstr()[()] for name in _NOTES)
        return Notes(study, json.loads(monitors))


def write_checkpoint(
    folder: Path,
    domain: Domain,
    state: State,
    balance: Balance,
    notes: Notes,
    record: EdgeRecord | None = None,
    surfaces: BrittleSurfaces | None = None,
) -> Path:
    """Write folder/checkpoint/state.h5, the old one in place until the new one is whole (collective).

    `record`: what is remembered of broken edges, in a study with fracture; `surfaces`: in one with brittle cracks.
    Raises CannotWrite.
    """
    d, stress = domain.dim, balance.stress
    arrays: dict[str, Any] = {f"{_TERMS}{name}": values for name, values in balance.saved().items()}
    arrays |= {name: domain.gather_nodes(getattr(state, name).reshape(-1, d)) for name in _NODAL}
    for name in _SOMETIMES:
        if (values := getattr(state, name)) is not None:
            arrays[name] = domain.gather_nodes(values.reshape(-1, d))
    if stress.chi is not None:
        arrays["chi"] = domain.gather_cells(stress.chi.x.array[: domain.cell_count])
    if (plastic := stress.material.plastic) is not None:
        arrays["plastic"] = domain.gather_cells(_by_cells(plastic.memory(), plastic.points))
    if record is not None:
        arrays["weakened"], arrays["integrity"] = record.graph.gather_weakened() or (None, None)
        arrays["broken"], arrays["breaks"] = record.saved() or (None, None)
    if surfaces is not None:
        arrays["starts"] = surfaces.starts
    path = checkpoint_path(folder)
    clock = {name: getattr(state, name) for name in _CLOCK}
    written(domain.comm, path, lambda: write_arrays(path, arrays, clock, domain.source, notes))
    return path


def _by_cells(rows: npt.NDArray[np.float64], points: int) -> npt.NDArray[np.float64]:
    """(cells, n), or (cells, points, n) where cells have several, of (cells points, n)."""
    return rows if points == 1 else rows.reshape(-1, points, rows.shape[1])


def write_arrays(
    path: Path, arrays: dict[str, Any], clock: dict[str, float], mesh: MeshData | None, notes: Notes
) -> None:
    """A checkpoint of arrays and numbers by name, of a state on a mesh, the old one in place until it is whole
    (rank 0). Raises OSError."""
    path.parent.mkdir(exist_ok=True)  # not its parents: a folder that is gone is to be told of
    with replacing(path) as new, hdf5_file(new, _size(arrays, notes), begin=True) as file:
        for name, values in arrays.items():
            file[name] = values
        for name, value in clock.items():
            file.attrs[name] = value
        file.attrs["mesh"] = fingerprint(mesh)
        file["notes/study"], file["notes/monitors"] = notes.study, json.dumps(notes.monitors)


def _size(arrays: dict[str, Any], notes: Notes) -> int:
    """Bytes, a little more than the file will have."""
    whole = sum(values.nbytes for values in arrays.values() if values is not None)
    return whole + len(notes.study) + 2 * ROOM + (1 << 10) * (len(arrays) + len(_NOTES))


def read_checkpoint(
    folder: Path,
    domain: Domain,
    state: State,
    balance: Balance,
    record: EdgeRecord | None = None,
    surfaces: BrittleSurfaces | None = None,
) -> State:
    """The state of a checkpoint, with chi and the record with its graph brought to it (collective). What terms
    remember comes as memory["saved"]: stepper.resume gives it to them, once the body is where it was.

    InputError where there is no checkpoint that fits.
    """
    comm, stress = domain.comm, balance.stress
    plastic = stress.material.plastic
    arrays = on_root(comm, lambda: _read(folder, domain.source, record is not None, plastic is not None))
    head = None
    if arrays is not None:
        small: dict[str, Any] = {name: arrays.get(name) for name in _ON_EVERY_RANK}
        small |= {name: values for name, values in arrays.items() if name.startswith(_TERMS)}
        head = arrays.pop("clock"), list(arrays), small
    clock, names, small = comm.bcast(head)

    def scattered(gather: Gather, name: str) -> npt.NDArray[Any]:
        return gather.scatter(arrays[name] if arrays is not None else None)

    nodal = {name: scattered(domain.gather_nodes, name).reshape(-1) for name in (*_NODAL, *_SOMETIMES) if name in names}
    if record is not None and small["weakened"] is not None:
        record.graph.restore(small["weakened"], small["integrity"])
        record.restore(small["broken"], small["breaks"])
    if surfaces is not None and small["starts"] is not None:
        surfaces.starts = small["starts"]
    if stress.chi is not None and "chi" in names:
        stress.chi.x.array[: domain.cell_count] = scattered(domain.gather_cells, "chi")
    if plastic is not None and "plastic" in names:
        rows = scattered(domain.gather_cells, "plastic")
        plastic.recall(rows.reshape(-1, rows.shape[-1]))
    read: dict[str, Any] = {name: clock[name] for name in _CLOCK} | nodal
    terms = {name.removeprefix(_TERMS): values for name, values in small.items() if name.startswith(_TERMS)}
    return replace(state, **read, memory={"saved": terms})


@contextlib.contextmanager
def _opened(folder: Path) -> Iterator[Any]:
    """The checkpoint, to be read."""
    path = checkpoint_path(folder)
    if not path.exists():
        raise InputError(f"--restart: there is no checkpoint {path}; run without --restart")
    try:
        with hdf5_there(path) as file:
            yield file
    except (OSError, KeyError, ValueError) as error:
        raise InputError(f"--restart: cannot read {path}: {error}; run without --restart") from None


def _read(folder: Path, mesh: MeshData | None, torn_too: bool, bent_too: bool) -> dict[str, Any]:
    """The arrays and the clock; the study can go on with broken edges (`torn_too`), plastic strain (`bent_too`)."""
    path = checkpoint_path(folder)
    arrays, clock = read_arrays(folder, mesh, _CLOCK)
    if len(arrays.get("weakened", ())) and not torn_too:
        raise InputError(f"--restart: the body in {path} has broken edges; the study needs its [fracture] table")
    if "plastic" in arrays and arrays["plastic"][..., -1].any() and not bent_too:
        raise InputError(f"--restart: the body in {path} has flowed; the study needs its [plasticity] table")
    return arrays | {"clock": clock}


def read_arrays(
    folder: Path, mesh: MeshData | None, names: Sequence[str]
) -> tuple[dict[str, npt.NDArray[Any]], dict[str, Any]]:
    """The arrays of a checkpoint and the numbers of these names (rank 0). InputError where there is none that fits."""
    with _opened(folder) as file:
        arrays = {name: data[()] for name, data in file.items() if name != "notes"}
        clock, name = {key: file.attrs[key].item() for key in names}, file.attrs["mesh"]
    if name != fingerprint(mesh):
        path = checkpoint_path(folder)
        raise InputError(f"--restart: {path} belongs to another mesh; run without --restart in another folder")
    return arrays, clock


def fingerprint(mesh: MeshData | None) -> str:
    """A short name of a mesh's nodes, cells, groups and regions (rank 0, where the mesh is)."""
    assert mesh is not None
    digest = hashlib.sha256()
    for values in (mesh.points, mesh.cells, *([] if mesh.middles is None else [mesh.middles])):
        digest.update(np.ascontiguousarray(values).tobytes())
    for name, members in sorted([*mesh.facet_groups.items(), *mesh.regions.items()], key=lambda each: each[0]):
        digest.update(name.encode())
        digest.update(np.ascontiguousarray(members).tobytes())
    return digest.hexdigest()[:16]
