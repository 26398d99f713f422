"""history.csv: one row a step, with energies, damage, iterations and probes."""

from __future__ import annotations

import csv
from collections.abc import Callable
from pathlib import Path

import numpy as np
import numpy.typing as npt

from ..errors import InputError
from ..mechanics.balance import Balance
from ..mechanics.time_functions import of_size
from ..mesh.domain import Domain, Ints
from ..mesh.ranks import total
from ..meshes.words import AXES
from ..stepping.state import State
from ..stepping.stepper import StepReport
from ..study import Probe

COLUMNS = (
    "step", "time", "dt", "kinetic", "elastic", "dissipated", "external_work", "broken_edges", "split_cells", "pieces",
    "newton_its", "krylov_its", "wall_step",
)  # fmt: skip

Reading = Callable[[], npt.NDArray[np.float64]]


class Probes:
    """Displacements and reactions that the study asks for."""

    def __init__(self, balance: Balance, probes: list[Probe]) -> None:
        self._balance, self._domain = balance, balance.domain
        self.names: list[str] = []
        self._readings: list[Reading] = []
        for index, probe in enumerate(probes):
            kind = "reaction" if probe.quantity == "reaction" else "probe"
            self.names += [f"{kind}_{probe.name}_{axis}" for axis in AXES[: self._domain.dim]]
            self._readings.append(self._reading(probe, f"probe.{index}"))

    def __call__(self) -> npt.NDArray[np.float64]:
        """All readings in the order of `names` (collective)."""
        if not self._readings:
            return np.empty(0)
        return total(self._domain.comm, np.concatenate([reading() for reading in self._readings]))

    def _reading(self, probe: Probe, key: str) -> Reading:
        if probe.point is not None:
            return self._mean_displacement(nearest_node(self._domain, probe.point, f"{key}.point"))
        assert probe.on is not None
        nodes = self._domain.nodes_of(probe.on, f"{key}.on")
        owned = nodes[nodes < self._domain.node_count]
        if probe.quantity == "displacement":
            return self._mean_displacement(owned)
        return lambda: self._balance.reactions.reshape(-1, self._domain.dim)[owned].sum(axis=0)

    def _mean_displacement(self, owned: Ints) -> Reading:
        count = total(self._domain.comm, len(owned))[0]
        d = self._domain.dim
        return lambda: self._balance.u.x.array.reshape(-1, d)[owned].sum(axis=0) / count


def nearest_node(domain: Domain, point: list[float], key: str) -> Ints:
    """The owned node nearest to a point, on the one rank that has it; ties go to the lowest node of the input mesh."""
    target = of_size(point, domain.dim, key)
    low, high = domain.lower - 1e-9 * domain.size, domain.upper + 1e-9 * domain.size
    if np.any(target < low) or np.any(target > high):
        raise InputError(f"{key} = {point} lies outside the body, which spans {domain.extent()}")
    distance = np.linalg.norm(domain.nodes[: domain.node_count] - target, axis=1)
    best = (np.inf, np.iinfo(np.int64).max, -1)
    if len(distance):
        rounded = np.round(distance / (1e-12 * domain.size))
        node = np.lexsort((domain.node_input[: domain.node_count], rounded))[0]
        best = (float(rounded[node]), int(domain.node_input[node]), int(node))
    winner = min(domain.comm.allgather(best[:2]))
    return np.array([best[2]] if best[:2] == winner else [], np.int32)


class History:
    """Appends rows on rank 0; every row is flushed, so that a run can be watched and survives being killed."""

    def __init__(self, path: Path | None, probe_names: list[str], resume_at: int | None = None) -> None:
        """`path` is None on ranks other than 0; `resume_at`: keep the rows up to this step."""
        self.columns = [*COLUMNS, *probe_names]
        self.peaks = dict.fromkeys((name for name in probe_names if name.startswith("reaction_")), 0.0)
        self._file = None
        if path is None:
            return
        kept = _rows_until(path, resume_at) if resume_at is not None else []
        self._file = path.open("w", newline="")
        self._writer = csv.writer(self._file)
        self._writer.writerow(self.columns)
        for row in kept:
            self._writer.writerow(row)
            self._note_peaks(dict(zip(self.columns, map(float, row), strict=True)))

    def append(
        self, state: State, report: StepReport, damage: tuple[int, int, int], probes: npt.NDArray[np.float64]
    ) -> None:
        """One row; `damage` is (broken edges, split cells, pieces)."""
        values = [
            state.step, state.t, report.dt, report.kinetic, report.elastic, state.dissipated, state.work, *damage,
            report.solve.newton, report.solve.krylov, report.seconds, *probes,
        ]  # fmt: skip
        self._note_peaks(dict(zip(self.columns, values, strict=True)))
        if self._file is not None:
            self._writer.writerow([value if isinstance(value, int) else f"{value:.12g}" for value in values])
            self._file.flush()

    def _note_peaks(self, row: dict[str, float]) -> None:
        for name, peak in self.peaks.items():
            self.peaks[name] = max(peak, abs(row[name]))

    def close(self) -> None:
        if self._file is not None:
            self._file.close()


def _rows_until(path: Path, step: int) -> list[list[str]]:
    if not path.exists():
        return []
    with path.open(newline="") as file:
        rows = list(csv.reader(file))[1:]
    return [row for row in rows if row and int(row[0]) <= step]
