"""Time stepping: from the state of a body at one time to the state at the next.

state             state of a body between two steps, and its initial velocity
stepper           interface of a stepper, and the parts of a step that all schemes share
implicit          steps of schemes with inertia that solve a nonlinear system
quasi_static      load steps without inertia: equilibrium and fracture in turn
explicit          steps without a system of equations
step_sizes        bounds of the step, reduction after a failure, growth after success
stable_time_step  bounds of the eigenfrequencies of cells, for explicit steps
inelastic_update  plastic flow and fracture at the end of a step, their interfaces, history variables
energy_balance    work, dissipation and stored energy of a step; forces released by fracture
"""
