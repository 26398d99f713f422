"""From one state to the next.

state                     what a run carries from step to step; damage and flow as values in the state
stepper                   what a stepper is; attempts, halved steps, arrival and books, as all schemes share them
implicit                  steps of schemes with inertia that solve a system
quasi_static              load steps: balance and breaking in turn until nothing changes
explicit                  steps without a system
protocols                 what flows and breaks at the end of a step; empty parts where nothing does
energy_balance            work and viscous loss of a step; what broken edges no longer hold
stable_time_step          bounds on how fast cells vibrate, for explicit steps
stable_time_step_damaged  the same of cells with broken edges
initial_conditions        velocity at the start
"""
