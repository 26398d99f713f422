"""Weights of contact forces in a time step.

Contact forces act at the end of a step alone, over all of the step, as in backward Euler (Kane, Repetto, Ortiz and
Marsden 1999, Finite element analysis of nonsmooth contact). With the rates c_a, c_v of a scheme and the fraction s of
the step at which forces balance,

    W = k s,    k = dt c_a / c_v,

is the weight of a contact force f in r; its energy has the weight k s^2, its second derivative k.

Equations: docs/theory.md#contact-in-a-time-step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..forms.schemes import Scheme


@dataclass(frozen=True)
class ContactTimeWeights:
    """Weights of contact forces in a step of a scheme.

    Attributes:
        factor: k, 1 for backward Euler.
        end_work_share: weight of the forces at the end of a step in their work; the rest is that of the start. 1 if
            forces act over the whole step, else 1/2.
        time_averaged: whether barriers use a mean of their force over the step (contact.laws).
    """

    factor: float = 1.0
    end_work_share: float = 0.5
    time_averaged: bool = False

    @classmethod
    def for_scheme(cls, scheme: Scheme) -> ContactTimeWeights:
        """Weights of a time integration scheme; all 1 for explicit schemes and without inertia."""
        if not (scheme.inertia and scheme.implicit):
            return cls()
        c_a, c_v = scheme.rate_coefficients(1.0)  # k does not depend on dt
        return cls(c_a / c_v, 1.0, scheme.carries_acceleration)


UNWEIGHTED = ContactTimeWeights()


def acceleration_change(scheme: Scheme, dt: float, displacement_change: Any) -> Any:
    """Change of the acceleration at the end of a step, m/s^2, that belongs to a change of the unknown.

    A scheme subtracts that of contact forces from the acceleration that it carries into the next step.

    Args:
        scheme: time integration.
        dt: size of the step, s.
        displacement_change: change of the unknown, m; a number or an array.
    """
    zero = 0.0 * displacement_change
    return scheme.complete_step(dt, displacement_change, zero, zero, zero)[2]
