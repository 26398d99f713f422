"""history.csv: one row a step, with energies, damage, iterations and probes."""

from __future__ import annotations

import os
from collections import Counter
from collections.abc import Callable, Sequence
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
from ..mechanics.time_functions import TimeFunction
from ..mesh.domain import Ints
from ..mesh.parallel import sum_over_ranks
from ..meshes.text import AXES
from ..timestepping.state import State
from ..timestepping.stepper import StepReport
from .atomic_write import open_to_append, replace_text, write_all, written

COLUMNS = (
    "step", "time", "dt", "kinetic", "elastic", "dissipated", "external_work", "broken_edges", "split_cells", "pieces",
    "newton_its", "krylov_its", "wall_step",
)  # fmt: skip

Reading = Callable[[], npt.NDArray[np.float64]]
Figure = Callable[[], float]
WORK = "work_"  # columns that are summed over steps
_NAMED = 5  # gaps between rows that a note names
# what a body of some thickness has as many times as one of 1 m: columns, and heads of columns of probes
OF_THICKNESS = ("kinetic", "elastic", "dissipated", "external_work", "reaction_", "contact_", WORK, "kinetic_")


@dataclass(frozen=True)
class Probe:
    """The mean displacement of nodes in m, or the sum of the reactions on them in N and how far they have moved in the
    mean; `nodes`: local ones."""

    name: str
    quantity: Literal["displacement", "reaction"]
    nodes: Ints


class Probes:
    """Reads displacements and reactions off a body."""

    def __init__(
        self, balance: Balance, probes: Sequence[Probe] = (), *, ways: dict[str, TimeFunction] | None = None,
        thickness: float = 1.0,
    ) -> None:  # fmt: skip
        """Counts the nodes of each. `ways`: (d,) how far each driven obstacle has moved, m; `thickness`: m, of a body
        in 2D, whose forces and energies are of 1 m (collective)."""
        self._balance, self._domain = balance, balance.domain
        axes = AXES[: self._domain.dim]
        readings: dict[str, Reading] = {}
        works: dict[str, Figure] = {}
        least: dict[str, Figure] = {}
        for term in balance.terms:
            readings |= term.summed_columns()
            works |= term.work_columns()
            least |= term.minimum_columns()
        first = {f"{HEADS[probe.quantity]}_{probe.name}": self._reading(probe) for probe in probes}
        pulled = [probe for probe in probes if probe.quantity == "reaction"]
        moved = {f"motion_{probe.name}": self._mean_displacement(probe) for probe in pulled}
        moved |= {f"motion_{name}": partial(self._moved, way) for name, way in (ways or {}).items()}
        self.names = [f"{name}_{axis}" for name in first for axis in axes] + [*readings]
        self.names += [f"{name}_{axis}" for name in moved for axis in axes] + [*works, *least]
        self._readings = [*first.values(), *readings.values(), *moved.values()]
        self._works, self._least = list(works.values()), list(least.values())
        self._factor = factors(self.names, thickness)

    def __call__(self) -> npt.NDArray[np.float64]:
        """All readings in the order of `names`; work_NAME is that of the last step (collective)."""
        if not self._readings:
            return np.empty(0)
        parts = [reading() for reading in self._readings] + [np.array([each() for each in self._works])]
        sums = sum_over_ranks(self._domain.comm, np.concatenate(parts))
        if not self._least:
            return sums * self._factor
        least = np.array([each() for each in self._least])
        self._domain.comm.Allreduce(MPI.IN_PLACE, least, MPI.MIN)
        return np.asarray(np.concatenate([sums, least]) * self._factor)

    def _moved(self, way: TimeFunction) -> npt.NDArray[np.float64]:
        """(d,) this rank's share."""
        return way(self._balance.level.t) if self._domain.comm.rank == 0 else np.zeros(self._domain.dim)

    def _reading(self, probe: Probe) -> Reading:
        if probe.quantity == "displacement":
            return self._mean_displacement(probe)
        owned = self._owned(probe)
        return lambda: self._balance.reactions.reshape(-1, self._domain.dim)[owned].sum(axis=0)

    def _mean_displacement(self, probe: Probe) -> Reading:
        owned, d = self._owned(probe), self._domain.dim
        count = sum_over_ranks(self._domain.comm, len(owned))[0]
        return lambda: self._balance.u.x.array.reshape(-1, d)[owned].sum(axis=0) / count

    def _owned(self, probe: Probe) -> Ints:
        return probe.nodes[probe.nodes < self._domain.node_count]


