"""history.csv: one row a step, with energies, damage, iterations and probes."""

from __future__ import annotations

import csv
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from io import RawIOBase
from pathlib import Path
from typing import Literal

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..errors import InputError
from ..mechanics.balance import Balance
from ..mesh.domain import Ints
from ..mesh.ranks import total
from ..meshes.words import AXES
from ..stepping.state import State
from ..stepping.stepper import StepReport
from .writing import replace_text, write_all, written

COLUMNS = (
    "step", "time", "dt", "kinetic", "elastic", "dissipated", "external_work", "broken_edges", "split_cells", "pieces",
    "newton_its", "krylov_its", "wall_step",
)  # fmt: skip

Reading = Callable[[], npt.NDArray[np.float64]]
Figure = Callable[[], float]
WORK = "work_"  # columns that are summed over steps


@dataclass(frozen=True)
class Probe:
    """The mean displacement of nodes in m, or the sum of the reactions on them in N; `nodes`: local ones."""

    name: str
    quantity: Literal["displacement", "reaction"]
    nodes: Ints


class Probes:
    """Reads displacements and reactions off a body."""

    def __init__(self, balance: Balance, probes: Sequence[Probe] = ()) -> None:
        """Counts the nodes of each (collective)."""
        self._balance, self._domain = balance, balance.domain
        kinds = {"reaction": "reaction", "displacement": "probe"}
        axes = AXES[: self._domain.dim]
        self.names = [f"{kinds[probe.quantity]}_{probe.name}_{axis}" for probe in probes for axis in axes]
        self._readings = [self._reading(probe) for probe in probes]
        readings: dict[str, Reading] = {}
        works: dict[str, Figure] = {}
        least: dict[str, Figure] = {}
        for term in balance.terms:
            readings |= term.readings()
            works |= term.works()
            least |= term.least()
        self.names += [*readings, *works, *least]
        self._readings += readings.values()
        self._works, self._least = list(works.values()), list(least.values())

    def __call__(self) -> npt.NDArray[np.float64]:
        """All readings in the order of `names`; work_NAME is that of the last step (collective)."""
        if not self._readings:
            return np.empty(0)
        parts = [reading() for reading in self._readings] + [np.array([each() for each in self._works])]
        sums = total(self._domain.comm, np.concatenate(parts))
        if not self._least:
            return sums
        least = np.array([each() for each in self._least])
        self._domain.comm.Allreduce(MPI.IN_PLACE, least, MPI.MIN)
        return np.concatenate([sums, least])

    def _reading(self, probe: Probe) -> Reading:
        owned = probe.nodes[probe.nodes < self._domain.node_count]
        if probe.quantity == "displacement":
            return self._mean_displacement(owned)
        return lambda: self._balance.reactions.reshape(-1, self._domain.dim)[owned].sum(axis=0)

    def _mean_displacement(self, owned: Ints) -> Reading:
        count = total(self._domain.comm, len(owned))[0]
        d = self._domain.dim
        return lambda: self._balance.u.x.array.reshape(-1, d)[owned].sum(axis=0) / count


def history_columns(probe_names: list[str]) -> list[str]:
    """The first line of history.csv."""
    return [*COLUMNS, *probe_names]


class History:
    """Appends rows on rank 0, each whole or not at all, so that a run can be watched and survives being killed.

    Attributes:
        peaks: name -> greatest absolute value of each reaction so far, N.        step: of the last row.
        worked: name -> sum of the work of each obstacle so far, J.
    """

    def __init__(self, comm: MPI.Comm, path: Path, probe_names: list[str], resume_at: int | None = None) -> None:
        """`resume_at`: keep the rows up to this step, in a file that takes the place of the old one (collective)."""
        self.comm, self._path = comm, path
        self.columns = history_columns(probe_names)
        self.step = resume_at or 0
        self.peaks = dict.fromkeys((name for name in probe_names if name.startswith("reaction_")), 0.0)
        self.worked = dict.fromkeys((name for name in probe_names if name.startswith(WORK)), 0.0)
        self._file: RawIOBase | None = written(comm, path, lambda: self._open(resume_at))

    def _open(self, resume_at: int | None) -> RawIOBase:
        kept = read_rows(self._path, self.columns, resume_at) if resume_at is not None else []
        replace_text(self._path, "".join(map(_line, [self.columns, *kept])))
        return self._path.open("ab", buffering=0)

    def append(
        self, state: State, report: StepReport, damage: tuple[int, int, int], probes: npt.NDArray[np.float64]
    ) -> None:
        """One row; `damage` is (broken edges, split cells, pieces). Raises CannotWrite (collective)."""
        values: list[int | float] = [
            state.step, state.t, report.dt, report.kinetic, report.elastic, state.dissipated, state.work, *damage,
            report.solve.newton, report.solve.krylov, report.seconds, *probes,
        ]  # fmt: skip
        self.append_row(values)

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


def read_rows(path: Path, columns: list[str], until: int) -> list[list[str]]:
    """The whole rows up to a step. InputError where the file has other columns; none where there is no file."""
    if not path.exists():
        return []
    with path.open(newline="") as file:
        head, *rows = [*csv.reader(file)] or [[]]
    if head and head != columns:
        raise InputError(
            f"--restart: {path} has other columns than this study ({', '.join(sorted({*head} ^ {*columns}))}); "
            "move it away to go on without its rows"
        )
    return [row for row in rows if len(row) == len(columns) and int(row[0]) <= until]


def _line(values: list[str]) -> str:
    return ",".join(values) + "\r\n"
