"""The split surface in time, as it is written.

fragment_table    mass, centre, velocity and spin of the pieces, and names that stay with them
body_surface      a surface at a time, ready to be written
instance_surface  of copies of one mesh: built again for those that broke
vtk_files         surface/*.vtu, pieces.csv
vtu               VTU files
collection        surface.pvd: which file is shown when
surface_output    the part of a run that gathers, builds and writes
"""
