"""Checkpoints: the state in the order of the input mesh, so that a run may go on with another number of ranks.

The mesh itself is built again from the study. Nodal and cell values, broken edges (as pairs of input nodes), what terms
remember and the clock are all that the next step depends on: a run that resumes takes the steps of the run that goes
on, to the last digit where ranks are the same. Only Newton's method keeps more (tangents, preconditioners, how solves
went), which a run drops as it writes a checkpoint (Stepper.forget). Only finite states are written.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..errors import InputError, NotConverged
from ..mechanics.balance import Balance
from ..mesh.domain import Domain
from ..mesh.parallel import Gather, bcast, on_root, sum_over_ranks
from ..timestepping.state import State
from .atomic_write import written
from .checkpoint_file import (
    LARGEST,
    Notes,
    Stored,
    check_mesh,
    checkpoint_path,
    read_stored,
    refusal,
    require,
    write_arrays,
)

if TYPE_CHECKING:
    from ..fracture.brittle.surface_criterion import BrittleSurfaces
    from ..fracture.edge_history import EdgeRecord

_CLOCK = ("t", "step", "dt", "dissipated", "work", "easy")
_NODAL = ("u", "v", "a", "forces")
_SOMETIMES = ("drag", "out_of_balance")
_EDGES = ("weakened", "integrity", "broken", "breaks")
_ON_EVERY_RANK = (*_EDGES, "starts")
_OF_FRACTURE = {*_ON_EVERY_RANK, "chi", "term.tethers"}
_TERMS = "term."  # before the names of what terms of the balance remember
_ROUNDED = 1e-9  # by which chi may lie outside of 0 and 1


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
    Raises CannotWrite, and NotConverged where the state is not finite: the old one stays.
    """
    d, stress, comm = domain.dim, balance.stress, domain.comm
    terms = balance.to_checkpoint()
    nodal = {name: getattr(state, name) for name in (*_NODAL, *_SOMETIMES)}
    clock: dict[str, Any] = {name: getattr(state, name) for name in _CLOCK}
    clock |= {"elastic": float(sum_over_ranks(comm, state.elastic)[0]), "dt_before": 0.0}
    if state.previous_increment is not None:
        nodal["u_before"], clock["dt_before"] = state.previous_increment
    nodal = {name: values for name, values in nodal.items() if values is not None}
    cells: dict[str, Any] = {}
    if state.frequencies is not None:
        cells["frequencies"] = state.frequencies
    if stress.chi is not None:
        cells["chi"] = stress.chi.x.array[: domain.cell_count]
    if (plastic := stress.material.plastic) is not None:
        cells["plastic"] = _by_cells(plastic.snapshot(), plastic.points_per_cell)
    edges = {} if record is None else {"integrity": record.graph.integrity}
    here = terms if comm.rank == 0 else {}
    if name := _first_not_finite(comm, [nodal | cells | edges, clock, here]):
        raise NotConverged(f"the state at t = {state.t:g} s is not finite ({name}): it was not written")
    arrays: dict[str, Any] = {f"{_TERMS}{name}": values for name, values in terms.items()}
    arrays |= {name: domain.gather_nodes(values.reshape(-1, d)) for name, values in nodal.items()}
    arrays |= {name: domain.gather_cells(values) for name, values in cells.items()}
    if record is not None:
        arrays["weakened"], arrays["integrity"] = record.graph.gather_weakened() or (None, None)
        arrays["broken"], arrays["breaks"] = record.saved() or (None, None)
    if surfaces is not None:
        arrays["starts"] = surfaces.starts
    path = checkpoint_path(folder)
    written(comm, path, lambda: write_arrays(path, arrays, clock, domain.source, notes))
    return path


def _by_cells(rows: npt.NDArray[np.float64], points: int) -> npt.NDArray[np.float64]:
    """(cells, n), or (cells, points, n) where cells have several, of (cells points, n)."""
    return rows if points == 1 else rows.reshape(-1, points, rows.shape[1])


def is_finite(values: npt.ArrayLike) -> bool:
    """Whether all numbers are finite, and so are their squares."""
    return bool(float(np.max(np.abs(values), initial=0.0)) < LARGEST)


def _first_not_finite(comm: MPI.Comm, parts: list[dict[str, Any]]) -> str:
    """The name of an array or a number that is not finite on some rank; empty: all are (collective)."""
    mine = next((name for part in parts for name, values in part.items() if not is_finite(values)), "")
    return next((name for name in comm.allgather(mine) if name), "")


