"""Contact of a body with itself, and of its pieces with one another: a term of the balance
(docs/theory.md#contact).

The split surface lies on rank 0, which finds what touches (ipc_pairs) and hands forces and stiffness down to the nodes:
x = W u, f = W^T dE/dx, K = W^T d2E/dx2 W. All else stays where it is. What rank 0 does alone in a step is in the
timings of Pairs: for 50,000 triangles less than a step of the body inside them.
"""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, ClassVar

import numpy as np
import numpy.typing as npt
from dolfinx import fem
from petsc4py import PETSc
from scipy.sparse import csr_matrix

from ..mechanics.extra_couplings import CouplingBuilder, StiffCoupling
from ..mechanics.term import Term, TimeLevel
from ..mechanics.term_protocols import CutPositions
from ..mesh.domain import Domain
from ..mesh.parallel import Gather, from_root, on_root, sum_over_ranks
from ..mesh.split_surface.entity_numbering import EntityNumbering
from ..mesh.split_surface.surface_map import SurfaceMap
from .ipc_friction import IpcFriction
from .ipc_surface import SelfContactLaw, SelfContactSurface
from .laws import stiffness_factor

if TYPE_CHECKING:
    from ..meshes.data import MeshData

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

STIFF = 100.0  # of what a wall of an edge's size has: from there on directions are worth to be told apart (Stiff)


