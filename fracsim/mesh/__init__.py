"""The distributed mesh of a run: domain, edge damage, fragments, split surface.

parallel                    collective operations; errors that reach every rank; halos of cells
domain                      the partitioned mesh: nodes, cells, function spaces, and numbers in the input mesh
mesh_shares                 meshes in files that all ranks read, each its share
facets                      named groups of facets, the boundary, neighbouring cells
midside_nodes               nodes of quadratic displacement
ghost_exchange              values of nodes, edges and facets that ranks share
input_topology              cells and edges of the input mesh, numbered once
selectors, selection        groups and regions by name, boxes and planes; the nodes and facets that they select
simplices                   edges of a triangle or tetrahedron; tables of patterns of broken edges
small_matrices              arrays of 2 x 2 and 3 x 3 matrices
edge_graph                  the edges of the mesh, their integrity, and the cells at an edge
fragments                   connected components of nodes under intact edges
free_motion                 rigid motions that supports leave free
node_cells                  cells around nodes, and facet-connected components
interpenetration            nodes of one fragment in cells of another
c_library, library_cache    functions in C and the types of their arguments; the folder of compiled libraries
dolfinx_compat              calls of DOLFINx that differ between versions
split_surface               geometry of the split surface
"""
