"""The split surface of a damaged body, for output and contact; the system of equations does not contain it.

cut_patterns      what every damage pattern does to one cell, derived once; cells cut flat between pieces; solid: the
                  surface of pieces alone; laid: all walls, those of pieces there
entity_numbering  numbers of the edges, facets and boundary of the input mesh
closed_surface    the points of a state of damage, numbered; damage -> points, elements and the parents of every point
smooth_cuts       where edges are cut so that what is drawn is smooth
local_surface     the surface of one rank's cells, whose points follow nodes linearly
surface_map       the same points drawn in towards their nodes by any share; identity: which are the same after a
                  break
surface_motion    children follow parents: x = mean over p of x_p + R_p (X - X_p)

Works on the arrays of a mesh on one rank, so that the surface is the same at any number of ranks.
"""
