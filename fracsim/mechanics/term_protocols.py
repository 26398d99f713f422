"""Protocols of terms that do more than add forces, and the terms of a balance that fulfil them.

A term of contact limits the steps of Newton's method, keeps the surface for output free of overlaps, or moves rigid
bodies. Terms with a history are restored when a step is repeated. Each protocol is one such ability: a term, or one of
its parts, fulfils those whose methods it has. `ContactTerms` and `TermHistories` run over the terms of a balance.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, NamedTuple, Protocol, runtime_checkable

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mesh.parallel import sum_over_ranks
from .term import Flags, Ints, Term, Values

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

    from ..mesh.split_surface.drawn_surface import DrawnSurface
    from ..mesh.split_surface.surface_map import SurfaceMap
    from .block_matrix import TieMatrix

# nodes (n, 2) of the broken edges of this rank, by their numbers in the input mesh, and positions (n, 1) of the cuts
# from the lower node, nan: in the middle
type CutPositions = Callable[[], tuple[npt.NDArray[np.int64], Values]]


@dataclass(frozen=True)
class SurfaceData:
    """Surface for output beside that of the body, such as an obstacle.

    Attributes:
        points: (n, d) positions, m.    triangles: (k, 3) indices of points.
        segments: (m, 2) indices of points in 2D: the outline of the triangles.
    """

    points: Values
    triangles: npt.NDArray[np.integer]
    segments: npt.NDArray[np.integer]


@dataclass(frozen=True)
class TermColumns:
    """Columns of history.csv by name.

    Attributes:
        sums: summed over ranks: functions that return the part of this rank, (1,).
        works: summed over steps and ranks: functions that return the part of this rank in the last step, J.
        minima: functions that return a value of this rank, of which the least counts (collective).
    """

    sums: Mapping[str, Callable[[], Values]]
    works: Mapping[str, Callable[[], float]] = field(default_factory=dict)
    minima: Mapping[str, Callable[[], float]] = field(default_factory=dict)


# --- what a term may be able to do ----------------------------------------------------------------------------------


@runtime_checkable
class StepLimiter(Protocol):
    """Term that limits the length of a Newton step."""

    def max_step_fraction(self, change: Values) -> float:
        """Largest fraction in (0, 1] of a change of u (owned dofs,), m, that is allowed on this rank (collective)."""


@runtime_checkable
class ContactTerm(Protocol):
    """Term whose forces act at the end of the step, with gaps that stay open."""

    def contact_forces(self) -> Values | None:
        """(owned dofs,) contact forces at the end of the step that belongs to the current u, N (collective).

        None if nothing is in contact. r has them with the contact weight of the time level, and the acceleration that
        a scheme carries into the next step excludes them.
        """

    def begin_solve(self) -> None:
        """Begin an attempt of Newton's method at the step."""

    def clear_search(self) -> None:
        """Clear caches of the contact search and initial guesses: what a checkpoint does not have (collective)."""


class ContactPatchValues(NamedTuple):
    """Potential of contact where k nodes move.

    Attributes:
        potential: J.
        forces: (k, d) its gradient, N.
        stiffness: (k d, k d) its second derivatives, N/m.
    """

    potential: float
    forces: Values
    stiffness: csr_matrix


class ContactPatch(Protocol):
    """Contact of k nodes that move by w (k, d), m, with all others fixed; the same on all ranks."""

    def evaluate(self, w: Values) -> ContactPatchValues:
        """Potential at w, m, with its derivatives (collective)."""

    def free_fraction(self, w: Values, step: Values) -> float:
        """Fraction in [0, 1] of a step (k, d), m, from w (k, d) that is allowed (collective)."""


@runtime_checkable
class PatchContactTerm(Protocol):
    """Term whose contact can be evaluated for few nodes that move, with all others fixed."""

    def patch(self, nodes: Ints) -> ContactPatch:
        """Contact of nodes (k,), by their ascending global numbers, that move from the current u (collective)."""


@runtime_checkable
class FollowingSurface(Protocol):
    """Contact whose surface follows nodes: it does not change where others move."""

    def followed_nodes(self) -> npt.NDArray[np.bool_]:
        """(owned nodes,) flags of the nodes that points of the surface follow (collective)."""


@runtime_checkable
class MovableSurface(FollowingSurface, StepLimiter, Protocol):
    """Contact in which nodes away from contact may move as far as steps are not limited."""

    def nodes_in_contact(self) -> npt.NDArray[np.bool_]:
        """(owned nodes,) flags of the nodes that points in contact follow (collective)."""

    def potential(self) -> float:
        """As of Term (collective)."""


@runtime_checkable
class InitialGuess(Protocol):
    """Term that moves an initial guess to where no gap is closed."""

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) an initial guess u, m, moved to where no gap is closed, as far as possible (collective)."""


@runtime_checkable
class FeasibilityTest(Protocol):
    """Term with gaps to bodies in prescribed motion."""

    def is_feasible(self, u: Values) -> bool:
        """Whether all gaps are open at u (owned dofs,), m, so that Newton's method may start there (collective)."""


