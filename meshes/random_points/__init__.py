"""Triangles between random points: meshes whose edges have no preferred directions."""
