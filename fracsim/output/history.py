"""File history.csv: one row per step with energies, damage, iterations, probes and obstacles."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from io import RawIOBase
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..errors import InputError
from ..mechanics.balance import Balance
from ..mechanics.term_protocols import HistoryColumns, fulfilling
from ..mechanics.time_functions import TimeFunction
from ..mesh.domain import Ints
from ..mesh.parallel import sum_over_ranks
from ..meshes.data import AXES
from ..timestepping.state import State
from ..timestepping.stepper import StepReport
from .atomic_write import open_to_append, replace_text, write_all, write_on_root

HISTORY_COLUMNS = (
    "step", "time", "dt", "kinetic", "elastic", "dissipated", "external_work", "broken_edges", "split_cells", "pieces",
    "newton_its", "krylov_its", "wall_step",
)  # fmt: skip

VectorReading = Callable[[], npt.NDArray[np.float64]]
ScalarReading = Callable[[], float]
# columns that are summed over the steps
WORK_PREFIX = "work_"
# quantity of a probe -> prefix of its columns
PROBE_PREFIXES = {"reaction": "reaction", "displacement": "probe"}
# Columns, and prefixes of columns, that are per metre of thickness in 2D before they are written.
THICKNESS_PREFIXES = (
    "kinetic", "elastic", "dissipated", "external_work", "reaction_", "onset_", "contact_", WORK_PREFIX, "kinetic_",
)  # fmt: skip
# ranges of missing rows listed in a note
_MAX_NAMED_GAPS = 5


@dataclass(frozen=True)
class ProbeGroup:
    """Group of nodes whose displacement or reaction is recorded.

    Attributes:
        name: name of the probe.
        quantity: "displacement" for the mean displacement in m; "reaction" for the sum of the reactions in N and the
            mean displacement.
        nodes: local nodes.
    """

    name: str
    quantity: Literal["displacement", "reaction"]
    nodes: Ints


class ProbeReader:
    """Values of all probes and terms in the columns of history.csv.

    Attributes:
        columns: names of the columns.
    """

    def __init__(
        self, balance: Balance, probes: Sequence[ProbeGroup] = (), *, motions: dict[str, TimeFunction] | None = None,
        contours: Mapping[str, VectorReading] | None = None,
        onset_reactions: Callable[[], npt.NDArray[np.float64] | None] | None = None, thickness: float = 1.0,
    ) -> None:  # fmt: skip
        """Count the nodes of each probe (collective).

        Args:
            balance: balance of forces; its terms have readings as well.
            probes: groups of nodes.
            motions: prescribed displacement (d,) in m of each driven obstacle, by name.
            onset_reactions: (owned dofs,) reactions at which edges broke in the step, N, or None before the first step;
                None: they are not recorded.
            contours: J-integrals (d,), J/m^2, by name.
            thickness: thickness of a 2D body, m; 1 in 3D.
        """
        self._balance, self._domain = balance, balance.domain
        axes = AXES[: self._domain.dim]
        term_readings: dict[str, VectorReading] = {}
        works: dict[str, ScalarReading] = {}
        minima: dict[str, ScalarReading] = {}
        for owner in fulfilling(balance.terms, HistoryColumns):
            columns = owner.history_columns()
            term_readings |= columns.sums
            works |= columns.works
            minima |= columns.minima
        probed = {f"{PROBE_PREFIXES[probe.quantity]}_{probe.name}": self._probe_reading(probe) for probe in probes}
        loaded = [probe for probe in probes if probe.quantity == "reaction"]
        if onset_reactions is not None:
            probed |= {f"onset_{probe.name}": self._reaction(probe, onset_reactions) for probe in loaded}
        probed |= {f"J_{name}": contour for name, contour in (contours or {}).items()}
        moved = {f"motion_{probe.name}": self._mean_displacement(probe) for probe in loaded}
        moved |= {f"motion_{name}": partial(self._obstacle_motion, motion) for name, motion in (motions or {}).items()}
        self.columns = [f"{name}_{axis}" for name in probed for axis in axes] + [*term_readings]
        self.columns += [f"{name}_{axis}" for name in moved for axis in axes] + [*works, *minima]
        self._vectors = [*probed.values(), *term_readings.values(), *moved.values()]
        self._works, self._minima = list(works.values()), list(minima.values())
        self._factor = thickness_factors(self.columns, thickness)

    def __call__(self) -> npt.NDArray[np.float64]:
        """Values in the order of `columns`; work_NAME is the work of the last step (collective)."""
        if not self._vectors:
            return np.empty(0)
        parts = [reading() for reading in self._vectors] + [np.array([work() for work in self._works])]
        sums = sum_over_ranks(self._domain.comm, np.concatenate(parts))
        if not self._minima:
            return sums * self._factor
        minima = np.array([minimum() for minimum in self._minima])
        self._domain.comm.Allreduce(MPI.IN_PLACE, minima, MPI.MIN)
        return np.asarray(np.concatenate([sums, minima]) * self._factor)

    def _obstacle_motion(self, motion: TimeFunction) -> npt.NDArray[np.float64]:
        """Prescribed displacement (d,) at the present time on rank 0, zeros on the others: the ranks are summed."""
        return motion(self._balance.level.t) if self._domain.comm.rank == 0 else np.zeros(self._domain.dim)

    def _probe_reading(self, probe: ProbeGroup) -> VectorReading:
        """Function that returns this rank's share (d,) of a probe's displacement or reaction (collective)."""
        if probe.quantity == "displacement":
            return self._mean_displacement(probe)
        return self._reaction(probe, lambda: self._balance.reactions)

    def _reaction(self, probe: ProbeGroup, reactions: Callable[[], npt.NDArray[np.float64] | None]) -> VectorReading:
        """Function that returns this rank's share (d,) of the sum of `reactions` (owned dofs,), N, on a probe."""
        owned, d = self._owned_nodes(probe), self._domain.dim
        # `reactions` of free dofs are the residual of some iterate
        prescribed = ~self._balance.motion.free_dofs.reshape(-1, d)[owned]

        def read() -> npt.NDArray[np.float64]:
            forces = reactions()
            return np.zeros(d) if forces is None else (forces.reshape(-1, d)[owned] * prescribed).sum(axis=0)

        return read

    def _mean_displacement(self, probe: ProbeGroup) -> VectorReading:
        """Function that returns this rank's share (d,) of a probe's mean displacement (collective)."""
        owned, d = self._owned_nodes(probe), self._domain.dim
        count = sum_over_ranks(self._domain.comm, len(owned))[0]
        return lambda: self._balance.u.x.array.reshape(-1, d)[owned].sum(axis=0) / count

    def _owned_nodes(self, probe: ProbeGroup) -> Ints:
        return probe.nodes[probe.nodes < self._domain.node_count]


