"""A load that has fallen to a share of its peak: what ends a test on a testing machine."""

from __future__ import annotations

from typing import Any

import numpy as np


class LoadDrop:
    """Watches the force on a probed group or an obstacle.

    Attributes:
        peak: N, of its size so far.    reached: whether it has fallen far enough since.
    """

    def __init__(self, name: str, drop: float, above: float, *, breaks: bool) -> None:
        """`name`: of the probe or obstacle; `drop`: share of the peak that is lost; `above`: N, no lower peak counts;
        `breaks`: what happens before anything has broken does not count."""
        self.name, self.drop, self.above, self._breaks = name, drop, above, breaks
        self.peak, self.last, self.t, self.reached = 0.0, 0.0, 0.0, False

    def look(self, t: float, figures: dict[str, float], broken: int) -> None:
        """Note the columns of history.csv at t (s), and how many edges have broken so far."""
        heads = tuple(f"{kind}_{self.name}_" for kind in ("reaction", "contact"))
        self.last = float(np.linalg.norm([value for name, value in figures.items() if name.startswith(heads)]))
        if self.last > self.peak:
            self.peak, self.t = self.last, t
        fallen = self.last <= (1 - self.drop) * self.peak and self.peak > self.above
        self.reached = fallen and (broken > 0 or not self._breaks)

    def monitors(self) -> dict[str, Any]:
        """What a restart goes on from, for `restore`."""
        return {"load_peak": [self.peak, self.t], "load_fallen": self.reached}

    def restore(self, monitors: dict[str, Any]) -> None:
        """Go on from `monitors`."""
        self.peak, self.t = monitors.get("load_peak", (0.0, 0.0))
        self.reached = monitors.get("load_fallen", False)

    def summary(self) -> dict[str, Any]:
        """For summary.json: the peak of the load, when, and whether its fall ended the run."""
        return {"load": {"of": self.name, "peak": self.peak, "peak_time": self.t, "ended_the_run": self.reached}}