@runtime_checkable
class RestrictedMotion(Protocol):
    """Bodies in prescribed motion, which can be restricted to a part of it during a solve."""

    def restrict_motion(self) -> None:
        """Restrict the prescribed motion to what the body at the start of the step allows (collective)."""

    def remaining_motion(self) -> float:
        """Fraction of the prescribed motion that is left, the same on all ranks; 0: none."""

    def continue_motion(self) -> None:
        """Continue a restricted motion as far as the body at the current u allows (collective)."""


@runtime_checkable
class CutFaces(Protocol):
    """Crack faces that are in contact."""

    def set_cuts(self, cuts: CutPositions) -> None:
        """Cut broken edges at the positions of `cuts`, asked after they broke; otherwise in the middle."""


@runtime_checkable
class StiffeningContact(Protocol):
    """Contact whose stiffness grows where it is too small."""

    def stiffen_contact(self) -> float:
        """Raise the contact stiffness if gaps at the end of the step are too small (collective).

        Returns:
            Energy that this adds at the same u, part of this rank, J.
        """


@runtime_checkable
class StepWork(Protocol):
    """Term with work that its forces at the end of a step do not show."""

    def step_work(self) -> tuple[float, float]:
        """External work of the last step that `applied_forces` does not show, and the part of it that is dissipated.

        Parts of this rank, J; asked once a step (collective).
        """


@runtime_checkable
class ObstacleWork(Protocol):
    """Part of a term that records the work of obstacles in a step.

    Attributes:
        work: of each obstacle on the body in the last step, part of this rank, J.
    """

    work: list[float]

    def replace_work(self, work: Sequence[float]) -> None:
        """Replace the work by that of an earlier equilibrium in the step."""


@runtime_checkable
class RigidMotionTerm(Protocol):
    """Term that moves rigid bodies beside the deformable one."""

    def kinetic_energy(self) -> float:
        """Kinetic energy of these bodies, part of this rank, J."""


@runtime_checkable
class EliminatingTerm(Protocol):
    """Term with unknowns y of its own, which are eliminated from each linear system (eliminated_unknowns)."""

    def low_rank_updates(self) -> list[tuple[Values, Values]]:
        """Matrices U (owned dofs, k) and C (k, k), C summed over ranks: the tangent lacks - U C U^T (collective)."""

    def condensed_residual(self) -> Values | None:
        """(owned dofs,) B D^-1 r_y at the current unknowns, N; None where it is zero (collective)."""

    def begin_correction(self, change: Values) -> None:
        """Compute the change dy that belongs to a change of u (owned dofs,), m (collective)."""

    def move_along(self, fraction: float) -> None:
        """Set y to that of the start of the correction plus a fraction of dy."""

    def unknowns_are_solved(self) -> bool:
        """Whether r_y = 0 to the tolerance (collective)."""

    def solve_unknowns(self) -> None:
        """Solve r_y = 0 with u held (collective)."""


@runtime_checkable
class TieTerm(Protocol):
    """Term that ties nodes which share no cell."""

    def tie_matrix(self, free: Flags) -> TieMatrix | None:
        """Same operator as `coupling_matrix`, beside a tangent in blocks; None if nothing is tied.

        Args:
            free: (owned dofs,) dofs whose displacement is not prescribed.
        """


