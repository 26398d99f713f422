"""Tangent of a balance as the matrices that a KSP takes, for products and for the set-up of preconditioners."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any, Protocol

from petsc4py import PETSc

from ..mechanics.balance import Balance
from ..mesh.domain import Domain
from ..mesh.parallel import sum_over_ranks
from .policy import SolverPolicy
from .preconditioner import mass_stiffness_ratio, rigid_body_nullspace

if TYPE_CHECKING:
    from dolfinx.fem import DofMap

    from ..mechanics.block_matrix import BlockMatrix
    from ..mechanics.tangent import Tangent
    from .multigrid.levels import FineLevel


class BlockOperator:
    """Context of a PETSc matrix for products with the tangent in blocks of the d dofs of a node.

    One index is read for d^2 values instead of for d: a product takes half the time. The matrix of single entries,
    which smoothed aggregation needs, is updated for a set-up of multigrid.

    Attributes:
        tangent: matrix of single entries.
        assembled: blocks in which K is assembled.
        fine_level: copy of the tangent in single precision that products use; None: double precision.
    """

    def __init__(self, tangent: PETSc.Mat, assembled: BlockMatrix) -> None:
        self.tangent, self.assembled = tangent, assembled
        self.fine_level: FineLevel | None = None

    def multiply_by(self, fine_level: FineLevel | None) -> None:
        """Multiply with this copy of the tangent in single precision; None: in double precision."""
        self.fine_level = fine_level

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Evaluate y = K x (collective)."""
        if self.fine_level is not None:
            self.fine_level.multiply(x, y)
        else:
            self.assembled.mult(x, y)

    def to_petsc(self) -> PETSc.Mat:
        """Return the operator as a PETSc matrix."""
        result: Any = PETSc.Mat().createPython(self.tangent.getSizes(), self, comm=self.tangent.comm)
        result.setUp()
        return result


class LowRankOperator:
    """Context of the PETSc matrix K - sum of U C U^T + C', for products.

    U C U^T belong to unknowns that terms have eliminated, C' couples few nodes. Preconditioners are set up from K
    alone: an update of rank k costs k more iterations, and a balancing preconditioner has C' (solvers.balancing).
    """

    def __init__(self, matrix: PETSc.Mat, tangent: Tangent) -> None:
        """Combine products with K, `matrix`, and the updates of the present `tangent`."""
        self._matrix, self._tangent = matrix, tangent

    def mult(self, _: PETSc.Mat, x: PETSc.Vec, y: PETSc.Vec) -> None:
        """Evaluate y = (K - sum of U C U^T + C') x (collective)."""
        self._matrix.mult(x, y)
        for U, C in self._tangent.low_rank_updates:
            y.array_w[:] -= U @ (C @ sum_over_ranks(self._matrix.comm.tompi4py(), U.T @ x.array_r))
        if (coupling := self._tangent.couplings.beside) is not None:
            coupling.add_product(x.array_r, y.array_w)

    def to_petsc(self) -> PETSc.Mat:
        """Return the operator as a PETSc matrix."""
        result: Any = PETSc.Mat().createPython(self._matrix.getSizes(), self, comm=self._matrix.comm)
        result.setUp()
        return result


def blocks_pay_off(dofs: DofMap, min_dofs: int) -> bool:
    """Return True if products in blocks are faster; small matrices stay in the cache in any form."""
    return dofs.index_map_bs > 1 and dofs.index_map.size_global * dofs.index_map_bs >= min_dofs


class PatternListener(Protocol):
    """Interface of an object with factors, coarse spaces or copies of a matrix."""

    def pattern_changed(self) -> None:
        """Note that the matrix is another one, or has entries at other positions."""

    def matrix_ends(self) -> None:
        """Free what was made for the matrix, since another one is about to take its place."""