def thickness_factors(columns: Sequence[str], thickness: float) -> npt.NDArray[np.float64]:
    """Factors (columns,) from values per metre of thickness to those of a body of the given thickness in m."""
    return np.array([thickness if name.startswith(THICKNESS_PREFIXES) else 1.0 for name in columns])


def history_columns(probe_columns: list[str]) -> list[str]:
    """Header of history.csv."""
    return [*HISTORY_COLUMNS, *probe_columns]


class History:
    """Writer of history.csv on rank 0. A row is written as a whole or not at all, also if the run is killed.

    Attributes:
        comm: the ranks of the run.
        columns: names of the columns.
        reaction_peaks: largest absolute value of each reaction so far, also as edges broke within a step, N.
        obstacle_work: sum of the work of each obstacle so far, J.
        last_step: step of the last row.
        last_row: values of the last row by column.
        notes: sentences about rows that a restart did not find (rank 0).
    """

    def __init__(
        self,
        comm: MPI.Comm,
        path: Path | None,
        probe_columns: list[str],
        resume_at: int | None = None,
        thickness: float = 1.0,
    ) -> None:
        """Open the file (collective).

        Args:
            comm: the ranks of the run.
            path: the file; None: rows are kept as `last_row` alone.
            probe_columns: names of the columns after `HISTORY_COLUMNS`.
            resume_at: keep the rows up to this step, in a new file; None: a new run.
            thickness: thickness of a 2D body, m; 1 in 3D.

        Raises:
            CannotWrite: the file cannot be written.
        """
        self.comm, self._path = comm, path
        self.columns, self._factor = history_columns(probe_columns), thickness_factors(HISTORY_COLUMNS, thickness)
        self.last_step = resume_at or 0
        self.reaction_peaks = dict.fromkeys((name for name in probe_columns if name.startswith("reaction_")), 0.0)
        self.obstacle_work = dict.fromkeys((name for name in probe_columns if name.startswith(WORK_PREFIX)), 0.0)
        self.notes: list[str] = []
        self.last_row: dict[str, int | float] = {}
        self._file: RawIOBase | None = None
        if path is not None:
            self._file = write_on_root(comm, path, lambda: self._open(path, resume_at))

    def _open(self, path: Path, resume_at: int | None) -> RawIOBase:
        """Write header and earlier rows, and open the file for appending (rank 0)."""
        earlier = EarlierRows([], []) if resume_at is None else read_earlier_rows(path, self.columns, resume_at)
        self.notes = earlier.notes
        if not earlier.is_readable:
            self.notes.append(f"it is {rename_unreadable(path)} from here on, and {path.name} begins anew")
        replace_text(path, "".join(map(_csv_line, [self.columns, *earlier.rows])))
        return open_to_append(path)

    def append(
        self, state: State, report: StepReport, damage: tuple[int, int, int], probes: npt.NDArray[np.float64]
    ) -> None:
        """Append the row of a step (collective).

        Args:
            state: state at the end of the step.
            report: energies and iterations of the step.
            damage: numbers of broken edges, split cells and fragments.
            probes: values of the probe columns.

        Raises:
            CannotWrite: the file cannot be written.
        """
        values: list[int | float] = [
            state.step, state.t, report.dt, report.kinetic, report.elastic, state.dissipated, state.work, *damage,
            report.solve.newton_iterations, report.solve.krylov_iterations, report.seconds,
        ]  # fmt: skip
        # integers stay integers
        scaled = [value if factor == 1 else value * factor for value, factor in zip(values, self._factor, strict=True)]
        self.append_row([*scaled, *probes])

    def append_row(self, values: Sequence[int | float]) -> None:
        """Append a row of values in the order of `columns`. Raises CannotWrite (collective)."""
        row = dict(zip(self.columns, values, strict=True))
        for name, peak in self.reaction_peaks.items():
            onset = row.get(name.replace("reaction_", "onset_", 1), 0.0)
            self.reaction_peaks[name] = max(peak, abs(float(row[name])), abs(float(onset)))
        self.obstacle_work = {name: done + float(row[name]) for name, done in self.obstacle_work.items()}
        row |= self.obstacle_work
        self.last_row = row
        if self._path is not None:
            line = _csv_line([str(value) if isinstance(value, int) else f"{value:.12g}" for value in row.values()])
            write_on_root(self.comm, self._path, lambda: self._write_line(line.encode()))
        self.last_step = int(values[0])

    def _write_line(self, line: bytes) -> None:
        """Append a line; if that fails (OSError), the file is unchanged."""
        assert self._file is not None
        start = self._file.tell()
        try:
            write_all(self._file, line)
        except OSError:
            self._file.truncate(start)
            raise

    def close(self) -> None:
        """Close the file."""
        if self._file is not None:
            self._file.close()


