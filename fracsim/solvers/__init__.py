"""Newton's method, linear solvers and preconditioners.

low_rank          a tangent less what terms have eliminated; few stiff pairs beside what a preconditioner knows
newton            one nonlinear solve, and what is tried where it fails
nonlinear_solver  iterations or factors: what a solve begins with; factors: what they cost
forcing_terms     how exactly its linear systems are solved
linear_solver     steps that are one linear solve
line_search       what its line search goes down, with moduli made positive where it would go up
preconditioner    when multigrid is made anew, and what takes over from it, and what decides
rigid_body_modes  its near null space; deflation: the same of parts that hang by a node or an edge
petsc_options     options of one solver
"""