class TangentOperators:
    """K of a balance at the present displacement, in one matrix or several.

    Attributes:
        block_operator: context of `products`; None without blocks.
        operator: K for the products of a Krylov method, with low-rank updates.
        products: K for products without low-rank updates; None: `matrix` serves.
        eigenvalue_floor: that of the last assembly (mechanics.psd_projection); None: the tangent is exact.
    """

    def __init__(self, balance: Balance, policy: SolverPolicy, *, for_multigrid: bool, may_use_blocks: bool) -> None:
        """Set up the matrices (collective).

        Args:
            balance: balance of forces.
            policy: size from which blocks pay off.
            for_multigrid: attach rigid body modes to the matrix.
            may_use_blocks: products may be with node blocks.
        """
        self._balance, self._tangent, self._policy = balance, balance.tangent, policy
        self._may_use_blocks = may_use_blocks
        self._near_nullspace = near_nullspace(balance.domain) if for_multigrid else None
        self.block_operator: BlockOperator | None = None
        self._low_rank_operator: PETSc.Mat | None = None
        self.eigenvalue_floor: float | None = None
        self._known_pattern = self._tangent.pattern_version
        self._listeners: tuple[PatternListener, ...] = ()
        self._make_operators()

    # --- matrices ---

    @property
    def matrix(self) -> PETSc.Mat:
        """Entries of K, which may be older than its blocks until `update_entries`."""
        return self._tangent.matrix

    @property
    def blocks(self) -> BlockMatrix | None:
        """Blocks in which K is assembled; None if it is not."""
        return None if self.block_operator is None else self.block_operator.assembled

    def _make_operators(self) -> None:
        """Set up the matrices for the present pattern (collective)."""
        self._release_operators()
        tangent = self._tangent
        self.products: PETSc.Mat | None = None
        pay_off = self._may_use_blocks and blocks_pay_off(tangent.domain.space.dofmap, self._policy.min_block_dofs)
        if pay_off and (blocks := tangent.switch_to_blocks()) is not None:
            self.block_operator = BlockOperator(tangent.matrix, blocks)
            self.products = self.block_operator.to_petsc()
        self.operator = self.products or tangent.matrix
        if tangent.may_be_incomplete:
            self._low_rank_operator = LowRankOperator(self.operator, tangent).to_petsc()
            self.operator = self._low_rank_operator
        self._attach_nullspace()

    def _attach_nullspace(self) -> None:
        """Attach the rigid body modes to the matrix."""
        # PETSc's sum of two matrices with different patterns loses them; multigrid would use translations alone.
        if self._near_nullspace is not None and not self.matrix.getNearNullSpace():
            self.matrix.setNearNullSpace(self._near_nullspace)

    def shrink(self, share: float) -> bool:
        """Remove the entries of dead cells, if at most the `share` of the cells is alive (collective).

        Returns:
            Whether there are new matrices.
        """
        if not self._tangent.may_shrink(share):
            return False
        # First: what was made for the old matrix has as many bytes as the new one.
        self.multiply_by(None)
        for listener in self._listeners:
            listener.matrix_ends()
        self._tangent.shrink()
        self._make_operators()
        return True

    # --- values ---

    def assemble(self, eigenvalue_floor: float | None) -> None:
        """Assemble K at the present displacement, in blocks if there are any (collective)."""
        self.multiply_by(None)
        self.eigenvalue_floor = eigenvalue_floor
        self._tangent.assemble(psd_tolerance=eigenvalue_floor, blocks_only=True)
        self._check_pattern()
        self._attach_nullspace()

    def add_pattern_listeners(self, *listeners: PatternListener) -> None:
        """Tell these listeners of every change of the pattern."""
        self._listeners += listeners

    def _check_pattern(self) -> None:
        """Tell the listeners if the pattern has changed."""
        if self._known_pattern == self._tangent.pattern_version:
            return
        self._known_pattern = self._tangent.pattern_version
        for listener in self._listeners:
            listener.pattern_changed()

    def update_entries(self) -> None:
        """Update the entries of `matrix` to the blocks (collective)."""
        self._tangent.update_entries()
        # Ties are not part of the blocks, and may be new.
        self._check_pattern()
        self._attach_nullspace()

    def release_entries(self) -> None:
        """Free the entries of `matrix` until `update_entries`, if there are blocks (collective)."""
        self._tangent.release_entries()

    def multiply_by(self, fine_level: FineLevel | None) -> None:
        """Multiply with this copy of the tangent in single precision; None: in double precision (collective)."""
        if self.block_operator is None:
            return
        # Inertia has to exceed the rounding error of the stiffness.
        if fine_level is not None and mass_stiffness_ratio(self._balance) <= self._policy.min_single_precision_inertia:
            fine_level = None
        self.block_operator.multiply_by(fine_level)

    def attach_to(self, ksp: PETSc.KSP, pc: PETSc.PC) -> None:
        """Give the tangent to a KSP with this preconditioner, and set both up (collective)."""
        ksp.setPC(pc)
        pc.setReusePreconditioner(False)
        pc.setUseAmat(self.products is not None)
        ksp.setOperators(self.products or self.matrix, self.matrix)
        ksp.setUp()

    # --- end ---

    def _release_operators(self) -> None:
        """Free the matrices for products."""
        self.block_operator = None
        if self._low_rank_operator is not None:
            self._low_rank_operator.destroy()
            self._low_rank_operator = None

    def destroy(self) -> None:
        """Free PETSc's objects."""
        self._release_operators()
        if self._near_nullspace is not None:
            self._near_nullspace.destroy()


def near_nullspace(domain: Domain) -> PETSc.NullSpace:
    """Return the rigid body modes of a body about its centre (collective)."""
    return rigid_body_nullspace(
        domain.comm, domain.nodes[: domain.node_count] - (domain.bounds.lower + domain.bounds.upper) / 2
    )
