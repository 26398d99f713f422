"""The mathematics in UFL: kinematics, energies, time discretisation. Needs UFL and the standard library only."""
