"""Where surfaces start: the highest load first, all that is near a start left out (non-maximum suppression)."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]


class Starts:
    """Candidates of one pass, handed out one by one.

    Attributes:
        places: (n, d) of the candidates, m.
        spacing: m; no start is closer than this to another, or to one of the starts `taken` before.
    """

    def __init__(self, places: Values, load: Values, spacing: float, taken: Values) -> None:
        """`load` (n,): the highest goes first, the earlier candidate where loads are equal."""
        self.places, self.spacing = places, spacing
        self._left: Ints = np.argsort(-load, kind="stable")
        for place in taken:
            self.leave_out(place)

    def next(self) -> int | None:
        """The candidate loaded most of those left, which does not come again. None: none is left."""
        if not len(self._left):
            return None
        chosen = int(self._left[0])
        self._left = self._left[1:]
        return chosen

    def leave_out(self, place: Values, share: float = 1.0) -> None:
        """Take out the candidates closer than the spacing, or a share of it, to a place (d,)."""
        arm = self.places[self._left] - place
        self._left = self._left[np.einsum("ni,ni->n", arm, arm) >= (share * self.spacing) ** 2]

    def drop(self, candidates: npt.NDArray[np.bool_]) -> None:
        """Take out those flagged (n,)."""
        self._left = self._left[~candidates[self._left]]
