"""Fracture on the edges of a finite element mesh: implicit, parallel, without remeshing.

Importing the package is light: no dolfinx, no gmsh, no pyvista.
"""

__version__ = "0.1.0"
