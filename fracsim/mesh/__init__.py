"""The mesh of a run: distributed, with edges that break and pieces that come apart.

parallel                    small collective operations; errors that reach every rank
domain                      the partitioned mesh with its named groups, function spaces, and maps to the input mesh
input_topology              cells and edges of the input mesh, numbered once
selectors                   groups and regions by name; boxes and planes
simplices                   edges of a triangle or tetrahedron, and what every pattern of broken ones means
small_matrices              arrays of 2 x 2 and 3 x 3 matrices
edge_graph                  the edges of the mesh and their integrity
incidence                   the cells at an edge, the edges at a node
incremental_fragments       pieces as edges break, looked for around those
fragments, connected_bodies connected components under intact edges; of the mesh as it was built
interpenetration            nodes of one piece in cells of another
c_library, library_cache    functions in C and the types of their arguments; the folder of compiled libraries
dolfinx_compat              calls of DOLFINx that a newer version touches
split_surface               geometry of the split surface
"""
