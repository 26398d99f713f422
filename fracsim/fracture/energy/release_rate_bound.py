"""Tips in space that wait: how long none of them can reach G_c once they were looked at, by how the body has moved.

    u = u_0 + t v_0 + r,  v = v_0 + w,  a = a_0 + b          since that look, t ago
    D = t |grad v_0| + max |r| sum |grad N_i| >= |H - H_0|

G is a sum of products of H, v and a. What each of these can have changed by bounds what it can have grown by:

    |psi - psi_0| + |H^T P - H_0^T P_0| <= 2 |P_0| D + |H_0| |P - P_0| + 3/2 k D^2
    |rho v^2 - rho v_0^2| / 2           <= rho (|v_0| + |w| / 2) |w|                and so on

with |P - P_0| <= t |C grad v_0| + k (D - t |grad v_0|), k the greatest modulus of Hooke's law C.

r is all but nothing as long as the body goes on as it did, so that the bound is close for as long as that. It takes the
motion of the nodes around tips, and no gradient of it, stress or force. For Hooke's law of small strains, where what is
cut has let go, and tips that go by their force: others are looked at in every pass.

Equations: docs/theory.md#release-with-inertia.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ...mechanics.stress import Stress
from .gradient_operators import Patch
from .tip_fields import ROUND_OFF, Sight
from .tip_neighbourhoods import Tips

Values = npt.NDArray[np.float64]

AGAIN = 4  # looks after which what had helped in no pass is tried again


@dataclass(frozen=True)
class Look:
    """What the body was like when the tips were looked at.

    Attributes:
        tips, patch: these, and the cells around them.    chi: (cells,) of those.    now: s.
        u, v, a: (3, nodes) of theirs, m, m/s, m/s^2.    fastest: greatest |v| and |a| on any rank, or more.
        G: (n,) no less than G of tips, J/m^2.    grows: (n, 9) how it grows with what `_changes` gives.
    """

    tips: Tips
    patch: Patch
    chi: Values
    now: float
    u: Values
    v: Values
    a: Values
    fastest: tuple[float, float]
    G: Values
    grows: Values


class Waiting:
    """Tips that need not be looked at."""

    def __init__(self, sight: Sight, stress: Stress) -> None:
        self._sight, self._stress, self._comm = sight, stress, stress.domain.comm
        material = stress.material
        mu, lmbda = np.asarray(material.mu), np.asarray(material.lmbda)
        every = (stress.domain.cell_count,)
        self._mu, self._lmbda = np.broadcast_to(mu, every), np.broadcast_to(lmbda, every)
        self._density = np.broadcast_to(np.asarray(material.density), every)
        self._last: Look | None = None
        self._passes = self._rests = 0

    def holds(self, toughness: Values, now: float) -> bool:
        """Whether no tip of this rank can have reached its G_c, `toughness` (n,) in J/m^2, by now, s (collective)."""
        most = self.most(now)
        return most is not None and bool(np.all(most < toughness))

    def most(self, now: float) -> Values | None:
        """(n,) no less than G of the tips of this rank, J/m^2; None where it takes a look (collective)."""
        last = self._last
        if last is None:
            return None
        self._passes += 1
        if last.tips is not self._sight.around.tips:
            return None
        time, (u, v, a) = abs(now - last.now), self._motion(last.patch)
        rest = u - last.u - (now - last.now) * last.v
        rest -= rest.mean(axis=1, keepdims=True) if rest.size else 0.0
        released = float(not np.array_equal(last.chi, self._chi()))
        here = np.array([_greatest(rest), _greatest(v - last.v), _greatest(a - last.a), released])
        self._comm.Allreduce(MPI.IN_PLACE, here, MPI.MAX)
        if here[3]:
            return None
        here[1:3] *= last.patch.most
        return (last.G + last.grows @ _changes(time, here, *last.fastest)) * (1 + ROUND_OFF)

    def looked(self, G: Values, now: float) -> None:
        """The tips were looked at: `G` (n,) in J/m^2 is no less than theirs (collective)."""
        if self._last is not None and self._passes <= 1:
            self._rests = AGAIN
        self._last, self._passes, self._rests = None, 0, self._rests - 1
        if self._rests >= 0 or self._sight.motion is None:
            return
        tips, patch = self._sight.around.tips, self._sight.patch
        u, v, a = self._motion(patch)
        here = np.array([_greatest(v), _greatest(a), float(not tips.mature.all())])
        self._comm.Allreduce(MPI.IN_PLACE, here, MPI.MAX)
        if not here[2]:
            grows = self._grows(patch, u, v)
            fastest = here[0] * patch.most, here[1] * patch.most
            self._last = Look(tips, patch, self._chi(), now, u, v, a, fastest, G, grows)

    def _motion(self, patch: Patch) -> tuple[Values, Values, Values]:
        """(3, nodes) u, v and a around tips (collective)."""
        assert self._sight.motion is not None
        v, a = map(self._stress.domain.with_ghosts, self._sight.motion)
        return patch.at_nodes(self._stress.u.x.array), patch.at_nodes(v), patch.at_nodes(a)

    def _chi(self) -> Values:
        assert self._stress.chi is not None
        return np.asarray(self._stress.chi.x.array[self._sight.around.asked.own])

    def _grows(self, patch: Patch, u: Values, v: Values) -> Values:
        """(n, 9) of `Look` (collective)."""
        around, chi = self._sight.around, self._chi()
        own = around.asked.own
        carried = chi * self._mu[own], chi * self._lmbda[own], np.where(chi > 0, self._density[own], 0.0)
        mu, lmbda, density = map(patch.everywhere, carried)
        (H, P), (rate, pressing) = (_sizes(patch.gradients(each), mu, lmbda) for each in (u, v))
        k, steep = 1.5 * np.maximum(2 * mu, 3 * lmbda + 2 * mu), patch.steepness
        first = [2 * P * rate + H * pressing, (2 * P + k / 1.5 * H) * steep]
        second = [k * rate**2, 2 * k * rate * steep, k * steep**2]
        moved = [density * H, density * steep, density * rate]
        (columns,) = around.asked(patch.means(np.column_stack([*first, *second, density, *moved])))
        sums = around.most_of(columns[:, :6], columns[:, 6:])
        return np.column_stack([around.along.most(each) for each in sums.T])


def _sizes(H: Values, mu: Values, lmbda: Values) -> tuple[Values, Values]:
    """(n,) |H| and |2 mu e + lambda tr(e) I| of gradients (n, 3, 3), e their symmetric part."""
    square, trace = np.einsum("nij,nij->n", H, H), np.einsum("nii->n", H)
    strain = (square + np.einsum("nij,nji->n", H, H)) / 2
    return np.sqrt(square), np.sqrt(4 * mu**2 * strain + lmbda * (4 * mu + 3 * lmbda) * trace**2)


def _greatest(vectors: Values) -> float:
    """Length of the longest of vectors (3, n)."""
    return float(np.sqrt(np.max(np.einsum("in,in->n", vectors, vectors), initial=0.0)))


def _changes(time: float, here: Values, v: float, a: float) -> Values:
    """(9,) how far products have changed in a time, s, in which u has gone aside by r, v and a have changed by w and b;
    `v` and `a`: the greatest there were."""
    r, w, b = here[:3]
    strain = [time, r, time**2, time * r, r**2]
    return np.array([*strain, w * (v + w / 2), b, r * (a + b) + w * (v + w), time * (a + b) + w])
