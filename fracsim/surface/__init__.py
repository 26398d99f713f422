"""The split surface of a torn body (METHOD section 8): what is drawn and what touches, never what is solved.

table     what every damage pattern does to one cell, derived once
skeleton  numbers of the edges, facets and boundary of the input mesh
build     damage -> points, elements and the parents of every point
follow    children follow parents: x = mean over p of x_p + R_p (X - X_p)
fragments mass, centre, velocity and spin of the pieces, and names that stay with them
frame     a surface at a time, ready to be written
files     surface.pvd, surface/*.vtu, pieces.csv
output    the part of a run that gathers, builds and writes

Everything here but `output` works on the arrays of the input mesh on one rank, so that the surface is the same at any
number of ranks.
"""
