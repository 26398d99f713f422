"""One nonlinear solve: PETSc SNES with line search, CG and algebraic multigrid, options from the study."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import numpy.typing as npt
from petsc4py import PETSc

from ..errors import InputError
from ..mechanics.balance import Equilibrium
from ..mesh.domain import Domain
from .petsc_options import Options, OptionSet, refusing
from .preconditioner import MULTIGRID, Age, Preconditioner

DEFAULTS: Options = {
    "snes_type": "newtonls",
    "snes_linesearch_type": "bt",
    "snes_max_it": 25,
    "snes_rtol": 1e-6,  # 1e-4 takes the first guess for the answer where cells are slivers
    "snes_stol": 0.0,
    "snes_lag_preconditioner": -2,  # made at the first tangent, then kept
    "snes_lag_preconditioner_persists": True,
    "ksp_type": "cg",
    "ksp_rtol": 1e-5,  # 1e-3 is no descent of the residual where a body is badly conditioned: a cantilever fails
    "ksp_max_it": 500,
}

# A jump of prescribed dofs larger than this share of an edge is carried into the body before Newton starts.
LARGE_GAP = 0.01

# Of GMRES, where CG has failed: with PETSc's 30 it stalls where a body is nearly incompressible.
RESTART = 200
# dofs up to which a system that no Krylov method gets through is factorised: seconds, and a few GB at most
FACTORISED = 100_000

# A smaller tangent, and with it a new preconditioner, where at most this share of its cells are alive. Where the
# preconditioner is made anew anyhow, every dead cell goes.
ROOMY = 0.9

_SNES = {value: name for name, value in vars(PETSc.SNES.ConvergedReason).items() if isinstance(value, int)}
_KSP = {value: name for name, value in vars(PETSc.KSP.ConvergedReason).items() if isinstance(value, int)}


@dataclass(frozen=True)
class Outcome:
    """How a solve ended."""

    converged: bool
    newton: int
    krylov: int
    reason: str  # a sentence where it did not converge


class Solver:
    """SNES on an `Equilibrium`, set up once and kept for the whole run."""

    def __init__(self, equations: Equilibrium, given: Options) -> None:
        self.equations = equations
        chosen = _chosen(equations, given)
        self._options = OptionSet(chosen)
        snes = self.snes = PETSc.SNES().create(equations.domain.comm)
        snes.setOptionsPrefix(self._options.prefix)
        snes.setFunction(equations.assemble_residual, equations.residual)
        self._near_null = rigid_body_modes(equations.domain) if chosen["pc_type"] in ("gamg", "ml", "hypre") else None
        self._take_tangent()
        self._x, self._correction = equations.residual.duplicate(), equations.residual.duplicate()
        self._configure(given)
        snes.setConvergenceTest(self._converged)
        self._rtol = float(chosen["snes_rtol"])
        self._single = chosen["snes_type"] == "ksponly"
        self._iterative = snes.ksp.getType() != "preonly"  # a direct solver's factors are for one tangent only
        self._preconditioner = Preconditioner(
            snes.ksp, self._options, keep=self._iterative, may_change=_may_change(equations, given)
        )
        self._first = 0.0

    def _take_tangent(self) -> None:
        """Solve with the matrix that the equations have now."""
        tangent = self.equations.tangent
        self.snes.setJacobian(self._assemble_tangent, tangent, tangent)
        if self._near_null is not None:
            tangent.setNearNullSpace(self._near_null)

    def _fit(self) -> None:
        """Where the body was damaged, see whether a smaller tangent does (collective)."""
        preconditioner = self._preconditioner
        preconditioner.look()
        worn = preconditioner.age == Age.WORN
        if preconditioner.age != Age.FRESH and self.equations.fit_tangent(1.0 if worn else ROOMY):
            self._take_tangent()
            preconditioner.age = Age.WORN

    def _configure(self, given: Options) -> None:
        try:
            refusing(self.snes.setFromOptions)
            refusing(self.snes.ksp.setFromOptions)
            self._options.check(given, self._set_up_at_rest)
        except InputError:
            self._options.remove()
            raise

    def _set_up_at_rest(self) -> None:
        self.equations.assemble_tangent(self.snes, self._x, self.equations.tangent, self.equations.tangent)
        self.snes.ksp.setOperators(self.equations.tangent)
        self.snes.ksp.setUp()

    def solve(self, guess: npt.NDArray[np.float64]) -> Outcome:
        """Solve r(u) = 0 from the owned values `guess`; u holds the result, also where it is no solution."""
        outcome = self._attempt(guess)
        if self._linear_failure(outcome):
            # Smoothers of an older tangent need not be positive for this one: set up anew at every tangent.
            self._preconditioner.age, self._preconditioner.keep = Age.WORN, False
            outcome = self._attempt(guess)
            self._preconditioner.keep = self._iterative
        tired = self.snes.ksp.reason == PETSc.KSP.ConvergedReason.DIVERGED_MAX_IT and self._may_factorise()
        if self._linear_failure(outcome) and self.snes.ksp.getType() == "cg" and not tired:
            # CG met negative curvature (a buckling, softening or nearly incompressible body): GMRES does not mind it.
            self.snes.ksp.setType("gmres")
            self.snes.ksp.setGMRESRestart(RESTART)
            outcome = self._attempt(guess)
            self.snes.ksp.setType("cg")
        if self._linear_failure(outcome) and self._may_factorise():
            outcome = self._attempt_directly(guess)
        return outcome

    def _may_factorise(self) -> bool:
        dofs = self.equations.residual.getSize()
        return self._iterative and dofs <= FACTORISED and bool(PETSc.Sys.hasExternalPackage("mumps"))

    def _attempt_directly(self, guess: npt.NDArray[np.float64]) -> Outcome:
        """Factors instead of iterations, for a tangent that no Krylov method gets through: pieces that hang by a
        thread, or no compressibility. A shorter step would be no easier.
        """
        ksp = self.snes.ksp
        kind, preconditioner = ksp.getType(), ksp.pc.getType()
        ksp.setType("preonly")
        ksp.pc.reset()
        ksp.pc.setType("lu")
        ksp.pc.setFactorSolverType("mumps")
        self._preconditioner.age, self._preconditioner.keep = Age.WORN, False
        outcome = self._attempt(guess)
        ksp.pc.reset()
        ksp.pc.setType(preconditioner)
        ksp.pc.setFromOptions()
        ksp.setType(kind)
        self._preconditioner.age, self._preconditioner.keep = Age.WORN, True
        return outcome

    def yielding(self, force: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
        """(owned dofs,) by how much the body at its present u yields to a force on free dofs in a step, linearly, m.

        0 where the linear solve fails: near incompressibility tangents may be indefinite.
        """
        equations, ksp = self.equations, self.snes.ksp
        self._fit()
        b = equations.residual
        b.array_w[:] = force
        self._assemble_tangent(self.snes, self._x, equations.tangent, equations.tangent)
        ksp.setOperators(equations.tangent)
        ksp.solve(b, self._correction)
        return self._correction.array_r.copy() if ksp.reason > 0 else np.zeros_like(force)

    def damage_changed(self) -> None:
        """Some cells lost stiffness: refresh the preconditioner at the next tangent."""
        self._preconditioner.damage_changed()

    def _linear_failure(self, outcome: Outcome) -> bool:
        return not outcome.converged and self.snes.ksp.reason < 0

    def _attempt(self, guess: npt.NDArray[np.float64]) -> Outcome:
        self._fit()
        self._x.array_w[:] = guess
        extended = self._extend() if self.equations.largest_gap(guess) > LARGE_GAP else 0
        self.snes.solve(None, self._x)
        snes, reason = self.snes, self.snes.reason
        self.equations.load_displacement(self._x)
        if reason > 0 and self._single:  # Newton's method has evaluated them for its test
            self.equations.update_reactions()
        krylov = snes.getLinearSolveIterations() + extended
        return Outcome(reason > 0, snes.its, krylov, "" if reason > 0 else self._sentence())

    def _extend(self) -> int:
        """Carry a jump of the prescribed displacement into the body linearly; returns the Krylov iterations."""
        equations, ksp = self.equations, self.snes.ksp
        b = equations.residual
        equations.assemble_extension(self._x, b)
        self._assemble_tangent(self.snes, self._x, equations.tangent, equations.tangent)
        ksp.setOperators(equations.tangent)
        ksp.solve(b, self._correction)
        self._x.axpy(-1.0, self._correction)
        return int(ksp.its)

    def _assemble_tangent(self, snes: Any, x: PETSc.Vec, A: PETSc.Mat, P: PETSc.Mat) -> None:
        self.equations.assemble_tangent(snes, x, A, P)
        self._preconditioner.refresh(P)

    def _sentence(self) -> str:
        why = _SNES.get(self.snes.reason, str(self.snes.reason)).lower().removeprefix("diverged_").replace("_", " ")
        if self.snes.reason == PETSc.SNES.ConvergedReason.DIVERGED_LINEAR_SOLVE:
            why += " (" + _KSP.get(self.snes.ksp.reason, "?").lower().removeprefix("diverged_").replace("_", " ") + ")"
        return f"Newton's method stopped after {self.snes.its} iterations: {why}"

    def _converged(self, snes: PETSc.SNES, its: int, norms: tuple[float, float, float]) -> int:
        """|r| <= rtol max(|r_0|, |forces|) or below round-off: forces are what r is the difference of.

        PETSc's own test against |r_0| alone asks for more and more digits as the first guess gets better.
        """
        reason = PETSc.SNES.ConvergedReason
        norm = norms[2]
        if not np.isfinite(norm):
            return int(reason.DIVERGED_FNORM_NAN)
        if its == 0:
            self._first = norm
        scale, floor = self.equations.force_scale()
        if norm <= max(self._rtol * max(self._first if its else 0.0, scale), floor):
            return int(reason.CONVERGED_FNORM_RELATIVE)
        return int(reason.ITERATING)

    def forget_options(self) -> None:
        """Take this solver's options out of PETSc's database; it must not be used any more."""
        self._options.remove()


def _chosen(equations: Equilibrium, given: Options) -> Options:
    """The study's options over the defaults."""
    multigrid = given.get("pc_type", "gamg") == "gamg"
    chosen = DEFAULTS | (MULTIGRID if multigrid else {})
    if multigrid and equations.scheme.inertia:
        # no aggregates across edges that carry nothing; without inertia every edge keeps RESIDUAL_STIFFNESS
        chosen |= {"pc_gamg_threshold": 0.0}
    plastic = equations.material.plastic
    turned = plastic is not None and plastic.frobenius  # pressure makes flow easier, flow makes no pressure
    if turned or (equations.forces.pressures and not equations.material.energy.linear):
        chosen |= {"ksp_type": "gmres"}  # the tangent of this or of a following pressure is not symmetric
    return chosen | given


