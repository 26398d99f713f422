"""Tangent K(u) = d r / d u of a balance of forces.

Forms of the terms are assembled cell by cell (mechanics.matrix_assembly). Couplings between nodes of different cells
are added to a matrix of single entries, and stay beside a matrix in blocks. Those that would fill the matrix stay
beside it in both cases: as low-rank updates, or as FewNodesCoupling.

Equations: docs/theory.md#linear-systems.
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
from .extra_couplings import CouplingBuilder, FewNodesCoupling
from .inertia import MassMatrix
from .jit import CellForm, cell_measure
from .matrix_assembly import TangentAssembler
from .prescribed_motion import PrescribedMotion
from .stress import Stress
from .term import Term, overriding, sum_of_forms
from .term_protocols import EliminatingTerm, TieTerm, fulfilling

if TYPE_CHECKING:
    from scipy.sparse import csr_matrix

    from ..mesh.domain import Domain
    from .block_matrix import BlockMatrix
    from .psd_projection import PsdProjection

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class Couplings:
    """Couplings between nodes of different cells, which the terms of a balance add to its tangent.

    Attributes:
        beside: coupling of the last tangent that the assembled matrix lacks; None: it has all.
        has_contact: whether terms coupled nodes in the last tangent, except by constants.
        in_entries: whether the matrix of single entries has ever had one.
    """

    def __init__(self, terms: Sequence[Term], motion: PrescribedMotion, domain: Domain) -> None:
        self._motion, self._domain = motion, domain
        self._tied = [term for term in terms if isinstance(term, TieTerm)]
        self._coupled = overriding(terms, "add_stiffness", "coupling_matrix")
        self.beside: FewNodesCoupling | None = None
        self._beside_blocks: list[PETSc.Mat] = []  # of the last tangent, but for ties
        self._builder, self._keeps_beside = CouplingBuilder(domain), True
        self.has_contact = self.in_entries = False

    def keep_beside(self, keep: bool) -> None:
        """Keep a FewNodesCoupling beside the matrix from now on, or add it to the matrix, as factors need it."""
        self._keeps_beside = keep

    def add_to_entries(self, K: PETSc.Mat, *, with_contact: bool) -> bool:
        """Add stiffness and couplings of the terms to the entries (collective).

        Args:
            K: tangent in single entries.
            with_contact: whether couplings are added.

        Returns:
            Whether the nonzero pattern has changed.
        """
        self.beside, self.has_contact, changed = None, False, False
        for term in self._coupled:
            term.add_stiffness(K)
            if with_contact and (coupling := self._coupling_of(term)) is not None:
                changed |= self._add(K, coupling)
        return changed

    def put_beside(self, blocks: BlockMatrix, *, with_contact: bool) -> None:
        """Put ties and couplings of the terms beside the blocks (collective)."""
        from .block_matrix import CouplingMatrix

        self.beside, self.has_contact, blocks.couplings, self._beside_blocks = None, False, [], []
        if not with_contact:
            return
        ties = [term.tie_matrix(self._motion.free_dofs) for term in self._tied]
        blocks.couplings += [tie for tie in ties if tie is not None]
        for term in self._coupled:
            if term in self._tied or (coupling := self._coupling_of(term)) is None:
                continue
            coupling.zeroRowsColumns(self._prescribed_rows, diag=0.0)
            self._beside_blocks.append(coupling)
            blocks.couplings.append(CouplingMatrix(coupling))

    def copy_to_entries(self, K: PETSc.Mat) -> bool:
        """Add ties and the couplings beside the blocks to entries; returns whether the pattern changed (collective)."""
        ties = [tie for term in self._tied if (tie := term.coupling_matrix()) is not None]
        return any([self._add(K, coupling) for coupling in (*ties, *self._beside_blocks)])

    def _coupling_of(self, term: Term) -> PETSc.Mat | None:
        """Coupling of a term that is to be added to K, if any; a FewNodesCoupling may stay beside it (collective)."""
        coupling = term.coupling_matrix()
        if coupling is None:
            return None
        self.has_contact |= not term.linear
        if isinstance(coupling, FewNodesCoupling):
            if self._keeps_beside:
                self.beside = coupling.without_dofs(self._domain, self._motion.owned_dofs)
                return None
            return self._builder(coupling.owned_rows(), coupling.numbers)
        return coupling

    def _add(self, K: PETSc.Mat, coupling: PETSc.Mat) -> bool:
        """Add a matrix of another pattern without prescribed dofs; returns whether the pattern changed (collective)."""
        before = K.getInfo()["nz_used"]
        part = coupling.copy()
        part.zeroRowsColumns(self._prescribed_rows, diag=0.0)
        K.axpy(1.0, part, PETSc.Mat.Structure.DIFFERENT_NONZERO_PATTERN)
        part.destroy()
        self.in_entries = True
        return bool(sum_over_ranks(self._domain.comm, int(K.getInfo()["nz_used"] != before))[0])

    @cached_property
    def _prescribed_rows(self) -> npt.NDArray[np.int32]:
        """Global numbers of the prescribed dofs of this rank."""
        first, d = self._domain.space.dofmap.index_map.local_range[0], self._domain.dim
        return np.asarray(self._motion.owned_dofs + first * d, PETSc.IntType)


class Tangent:
    """Tangent of a balance, with rows and columns of prescribed dofs replaced by those of the identity.

    Attributes:
        domain: the mesh.
        form: bilinear form of the terms.
        c_v: rate of the scheme, 1/s.
        pattern_version: number of changes of the matrix or of its nonzero pattern. PETSc does not notice new entries:
            the owner of anything made for an earlier pattern has to make it again.
        low_rank_updates: U (owned dofs, k) and C (k, k): the assembled matrix lacks - U C U^T.
        couplings: couplings between nodes of different cells.
        may_be_incomplete: whether the assembled matrix may lack low-rank updates or a coupling.
    """

    def __init__(self, terms: Sequence[Term], stress: Stress, motion: PrescribedMotion, mass: MassMatrix) -> None:
        """Compile the sum of the terms' forms (collective)."""
        self.domain, self.c_v = stress.domain, 0.0
        self._terms, self._stress, self._motion, self._mass = terms, stress, motion, mass
        self.pattern_version, self.couplings = 0, Couplings(terms, motion, self.domain)
        self.low_rank_updates: list[tuple[Values, Values]] = []
        self._eliminating = fulfilling(terms, EliminatingTerm)
        self._inertial = overriding(terms, "mass_factor")
        self.may_be_incomplete = any(term.leaves_tangent_incomplete for term in terms)
        self._linear = all(term.linear for term in terms)
        self._with_contact = True
        self._psd: PsdProjection | None = None
        self._last: tuple[object, list[Values]] | None = None  # rates and damage of the last linear tangent
        v, w, dx = ufl.TrialFunction(self.domain.space), ufl.TestFunction(self.domain.space), cell_measure(self.domain)
        self.form = CellForm(sum_of_forms([term.tangent_form(v, w, dx) for term in terms]))
        self._assembler = TangentAssembler(self.form, stress.kernels)

    # --- matrices ---

    @property
    def matrix(self) -> PETSc.Mat:
        """Assembled matrix, until `shrink` replaces it."""
        return self._assembler.matrix

    def switch_to_blocks(self) -> BlockMatrix | None:
        """Assemble into blocks of a node's dofs from now on; returns the matrix in blocks (collective).

        None if terms add entries to the matrix themselves, or without a compiler.
        """
        if overriding(self._terms, "add_stiffness"):
            return None
        return self._assembler.switch_to_blocks(with_dead_cells=not self._mass.is_diagonal)

    def update_entries(self) -> None:
        """Update `matrix` from its blocks, with the couplings beside them (collective)."""
        if self.couplings.in_entries and self._assembler.entries_outdated:
            self.matrix.zeroEntries()  # entries beyond the blocks
        if self._assembler.update_entries() and self._with_contact:
            self.pattern_version += self.couplings.copy_to_entries(self.matrix)

    def owned_rows(self, nodes: Ints) -> csr_matrix:
        """(d n, dofs of all ranks) rows of owned nodes (n,), with ties (collective)."""
        if (blocks := self._assembler.blocks) is not None:
            return blocks.owned_rows(nodes)
        from scipy.sparse import csr_matrix

        d = self.domain.dim
        first = d * self.domain.space.dofmap.index_map.local_range[0]
        rows = (first + d * nodes[:, None] + np.arange(d)).reshape(-1).astype(PETSc.IntType)
        index_set = PETSc.IS().createGeneral(rows, comm=self.domain.comm)
        part = self.matrix.createSubMatrix(index_set)
        starts, columns, values = part.getValuesCSR()
        result = csr_matrix((values, columns, starts), shape=(len(rows), self.matrix.getSize()[1]))
        index_set.destroy()
        part.destroy()
        return result

    def damage_changed(self) -> None:
        """Exclude cells without stress from integration (not collective)."""
        _exclude_dead_cells(self._stress, self.form)
        if self._psd is not None:
            _exclude_dead_cells(self._stress, self._psd.form)

    def release_entries(self) -> None:
        """Free the entries of `matrix` until `update_entries`, if there are blocks (collective)."""
        if self._assembler.blocks is not None:
            self._assembler.release_entries()

    def may_shrink(self, share: float) -> bool:
        """Return True if `shrink` would drop entries: at most a share of its cells are alive (collective)."""
        dead = self._stress.dead_cells
        return dead is not None and self._mass.is_diagonal and self._assembler.may_shrink(dead, share)

    def shrink(self) -> None:
        """Drop the entries of dead cells, where `may_shrink` (collective)."""
        assert self._stress.dead_cells is not None
        self._assembler.shrink(self._stress.dead_cells)
        self.pattern_version += 1

    # --- a solve ---

    @contextmanager
    def without_contact(self) -> Iterator[None]:
        """Context in which K is that of a body without contact."""
        self._with_contact = False
        try:
            yield
        finally:
            self._with_contact = True

    def assemble(self, *, psd_tolerance: float | None = None, blocks_only: bool = False) -> None:
        """Assemble K at the current u; a linear K is reused while damage and rates are unchanged (collective).

        Args:
            psd_tolerance: tolerance of positive semi-definite moduli (psd_projection); None: exact moduli.
            blocks_only: whether single entries are left for `update_entries`, if there are blocks.
        """
        if not (self._linear and self._is_assembled(psd_tolerance)):
            self._assemble_all(psd_tolerance)
        if not blocks_only:
            self.update_entries()

    def _assemble_all(self, psd_tolerance: float | None) -> None:
        self._assemble_body(psd_tolerance)
        with_contact = self._with_contact
        if (blocks := self._assembler.blocks) is not None:
            self.couplings.put_beside(blocks, with_contact=with_contact)
        else:
            self.pattern_version += self.couplings.add_to_entries(self.matrix, with_contact=with_contact)
        eliminating = self._eliminating if with_contact else []
        self.low_rank_updates = [update for term in eliminating for update in term.low_rank_updates()]
        for U, _ in self.low_rank_updates:
            U[self._motion.owned_dofs] = 0.0

    # --- the body's part ---

    def _assemble_body(self, psd_tolerance: float | None) -> None:
        """Assemble forms and inertia, without couplings."""
        if self.couplings.in_entries and self._assembler.blocks is None:
            self.matrix.zeroEntries()  # entries beyond the pattern of the cells
        factor = sum(term.mass_factor for term in self._inertial)
        psd_form = None if psd_tolerance is None else self._psd_form(psd_tolerance, has_inertia=factor > 0)
        if self._assembler.blocks is not None:
            mass = self._mass.block_values(self._assembler, factor) if factor else None
            self._assembler(self._motion.bcs, psd_form, mass)
        else:
            self._assembler(self._motion.bcs, psd_form)
            if factor:
                self._mass.add_to(self.matrix, factor, more_entries=self.couplings.in_entries)

    def _psd_form(self, tolerance: float, *, has_inertia: bool) -> fem.Form:
        """Form of the correction of the moduli at the current u."""
        if self._psd is None:
            from .psd_projection import PsdProjection

            self._psd = PsdProjection(self._stress)
            _exclude_dead_cells(self._stress, self._psd.form)
        # Absolute values of the eigenvalues would hold a body that buckles without inertia.
        self._psd.update(tolerance, 2.0 if has_inertia else 1.0)
        return self._psd.form

    def _is_assembled(self, psd_tolerance: float | None) -> bool:
        """Whether a linear K is up to date; where it is not, the caller assembles it (collective)."""
        fields = [field.x.array for field in self._stress.damage_fields]
        factor = sum(term.mass_factor for term in self._inertial)
        rates = self.matrix.handle, psd_tolerance, factor, self.c_v, self._with_contact
        last = self._last
        same = last is not None and last[0] == rates and all(map(np.array_equal, last[1], fields))
        if not same:
            self._last = rates, [field.copy() for field in fields]
        return bool(self.domain.comm.allreduce(same, op=MPI.LAND))

    def destroy(self) -> None:
        """Free PETSc's objects."""
        self._assembler.destroy()


def _exclude_dead_cells(stress: Stress, form: CellForm) -> None:
    if (dead := stress.dead_cells) is not None:
        form.exclude_cells(dead)