@runtime_checkable
class HistoryTerm(Protocol):
    """Term with history variables beside u."""

    def snapshot(self) -> object:
        """History variables between two steps, never written to again."""

    def restore(self, snapshot: object) -> None:
        """Restore the history variables of `snapshot`, together with the damage of that time (collective)."""

    def to_checkpoint(self) -> dict[str, Values]:
        """History variables as arrays that are independent of the number of ranks, on rank 0 (collective)."""

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Restore `to_checkpoint`, given on all ranks, together with u and the damage of that time (collective)."""


@runtime_checkable
class HistoryColumns(Protocol):
    """Term with columns in history.csv."""

    def history_columns(self) -> TermColumns:
        """Columns with their functions."""


@runtime_checkable
class SurfaceSeparator(Protocol):
    """Term that keeps surfaces apart, in output as well."""

    def separate_surface(self, points: SurfaceMap, surface: DrawnSurface, u: Values, t: float) -> SurfaceMap:
        """Points of the split surface of this rank's cells without overlaps (collective).

        Args:
            points: drawn points, as a map without nodes.
            surface: the surface without regard to contact.
            u: (owned dofs,) displacement, m.
            t: time of the state, s.
        """


@runtime_checkable
class OutputSurfaces(Protocol):
    """Term with surfaces of its own in output."""

    def output_surfaces(self, t: float) -> dict[str, SurfaceData]:
        """Surfaces at the time t of the state, s, by name; the same on all ranks (not collective)."""


# --- the terms of a balance -----------------------------------------------------------------------------------------


def fulfilling[P](terms: Iterable[Term], protocol: type[P]) -> list[P]:
    """Parts of terms, and terms, that fulfil a protocol; parts before their term."""
    return [part for term in terms for part in (*term.parts, term) if isinstance(part, protocol)]


class ContactTerms:
    """Contact of a balance: the sum of contact forces, and the bounds of all terms on the steps of Newton's method.

    Attributes:
        contacts: terms with contact forces at the end of a step.
        limits_newton_steps: whether any term limits the length of a Newton step.
    """

    def __init__(self, comm: MPI.Comm, terms: Iterable[Term]) -> None:
        terms = tuple(terms)
        self._comm = comm
        self._limiters = fulfilling(terms, StepLimiter)
        self.contacts = fulfilling(terms, ContactTerm)
        self._guessing = fulfilling(terms, InitialGuess)
        self._tests = fulfilling(terms, FeasibilityTest)
        self._prescribed = fulfilling(terms, RestrictedMotion)
        self._cut_faces = fulfilling(terms, CutFaces)
        self._stiffening = fulfilling(terms, StiffeningContact)
        self._limiting_terms = [term for term in terms if fulfilling([term], StepLimiter)]
        self.limits_newton_steps = bool(self._limiters)

    def forces(self) -> Values | None:
        """(owned dofs,) contact forces at the end of the step, N; None if nothing is in contact (collective)."""
        forces = [force for term in self.contacts if (force := term.contact_forces()) is not None]
        return sum(forces[1:], forces[0]) if forces else None

    def is_active(self) -> bool:
        """Whether a term that limits steps has a nonzero potential at the current u (collective)."""
        potentials = (term.potential() for term in self._limiting_terms)
        return bool(sum_over_ranks(self._comm, sum(abs(potential or 0.0) for potential in potentials))[0] > 0)

    def begin_solve(self) -> None:
        """Begin an attempt of Newton's method at the step."""
        for term in self.contacts:
            term.begin_solve()

    def max_step_fraction(self, change: Values) -> float:
        """Largest fraction in (0, 1] of a change of u (owned dofs,), m, that all terms allow (collective)."""
        fraction = min((term.max_step_fraction(change) for term in self._limiters), default=1.0)
        return float(self._comm.allreduce(fraction, op=MPI.MIN))

    def feasible_guess(self, u: Values, u_n: Values) -> Values:
        """(owned dofs,) displacement, m, from which Newton's method may start (collective).

        The start of the step if no other guess is feasible; prescribed motion is then restricted, until
        `continue_motion` has completed it.

        Args:
            u: (owned dofs,) initial guess with prescribed dofs at their values, m.
            u_n: (owned dofs,) displacement at the start of the step, m.
        """
        for term in self._guessing:
            u = term.feasible_guess(u)
        # all are asked, since the question is collective
        if all([term.is_feasible(u) for term in self._tests]):
            return u
        for contact in self._prescribed:
            contact.restrict_motion()
        return u_n

    def remaining_motion(self) -> float:
        """Largest fraction of a prescribed motion that is left; 0: r = 0 was solved for the whole motion."""
        return max((term.remaining_motion() for term in self._prescribed), default=0.0)

    def continue_motion(self) -> None:
        """Continue restricted motions (collective)."""
        for term in self._prescribed:
            term.continue_motion()

    def stiffen(self) -> float:
        """Raise contact stiffness where gaps are too small; energy that this adds on this rank, J (collective)."""
        return sum(term.stiffen_contact() for term in self._stiffening)

    def set_cuts(self, cuts: CutPositions) -> None:
        """Cut broken edges at the positions of `cuts`."""
        for faces in self._cut_faces:
            faces.set_cuts(cuts)

    def clear_search(self) -> None:
        """Clear caches of the contact search (collective)."""
        for term in self.contacts:
            term.clear_search()


class TermHistories:
    """History variables of all terms of a balance, by the names of the terms."""

    def __init__(self, terms: Iterable[Term]) -> None:
        owners = {term.name: fulfilling([term], HistoryTerm) for term in terms}
        self._owners = {name: parts for name, parts in owners.items() if parts}

    def snapshot(self) -> dict[str, object]:
        """History variables of the terms between two steps."""
        return {name: [part.snapshot() for part in parts] for name, parts in self._owners.items()}

    def restore(self, snapshot: object) -> None:
        """Restore the history variables of `snapshot`, together with the damage of that time (collective)."""
        assert isinstance(snapshot, dict)
        for name, parts in self._owners.items():
            if name in snapshot:
                for part, of_part in zip(parts, snapshot[name], strict=True):
                    part.restore(of_part)

    def to_checkpoint(self) -> dict[str, Values]:
        """Arrays of the terms by "term.array", whole on rank 0 (collective)."""
        items = [(name, part) for name, parts in self._owners.items() for part in parts]
        return {f"{name}.{array}": values for name, part in items for array, values in part.to_checkpoint().items()}

    def from_checkpoint(self, saved: object) -> None:
        """Restore the arrays of `to_checkpoint`, given on all ranks (collective)."""
        assert isinstance(saved, dict)
        for name, parts in self._owners.items():
            prefix = f"{name}."
            arrays = {key.removeprefix(prefix): values for key, values in saved.items() if key.startswith(prefix)}
            if arrays:
                for part in parts:
                    part.from_checkpoint(arrays)
