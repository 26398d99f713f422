"""File tips.csv: place, energy release rate and stress intensities of every crack tip, a row per tip and step."""

from __future__ import annotations

import math
from collections import deque
from pathlib import Path

import numpy as np
import numpy.typing as npt
from scipy.spatial import cKDTree

from ..fracture.energy.tip_record import TipRecord
from ..mesh.parallel import allgather
from ..meshes.data import AXES
from .atomic_write import append_bytes, replace_text, write_on_root
from .crack_length import CrackExtent, CrackTable
from .history import rename_unreadable

Ints = npt.NDArray[np.integer]
Values = npt.NDArray[np.float64]


class TrackedTip:
    """Crack tip that is followed from step to step.

    Its speed is the mean over 10 rows: in 2D passes are so frequent that a Rayleigh wave crosses the disc meanwhile.

    Attributes:
        cell: number of its cell in the input mesh.
        course: time, s, and position (d,), m, in the last rows.
    """

    def __init__(self) -> None:
        self.cell = -1
        self.course: deque[tuple[float, list[float]]] = deque(maxlen=11)

    def move(self, t: float, cell: int, point: list[float]) -> None:
        """Add the position (d,), m, at time t, s."""
        self.cell = cell
        self.course.append((t, point))

    @property
    def speed(self) -> float:
        """Mean speed over the last rows, m/s; NaN in the first one."""
        (began, first), (ended, last) = self.course[0], self.course[-1]
        return math.dist(first, last) / (ended - began) if ended > began else math.nan


