"""What a run carries from one step to the next.

Parts of a body that remember: what they are between two steps is a value in the state.

A step begins with recalling that value, so that a trial which fails, is repeated or starts from an earlier state finds
the body as it was, whatever was tried in between.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
import numpy.typing as npt

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class State:
    """A body at time t; arrays are of the owned dofs, and are not written to once they are here.

    Attributes:
        t: s.        step: steps taken.        dt: size of the next step, s.
        u, v, a: (owned dofs,) displacement, velocity, acceleration in m, m/s, m/s^2.
        dissipated: energy lost to fracture, flow and damping, J.    work: external work, J (both summed over ranks).
        easy: steps in a row that went without halving.
        elastic: stored energy at t on this rank, J.
        forces: loads and reactions where the last step balanced them, N.    drag: damping forces there, N.
        memory: what parts of the body remember of their past, by name (damage, flow, terms): see timestepping.state.
        out_of_balance: (owned dofs,) residual that the last step ended with, N; None: none but the solver's tolerance.
        before: (displacement a step ago, size of that step), from which a quasi-static load path is extrapolated; None:
            unknown, or not needed.
        frequencies: (cells,) bounds of omega^2 of undamaged cells, 1/s^2, from which explicit steps take their size;
            None: the scheme has no such limit.
    """

    u: Values
    v: Values
    a: Values
    t: float = 0.0
    step: int = 0
    dt: float = 0.0
    dissipated: float = 0.0
    work: float = 0.0
    easy: int = 0
    elastic: float = 0.0
    forces: Values = field(default_factory=lambda: np.empty(0))
    drag: Values | None = None
    history: dict[str, object] = field(default_factory=dict)
    out_of_balance: Values | None = None
    previous_increment: tuple[Values, float] | None = None
    frequencies: Values | None = None


class HistoryVariables(Protocol):
    """A part with a past, such as damage or plastic flow."""

    def snapshot(self) -> object:
        """What it is now, never to be written to again; the same object as before where nothing has changed."""

    def restore(self, saved: object) -> bool:
        """Be again what `memory` gave, which costs nothing where that is what it is; whether it was anything else.

        Not collective, but the same on all ranks.
        """
