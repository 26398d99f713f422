"""Blows: how the forces of contact enter a step, whose length need not resolve the time that a body takes to bounce.

Newmark's formulae (generalized-alpha's with balance at a level inside the step, alpha_m = 0 else),

    v = v_n + dt ((1 - gamma) a_n + gamma a),    u = u_n + dt v_n + dt^2 ((1/2 - beta) a_n + beta a),

take the impulse of a step from forces at both of its ends. A body that was stopped at the end of one step is pushed on
in the next, though its gap has opened by then: energy from nowhere. Contact acts here as in backward Euler, and as in
Kane, Repetto, Ortiz, Marsden, Finite element analysis of nonsmooth contact, CMAME 180 (1999) 1-26: by its forces f at
the end of the step alone, all the step long. With a = a_o + M^-1 f / gamma, a_o the acceleration by all other forces
and the one that is carried into the next step,

    v = v_n + dt ((1 - gamma) a_o,n + gamma a_o) + dt M^-1 f,    u = ... + theta dt^2 M^-1 f,    theta = beta / gamma.

Momentum: m (v - v_n) = dt f + what the others give. Energy of a linear body with beta = 1/4, gamma = 1/2:

    T + V - T_n - V_n = f . (u - u_n) - (theta - 1/2) dt^2 f . M^-1 f  <=  E(u_n) - E(u),

where f = -E' and E is convex, since theta >= 1/2 wherever the scheme is stable for all steps (2 beta >= gamma). What
is lost is the sum of E(u_n) - E(u) - f . (u - u_n), of first order in dt where steps resolve the blow; of obstacles a
fifth of that (contact.along).

Of a body at large strains Newmark's method itself gains energy in steps that are long for its waves, contact or not: it
keeps that of linear forces alone (Simo, Tarnow, The discrete energy-momentum method, ZAMP 43 (1992) 757). A bar that
falls at 10 m/s in steps of four waves through it loses in the two steps in touch, and has up to six times its energy
later; begun as it leaves the floor, without one, it gains even more. generalized-alpha loses what rings.

In M ((1 - alpha_m) a + alpha_m a_n) + ... = W f the weight is W = (1 - alpha_m) / gamma. By the rates of a scheme
(forms.schemes), which know neither: f moves the unknown x, at share s of the step, by W M^-1 f / c_a, thus u by 1 / s
and v by c_v / s times that; that v changes by dt M^-1 f says

    W = k s,    k = dt c_a / c_v,

1 of backward Euler. So contact adds k s^2 E(u(x)) to the incremental potential, k s f to the forces and k E'' to the
tangent: all is as for forces that balance at the level, of a contact that is stiffer by k.

Equations: docs/theory.md#contact-in-a-time-step.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from ..forms.schemes import Scheme


@dataclass(frozen=True)
class ContactTimeWeights:
    """Of a scheme.

    Attributes:
        factor: k.    end: share of the forces at the end of a step in its work, the rest is that of the start's: all
            where they act the whole step long, else half.    along: whether barriers act along the way (contact.along).
    """

    factor: float = 1.0
    end_work_share: float = 0.5
    time_averaged: bool = False

    @classmethod
    def for_scheme(cls, scheme: Scheme) -> ContactTimeWeights:
        """Steps without inertia, and explicit ones, know no blows."""
        if not (scheme.inertia and scheme.implicit):
            return cls()
        c_a, c_v = scheme.rates(1.0)  # k is the same for every dt
        return cls(c_a / c_v, 1.0, scheme.carries_acceleration)


UNWEIGHTED = ContactTimeWeights()


def acceleration_change(scheme: Scheme, dt: float, displacement_change: Any) -> Any:
    """The acceleration at the end of a step of dt s that comes with a change `moved` of its unknown: what blows give is
    not carried on."""
    still = 0.0 * displacement_change
    return scheme.finish(dt, displacement_change, still, still, still)[2]
