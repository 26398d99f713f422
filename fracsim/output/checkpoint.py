"""Checkpoints of a run with deformable bodies, in the order of the input mesh.

The mesh is built again from the study, so a run may continue on another number of ranks. Rank 0 reads and writes the
file; of rows of nodes, cells and edges it holds one block at a time. A checkpoint holds all values on which the next
step depends: nodal and cell values, broken edges as pairs of input nodes, history variables of the terms, and the
clock. On the same number of ranks a resumed run takes the steps of the uninterrupted run, to the last digit.
Newton's method keeps tangents and preconditioners as well; a run discards them when it writes a checkpoint
(`Stepper.discard_unsaved_data`). Only finite states are written.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..errors import InputError, NotConverged
from ..mechanics.balance import Balance
from ..mesh.domain import Domain
from ..mesh.parallel import BlockGather, bcast, from_root, on_root, sum_over_ranks
from ..timestepping.state import State
from .atomic_write import write_on_root
from .checkpoint_file import (
    CHECKPOINT_LIMITS,
    ArrayWriter,
    CheckpointNotes,
    Layout,
    StoredCheckpoint,
    check_mesh,
    check_names,
    checkpoint_path,
    layouts_of,
    new_checkpoint_file,
    open_checkpoint,
    read_rows,
    restart_error,
    row_blocks,
)

if TYPE_CHECKING:
    from ..fracture.brittle.surface_criterion import BrittleSurfaces
    from ..fracture.edge_history import EdgeHistory
    from ..mesh.edge_graph import EdgeRows

_CLOCK = ("t", "step", "dt", "dissipated", "work")
_NODAL = ("u", "v", "a", "forces")
# Arrays that a study may not have: name in the file, attribute of the state.
_OPTIONAL_NODAL = {"drag": "damping", "out_of_balance": "out_of_balance"}
_EDGES = ("weakened", "integrity", "broken", "breaks")
_FRACTURE = {*_EDGES, "starts", "chi", "term.tethers"}
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
    edges = {} if record is None else {_EDGES[:2]: record.graph.integrity[:, None], _EDGES[2:]: record.weakened_rows()}
    # history variables of the terms are the same on all ranks
    whole = terms if comm.rank == 0 else {}
    integrity = {} if record is None else {"integrity": record.graph.integrity}
    if name := _first_not_finite(comm, [nodal | cells | integrity, clock, whole]):
        raise NotConverged(f"the state at t = {state.t:g} s is not finite ({name}): it was not written")
    whole = {f"{_TERM_PREFIX}{name}": values for name, values in whole.items()}
    if surfaces is not None:
        whole["starts"] = surfaces.starts
    numbering = domain.input_numbering
    of_nodes = BlockGather(comm, numbering.nodes[: domain.node_count])
    of_cells = BlockGather(comm, numbering.cells)
    weakened = 0 if record is None else int(sum_over_ranks(comm, record.graph.weakened_count)[0])
    layouts: dict[str, Layout] = layouts_of(whole)
    layouts |= {name: ((of_nodes.count, d), values.dtype) for name, values in nodal.items()}
    layouts |= {name: ((of_cells.count, *values.shape[1:]), values.dtype) for name, values in cells.items()}
    for (keys, name), values in edges.items():
        layouts |= {keys: ((weakened, 2), np.dtype(np.int64)), name: ((weakened, values.shape[1]), values.dtype)}

    def blocks() -> Iterator[dict[str, Any]]:
        yield whole
        for name, values in nodal.items():
            yield from ({name: rows} for rows in of_nodes(values.reshape(-1, d)))
        for name, values in cells.items():
            yield from ({name: rows} for rows in of_cells(values))
        for names, values in edges.items():
            assert record is not None
            for keys_and_rows in record.graph.weakened_blocks(values):
                yield dict(zip(names, keys_and_rows or (None, None), strict=True))

    path, fingerprint = checkpoint_path(folder), domain.fingerprint
    _write_blocks(comm, path, new_checkpoint_file(path, layouts, clock, fingerprint, notes), blocks())
    return path


def _write_blocks(
    comm: MPI.Comm, path: Path, new_file: AbstractContextManager[ArrayWriter], blocks: Iterator[dict[str, Any]]
) -> None:
    """Write a checkpoint (collective).

    Args:
        comm: the ranks that call.
        path: the file.
        new_file: opens the file, on rank 0.
        blocks: the next rows of arrays on rank 0, by name.

    Raises:
        CannotWrite: the file cannot be written; the previous one stays.
    """
    stack = ExitStack()
    try:
        writer = write_on_root(comm, path, lambda: stack.enter_context(new_file))
        for block in blocks:
            write_on_root(comm, path, partial(_append, writer, block))
    except BaseException as error:
        # closing the incomplete file may fail as well
        with suppress(OSError):
            stack.__exit__(type(error), error, error.__traceback__)
        raise
    write_on_root(comm, path, stack.close)


def _append(writer: ArrayWriter | None, block: dict[str, npt.NDArray[Any]]) -> None:
    """Write the next rows of arrays (rank 0). Raises OSError."""
    assert writer is not None
    for name, rows in block.items():
        writer.append_rows(name, rows)


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
    fingerprint, numbering = domain.fingerprint, domain.input_numbering
    of_nodes = BlockGather(comm, numbering.nodes[: domain.node_count])
    of_cells = BlockGather(comm, numbering.cells)
    with ExitStack() as stack:
        stored = on_root(comm, lambda: _open_checked(stack, folder, fingerprint, checks))
        file = _SharedReader(comm, stored)
        nodal_names = [name for name in (*_NODAL, *_OPTIONAL_NODAL, "u_before") if name in file.lengths]
        nodal = {name: of_nodes.scatter(partial(file.read_rows, name)).reshape(-1) for name in nodal_names}
        names = {"frequencies"}
        if stress.chi is not None:
            names.add("chi")
        if plastic is not None:
            names.add("plastic")
        cells = {name: of_cells.scatter(partial(file.read_rows, name)) for name in sorted(names & file.lengths.keys())}
        if record is not None and "weakened" in file.lengths:
            owned = record.graph.restore_integrity(file.edge_blocks("weakened", "integrity"))
            if unknown := file.lengths["weakened"] - int(sum_over_ranks(comm, owned)[0]):
                raise restart_error(checkpoint_path(folder), f"{unknown} of its weakened edges are none of the mesh")
            record.restore_rows(file.edge_blocks("broken", "breaks"))
    if surfaces is not None and "starts" in file.whole:
        surfaces.set_starts(file.whole["starts"])
    if stress.chi is not None and "chi" in cells:
        stress.chi.x.array[: domain.cell_count] = cells["chi"]
    if plastic is not None and "plastic" in cells:
        rows = cells["plastic"]
        plastic.restore(rows.reshape(-1, rows.shape[-1]))
    before = nodal.pop("u_before", None)
    values: dict[str, Any] = {name: file.clock[name] for name in _CLOCK}
    values |= {_OPTIONAL_NODAL.get(name, name): rows for name, rows in nodal.items()}
    values["easy_steps"] = file.clock["easy"]
    # the energy is a sum over the ranks: rank 0 takes all of it
    values["elastic"] = 0.0 if comm.rank else file.clock["elastic"]
    values["previous_increment"] = None if before is None else (before, file.clock["dt_before"])
    if "frequencies" in cells:
        values["frequencies"] = cells["frequencies"]
    history = {name.removeprefix(_TERM_PREFIX): rows for name, rows in file.whole.items() if name != "starts"}
    return replace(state, **values, history={"saved": history})


class _SharedReader:
    """Checkpoint that rank 0 reads for all ranks.

    Attributes:
        clock: numbers by name.
        lengths: number of rows of each array.
        whole: arrays that every rank has: history variables of terms, and starts of brittle surfaces.
    """

    def __init__(self, comm: MPI.Comm, stored: StoredCheckpoint | None) -> None:
        """`stored`: the open file on rank 0, None elsewhere (collective). Raises InputError."""
        self._comm, self._stored = comm, stored
        self.clock, self.lengths, self.whole = from_root(comm, self._read_head)

    def _read_head(self) -> tuple[dict[str, Any], dict[str, int], dict[str, npt.NDArray[Any]]]:
        assert self._stored is not None
        arrays = self._stored.arrays
        names = [name for name in arrays if name == "starts" or name.startswith(_TERM_PREFIX)]
        whole = {name: read_rows(self._stored, name, slice(None)) for name in names}
        return self._stored.clock, {name: len(rows) for name, rows in arrays.items()}, whole

    def read_rows(self, name: str, rows: slice) -> npt.NDArray[Any] | None:
        """Rows of an array on rank 0, None elsewhere (collective). Raises InputError."""
        stored = self._stored
        return on_root(self._comm, lambda: None if stored is None else read_rows(stored, name, rows))

    def edge_blocks(self, *names: str) -> Iterator[EdgeRows]:
        """Rows of two arrays of edges, keys and values, in blocks on every rank (collective). Raises InputError."""
        for rows in row_blocks(self.lengths[names[0]]):
            keys, values = bcast(self._comm, [self.read_rows(name, rows) for name in names])
            yield keys, values


def _open_checked(stack: ExitStack, folder: Path, fingerprint: str | None, checks: _ContentChecks) -> StoredCheckpoint:
    """Checkpoint that passed all checks, open until the stack is closed (rank 0). Raises InputError."""
    stored = stack.enter_context(open_checkpoint(folder))
    check_mesh(stored, fingerprint)
    checks(stored)
    return stored


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
        if "weakened" in arrays and any(arrays["weakened"].shape[:1]) and not self.fracture:
            raise InputError(f"--restart: the body in {path} has broken edges; the study needs its [fracture] table")
        if not self.plasticity and any(np.any(np.atleast_1d(rows)[..., -1:]) for rows in _blocks(stored, "plastic")):
            raise InputError(f"--restart: the body in {path} has flowed; the study needs its [plasticity] table")
        # a table that was added to the study since has no arrays in the checkpoint
        added = set() if "fracture" in tables else _FRACTURE
        added = added if "plasticity" in tables else added | {"plastic"}
        added = added if "brittle" in tables else added | {"starts"}
        optional = {*_OPTIONAL_NODAL, "u_before", *_EDGES, "starts", "chi", "plastic"}
        dropped = {name for name in arrays if name.startswith("term.tethers") and not self.fracture}
        allowed = {*self.shapes, *optional, *dropped}
        check_names(arrays, {name for name in self.shapes if not _has_prefix(name, added)}, allowed, path)
        numbers = {*_CLOCK, "easy", "elastic", "dt_before"}
        check_names(stored.clock, numbers, numbers, path)
        for name, values in arrays.items():
            problems = (self._value_problem(name, rows) for rows in _blocks(stored, name))
            if problem := self._shape_problem(name, values.shape) or next(filter(None, problems), ""):
                raise restart_error(path, f"{name} {problem}")
        if problem := self._edge_problem(stored) or _clock_problem(stored.clock, arrays):
            raise restart_error(path, problem)

    def _shape_problem(self, name: str, shape: tuple[int, ...]) -> str:
        """Error text for the shape of an array, empty if it is right."""
        required = self.shapes.get(name)
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
            expected = shape if len(shape) in (1, 2) else (*shape[:1], 1)
        return "" if shape == expected else f"has the shape {shape}, of this study it is {expected}"

    def _value_problem(self, name: str, values: npt.NDArray[Any]) -> str:
        """Error text for the numbers of rows of an array, empty if they are in their range."""
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

    def _edge_problem(self, stored: StoredCheckpoint) -> str:
        """Error text for arrays of edges that do not match each other, empty if they do."""
        arrays = stored.arrays
        if (present := [name for name in _EDGES if name in arrays]) and len(present) < len(_EDGES):
            return f"it holds {present[0]} without the others of {', '.join(_EDGES)}"
        for keys, rows in (("weakened", "integrity"), ("broken", "breaks")) if present else ():
            if arrays[keys].dtype.kind != "i" or len(arrays[keys]) != len(arrays[rows]):
                return f"{keys} and {rows} do not belong together"
            last = -1
            for pairs in _blocks(stored, keys):
                numbers = pairs.astype(np.int64) @ np.array([self.nodes, 1])
                if np.any(pairs[:, 0] >= pairs[:, 1]) or np.any(np.diff(numbers, prepend=last) <= 0):
                    return f"{keys} are not edges in rising order"
                last = int(np.max(numbers, initial=last))
        return ""


def _blocks(stored: StoredCheckpoint, name: str) -> Iterator[npt.NDArray[Any]]:
    """Rows of an array, a block at a time; none if there is no such array (rank 0). Raises InputError."""
    if name in stored.arrays:
        for rows in row_blocks(*stored.arrays[name].shape[:1]):
            yield read_rows(stored, name, rows)


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
