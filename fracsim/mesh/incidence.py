"""Which rows of a table a number is in: the cells at an edge, the edges at a node."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]


class Incidence:
    """Rows of a table (n, k) by the numbers in them, from 0 to `count` - 1: what changes at a few of them is looked for
    nowhere else.

    Attributes:
        rows: those of one number after the other.    end: where in these those of each end; of -1 at 0.
    """

    def __init__(self, table: npt.NDArray[np.integer], count: int) -> None:
        numbers = table.ravel()
        self.rows: Ints = np.argsort(numbers, kind="stable") // table.shape[1]
        self.end = np.append(np.cumsum(np.bincount(numbers, minlength=count)), 0)  # 0: before the first

    def __call__(self, numbers: npt.NDArray[np.integer]) -> Ints:
        """(m,) rows that have any of the numbers (n,), rising, each once."""
        return np.unique(self.entities_of(numbers))

    def entities_of(self, numbers: npt.NDArray[np.integer]) -> Ints:
        """(m,) the same for one number after the other: rows that have several of them as often."""
        end = self.end[numbers]
        many = end - self.end[numbers - 1]
        last = np.cumsum(many)
        at = np.repeat(end - last, many)
        at += np.arange(len(at))
        return self.rows[at]
