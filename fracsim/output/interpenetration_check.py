"""Pieces that pass through each other where nothing keeps them apart: looked for at every frame, told at the end."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt

from ..meshes.text import format_point

if TYPE_CHECKING:
    from .surface.body_surface import Surface

Values = npt.NDArray[np.float64]


class Passing:
    """The first time that pieces were seen in each other, on rank 0: nothing is looked for after that, nor in a body of
    one piece.

    Attributes:
        seen: time (s), place (m) and the names of the two pieces; empty: never.
    """

    def __init__(self) -> None:
        self.seen: dict[str, Any] = {}

    def look(self, t: float, surface: Surface, u: Values) -> None:
        """Note the pieces of a frame at t s, u (N, d) the displacement of its nodes, m (rank 0)."""
        pieces = surface.split.node_fragment
        if self.seen or surface.split.fragment_count == 1:
            return
        from ..mesh.interpenetration import find_interpenetration

        x = surface.skeleton.points + u
        found = find_interpenetration(x, surface.skeleton.cells[surface.whole], pieces)
        if found is not None:
            node, cell = found
            inner = surface.skeleton.cells[surface.whole][cell, 0]
            both = sorted(int(surface.names[pieces[each]]) for each in (node, inner))
            self.seen = {"time": t, "place": x[node].tolist(), "pieces": both}

    def monitors(self) -> dict[str, Any]:
        """What a restart goes on from, for `restore`."""
        return {"passed_through": self.seen}

    def restore(self, monitors: dict[str, Any]) -> None:
        """Go on from `monitors`."""
        self.seen = monitors.get("passed_through", {})

    def summary(self) -> dict[str, Any]:
        """For summary.json, where there was anything."""
        return self.monitors() if self.seen else {}

    def notes(self, *, implicit: bool) -> list[str]:
        """A sentence where there were any; `implicit`: the scheme of the study is (rank 0)."""
        if not self.seen:
            return []
        first, second = self.seen["pieces"]
        remedy = "a [contact] table" if implicit else "[contact] with an implicit scheme"
        return [
            f"pieces {first} and {second} pass through each other, first seen at t = {self.seen['time']:g} s near "
            f"{format_point(self.seen['place'])}; {remedy} keeps them apart"
        ]
