"""The split surface in time, as it is written.

fragments  mass, centre, velocity and spin of the pieces, and names that stay with them
frame      a surface at a time, ready to be written
copies     of copies of one mesh: built again for those that broke
files      surface/*.vtu, pieces.csv
vtu        VTU files
collection surface.pvd: which file is shown when
output     the part of a run that gathers, builds and writes
"""
