"""Split surface of a body in time.

body_surface      the surface at a time, ready to be written
fragment_table    mass, centre, velocity and spin of the fragments, and names that stay with them
surface_output    gathers values in a run, builds the surface and writes it
vtk_files         surface.pvd, surface/*.vtu and pieces.csv
"""
