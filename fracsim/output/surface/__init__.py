"""Split surface of a body in time.

body_surface      the surface at a time, ready to be written
fragment_table    mass, centre, velocity and spin of the fragments, and names that stay with them
surface_output    builds the surface in a run and writes it
vtk_files         surface.pvd and pieces.csv
vtu_file          surface/*.vtu, compressed by all ranks
"""
