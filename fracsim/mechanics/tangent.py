"""The tangent of a balance of forces, K(u) = d r / d u: when it is assembled, and what is kept beside its matrix.

What terms give as forms is assembled cell by cell (mechanics.matrix_assembly). What couples nodes of different cells is
added to that, or kept beside it as products of few vectors or as springs, where it would fill the matrix.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from mpi4py import MPI
from petsc4py import PETSc

from ..mesh.parallel import sum_over_ranks
from .inertia import MassMatrix
from .jit import CellForm, cell_measure
from .low_rank_springs import StiffCoupling
from .matrix_assembly import TangentAssembler
from .prescribed_motion import PrescribedMotion
from .stress import Stress
from .term import Term, sum_of_forms

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

    from .bcsr_matvec import BlockMatrix
    from .psd_projection import PsdProjection

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

# of an edge: moves within an attempt that leave the body's share of the tangent as it is while pieces touch
MAX_MOVE_FOR_REUSE = 0.01
# of a correction: where contact leaves less of it, the next one, which is the rest of it, is found with the same share
MAX_FRACTION_FOR_REUSE = 0.5


class Tangent:
    """K of a balance, rows and columns of prescribed dofs replaced by the identity's.

    Attributes:
        form: of what K is the assembly of.    c_v: rate of the scheme that it is assembled with, 1/s.
        pattern: how often the matrix has become another one, or has got entries at more places, since the start. PETSc
            does not notice new entries: whatever was made for an earlier pattern has to be made anew by its owner.
        low_rank: U (owned dofs, k) and C (k, k) of what K lacks yet, - U C U^T, since it was assembled.
        springs: the rest of what it lacks.
        couples: whether terms coupled dofs of different cells in the last tangent otherwise than by constants.
    """

    def __init__(
        self, u: fem.Function, terms: Sequence[Term], stress: Stress, motion: PrescribedMotion, mass: MassMatrix
    ) -> None:
        """Compiles what the forms of the terms add up to (collective)."""
        self.domain, self.c_v = stress.domain, 0.0
        self._u, self._terms, self._stress, self._motion, self._mass = u, terms, stress, motion, mass
        self._owned = u.x.index_map.size_local * u.x.block_size
        self.pattern_version, self.has_contact_coupling = 0, False
        self.low_rank_updates: list[tuple[Values, Values]] = []
        self.stiff_couplings: list[StiffCoupling] = []
        self._coupled = False  # whether a coupling has ever been added
        self._mixed = False  # whether what is no constant has ever been added to the tangent's own entries
        self._touches = True  # whether the tangent has contact in it
        self._positive: PsdProjection | None = None
        self._body_at: tuple[float | None, Values] | None = None  # where K was assembled in this attempt
        self._went = 1.0  # share of the last correction
        self._last: tuple[object, list[Values]] | None = None  # what a linear tangent was last assembled with
        v, w, dx = ufl.TrialFunction(self.domain.space), ufl.TestFunction(self.domain.space), cell_measure(self.domain)
        self.form = CellForm(sum_of_forms([term.tangent_form(v, w, dx) for term in terms]))
        self._assembly = TangentAssembler(self.form)

    # --- what K is kept in ---

    @property
    def matrix(self) -> PETSc.Mat:
        """That of K, until `shrink` makes another."""
        return self._assembly.matrix

    def switch_to_blocks(self) -> BlockMatrix | None:
        """Products with the same in blocks of a node's dofs, which are assembled first from here on; None where terms
        add to single entries, or nothing can be compiled (collective)."""
        if any(map(adds_single_entries, self._terms)):
            return None
        return self._assembly.switch_to_blocks(with_dead_cells=not self._mass.is_diagonal)

    def update_entries(self) -> None:
        """Bring `matrix` to where its blocks are, with what is beside them (collective)."""
        if self._coupled and self._assembly.entries_outdated:
            self.matrix.zeroEntries()  # those beyond the blocks
        if self._assembly.update_entries() and self._touches:
            for coupling in [term.coupling_matrix() for term in self._terms]:
                if coupling is not None:
                    self._couple(coupling, constant=True)

    def owned_rows(self, nodes: Ints) -> csr_matrix:
        """(d n, dofs of all ranks) those of owned nodes (n,), of blocks where there are any (collective)."""
        if (blocks := self._assembly.blocks) is not None:
            return blocks.owned_rows(nodes)
        from scipy.sparse import csr_matrix

        d = self.domain.dim
        first = d * self.domain.space.dofmap.index_map.local_range[0]
        at = (first + d * nodes[:, None] + np.arange(d)).reshape(-1).astype(PETSc.IntType)
        which = PETSc.IS().createGeneral(at, comm=self.domain.comm)
        part = self.matrix.createSubMatrix(which)
        starts, columns, values = part.getValuesCSR()
        result = csr_matrix((values, columns, starts), shape=(len(at), self.matrix.getSize()[1]))
        which.destroy()
        part.destroy()
        return result

    @property
    def may_be_incomplete(self) -> bool:
        """Whether K may lack `low_rank` or `springs`."""
        return any(term.leaves_tangent_incomplete for term in self._terms)

    def damage_changed(self) -> None:
        """Cells lost stiffness: those without any stress are not integrated from here on (not collective)."""
        self._leave_out_dead(self.form)
        if self._positive is not None:
            self._leave_out_dead(self._positive.form)

    def _leave_out_dead(self, form: CellForm) -> None:
        if (dead := self._stress.dead_cells) is not None:
            form.exclude_cells(dead)

    def shrink(self, share: float) -> bool:
        """Give up the tangent's entries of dead cells where at most that share of its cells are alive; whether it is a
        new matrix (collective)."""
        dead = self._stress.dead_cells
        changed = dead is not None and self._mass.is_diagonal and self._assembly.shrink(dead, share)
        self.pattern_version += changed
        return changed

    # --- a solve ---

    def begin_solve(self) -> None:
        """Newton's method sets out on the step, once more where it has failed before."""
        self._body_at, self._went = None, 1.0

    def record_step_fraction(self, share: float) -> None:
        """u went that share of a correction."""
        self._went = share

    @contextmanager
    def without_contact(self) -> Iterator[None]:
        """That of a body that touches nothing."""
        self._touches = False
        try:
            yield
        finally:
            self._touches = True

    def assemble(self, *, psd_tolerance: float | None = None, blocks_only: bool = False) -> None:
        """K at the current u; `small`: with moduli made positive to within that share of them; `blocks_alone`: where it
        has blocks, single entries are left for `bring_entries` (collective).

        A linear one is kept while damage and rates are what they were.
        """
        if not (self._linear and self._is_assembled(psd_tolerance)):
            self._assemble_all(psd_tolerance)
        if not blocks_only:
            self.update_entries()

    def _assemble_all(self, small: float | None) -> None:
        served = self._serves(small)
        if not served:
            self._assemble_body(small)
        self.stiff_couplings, self.has_contact_coupling = [], False
        if (blocks := self._assembly.blocks) is not None:
            tied = [term.tie_matrix(self._motion.free_dofs) for term in self._terms] if self._touches else []
            blocks.ties = [each for each in tied if each is not None]
            return
        for term in self._terms:
            term.add_stiffness(self.matrix)
            if self._touches and (coupling := term.coupling_matrix()) is not None and not (served and term.linear):
                self._couple(coupling, constant=term.linear)
        self.low_rank_updates = (
            [part for term in self._terms for part in term.low_rank_updates()] if self._touches else []
        )
        for U, _ in self.low_rank_updates:
            U[self._motion.owned_dofs] = 0.0

    # --- the body's share ---

    def _assemble_body(self, small: float | None) -> None:
        """What K has without terms that add to it."""
        if self._coupled:
            self.matrix.zeroEntries()  # those beyond the pattern of the cells, which the next line does not reach
        more = None if small is None else self._positive_moduli(small)
        factor = sum(term.mass_factor for term in self._terms)
        if self._assembly.blocks is not None:
            mass = self._mass.block_values(self._assembly, factor) if factor else None
            self._assembly(self._motion.bcs, more, mass)
        else:
            self._assembly(self._motion.bcs, more)
            if factor:
                self._mass.add_to(self.matrix, factor, more_entries=self._coupled)
        self._body_at = (small, self._displacement.copy()) if self._alone else None

    @property
    def _displacement(self) -> Values:
        return np.asarray(self._u.x.array[: self._owned])

    def _serves(self, small: float | None) -> bool:
        """Whether the last K of this attempt is the body's own, and it has hardly moved since (collective).

        While pieces touch most corrections are of a share of the barrier's distance: what bends is the barrier. And
        while they come into touch, one after another, a correction is found again and again.
        """
        if self._body_at is None or self._mixed or not self.has_contact_coupling or self._body_at[0] != small:
            return False
        if self._went < MAX_FRACTION_FOR_REUSE:
            return True
        moved = float(np.abs(self._displacement - self._body_at[1]).max(initial=0.0))
        return bool(self.domain.comm.allreduce(moved, op=MPI.MAX) <= MAX_MOVE_FOR_REUSE * self.domain.mean_edge_length)

    @cached_property
    def _alone(self) -> bool:
        """Whether all that terms add to K is beside it, or a coupling, and the body's share follows from u alone."""
        within = any(type(term).add_stiffness is not Term.add_stiffness for term in self._terms)
        limited = any(term.limits_newton_steps for term in self._terms)
        return limited and all([term.potential() is not None for term in self._terms]) and not within

    def _positive_moduli(self, small: float) -> fem.Form:
        """What makes the moduli positive at the current u."""
        if self._positive is None:
            from .psd_projection import PsdProjection

            self._positive = PsdProjection(self._stress)
            self._leave_out_dead(self._positive.form)
        self._positive.update(small)
        return self._positive.form

    @cached_property
    def _linear(self) -> bool:
        return all(term.linear for term in self._terms)

    def _is_assembled(self, small: float | None) -> bool:
        """Whether K is what would be assembled, if it is linear; it is assembled next where not (collective)."""
        fields = [field.x.array for field in self._stress.damage_fields]
        rates = self.matrix.handle, small, sum(term.mass_factor for term in self._terms), self.c_v, self._touches
        was = self._last
        same = was is not None and was[0] == rates and all(map(np.array_equal, was[1], fields))
        if not same:
            self._last = rates, [field.copy() for field in fields]
        return bool(self.domain.comm.allreduce(same, op=MPI.LAND))

    # --- what couples nodes of different cells ---

    def _couple(self, coupling: PETSc.Mat | StiffCoupling, *, constant: bool) -> None:
        """K += a matrix of another pattern, but for prescribed dofs; what is Stiff is kept beside it. What is
        `constant` stays in K while the body's share does (collective)."""
        self.has_contact_coupling |= not constant
        if isinstance(coupling, StiffCoupling):
            coupling.matrix.zeroRowsColumns(self._prescribed_rows, diag=0.0)
            coupling.directions[self._motion.owned_dofs] = 0.0
            self.stiff_couplings.append(coupling)
            return
        K = self.matrix
        before = K.getInfo()["nz_used"]
        part = coupling.copy()
        part.zeroRowsColumns(self._prescribed_rows, diag=0.0)
        K.axpy(1.0, part, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        part.destroy()
        self._coupled, self._mixed = True, self._mixed or not constant
        self.pattern_version += bool(sum_over_ranks(self.domain.comm, int(K.getInfo()["nz_used"] != before))[0])

    @cached_property
    def _prescribed_rows(self) -> npt.NDArray[np.int32]:
        """Global numbers of the prescribed dofs of this rank."""
        first, d = self.domain.space.dofmap.index_map.local_range[0], self.domain.dim
        return np.asarray(self._motion.owned_dofs + first * d, PETSc.IntType)

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        self._assembly.destroy()


def adds_single_entries(term: Term) -> bool:
    """Whether a term adds to a tangent in blocks what is neither a form nor tied."""
    kind = type(term)
    coupling = (Term.coupling_matrix,) if kind.tie_matrix is Term.tie_matrix else ()
    return any(
        getattr(kind, each.__name__) is not each for each in (Term.add_stiffness, Term.low_rank_updates, *coupling)
    )