@dataclass(frozen=True)
class EarlierRows:
    """Rows of history.csv before a restart.

    Attributes:
        rows: complete rows, one per step, in ascending order.
        notes: sentences about missing or repeated rows.
        is_readable: False if the file is not a text file.
    """

    rows: list[list[str]]
    notes: list[str]
    is_readable: bool = True


def read_earlier_rows(path: Path, columns: list[str], until: int) -> EarlierRows:
    """Rows of history.csv up to the step of a checkpoint (rank 0).

    Args:
        path: the file; it may be missing.
        columns: columns that the file must have.
        until: step of the checkpoint.

    Raises:
        InputError: the file is not a regular file, or has other columns.
    """
    if not path.exists():
        return EarlierRows([], _missing_row_notes(path, "is gone", [], until))
    if not path.is_file():
        raise InputError(f"--restart: {path} is no file; move it away to go on without its rows")
    try:
        lines = path.read_bytes().decode("utf-8-sig").splitlines(keepends=True)
    except UnicodeDecodeError:
        return EarlierRows([], _missing_row_notes(path, "is not text", [], until), is_readable=False)
    # the last line of a killed run may lack its end
    complete = [line.rstrip("\r\n").split(",") for line in lines if line.endswith("\n")]
    header = complete[0] if complete else lines[0].split(",") if lines else []
    if any("\0" in name for name in header):
        return EarlierRows([], _missing_row_notes(path, "is not text", [], until), is_readable=False)
    # a file that ends within its header is accepted: it has no rows
    if header != columns and (complete or not ",".join(columns).startswith(",".join(header))):
        raise InputError(
            f"--restart: {path} has other columns than this study ({', '.join(sorted({*header} ^ {*columns}))}); "
            "move it away to go on without its rows"
        )
    steps = [(step, row) for row in complete[1:] if 1 <= (step := _step_of_row(row, len(columns))) <= until]
    row_of_step = dict(steps)
    repeated = sorted(step for step, count in Counter(step for step, _ in steps).items() if count > 1)
    notes = _missing_row_notes(path, "is cut or damaged" if lines else "is empty", sorted(row_of_step), until)
    if repeated:
        notes.append(f"{path} had the rows of {_step_ranges(repeated)} twice: the last ones are kept")
    return EarlierRows([row_of_step[step] for step in sorted(row_of_step)], notes)