class TipFile:
    """Writer of tips.csv on rank 0.

    A row is that of a tip in balance at the end of a step, before it advances there.

    Attributes:
        columns: names of the columns.
        notes: sentences about rows that a restart did not find (rank 0).
    """

    def __init__(
        self, path: Path, record: TipRecord, extent: CrackExtent, *, inertia: bool, resume_at: int | None = None
    ) -> None:
        """Open the file (collective).

        Args:
            path: the file.
            record: tips of the last step.
            extent: lengths or areas of cracks.
            inertia: tips have a speed.
            resume_at: keep the rows up to this step; None: a new run.

        Raises:
            CannotWrite: the file cannot be written.
        """
        self._path, self._record, self._extent = path, record, extent
        self._comm, d = extent.comm, extent.dim
        plane = ["K_I", "K_II"] if d == 2 else []
        speed = ["speed"] if inertia else []
        self.columns = [
            "step", "time", "tip", "cell", *AXES[:d], "length" if d == 2 else "area", "G", *plane, *speed,
        ]  # fmt: skip
        self._has_speed, self.notes = inertia, list[str]()
        self._tips: dict[int, TrackedTip] = {}
        self._newest = 0  # the largest number of a tip
        # cells (n,), points (n, d), m, and numbers (n,) of the tips in the last rows
        self._last: tuple[Ints, Values, Ints] | None = None
        self._cracks: CrackTable | None = None
        write_on_root(self._comm, path, lambda: self._open(resume_at))
        self.update_cracks()

    def _open(self, resume_at: int | None) -> None:
        """Write the header and earlier rows, and follow their tips (rank 0)."""
        rows = [] if resume_at is None else self._read_rows(resume_at)
        self._newest = max((int(row[2]) for row in rows), default=0)
        tips = {int(row[2]) for row in rows if row[0] == rows[-1][0]}
        for row in (row for row in rows if int(row[2]) in tips):
            point = [float(coordinate) for coordinate in row[4 : 4 + self._extent.dim]]
            self._tips.setdefault(int(row[2]), TrackedTip()).move(float(row[1]), int(row[3]), point)
        replace_text(self._path, "".join(",".join(row) + "\r\n" for row in [self.columns, *rows]))

    def _read_rows(self, until: int) -> list[list[str]]:
        """Return the complete rows up to a step; a file that is not such a table is renamed."""
        if not self._path.exists():
            self.notes.append(f"{self._path} is gone: it has the tips from here on")
            return []
        try:
            lines = self._path.read_bytes().decode("utf-8-sig").splitlines()
        except UnicodeDecodeError:
            lines = []
        if not lines or lines[0].split(",") != self.columns:
            moved = rename_unreadable(self._path)
            self.notes.append(
                f"{self._path} has other columns than this run: it is {moved} from here on, and begins anew"
            )
            return []
        rows = [line.split(",") for line in lines[1:]]
        complete = [row for row in rows if self._is_complete(row)]
        if len(complete) < len(rows):
            self.notes.append(f"{len(rows) - len(complete)} rows of {self._path} are damaged and left out")
        return [row for row in complete if int(row[0]) <= until]

    def _is_complete(self, row: list[str]) -> bool:
        """Return whether a row has a number in each column."""
        try:
            return len([float(value) for value in row]) == len(self.columns) and row[0].isdecimal()
        except ValueError:
            return False

    def update_cracks(self) -> None:
        """Find the cracks and their lengths after edges have broken (collective)."""
        self._cracks = self._extent.gather_cracks()

    def append(self, step: int, t: float) -> None:
        """Append the rows of a step that ends at t, s; lengths are those at the last update (collective).

        Raises:
            CannotWrite: the file cannot be written.
        """
        reading = self._record.reading
        if reading is None:
            return
        local_rows = np.column_stack([reading.cell, reading.point, reading.release_rate, reading.intensities])
        rows: Values = np.concatenate(allgather(self._comm, local_rows))
        write_on_root(self._comm, self._path, lambda: append_bytes(self._path, self._lines(step, t, rows).encode()))

    def _lines(self, step: int, t: float, rows: Values) -> str:
        """Return the lines of tips, given as rows (n, 2 + d or 4 + d) of cell, position, G and K (rank 0)."""
        assert self._cracks is not None
        rows, d = rows[np.argsort(rows[:, 0])], self._extent.dim
        cells: Ints = rows[:, 0].astype(np.int64)
        points = rows[:, 1 : 1 + d]
        crack, size = self._cracks.find(cells)
        tips = self._follow(cells, points, crack)
        measured = np.column_stack([points, size, rows[:, 1 + d :]])
        lines = []
        for k in np.argsort(tips):
            number, cell, values = int(tips[k]), int(cells[k]), list(map(float, measured[k]))
            tip = self._tips[number]
            tip.move(t, cell, values[:d])
            if self._has_speed:
                values.append(tip.speed)
            lines.append(f"{step},{t:.12g},{number},{cell}," + ",".join([f"{x:.12g}" for x in values]) + "\r\n")
        return "".join(lines)

    def _follow(self, cells: Ints, points: Values, crack: Ints) -> Ints:
        """Return the numbers (n,) of tips: that of the nearest tip of the last rows in the same crack, or a new one."""
        assert self._cracks is not None
        if self._last is not None and np.array_equal(cells, self._last[0]) and np.array_equal(points, self._last[1]):
            return self._last[2]
        last = list(self._tips.values())
        last_crack = self._cracks.find(np.array([tip.cell for tip in last], np.int64))[0]
        last_points = np.array([tip.course[-1][1] for tip in last]).reshape(-1, points.shape[1])
        row = pair_nearest_first(last_points, last_crack, points, crack)
        tips: Ints = np.array([*self._tips, 0])[row]
        new = row < 0
        tips[new] = self._newest + 1 + np.arange(new.sum())
        self._newest += int(new.sum())
        # A tip that ended is not taken up again by another one.
        self._tips = {tip: self._tips.get(tip) or TrackedTip() for tip in map(int, np.sort(tips))}
        self._last = cells, points, tips
        return tips


def pair_nearest_first(last: Values, last_crack: Ints, points: Values, crack: Ints) -> Ints:
    """Return for each point (n, d), m, the row of its partner among `last` (m, d), m, or -1.

    Partners are in the same crack, `crack` (n,) and `last_crack` (m,). The nearest two of all pairs become partners
    first, then the nearest two that are left: mutual nearest neighbours are such pairs.
    """
    partner: Ints = np.full(len(points), -1)
    # One more axis keeps cracks further apart than any two points.
    apart = 1 + 2 * float(np.linalg.norm(np.concatenate([last, points]), axis=1).max(initial=0.0))
    old, new = (np.column_stack([x, apart * c]) for x, c in ((last, last_crack), (points, crack)))
    free_old, free = np.arange(len(old)), np.arange(len(new))
    while len(free_old) and len(free):
        distance, row = cKDTree(old[free_old]).query(new[free])
        is_near = distance < apart
        if not is_near.any():
            break
        mutual = is_near & (cKDTree(new[free]).query(old[free_old])[1][row] == np.arange(len(free)))
        # Equal distances may leave no mutual pair: the first one of the nearest is made.
        mutual[np.argmin(distance)] |= not mutual.any()
        partner[free[mutual]] = free_old[row[mutual]]
        free_old, free = np.delete(free_old, row[mutual]), free[~mutual]
    return partner