def _may_change(equations: Equilibrium, given: Options) -> bool:
    """Whether multigrid of another kind may take over: nobody asked for this one, and inertia holds what hangs."""
    own = not any(key.startswith(("pc_", "mg_")) for key in given)
    return own and equations.scheme.inertia


def rigid_body_modes(domain: Domain) -> PETSc.NullSpace:
    """Translations and linearised rotations about the centre, orthonormal: 3 in 2D, 6 in 3D."""
    d, nodes = domain.dim, domain.nodes[: domain.node_count]
    X = nodes - (domain.lower + domain.upper) / 2
    modes = [np.tile(axis, (len(X), 1)) for axis in np.eye(d)]
    for i, j in ((0, 1), (0, 2), (1, 2))[: 1 if d == 2 else 3]:
        rotation = np.zeros_like(X)
        rotation[:, i], rotation[:, j] = -X[:, j], X[:, i]
        modes.append(rotation)
    vectors: list[PETSc.Vec] = []
    for mode in modes:
        vector = PETSc.Vec().createMPI((X.size, None), bsize=d, comm=domain.comm)
        vector.array_w[:] = mode.reshape(-1)
        for earlier in vectors:
            vector.axpy(-vector.dot(earlier), earlier)
        vector.normalize()
        vectors.append(vector)
    return PETSc.NullSpace().create(vectors=vectors, comm=domain.comm)
