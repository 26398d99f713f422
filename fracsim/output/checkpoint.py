"""Checkpoints of a run with deformable bodies, in the order of the input mesh.

The mesh is built again from the study, so a run may continue on another number of ranks. A checkpoint holds all values
on which the next step depends: nodal and cell values, broken edges as pairs of input nodes, history variables of the
terms, and the clock. On the same number of ranks a resumed run takes the steps of the uninterrupted run, to the last
digit. Newton's method keeps tangents and preconditioners as well; a run discards them when it writes a checkpoint
(`Stepper.discard_unsaved_data`). Only finite states are written.
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
from ..meshes.data import MeshData
from ..timestepping.state import State
from .atomic_write import write_on_root
from .checkpoint_file import (
    CHECKPOINT_LIMITS,
    CheckpointNotes,
    StoredCheckpoint,
    check_mesh,
    check_names,
    checkpoint_path,
    read_checkpoint_file,
    restart_error,
    write_checkpoint_file,
)

if TYPE_CHECKING:
    from ..fracture.brittle.surface_criterion import BrittleSurfaces
    from ..fracture.edge_history import EdgeHistory

_CLOCK = ("t", "step", "dt", "dissipated", "work")
_NODAL = ("u", "v", "a", "forces")
# Arrays that a study may not have: name in the file, attribute of the state.
_OPTIONAL_NODAL = {"drag": "damping", "out_of_balance": "out_of_balance"}
_EDGES = ("weakened", "integrity", "broken", "breaks")
# arrays that every rank needs as a whole
_REPLICATED = (*_EDGES, "starts")
_FRACTURE = {*_REPLICATED, "chi", "term.tethers"}
# before the names of the history variables of the terms
_TERM_PREFIX = "term."


def write_checkpoint(
    folder: Path,
    domain: Domain,
    state: State,
    balance: Balance,
    notes: CheckpointNotes,
    record: EdgeHistory | None = None,
    surfaces: BrittleSurfaces | None = None,
) -> Path:
    """Write folder/checkpoint/state.h5 and return its path (collective). The old file stays until the new one is whole.

    Args:
        folder: output folder.
        domain: distributed mesh.
        state: the state to write.
        balance: its terms give their history variables.
        notes: study and monitors.
        record: history of broken edges, in a study with fracture.
        surfaces: start points of brittle surfaces, in a study with them.

    Raises:
        CannotWrite: the file cannot be written.
        NotConverged: the state is not finite; the old file stays.
    """
    d, stress, comm = domain.dim, balance.stress, domain.comm
    terms = balance.histories.to_checkpoint()
    nodal = {name: getattr(state, name) for name in _NODAL}
    nodal |= {name: getattr(state, attribute) for name, attribute in _OPTIONAL_NODAL.items()}
    clock: dict[str, Any] = {name: getattr(state, name) for name in _CLOCK}
    clock |= {"easy": state.easy_steps, "elastic": float(sum_over_ranks(comm, state.elastic)[0]), "dt_before": 0.0}
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
    # history variables of the terms are the same on all ranks
    replicated = terms if comm.rank == 0 else {}
    if name := _first_not_finite(comm, [nodal | cells | edges, clock, replicated]):
        raise NotConverged(f"the state at t = {state.t:g} s is not finite ({name}): it was not written")
    arrays: dict[str, Any] = {f"{_TERM_PREFIX}{name}": values for name, values in terms.items()}
    arrays |= {name: domain.input_numbering.gather_nodes(values.reshape(-1, d)) for name, values in nodal.items()}
    arrays |= {name: domain.input_numbering.gather_cells(values) for name, values in cells.items()}
    if record is not None:
        arrays["weakened"], arrays["integrity"] = record.graph.gather_weakened() or (None, None)
        arrays["broken"], arrays["breaks"] = record.to_checkpoint() or (None, None)
    if surfaces is not None:
        arrays["starts"] = surfaces.starts
    path, mesh = checkpoint_path(folder), domain.input_mesh
    write_on_root(comm, path, lambda: write_checkpoint_file(path, arrays, clock, mesh, notes))
    return path


def _by_cells(rows: npt.NDArray[np.float64], points: int) -> npt.NDArray[np.float64]:
    """Rows (cells points, n) as (cells, points, n), or (cells, n) for one quadrature point per cell."""
    return rows if points == 1 else rows.reshape(-1, points, rows.shape[1])


def is_finite(values: npt.ArrayLike) -> bool:
    """True if all numbers and their squares are finite."""
    return bool(float(np.max(np.abs(values), initial=0.0)) < CHECKPOINT_LIMITS.magnitude)


def _first_not_finite(comm: MPI.Comm, parts: list[dict[str, Any]]) -> str:
    """Name of an array or number that is not finite on some rank, empty if all are finite (collective)."""
    local_name = next((name for part in parts for name, values in part.items() if not is_finite(values)), "")
    return next((name for name in comm.allgather(local_name) if name), "")


# --- reading ----------------------------------------------------------------------------------------------------------


def read_checkpoint(
    folder: Path,
    domain: Domain,
    state: State,
    balance: Balance,
    record: EdgeHistory | None = None,
    surfaces: BrittleSurfaces | None = None,
) -> State:
    """State of a checkpoint (collective). The degradation chi, plastic strain and `record` are set from it as well.

    The history variables of the terms are returned as `history["saved"]`; `Stepper.from_checkpoint` passes them on once
    the displacement is set.

    Args:
        folder: output folder.
        domain: distributed mesh.
        state: initial state of the study.
        balance: its terms say which history variables they need.
        record: history of broken edges, in a study with fracture.
        surfaces: start points of brittle surfaces, in a study with them.

    Raises:
        InputError: there is no checkpoint, or it does not fit the study.
    """
    comm, stress = domain.comm, balance.stress
    plastic, terms = stress.material.plastic, balance.histories.to_checkpoint()
    shapes = {f"{_TERM_PREFIX}{name}": np.shape(values)[1:] for name, values in terms.items()}
    nodes = int(domain.space.dofmap.index_map.size_global)
    cell_count = int(domain.mesh.topology.index_map(domain.dim).size_global)
    shapes |= {name: (nodes, domain.dim) for name in _NODAL}
    if state.damping is not None:
        shapes["drag"] = (nodes, domain.dim)
    if state.frequencies is not None:
        shapes["frequencies"] = (cell_count,)
    if stress.chi is not None:
        shapes["chi"] = (cell_count,)
    if plastic is not None:
        shapes["plastic"] = _by_cells(plastic.snapshot(), plastic.points_per_cell).shape[1:]
    if record is not None:
        shapes |= dict.fromkeys(_EDGES, ())
    if surfaces is not None:
        shapes["starts"] = ()
    checks = _ContentChecks(shapes, nodes, cell_count, fracture=record is not None, plasticity=plastic is not None)
    mesh = domain.input_mesh
    stored = on_root(comm, lambda: _read_checked(folder, mesh, checks))
    message, arrays = None, {} if stored is None else stored.arrays
    if stored is not None:
        replicated: dict[str, Any] = {name: arrays.get(name) for name in _REPLICATED}
        replicated |= {name: values for name, values in arrays.items() if name.startswith(_TERM_PREFIX)}
        message = stored.clock, list(arrays), replicated
    clock, names, replicated = bcast(comm, message)

    def scattered(gather: Gather, name: str) -> npt.NDArray[Any]:
        return gather.scatter(arrays.get(name))

    nodal_names = (*_NODAL, *_OPTIONAL_NODAL, "u_before")
    nodal = {
        name: scattered(domain.input_numbering.gather_nodes, name).reshape(-1) for name in nodal_names if name in names
    }
    before = nodal.pop("u_before", None)
    nodal = {_OPTIONAL_NODAL.get(name, name): values for name, values in nodal.items()}
    if record is not None and replicated["weakened"] is not None:
        _check_edges(comm, record, replicated["weakened"], checkpoint_path(folder))
        record.graph.restore_integrity(replicated["weakened"], replicated["integrity"])
        record.from_checkpoint(replicated["broken"], replicated["breaks"])
    if surfaces is not None and replicated["starts"] is not None:
        surfaces.set_starts(replicated["starts"])
    if stress.chi is not None and "chi" in names:
        stress.chi.x.array[: domain.cell_count] = scattered(domain.input_numbering.gather_cells, "chi")
    if plastic is not None and "plastic" in names:
        rows = scattered(domain.input_numbering.gather_cells, "plastic")
        plastic.restore(rows.reshape(-1, rows.shape[-1]))
    values: dict[str, Any] = {name: clock[name] for name in _CLOCK} | nodal
    values["easy_steps"] = clock["easy"]
    # the energy is a sum over the ranks: rank 0 takes all of it
    values["elastic"] = 0.0 if comm.rank else clock["elastic"]
    values["previous_increment"] = None if before is None else (before, clock["dt_before"])
    if "frequencies" in names:
        values["frequencies"] = scattered(domain.input_numbering.gather_cells, "frequencies")
    history = {key.removeprefix(_TERM_PREFIX): rows for key, rows in replicated.items() if key.startswith(_TERM_PREFIX)}
    return replace(state, **values, history={"saved": history})


class _ContentChecks:
    """Checks of the contents of a checkpoint against a study.

    Attributes:
        shapes: required arrays by name with their shapes. For arrays with any number of rows the shape of a row; () if
            that may be any as well.
        nodes, cells: numbers of nodes and cells of the mesh.
        fracture, plasticity: True if the study can have broken edges, plastic strain.
    """

    def __init__(
        self, shapes: dict[str, tuple[int, ...]], nodes: int, cells: int, *, fracture: bool, plasticity: bool
    ) -> None:
        self.shapes, self.nodes, self.cells = shapes, nodes, cells
        self.fracture, self.plasticity = fracture, plasticity

    def __call__(self, stored: StoredCheckpoint) -> None:
        """Raise InputError for an array that is missing, unknown, of another shape, or out of its range (rank 0)."""
        arrays, path, tables = stored.arrays, stored.path, stored.notes.study_tables()
        if len(arrays.get("weakened", ())) and not self.fracture:
            raise InputError(f"--restart: the body in {path} has broken edges; the study needs its [fracture] table")
        if "plastic" in arrays and arrays["plastic"][..., -1].any() and not self.plasticity:
            raise InputError(f"--restart: the body in {path} has flowed; the study needs its [plasticity] table")
        # a table that was added to the study since has no arrays in the checkpoint
        added = set() if "fracture" in tables else _FRACTURE
        added = added if "plasticity" in tables else added | {"plastic"}
        added = added if "brittle" in tables else added | {"starts"}
        optional = {*_OPTIONAL_NODAL, "u_before", *_REPLICATED, "chi", "plastic"}
        dropped = {name for name in arrays if name.startswith("term.tethers") and not self.fracture}
        allowed = {*self.shapes, *optional, *dropped}
        check_names(arrays, {name for name in self.shapes if not _has_prefix(name, added)}, allowed, path)
        numbers = {*_CLOCK, "easy", "elastic", "dt_before"}
        check_names(stored.clock, numbers, numbers, path)
        for name, values in arrays.items():
            if problem := self._shape_problem(name, values) or self._value_problem(name, values):
                raise restart_error(path, f"{name} {problem}")
        if problem := self._edge_problem(arrays) or _clock_problem(stored.clock, arrays):
            raise restart_error(path, problem)

    def _shape_problem(self, name: str, values: npt.NDArray[Any]) -> str:
        """Error text for the shape of an array, empty if it is right."""
        shape, required = values.shape, self.shapes.get(name)
        if name in (*_NODAL, *_OPTIONAL_NODAL, "u_before"):
            expected: tuple[int, ...] = self.shapes["u"]
        elif name in ("chi", "frequencies"):
            expected = (self.cells,)
        elif name == "plastic":
            expected = (self.cells, *(required or shape[1:]))
        elif name in ("weakened", "broken"):
            expected = (*shape[:1], 2)
        elif name == "integrity":
            expected = (*shape[:1], 1)
        elif name.startswith(_TERM_PREFIX) and required is not None and 0 not in required:
            expected = (*shape[:1], *required)
        else:
            expected = shape if len(shape) in (1, 2) else (len(values), 1)
        return "" if shape == expected else f"has the shape {shape}, of this study it is {expected}"

    def _value_problem(self, name: str, values: npt.NDArray[Any]) -> str:
        """Error text for the numbers of an array, empty if they are in their range."""
        if name == "breaks":
            # NaN: intact edges have no time, and edges cut in their middle no position of the cut
            values = np.nan_to_num(values, nan=0.0)
        if not is_finite(values):
            return "is not finite"
        rounding = CHECKPOINT_LIMITS.chi_rounding
        low, high = {
            "chi": (-rounding, 1 + rounding),
            "integrity": (0.0, np.nextafter(1.0, 0.0)),
            "frequencies": (0.0, np.inf),
            **dict.fromkeys(("weakened", "broken"), (0, self.nodes - 1)),
        }.get(name, (-np.inf, np.inf))
        if values.size and not (low <= values.min() and values.max() <= high):
            return f"is not all from {low:g} to {high:g}"
        return ""

    def _edge_problem(self, arrays: dict[str, npt.NDArray[Any]]) -> str:
        """Error text for arrays of edges that do not match each other, empty if they do."""
        if (present := [name for name in _EDGES if name in arrays]) and len(present) < len(_EDGES):
            return f"it holds {present[0]} without the others of {', '.join(_EDGES)}"
        for keys, rows in (("weakened", "integrity"), ("broken", "breaks")) if present else ():
            pairs = arrays[keys].astype(np.int64)
            if arrays[keys].dtype.kind != "i" or len(pairs) != len(arrays[rows]):
                return f"{keys} and {rows} do not belong together"
            if np.any(pairs[:, 0] >= pairs[:, 1]) or np.any(np.diff(pairs @ np.array([self.nodes, 1])) <= 0):
                return f"{keys} are not edges in rising order"
        return ""


def _has_prefix(name: str, prefixes: set[str]) -> bool:
    """True if a dotted name is one of the prefixes or begins with one and a dot."""
    return any(name == prefix or name.startswith(f"{prefix}.") for prefix in prefixes)


def _clock_problem(clock: dict[str, Any], arrays: dict[str, npt.NDArray[Any]]) -> str:
    """Error text for the numbers of the time scheme, empty if they are in their range."""
    # schemes divide by dt squared
    if not clock["dt"] > 0 or clock["dt"] ** 2 == 0:
        return f"dt is {clock['dt']}, not above 0, or too small"
    if clock["easy"] < 0 or clock["easy"] != int(clock["easy"]):
        return f"easy is {clock['easy']}, no number of steps"
    if ("u_before" in arrays) != (clock["dt_before"] > 0):
        return "u_before and dt_before do not belong together"
    return ""


def _read_checked(folder: Path, mesh: MeshData | None, checks: _ContentChecks) -> StoredCheckpoint:
    """Checkpoint that passed all checks (rank 0). Raises InputError."""
    stored = read_checkpoint_file(folder)
    check_mesh(stored, mesh)
    checks(stored)
    return stored


def _check_edges(comm: MPI.Comm, record: EdgeHistory, keys: npt.NDArray[np.int64], path: Path) -> None:
    """Raise InputError if pairs of input nodes (n, 2), in rising order, are not edges of the mesh (collective)."""
    graph = record.graph
    local, _ = graph.keys.find_edges(keys)
    count = int(sum_over_ranks(comm, np.count_nonzero(local < graph.edge_count))[0])
    if count != len(keys):
        raise restart_error(path, f"{len(keys) - count} of its weakened edges are none of the mesh")