class SelfContact(Term):
    """A body that cannot pass through itself."""

    name = "contact"
    leaves_tangent_incomplete = True
    exact_near_solution: ClassVar[bool] = True  # tangents where Newton's method is at its end
    _attempts = 0  # of the step
    _cuts: CutPositions | None = None

    def __init__(self, domain: Domain, u: fem.Function, law: SelfContactLaw) -> None:
        """InputError where the surface at rest cuts itself (collective)."""
        self.law, self._domain, self._u = law, domain, u
        self._owned, self.comm = domain.node_count * domain.dim, domain.comm
        self._coupling = CouplingBuilder(domain)
        self._stiff_threshold = STIFF * domain.mean_edge_length ** (domain.dim - 2)  # m^(d-2), times a stiffness in Pa
        mesh = _refined(domain) if self._is_refined(law) else domain.source
        self._skeleton = None if mesh is None else EntityNumbering(mesh)
        self._gather = node_gather(domain, law)
        first = domain.space.dofmap.index_map.local_range[0]
        self._input_nodes = self._gather(first + np.arange(domain.node_count))  # of input nodes, on rank 0
        self._pattern: npt.NDArray[np.uint8] = np.zeros(domain.cell_count, np.uint8)
        self._surface: SelfContactSurface | None = None
        self._rebuild()

    # --- where the surface is ---

    def _rebuild(self) -> None:
        """The surface of the damage of now (collective)."""
        pattern, u = self._gathered_pattern(), self._gathered(self._u.x.array[: self._owned])
        cuts = None if self._cuts is None else self._cuts()

        def made() -> SelfContactSurface:
            assert pattern is not None and u is not None and self._skeleton is not None
            cut = None if cuts is None else self._skeleton.of_edges(cuts[0], cuts[1][:, 0])
            return self._build_surface(pattern, u, cut)

        self._surface = on_root(self.comm, made)
        self._positions: Values | None = None
        self._contact_force: Values | None = None
        self._stored: float | None = None
        self._start_positions: Values | None = None
        self._tangent_positions: Values | None = None
        self._friction: IpcFriction | None = None
        self._is_stale = True

    def _build_surface(self, pattern: npt.NDArray[np.uint8], u: Values, cut: Values | None) -> SelfContactSurface:
        """On rank 0."""
        assert self._skeleton is not None
        if self._surface is not None and self._surface.represents(pattern):
            return self._surface
        return SelfContactSurface(self._skeleton, pattern, self.law, u, self._surface, cut)

    def _gathered_pattern(self) -> npt.NDArray[np.uint8] | None:
        """(C,) of the cells of the skeleton, on rank 0; nothing breaks where quadratic ones are cut up (collective)."""
        pattern = self._domain.gather_cells(self._pattern)
        parts = 2**self._domain.dim if self._is_refined(self.law) else 1
        return None if pattern is None else np.repeat(pattern, parts)

    def _is_refined(self, law: SelfContactLaw) -> bool:
        return self._domain.order == 2 and not law.corners_only

    def _gathered(self, u: Values) -> Values | None:
        """(nodes, d) in the order of the input mesh on rank 0 (collective)."""
        return self._gather(np.asarray(u).reshape(-1, self._domain.dim))

    def separate_surface(self, at: SurfaceMap, elements: Ints, u: Values, t: float) -> SurfaceMap:
        """Where contact sees the walls: what would be drawn otherwise may overlap by as much as they recede."""
        assert self._surface is not None
        own = self._surface.point_map
        if self.law.fragments_only:
            return self._surface.place_faces(at)
        return own.with_arm_share(np.minimum(own.share, at.share))

    def set_cuts(self, cuts: CutPositions) -> None:
        """Walls between pieces are where edges are cut."""
        if self.law.fragments_only:
            self._cuts = cuts

    def edges_broke(self, pattern: npt.NDArray[np.uint8]) -> None:
        """New walls may touch from here on, drawn in where they are crowded as they appear (collective)."""
        self._pattern = pattern
        self._rebuild()
        self._friction, self._is_stale = None, True

    def snapshot(self) -> object:
        """What is drawn in, and left out, on rank 0."""
        return (self._surface and self._surface.snapshot(),)

    def restore(self, memory: object) -> None:
        """Be again what `memory` gave (not collective)."""
        assert isinstance(memory, tuple)
        if self._surface is not None:
            self._surface.restore(memory[0])

    def to_checkpoint(self) -> dict[str, Values]:
        """Shares of arms, numbers of elements that are left out, steps to the next look for room, and stiffness."""
        share, out, pause = (np.empty(0), np.empty(0), (0, 0)) if self._surface is None else self._surface.snapshot()
        return {"share": share, "left_out": np.asarray(out, float), "pause": np.array(pause, float),
                "stiffness": np.array([self.law.stiffness])}  # fmt: skip

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        self._stiffen_to(float(saved["stiffness"][0]))
        if self._surface is not None:
            pause, waits = (int(each) for each in saved.get("pause", (1, 1)))
            self._surface.restore((saved["share"], saved["left_out"].astype(np.int64), (pause, waits)))

    def begin_step(self, level: TimeLevel) -> None:
        """A step begins: friction is that of its start."""
        self._level, self._is_stale, self._friction, self._attempts = level, True, None, 0
        if not level.dt:
            return
        nodal, creep = (
            self._gathered(level.u_n),
            max(self.law.sticking_speed, self.law.sticking_speed_ratio * self._speed(level.v_n)),
        )
        if self._surface is not None and nodal is not None:
            self._surface.extend_faces(nodal)
            self._start_positions = self._surface.point_map(nodal)
        if self.law.friction and self._surface is not None and self._start_positions is not None:
            x, slip = self._start_positions, creep * level.dt
            self._friction = self._surface.pairs.lag_friction(x, x, slip)

    def _speed(self, v: Values) -> float:
        """Root mean square of the nodes' speeds, m/s (collective)."""
        squares, count = sum_over_ranks(self.comm, np.array([v @ v, len(v) / self._domain.dim]))
        return float(np.sqrt(squares / count))

    def update_displacement(self) -> None:
        """What touches has to be found anew."""
        self._is_stale = True

    def _end_positions(self) -> Values | None:
        """(n, d) at the end of the step that belongs to the current u, on rank 0 (collective)."""
        if self._is_stale:
            self._positions, self._is_stale = (
                self._positions_at(self._level.displacement_at_end(self._u.x.array[: self._owned])),
                False,
            )
            self._contact_force = self._stored = None
        return self._positions

    def _positions_at(self, u: Values) -> Values | None:
        """(n, d) x of the owned displacements u, on rank 0 (collective)."""
        nodal = self._gathered(u)
        return None if self._surface is None or nodal is None else self._surface.point_map(nodal)

    # --- what it adds to the balance ---

    def _nodal_forces(self, x: Values | None, *, normal: bool = True) -> Values:
        """(owned dofs,) forces on the nodes with the surface at x (n, d), given on rank 0, N; those of friction alone
        where not `normal` (collective)."""

        def found() -> Values:
            assert self._surface is not None and x is not None
            gradient = self._surface.pairs.gradient(x) if normal else np.zeros_like(x)
            if self._friction is not None:
                gradient = gradient + self._friction.gradient(x)
            return self._surface.nodal_forces(-gradient)

        return np.asarray(self._gather.scatter(on_root(self.comm, found))).reshape(-1)

    def contact_forces(self) -> Values:
        """(owned dofs,) forces at the end of the step, N (collective)."""
        x = self._end_positions()
        if self._contact_force is None:  # r and its scale ask for the same
            self._contact_force = self._nodal_forces(x)
        return self._contact_force

    def reference_forces(self) -> Values:
        """(owned dofs,) the same as they enter r, N (collective)."""
        return np.asarray(self._level.contact_weight * self.contact_forces())

    def coupling_matrix(self) -> PETSc.Mat | StiffCoupling | None:
        """Minus the derivative of the forces, where anything is in touch; Stiff where it is little (collective)."""
        x = self._end_positions()

        def found() -> tuple[csr_matrix, tuple[Values, Values] | None]:
            assert self._surface is not None and x is not None
            near, self._tangent_positions = (
                self._surface.is_near_tangent(x, self._tangent_positions, again=self._attempts > 1),
                x,
            )
            exact = near and self.exact_near_solution
            H = self._surface.pairs.hessian(x, exact=exact)
            if self._friction is not None:
                H = (H + self._friction.hessian(x, exact=exact)).tocsr()
            return self._surface.nodal_stiffness(
                self._level.contact_weights.factor * H, self._stiff_threshold * self.law.stiffness
            )

        K, stiff = on_root(self.comm, found) or (None, None)
        if not self.comm.bcast(K is not None and K.nnz):
            return None
        if K is None or self._input_nodes is None:
            matrix = self._coupling(csr_matrix((0, 0)), np.empty(0, np.int64))
        else:
            matrix = self._coupling(K, self._input_nodes)
        if (stiffness := self.comm.bcast(stiff and stiff[1])) is None:
            return matrix
        directions = self._gather.scatter(stiff and stiff[0])
        return StiffCoupling(matrix, directions.reshape(self._owned, len(stiffness)), stiffness)

    def min_gap(self) -> float:
        """Between elements on which the barrier acts at the current u, m; infinite where none do (collective)."""
        x = self._positions_at(self._u.x.array[: self._owned])

        def found() -> float:
            assert self._surface is not None and x is not None
            return self._surface.pairs.min_gap(x)

        return from_root(self.comm, found)

    def stored_energy(self) -> float:
        """Energy of the barrier at the current u, on rank 0, J (collective)."""
        x = self._end_positions()
        if self._stored is None:  # asked for in turn by whether it acts, the line search, and the book of energies
            self._stored = 0.0 if self._surface is None or x is None else self._surface.pairs.energy(x)
        return self._stored

    def stiffen_contact(self) -> float:
        """A barrier that is all but closed where the step ends is stiffer from here on (laws)."""
        x = self._end_positions()

        def found() -> tuple[float, float]:
            assert self._surface is not None and x is not None
            pairs = self._surface.pairs
            factor = stiffness_factor(pairs.min_gap(x) / self.law.distance)
            return factor, (factor - 1) * pairs.energy(x) if factor > 1 else 0.0

        factor, gained = from_root(self.comm, found)
        if factor > 1:
            self._stiffen_to(factor * self.law.stiffness)
        return gained if self.comm.rank == 0 else 0.0

    def _stiffen_to(self, stiffness: float) -> None:
        if stiffness == self.law.stiffness:
            return
        self.law = replace(self.law, stiffness=stiffness)
        if self._surface is not None:
            self._surface.set_stiffness(stiffness)

    def damping_forces(self) -> Values | None:
        """(owned dofs,) minus the forces of friction, N (collective)."""
        return -self._nodal_forces(self._end_positions(), normal=False) if self.law.friction else None

    def potential(self) -> float:
        """Barrier and friction at the end of the step as they enter that of r, on rank 0, J (collective)."""
        x, energy = self._end_positions(), self.stored_energy()
        if self._friction is not None and x is not None:
            energy += self._friction.energy(x)
        return self._level.contact_weight * self._level.fraction * energy

    # --- how far Newton's method may go ---

    def max_step_fraction(self, change: Values) -> float:
        """Share of a change of u on the way of which nothing meets (collective)."""
        x, way = self._end_positions(), self._gathered(np.divide(change, self._level.fraction))
        return from_root(self.comm, lambda: self._free_fraction(x, way))

    def _free_fraction(self, x: Values | None, way: Values | None) -> float:
        assert self._surface is not None and x is not None and way is not None
        return self._surface.pairs.free_fraction(x, x + self._surface.point_map.weights @ way)

    def begin_solve(self) -> None:
        """Newton's method sets out on the step: after it has failed it is exact later."""
        self._tangent_positions, self._attempts = None, self._attempts + 1

    def feasible_guess(self, u: Values) -> Values:
        """(owned dofs,) a first guess of u as far on the way from the start as nothing meets (collective)."""
        level = self._level
        if not level.dt:
            return u
        x, way = self._start_positions, self._gathered(self._level.displacement_at_end(u) - level.u_n)
        share = from_root(self.comm, lambda: self._free_fraction(x, way))
        return u if share == 1 else np.asarray(level.u_n + share * (u - level.u_n))

    def clear_search(self) -> None:
        """Forget which pairs were near (not collective)."""
        self._is_stale = True
        if self._surface is not None:
            self._surface.pairs.clear_caches()

    def destroy(self) -> None:
        """Give the memory of PETSc's objects back."""
        self._coupling.destroy()


def node_gather(domain: Domain, law: SelfContactLaw) -> Gather:
    """Of the nodes that the surface follows."""
    return domain.gather_corners if law.corners_only else domain.gather_nodes


def _refined(domain: Domain) -> MeshData | None:
    from ..mesh.split_surface.quadratic_surface import refined_input

    return refined_input(domain)
