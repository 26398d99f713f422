"""Where the balance is linear a step is one linear solve, with a tangent that is kept.

CG goes on until the residual is what Newton's method would stop at, and says what is left: nothing is assembled to see
it. It starts from the combination of earlier solutions that is nearest in energy (Fischer 1998): of smooth motion two
iterations are left of nine. Without inertia it goes on to a third of that, some two iterations more: loads that grow
in proportion are then extrapolated to a solution, which takes none.
"""

from __future__ import annotations

import math

from petsc4py import PETSc

from ..mechanics.balance import Balance
from .petsc_options import Options, OptionSet

GUESS: Options = {"ksp_guess_type": "fischer", "ksp_guess_fischer_model": "1,10"}  # 10 solutions and their forces
AT_REST = 0.3  # of what Newton's method would leave: so far without inertia
ENOUGH = 3  # iterations that tell how quickly CG converges

_SILENT = ("snes_rtol", "ksp_rtol", "ksp_type")


def is_linear(balance: Balance, given: Options, method: str) -> bool:
    """Whether steps are single solves: of a linear body by CG or factors, where nobody asked for another way, nor to be
    shown Newton's."""
    own = all(key in _SILENT or key.startswith(("pc_", "mg_")) for key in given)
    # without inertia a piece hangs by 1e-8 of its stiffness: a residual that is small leaves its place open
    may_hang = balance.stress.chi is not None and not balance.scheme.inertia
    held = method == "preonly" or (method == "cg" and not may_hang)
    return own and balance.linear and balance.symmetric and held


class Ending:
    """CG for solves that end a step.

    Attributes:
        its: iterations of the last solve.    left: |r| after it, N.
    """

    def __init__(self, comm: object, most: int) -> None:
        """`most`: iterations."""
        self._ksp = ksp = PETSc.KSP().create(comm)
        self._options = OptionSet(GUESS)
        ksp.setOptionsPrefix(self._options.prefix)
        ksp.setType("cg")
        ksp.setNormType(PETSc.KSP.NormType.UNPRECONDITIONED)
        ksp.setFromOptions()
        ksp.setConvergenceHistory(most + 1, reset=True)
        self._most = most
        self.its, self.left = 0, 0.0

    def solve(self, A: PETSc.Mat, K: PETSc.Mat, pc: PETSc.PC, b: PETSc.Vec, x: PETSc.Vec, little: float) -> bool:
        """K x = b down to |r| = `little`, N, `A` being K for products; whether it is solved (collective)."""
        ksp = self._ksp
        pc.setReusePreconditioner(True)
        ksp.setPC(pc)
        ksp.setOperators(A, K)
        ksp.setTolerances(rtol=0.0, atol=little, max_it=self._most)
        ksp.solve(b, x)
        self.its, self.left = ksp.its, ksp.norm
        return bool(ksp.reason > 0)

    def to_share(self, rtol: float) -> int:
        """Iterations that a solve to a share of the residual would have taken; 0: too few to tell."""
        begun = self._ksp.getConvergenceHistory()[:1]
        if self.its < ENOUGH or not 0 < self.left < begun[0]:
            return 0
        return round(self.its * math.log(rtol) / math.log(self.left / begun[0]))

    def destroy(self) -> None:
        """Give back PETSc's objects, and take the options out of its database."""
        self._options.remove()
        self._ksp.destroy()