# --- reading ----------------------------------------------------------------------------------------------------------


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

    `state`: that of the study at its start. InputError where there is no checkpoint that fits.
    """
    comm, stress = domain.comm, balance.stress
    plastic, terms = stress.material.plastic, balance.to_checkpoint()
    wanted = {f"{_TERMS}{name}": np.shape(values)[1:] for name, values in terms.items()}
    nodes = int(domain.space.dofmap.index_map.size_global)
    cell_count = int(domain.mesh.topology.index_map(domain.dim).size_global)
    wanted |= {name: (nodes, domain.dim) for name in _NODAL}
    if state.drag is not None:
        wanted["drag"] = (nodes, domain.dim)
    if state.frequencies is not None:
        wanted["frequencies"] = (cell_count,)
    if stress.chi is not None:
        wanted["chi"] = (cell_count,)
    if plastic is not None:
        wanted["plastic"] = _by_cells(plastic.snapshot(), plastic.points_per_cell).shape[1:]
    if record is not None:
        wanted |= dict.fromkeys(_EDGES, ())
    if surfaces is not None:
        wanted["starts"] = ()
    checks = _Checks(wanted, nodes, cell_count, torn_too=record is not None, bent_too=plastic is not None)
    stored = on_root(comm, lambda: _read(folder, domain, checks))
    head, arrays = None, {} if stored is None else stored.arrays
    if stored is not None:
        small: dict[str, Any] = {name: arrays.get(name) for name in _ON_EVERY_RANK}
        small |= {name: values for name, values in arrays.items() if name.startswith(_TERMS)}
        head = stored.clock, list(arrays), small
    clock, names, small = bcast(comm, head)

    def scattered(gather: Gather, name: str) -> npt.NDArray[Any]:
        return gather.scatter(arrays.get(name))

    every = (*_NODAL, *_SOMETIMES, "u_before")
    nodal = {name: scattered(domain.gather_nodes, name).reshape(-1) for name in every if name in names}
    before = nodal.pop("u_before", None)
    if record is not None and small["weakened"] is not None:
        _check_edges(comm, record, small["weakened"], checkpoint_path(folder))
        record.graph.restore_integrity(small["weakened"], small["integrity"])
        record.restore(small["broken"], small["breaks"])
    if surfaces is not None and small["starts"] is not None:
        surfaces.starts = small["starts"]
    if stress.chi is not None and "chi" in names:
        stress.chi.x.array[: domain.cell_count] = scattered(domain.gather_cells, "chi")
    if plastic is not None and "plastic" in names:
        rows = scattered(domain.gather_cells, "plastic")
        plastic.restore(rows.reshape(-1, rows.shape[-1]))
    read: dict[str, Any] = {name: clock[name] for name in _CLOCK} | nodal
    read["elastic"] = 0.0 if comm.rank else clock["elastic"]
    read["previous_increment"] = None if before is None else (before, clock["dt_before"])
    if "frequencies" in names:
        read["frequencies"] = scattered(domain.gather_cells, "frequencies")
    remembered = {name.removeprefix(_TERMS): values for name, values in small.items() if name.startswith(_TERMS)}
    return replace(state, **read, history={"saved": remembered})


class _Checks:
    """What a checkpoint has to hold for a study to go on from it.

    Attributes:
        wanted: shapes of arrays by name; of what has rows of any number those of a row, () where it may be any.
        nodes, cells: of the mesh.    torn_too, bent_too: whether the study can have broken edges, plastic strain.
    """

    def __init__(
        self, wanted: dict[str, tuple[int, ...]], nodes: int, cells: int, *, torn_too: bool, bent_too: bool
    ) -> None:
        self.wanted, self.nodes, self.cells = wanted, nodes, cells
        self.torn_too, self.bent_too = torn_too, bent_too

    def __call__(self, stored: Stored) -> None:
        """InputError where something is missing, unknown, of another shape, or out of its range (rank 0)."""
        arrays, path, then = stored.arrays, stored.path, stored.notes.values()
        if len(arrays.get("weakened", ())) and not self.torn_too:
            raise InputError(f"--restart: the body in {path} has broken edges; the study needs its [fracture] table")
        if "plastic" in arrays and arrays["plastic"][..., -1].any() and not self.bent_too:
            raise InputError(f"--restart: the body in {path} has flowed; the study needs its [plasticity] table")
        late = set() if "fracture" in then else _OF_FRACTURE
        late = late if "plasticity" in then else late | {"plastic"}
        late = late if "brittle" in then else late | {"starts"}
        optional = {*_SOMETIMES, "u_before", *_ON_EVERY_RANK, "chi", "plastic"}
        gone = {name for name in arrays if name.startswith("term.tethers") and not self.torn_too}
        known = {*self.wanted, *optional, *gone}
        require(arrays, {name for name in self.wanted if not _is_of(name, late)}, known, path)
        require(stored.clock, {*_CLOCK, "elastic", "dt_before"}, {*_CLOCK, "elastic", "dt_before"}, path)
        for name, values in arrays.items():
            if said := self._shape(name, values) or self._values(name, values):
                raise refusal(path, f"{name} {said}")
        if said := self._together(arrays) or _of_clock(stored.clock, arrays):
            raise refusal(path, said)

    def _shape(self, name: str, values: npt.NDArray[Any]) -> str:
        """What is wrong with the shape of an array; empty: nothing."""
        shape, wanted = values.shape, self.wanted.get(name)
        if name in (*_NODAL, *_SOMETIMES, "u_before"):
            right: tuple[int, ...] = self.wanted["u"]
        elif name in ("chi", "frequencies"):
            right = (self.cells,)
        elif name == "plastic":
            right = (self.cells, *(wanted or shape[1:]))
        elif name in ("weakened", "broken"):
            right = (*shape[:1], 2)
        elif name == "integrity":
            right = (*shape[:1], 1)
        elif name.startswith(_TERMS) and wanted is not None and 0 not in wanted:
            right = (*shape[:1], *wanted)
        else:
            right = shape if len(shape) in (1, 2) else (len(values), 1)
        return "" if shape == right else f"has the shape {shape}, of this study it is {right}"

    def _values(self, name: str, values: npt.NDArray[Any]) -> str:
        """What is wrong with the numbers of an array; empty: nothing."""
        if name == "breaks":  # of edges that are whole, and of cuts in the middle, there is no number
            values = np.nan_to_num(values, nan=0.0)
        if not is_finite(values):
            return "is not finite"
        low, high = {
            "chi": (-_ROUNDED, 1 + _ROUNDED),
            "integrity": (0.0, np.nextafter(1.0, 0.0)),
            "frequencies": (0.0, np.inf),
            **dict.fromkeys(("weakened", "broken"), (0, self.nodes - 1)),
        }.get(name, (-np.inf, np.inf))
        if values.size and not (low <= values.min() and values.max() <= high):
            return f"is not all from {low:g} to {high:g}"
        return ""

    def _together(self, arrays: dict[str, npt.NDArray[Any]]) -> str:
        """What is wrong between the arrays of edges; empty: nothing."""
        if (there := [name for name in _EDGES if name in arrays]) and len(there) < len(_EDGES):
            return f"it holds {there[0]} without the others of {', '.join(_EDGES)}"
        for keys, rows in (("weakened", "integrity"), ("broken", "breaks")) if there else ():
            pairs = arrays[keys].astype(np.int64)
            if arrays[keys].dtype.kind != "i" or len(pairs) != len(arrays[rows]):
                return f"{keys} and {rows} do not belong together"
            if np.any(pairs[:, 0] >= pairs[:, 1]) or np.any(np.diff(pairs @ np.array([self.nodes, 1])) <= 0):
                return f"{keys} are not edges in rising order"
        return ""


def _is_of(name: str, names: set[str]) -> bool:
    return any(name == each or name.startswith(f"{each}.") for each in names)


def _of_clock(clock: dict[str, Any], arrays: dict[str, npt.NDArray[Any]]) -> str:
    """What is wrong with the numbers beside the time; empty: nothing."""
    if not clock["dt"] > 0 or clock["dt"] ** 2 == 0:  # what a scheme divides by
        return f"dt is {clock['dt']}, not above 0, or too small"
    if clock["easy"] < 0 or clock["easy"] != int(clock["easy"]):
        return f"easy is {clock['easy']}, no number of steps"
    if ("u_before" in arrays) != (clock["dt_before"] > 0):
        return "u_before and dt_before do not belong together"
    return ""


def _read(folder: Path, domain: Domain, checks: _Checks) -> Stored:
    stored = read_stored(folder)
    check_mesh(stored, domain.source)
    checks(stored)
    return stored


def _check_edges(comm: MPI.Comm, record: EdgeRecord, keys: npt.NDArray[np.int64], path: Path) -> None:
    """InputError where pairs of nodes (n, 2), in rising order, are no edges of the mesh (collective)."""
    graph = record.graph
    local, _ = graph.find_keys(keys)
    found = int(sum_over_ranks(comm, np.count_nonzero(local < graph.edge_count))[0])
    if found != len(keys):
        raise refusal(path, f"{len(keys) - found} of its weakened edges are none of the mesh")