HEADS = {"reaction": "reaction", "displacement": "probe"}


def factors(names: Sequence[str], thickness: float) -> npt.NDArray[np.float64]:
    """(columns,) what figures of a 2D body of 1 m are multiplied with."""
    return np.array([thickness if name.startswith(OF_THICKNESS) else 1.0 for name in names])


def history_columns(probe_names: list[str]) -> list[str]:
    """The first line of history.csv."""
    return [*COLUMNS, *probe_names]


class History:
    """Appends rows on rank 0, each whole or not at all, so that a run can be watched and survives being killed.

    Attributes:
        peaks: name -> greatest absolute value of each reaction so far, N.        step: of the last row.
        worked: name -> sum of the work of each obstacle so far, J.
        notes: sentences on rows that a restart has not found (rank 0).
    """

    def __init__(
        self, comm: MPI.Comm, path: Path, probe_names: list[str], resume_at: int | None = None, thickness: float = 1.0
    ) -> None:
        """`resume_at`: keep the rows up to this step, in a file that takes the place of the old one; `thickness`: m, of
        a 2D body, whose energies are of 1 m (collective)."""
        self.comm, self._path = comm, path
        self.columns, self._factor = history_columns(probe_names), factors(COLUMNS, thickness)
        self.step = resume_at or 0
        self.peaks = dict.fromkeys((name for name in probe_names if name.startswith("reaction_")), 0.0)
        self.worked = dict.fromkeys((name for name in probe_names if name.startswith(WORK)), 0.0)
        self.notes: list[str] = []
        self._file: RawIOBase | None = written(comm, path, lambda: self._open(resume_at))

    def _open(self, resume_at: int | None) -> RawIOBase:
        earlier = Earlier([], []) if resume_at is None else read_earlier(self._path, self.columns, resume_at)
        self.notes = earlier.notes
        if not earlier.readable:
            self.notes.append(f"it is {set_aside(self._path)} from here on, and {self._path.name} begins anew")
        replace_text(self._path, "".join(map(_line, [self.columns, *earlier.rows])))
        return open_to_append(self._path)

    def append(
        self, state: State, report: StepReport, damage: tuple[int, int, int], probes: npt.NDArray[np.float64]
    ) -> None:
        """One row; `damage` is (broken edges, split cells, pieces). Raises CannotWrite (collective)."""
        values: list[int | float] = [
            state.step, state.t, report.dt, report.kinetic, report.elastic, state.dissipated, state.work, *damage,
            report.solve.newton_iterations, report.solve.krylov_iterations, report.seconds,
        ]  # fmt: skip
        of_body = [each if factor == 1 else each * factor for each, factor in zip(values, self._factor, strict=True)]
        self.append_row([*of_body, *probes])

    def append_row(self, values: Sequence[int | float]) -> None:
        """One row of values in the order of `columns`, the step first. Raises CannotWrite (collective)."""
        row = dict(zip(self.columns, values, strict=True))
        self.peaks = {name: max(peak, abs(float(row[name]))) for name, peak in self.peaks.items()}
        self.worked = {name: done + float(row[name]) for name, done in self.worked.items()}
        row |= self.worked
        line = _line([str(value) if isinstance(value, int) else f"{value:.12g}" for value in row.values()])
        written(self.comm, self._path, lambda: self._write(line.encode()))
        self.step = int(values[0])

    def _write(self, line: bytes) -> None:
        assert self._file is not None
        at = self._file.tell()
        try:
            write_all(self._file, line)
        except OSError:
            self._file.truncate(at)
            raise

    def close(self) -> None:
        if self._file is not None:
            self._file.close()


