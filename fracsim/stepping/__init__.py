"""From one state to the next.

state              what a run carries from step to step
stepper            what a stepper is; attempts, halved steps, arrival and books, as all schemes share them
implicit           steps of schemes with inertia that solve a system
quasi_static       load steps: balance and breaking in turn until nothing changes
explicit           steps without a system
after_step         what flows and breaks at the end of a step; empty parts where nothing does
memory             damage and flow as values in the state
condensed          a tangent less what terms have eliminated
energy_book        work and viscous loss of a step
stress_release     what broken edges no longer hold
newton             one nonlinear solve, and what is tried where it fails
choice             iterations or factors: what a solve begins with; factors: what they cost
forcing            how exactly its linear systems are solved
one_solve          steps that are one linear solve
descent, downhill  what its line search goes down, with moduli made positive where it would go up
blocks             products with the tangent in blocks of a node's dofs
cycle              multigrid's cycle in single precision; levels: PETSc's, copied; smoother: how they are smoothed
finest             its finest level, which CG goes by, too; rows, between: products on levels and between them in C
woodbury           few stiff pairs beside what a preconditioner knows
preconditioner     when multigrid is made anew, and what takes over from it; inertia_share: what decides
rigid_modes        its near null space; loose_parts: the same of parts that hang by a node or an edge
petsc_options      options of one solver
frequencies        bounds on how fast cells vibrate, for explicit steps
edge_frequencies   the same of cells with broken edges
initial            velocity at the start
"""
