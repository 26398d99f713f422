"""Explicit central differences.

L. Verlet: Computer "experiments" on classical fluids. Phys. Rev. 159 (1967) 98-103; Newmark's formulae with beta = 0,
gamma = 1/2.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from .scheme import Array, AtTheEnd


@dataclass(frozen=True)
class CentralDifference(AtTheEnd):
    """Explicit central differences in velocity Verlet form: u moves by v and a of the start, then a follows from u.

    u = u_n + dt v_n + dt^2/2 a_n,  M a = f_ext - f_int(u) - C v_{n+1/2},  v = v_n + dt/2 (a_n + a). Second order,
    stable for dt < 2 / omega_max, no system to solve. `rates` serve damping only.
    """

    summary: ClassVar[str] = "central differences, no system to solve; the step is cut to what the fastest cell allows"
    inertia: ClassVar[bool] = True
    implicit: ClassVar[bool] = False
    carries_acceleration: ClassVar[bool] = True

    def rates(self, dt: float) -> tuple[float, float]:
        """(0, 1/dt): inertia is not part of the assembled forces."""
        return 0.0, 1 / dt

    def references(self, dt: float, u: Array, v: Array, a: Array) -> tuple[Array, Array]:
        """(u_n, u_n)."""
        return u, u
