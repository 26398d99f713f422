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
preconditioner     when multigrid is made anew
petsc_options      options of one solver
frequencies        bounds on how fast cells vibrate, for explicit steps
edge_frequencies   the same of cells with broken edges
initial            velocity at the start
"""
