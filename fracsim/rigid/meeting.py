"""How contacts act in a step: velocities after it, in one solve with all contacts (J. J. Moreau 1988, time stepping).

    0 <= force  _|_  speed after + r / dt >= 0

along the normal, speeds of parting; with r the distance g still between two things, so that they come no nearer than
touching. What meets fast, c > c_0, within the step, c dt > g, bounces or stops at once, r = -e c dt, and until it
meets, after the share g / (c dt) of the step, it flies as if there were nothing: it ends where it touches (to c_0 dt,
which is not waited for). So a blow gives its whole impulse in the step that it falls in. What lies in one another even
so (turns are not linear) comes apart no faster than c_0 / 4, which hardly any energy comes of.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

RECOVERED = 0.2  # of what things lie in one another by, in a step
SLOWLY = 0.25  # c_0: what is jammed is driven apart with the force that jams it, which is work


@dataclass(frozen=True)
class Meetings:
    """Of k contacts.

    Attributes:
        gap: (k,) distances, m.    aim: (k,) r, m.    near: (k,) whether they may touch in the step.
        closing: (k,) m/s of what meets fast, 0 of all others.    when: (k,) share of the step, of these.
    """

    gap: Values
    aim: Values
    near: Flags
    closing: Values
    when: Values


def meetings(gap: Values, closing: Values, dt: float, fast: float, restitution: float) -> Meetings:
    """Of contacts at distances `gap` (k,) m whose things come together at `closing` (k,) m/s; `fast`: c_0, m/s."""
    hits = (closing > fast) & (gap < closing * dt)
    inside = np.maximum(RECOVERED * gap, -SLOWLY * fast * dt)
    aim = np.where(hits, -restitution * closing * dt, np.where(gap < 0, inside, gap))
    share = np.divide(gap, closing * dt, out=np.zeros_like(gap), where=hits & (gap > fast * dt))
    near = gap < (closing + fast) * dt
    return Meetings(gap, aim, near, np.where(hits, closing, 0.0), np.clip(share, 0.0, 1.0))


def flown(meeting: Meetings, things: Ints, count: int) -> Values:
    """(count,) share of the step that bodies fly for before something strikes them, 0 of what nothing does; `things`:
    (k, 2) of the contacts, bodies below `count`."""
    share = np.ones(count + 1)
    struck = np.minimum(things[meeting.closing > 0], count)
    np.minimum.at(share, struck, np.repeat(meeting.when[meeting.closing > 0, None], 2, axis=1))
    met = np.zeros(count + 1, bool)
    met[struck] = True
    return np.where(met, share, 0.0)[:count]