@dataclass(frozen=True)
class Earlier:
    """What history.csv has of the steps before a restart.

    Attributes:
        rows: values of whole rows, one a step, in rising order.    notes: sentences on what is not as a run leaves it.
        readable: whether it is a table of a run at all.
    """

    rows: list[list[str]]
    notes: list[str]
    readable: bool = True


def read_earlier(path: Path, columns: list[str], until: int) -> Earlier:
    """The rows up to the step of a checkpoint (rank 0). InputError where the file has other columns."""
    if not path.exists():
        return Earlier([], _of_missing(path, "is gone", [], until))
    if not path.is_file():
        raise InputError(f"--restart: {path} is no file; move it away to go on without its rows")
    try:
        lines = path.read_bytes().decode("utf-8-sig").splitlines(keepends=True)
    except UnicodeDecodeError:
        return Earlier([], _of_missing(path, "is not text", [], until), readable=False)
    whole = [line.rstrip("\r\n").split(",") for line in lines if line.endswith("\n")]  # the last one may be cut
    head = whole[0] if whole else lines[0].split(",") if lines else []
    if any("\0" in name for name in head):
        return Earlier([], _of_missing(path, "is not text", [], until), readable=False)
    if head != columns and (whole or not ",".join(columns).startswith(",".join(head))):
        raise InputError(
            f"--restart: {path} has other columns than this study ({', '.join(sorted({*head} ^ {*columns}))}); "
            "move it away to go on without its rows"
        )
    steps = [(step, row) for row in whole[1:] if 1 <= (step := _step(row, len(columns))) <= until]
    known = dict(steps)
    twice = sorted(step for step, count in Counter(step for step, _ in steps).items() if count > 1)
    notes = _of_missing(path, "is cut or damaged" if lines else "is empty", sorted(known), until)
    if twice:
        notes.append(f"{path} had the rows of {_ranges(twice)} twice: the last ones are kept")
    return Earlier([known[step] for step in sorted(known)], notes)


def _step(row: list[str], columns: int) -> int:
    """Of a row of numbers; 0: it is none."""
    try:
        return int(row[0]) if len([float(each) for each in row]) == columns else 0
    except ValueError:
        return 0


def _of_missing(path: Path, why: str, there: list[int], until: int) -> list[str]:
    """A note on the steps up to `until` that have no row."""
    if not (missing := sorted({*range(1, until + 1)} - {*there})):
        return []
    return [f"{path} {why}: the rows of {_ranges(missing)} are missing, of the {until} that the run had taken"]


def _ranges(steps: list[int]) -> str:
    """Steps in words, ascending."""
    ends = np.flatnonzero(np.diff(steps) > 1)
    first, last = [steps[0], *(steps[end + 1] for end in ends)], [*(steps[end] for end in ends), steps[-1]]
    parts = [str(a) if a == b else f"{a} to {b}" for a, b in zip(first, last, strict=True)]
    more = f" and {len(parts) - _NAMED} more gaps" if len(parts) > _NAMED else ""
    return f"step{'s' * (len(steps) > 1)} {', '.join(parts[:_NAMED])}{more}"


def set_aside(path: Path) -> Path:
    """Give a file another name, which no file has yet; returns that. Raises OSError."""
    names = (path.with_name(f"{path.name}.unreadable{number}") for number in ("", *range(2, 1000)))
    free = next(name for name in names if not os.path.lexists(name))
    path.rename(free)
    return free


def _line(values: list[str]) -> str:
    return ",".join(values) + "\r\n"
