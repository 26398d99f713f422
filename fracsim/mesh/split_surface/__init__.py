"""The split surface of a damaged body, for output and contact; the system of equations does not contain it.

entity_numbering    numbers of the edges, facets and boundary facets of a mesh
cut_patterns        points and elements of one cell for each pattern of broken edges, also with planar cuts
closed_surface      points, elements and parents of the split surface of a damaged mesh
mesh_part           the part of a mesh that a rank has: a whole mesh, or its own cells
surface_numbering   numbers of the points and elements of a surface that ranks have in parts
fragment_surface    the split surface with crack faces between fragments alone, for contact
smooth_cuts         positions of cuts that give a smooth surface
surface_motion      motion of points with their parents: x = mean over p of x_p + R_p (X - X_p)
surface_map         linear map from nodal displacements to points, with shortened arms
drawn_surface       the surface at a time, whose points contact moves before they are drawn
local_surface       the split surface of the cells of one rank, linear in the nodes
quadratic_surface   the split surface of quadratic cells
polyhedron_moments  volume, centre and second moments within closed surfaces

Nodes and cells are in the order of the input mesh, also where a rank has a part of it, so that the surface does not
depend on the number of ranks.
"""
