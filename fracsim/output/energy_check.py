"""Energy from nowhere: watched in every step, told at the end."""

from __future__ import annotations

import numpy as np

from ..mechanics.stress import Stress
from ..mesh.parallel import sum_over_ranks
from ..timestepping.state import State
from ..timestepping.stepper import StepReport

# Strain below which energies are round-off: Y V STRAIN^2 is not worth a word, as in a body that only lies there.
STRAIN = 3e-8
SHARE = 0.05  # of the energy at play: what steps that are long for the waves in them may gain without a word

SUDDEN = 0.5  # of a gain: what one step gained is told from this share on

# schemes that may do instead; Newmark's keeps the energy of linear bodies alone, in steps that are long for the waves
_OTHERS = {
    "backward-euler": "",
    "quasi-static": "",
    "newmark": 'time.scheme = "generalized-alpha" or "backward-euler", or ',
}


class EnergyGain:
    """The largest rise of elastic + kinetic + dissipated - work above what it was before.

    Schemes may lose energy. One that gains it (projected strains at large strains; second-order schemes in tangents
    that are not positive, or where all breaks at once) leads to motion that nothing drives.

    Attributes:
        rise: J; told with the step that gained most of it, where one did.
        scale: largest energy or work so far, J.    floor: J, below which nothing is told.
        All three are of a 2D body of 1 m.
    """

    def __init__(self, *, at_rest: bool, floor: float = 0.0, thickness: float = 1.0) -> None:
        """`at_rest`: the body starts without energy; else from what its first step ends with. `thickness`: m, of a 2D
        body."""
        self._thickness = thickness
        self._least = 0.0 if at_rest else float("inf")
        self.rise, self.scale, self.floor = 0.0, 0.0, floor
        self._balance = self._least  # after the last step
        self._most, self._time = 0.0, 0.0

    def look(self, report: StepReport, state: State) -> None:
        """Note a step that was taken."""
        held = report.kinetic + report.elastic
        balance = held + state.dissipated - state.work
        if balance - self._balance > self._most:
            self._most, self._time = balance - self._balance, state.t
        self._balance, self._least = balance, min(self._least, balance)
        self.rise = max(self.rise, balance - self._least)
        self.scale = max(self.scale, held, abs(state.work))

    def monitors(self) -> dict[str, float]:
        """What a restart goes on from, for `restore`."""
        return {
            "energy_rise": self.rise, "energy_scale": self.scale, "energy_least": self._least,
            "energy_balance": self._balance, "energy_most": self._most, "energy_time": self._time,
        }  # fmt: skip

    def restore(self, monitors: dict[str, float]) -> None:
        """Go on from `monitors`."""
        self.rise, self.scale, self._least = (monitors[f"energy_{name}"] for name in ("rise", "scale", "least"))
        # checkpoints of earlier versions do not have them; then no step has gained yet
        self._balance = monitors.get("energy_balance", float("inf"))
        self._most, self._time = monitors.get("energy_most", 0.0), monitors.get("energy_time", 0.0)

    def note(self, scheme: str) -> str:
        """A sentence where it is too much; `scheme` is that of the study."""
        if self.rise <= max(SHARE * self.scale, self.floor):
            return ""
        one_step = ""
        if self._most >= SUDDEN * self.rise:
            one_step = f" ({min(self._most / self.rise, 1.0):.0%} of it in the step to t = {self._time:g} s)"
        other = _OTHERS.get(scheme, 'time.scheme = "backward-euler", or ')
        return (
            f"the body gained {self.rise * self._thickness:.3g} J of energy from nowhere{one_step}, "
            f"{self.rise / self.scale:.0%} of all that was at play: its motion is not to be trusted; "
            f"try {other}a shorter time.step"
        )


def worth_telling(stress: Stress) -> float:
    """Y V STRAIN^2 of a body, J (collective)."""
    domain = stress.domain
    return float(sum_over_ranks(domain.comm, np.sum(stress.material.young * domain.volumes))[0]) * STRAIN**2
