"""Newton's method, linear solvers and preconditioners.

nonlinear_solver       solve of a step by a sequence of strategies
strategies             strategies, the order in which they are tried, and which one begins
newton                 one attempt of Newton's method (PETSc's SNES)
line_search            merit function of the line search, positive tangents
nonlinear_elimination  separate solve for the few nodes that hold most of the residual
forcing_terms          tolerances of inexact Newton
linear_solver          systems with the tangent: options, Krylov method, steps that are one linear solve
direct_solver          factors of the tangent (MUMPS), and their cost
preconditioner         multigrid or SSOR: when it is rebuilt, and from what
plain_solver           linear solver of `plain = true`: PETSc alone
balancing              balancing preconditioner: exact solutions in a coarse space, as for nodes in contact
tangent_operators      tangent as the matrices that a KSP takes: in blocks of a node's dofs, with low-rank updates
multigrid              V cycle in single precision
policy                 tuned numbers
petsc_options          options of one solver in PETSc's database
weak_callbacks         callbacks of PETSc's objects that do not keep their owner alive
"""
