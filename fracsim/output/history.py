"""history.csv: one row a step, with energies, damage, iterations and probes."""

from __future__ import annotations

import csv
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
            readings |= term.readings()
            works |= term.works()
            least |= term.least()
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
        sums = total(self._domain.comm, np.concatenate(parts))
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
        count = total(self._domain.comm, len(owned))[0]
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
            report.solve.newton, report.solve.krylov, report.seconds,
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
