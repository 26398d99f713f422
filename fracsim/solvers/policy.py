"""Tuned numbers of the solvers: each with its unit, the quantity that it bounds, and the evidence for its value.

A solver reads its policy when it is built: `DEFAULT_POLICY`, or the one that `NonlinearSolver` is given.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np


@dataclass(frozen=True)
class SolverPolicy:
    """Numbers that change how systems are solved, but not their solution.

    A field without a unit is a ratio. "Measured" names the bodies on which the value was chosen.
    """

    # --- Newton's method (newton) ---
    # Mean edges. Longest jump of prescribed dofs without a linear extension into the body. A longer jump at a support
    # alone may invert its cells.
    max_support_jump: float = 0.01
    # |r| of the first guess over the forces of the solution, up to which it counts in the convergence test of a body
    # without broken edges, and iterations that may be spent on the rest: |r| is then below 1e-4 of the forces. Without
    # the limit a cantilever 300 times as long as thick, whose end is displaced in one step, carried 1.5 times its load.
    max_first_norm_ratio: float = 1e2
    max_further_iterations: int = 2
    # Extensions of a prescribed motion that contact is in the way of, before the step is halved.
    max_extensions: int = 10
    # Share of |r| that an iteration leaves. Below it the method converges by itself and no nodes are relaxed
    # separately.
    fast_reduction_ratio: float = 0.1
    # Eliminations in an attempt with the merit function |r|, which may rise in each of them: bounds a cycle.
    max_eliminations: int = 4
    # Linear solves of a step with a linear balance, before Newton's method takes over. One is the rule.
    max_linear_solves: int = 3
    # Solves of a step in which jammed obstacles advance, at most, and before advancing may be judged as too slow.
    max_obstacle_solves: int = 20
    min_obstacle_solves: int = 5
    # Relative tolerance of |r| of all those solves but the last, whose solution alone is kept.
    intermediate_rtol: float = 1e-2

    # --- line search (line_search) ---
    # Share of the summed terms of the potential, below which two potentials are equal up to round-off.
    potential_round_off: float = 1e4 * float(np.finfo(float).eps)
    # Multiples of that round-off. Whole steps whose potential rises by no more are taken as steps near the solution.
    near_solution_ratio: float = 1e3
    # Iterations without a smaller |r|, after which an attempt is given up: with exact tangents it cycles. With positive
    # ones |r| has also to be this multiple of its smallest value: a granite cylinder that breaks took 50 iterations to
    # diverge, and 3 with half the step.
    max_stalled_iterations: int = 10
    divergence_ratio: float = 2.0
    # Share of the largest |r| of an attempt below which its tangents are exact, and mean moduli of a cell: negative
    # eigenvalues above minus this floor stay. Measured on a jelly that tears: with 1e-2 for the first its exact
    # tangents were indefinite in four steps of five.
    exact_below: float = 1e-3
    eigenvalue_floor: float = 1e-2

    # --- inexact Newton (forcing_terms) ---
    # Shares of the residual left by the linearisation, which CG may leave: in the preconditioned norm, and in |r|.
    cg_share: float = 0.1
    cg_share_of_residual: float = 0.3
    # Share of the residual of a solution that CG may leave. Results on other numbers of ranks differ by it.
    cg_share_of_solution: float = 1e-2
    # Share of the residual of a solution that the tangent of an earlier iterate may leave.
    reused_tangent_share: float = 0.3
    # Largest relative tolerance of a correction, and of a last one. A rougher correction of a slender body may not
    # be a direction of descent.
    max_correction_rtol: float = 1e-2
    max_last_correction_rtol: float = 0.1
    # Iterations of CG from which on its rate of convergence is known.
    min_rate_iterations: int = 3

    # --- linear steps and the tangent (linear_solver) ---
    # Share of the residual of a solution that a linear step without inertia leaves: loads that grow in proportion are
    # extrapolated to a solution then, which takes no iteration.
    static_residual: float = 0.3
    # Share of the cells of a matrix that are alive, below which a smaller matrix takes its place.
    shrink_below: float = 0.9
    # c_a rho h^2 / Y. Above it CG multiplies with the tangent in single precision: rounding takes 6e-8 of a stiffness
    # where neighbours move apart, less than the inertia of a part that is attached by one node.
    min_single_precision_inertia: float = 1e-6
    # Dofs from which on products in blocks of a node are used. Smaller matrices stay in the cache.
    min_block_dofs: int = 10_000

    # --- direct solver (direct_solver) ---
    # Dofs up to which a system is factorised where no Krylov method converges: seconds, and a few GB at most.
    max_direct_dofs: int = 100_000
    # Dofs up to which a factorisation takes no longer than GMRES takes to fail: in 2D, in 3D.
    max_direct_before_gmres_2d: int = 100_000
    max_direct_before_gmres_3d: int = 10_000
    # Cost of a factorisation in iterations of CG, until it is measured.
    assumed_direct_cost: int = 40
    # Operations of MUMPS for each entry of the tangent that take as long as an iteration of CG. Measured 4 to 16 on 13
    # bodies: plane and solid, slender and compact, linear and quadratic, 600 to 100,000 dofs.
    flops_per_iteration: float = 11.0
    # Factorisations that the iterations of an attempt may cost, before it continues with factors on trial.
    tangents_on_trial: int = 4
    # Largest cost of a factorisation in 3D, iterations for each dof: a compact body of n dofs takes n / 16.
    compact_direct_cost: float = 1 / 16
    # Solves that start with factors after iterations have failed: the first time, and at most.
    first_direct_solves: int = 8
    max_direct_solves: int = 256

    # Dofs up to which `[solver] plain = true` preconditions by factors: 3.7 s for 14,000 dofs in space, GAMG above.
    max_plain_direct_dofs: int = 5_000

    # --- fallbacks (strategies) ---
    # Restart length of GMRES. With PETSc's 30 it stalls on nearly incompressible bodies.
    gmres_restart: int = 200

    # --- preconditioner ---
    # c_a rho h^2 / Y. Above it SSOR alone serves a body in fragments. Measured on a porcelain figure that shatters
    # (46,000 tetrahedra, a sixth): 2.5 times the iterations, half the time.
    min_ssor_inertia: float = 1e-2
    # The same of any broken body, however few iterations multigrid takes. Measured at 0.07 on that figure: 0.75 of the
    # time; at 0.12 on a bar of 144,000 tetrahedra with one crack: 1.15 times.
    min_ssor_inertia_broken: float = 5e-2
    # Dofs up to which products of multigrid's set-up are stored on one rank: half of its time for 0.5 KB a tetrahedron.
    max_stored_product_dofs: int = 250_000
    # Dofs up to which PETSc's multigrid stays beside the V cycle, so that a refresh keeps its coarse spaces. It and its
    # matrix take 0.55 KB a tetrahedron (1.5 million), which larger bodies need more than a cheap refresh.
    max_kept_multigrid_dofs: int = 250_000
    # Iterations of a whole body from which on aggregates of strong links are tried, and share of these that the new
    # aggregates may take. Measured: 38 iterations for 77 on a sheet of 234,000 tetrahedra, nu = 0.45.
    slow_iterations: int = 25
    strong_link_gain: float = 0.9
    # Iterations as a multiple of those after a set-up, plus 2, above which coarse spaces are set up again.
    rebuild_ratio: float = 1.3
    # Iterations of a fresh set-up as a multiple of those of the whole body, plus 2, above which sweeps of SSOR may
    # serve a broken body.
    fragmented_ratio: float = 1.5
    # Edges that broke for each node of the body, after which operators are refreshed; the V cycle is judged by its
    # iterations alone. Measured: a jelly that tears is set up in two steps of six in place of five.
    refresh_edges: float = 0.02
    # Edges that broke for each node of the body, after which the V cycle is refreshed as well: where all cells are
    # split its old levels take three times the time of a step.
    many_edges: float = 0.5
    # Iterations that a refresh costs.
    refresh_cost: int = 10
    # Iterations that a set-up and, where no edge broke, a refresh cost beside the V cycle in single precision. Measured
    # with stored products on 157,000 tetrahedra: 60 and 30.
    vcycle_setup_cost: int = 65
    vcycle_refresh_cost: int = 30
    # Factor of both where coarse levels are smoothed thoroughly and an iteration costs more.
    thorough_cost_factor: float = 0.6
    # Solves whose slowest tells the iterations of a fresh set-up beside the V cycle. One step has tangents that differ
    # by three times the iterations; with two solves a jelly that tumbles was set up in each step.
    solves_after_setup: int = 5

    # --- changed nodes ---
    # |D_0^-1 D - 1| of the block D of a node and D_0 of the set-up, above which the stiffness has changed.
    changed_stiffness: float = 0.2
    # Share of all nodes, and their number, up to which they are solved for exactly, with their neighbours. Measured: a
    # Charpy bar takes 1.3 times as long without the share, a jelly of 33,000 nodes with 2,000 in place of 6,000.
    max_changed_share: float = 0.2
    max_changed_nodes: int = 6000

    # --- nonlinear elimination ---
    # Share of |r|^2 on the nodes that are relaxed: no more of them than it takes, and the least that is worth it.
    relaxed_share: float = 0.99
    min_relaxed_share: float = 0.9
    # Share of all nodes that are relaxed at most. With their neighbours they are some hundredths of the body.
    max_relaxed_nodes: float = 0.003
    # Trust-region steps of a patch.
    max_trust_steps: int = 40
    # Shares of a patch's first |r| and of the residual of a solution of the body, which a patch may keep.
    patch_rtol: float = 1e-2
    patch_residual: float = 0.1
    # Mean edges. First trust radius, and radius at which a patch is given up.
    first_trust_radius: float = 0.3
    last_trust_radius: float = 1e-8
    # Share of the largest eigenvalue of a node's block, to which smaller ones are raised for preconditioning.
    min_block_eigenvalue: float = 1e-8
    # Actual over predicted decrease: below the first a step is refused, above the second the radius may grow.
    min_decrease_ratio: float = 0.05
    growth_decrease_ratio: float = 0.7
    # Relative tolerance and iterations of the conjugate gradients of a trust-region step.
    trust_cg_rtol: float = 1e-2
    max_trust_cg_iterations: int = 200

    # --- multigrid ---
    # Lanczos products that estimate the largest eigenvalue of a level, and multiple of it up to which is smoothed.
    lanczos_products: int = 10
    chebyshev_upper: float = 1.1
    # Cycles that tell whether coarse levels converge slowly, and share that the last of them leaves where they do.
    # Measured on a doormat after 110 steps: 31 iterations for 98, in 0.4 of the time.
    trial_cycles: int = 4
    slow_cycle_ratio: float = 0.8

    # --- memory (weak_callbacks) ---
    # Scenes after which dropped ones are freed. A scene has some 13 communicators.
    scenes_between_collections: int = 32

    def max_direct_before_gmres(self, dim: int) -> int:
        """Dofs up to which factors take no longer than GMRES takes to fail, by dimension."""
        return self.max_direct_before_gmres_2d if dim == 2 else self.max_direct_before_gmres_3d


DEFAULT_POLICY = SolverPolicy()