def _step_of_row(row: list[str], columns: int) -> int:
    """Step of a row; 0 if the row has a cell that is not a number or another number of columns."""
    try:
        return int(row[0]) if len([float(cell) for cell in row]) == columns else 0
    except ValueError:
        return 0


def _missing_row_notes(path: Path, why: str, present: list[int], until: int) -> list[str]:
    """Sentence about the steps up to `until` that have no row, if there are any."""
    if not (missing := sorted({*range(1, until + 1)} - {*present})):
        return []
    return [f"{path} {why}: the rows of {_step_ranges(missing)} are missing, of the {until} that the run had taken"]


def _step_ranges(steps: list[int]) -> str:
    """Ascending step numbers in words, as in "steps 1 to 3, 7"."""
    ends = np.flatnonzero(np.diff(steps) > 1)
    first, last = [steps[0], *(steps[end + 1] for end in ends)], [*(steps[end] for end in ends), steps[-1]]
    ranges = [str(a) if a == b else f"{a} to {b}" for a, b in zip(first, last, strict=True)]
    unnamed = f" and {len(ranges) - _MAX_NAMED_GAPS} more gaps" if len(ranges) > _MAX_NAMED_GAPS else ""
    return f"step{'s' * (len(steps) > 1)} {', '.join(ranges[:_MAX_NAMED_GAPS])}{unnamed}"


def rename_unreadable(path: Path) -> Path:
    """Rename a file to an unused name and return that. Raises OSError."""
    names = (path.with_name(f"{path.name}.unreadable{number}") for number in ("", *range(2, 1000)))
    unused = next(name for name in names if not os.path.lexists(name))
    path.rename(unused)
    return unused


def _csv_line(values: list[str]) -> str:
    return ",".join(values) + "\r\n"
