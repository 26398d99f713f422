"""The mathematics in UFL: kinematics, energies, virtual work, damage, plasticity, time schemes; it needs UFL alone."""
