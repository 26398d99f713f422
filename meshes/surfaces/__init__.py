"""Closed surfaces: read, made from a level set, filled with tetrahedra."""
