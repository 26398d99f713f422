"""What rests sinks into the floor while it flies to where something strikes it: it is set back onto it.

A body flies as if there were nothing for the share s of the step (rigid.meeting), through what it comes to more slowly
than c_0 as well: it lies deeper by up to c_0 dt then, at every blow. It is moved by that along the normal of what
stands there, its velocity as it was: no work but that of its weight, which it had lost too much of.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt

from .contacts import Contacts

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]


def lifts(before: Contacts, after: Contacts, flew: Flags) -> Values:
    """(n, 3) m by which bodies that flew (n,) are set back: by what the deepest of their contacts with what stands is
    deeper in than any was before."""
    count = len(flew)
    deep: Values = np.zeros(count)
    rows, body, _ = _standing(before, flew)
    np.maximum.at(deep, body, -before.gap[rows])
    rows, body, sign = _standing(after, flew)
    sunk = -after.gap[rows] - deep[body]
    order = np.argsort(sunk, kind="stable")
    order = order[sunk[order] > 0]
    lift: Values = np.zeros((count, 3))
    lift[body[order]] = (sunk * sign)[order, None] * after.axes[rows[order], 0]
    return lift


def _standing(contacts: Contacts, flew: Flags) -> tuple[Ints, Ints, Values]:
    """Contacts (k,) of bodies that flew (n,) with what stands, these bodies (k,), and 1 where the normal is towards
    them, -1 where it is away."""
    count, (first, second) = len(flew), contacts.things.T
    body = np.minimum(first, second)
    rows = np.flatnonzero((np.maximum(first, second) >= count) & np.append(flew, False)[np.minimum(body, count)])
    return rows, body[rows], np.where(second[rows] < count, 1.0, -1.0)


def raised(contacts: Contacts, lift: Values) -> Values:
    """(k,) distances where bodies (n,) are moved by (n, 3), m."""
    if not np.any(lift):
        return contacts.gap
    things = np.minimum(contacts.things, len(lift))
    moved = np.append(lift, np.zeros((1, 3)), axis=0)[things]
    return np.asarray(contacts.gap + np.einsum("ki,ki->k", moved[:, 1] - moved[:, 0], contacts.axes[:, 0]))
