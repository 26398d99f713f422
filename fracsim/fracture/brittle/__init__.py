"""Brittle cracks as surfaces, in place of single edges (docs/theory.md#brittle-surfaces; M22 5.1.2, B07 7.1).

principal  largest principal stress, its direction, and the material plane normal to it
start      where surfaces start: the cells loaded most, no two closer than a distance
body       the edges and triangles of the input mesh
level_set  the surface through a start: a plane, or one that turns with the principal direction
sheet      what a level set cuts: from the start through intact material, up to the boundary or an older crack
grains     grain boundaries: regions of seeded points
one_by_one nodes without a whole cell on their side, moved one after the other
pattern    all surfaces so far, and the edges that new ones cut
surfaces   the part of the fracture pass that starts surfaces and breaks the edges that they cut

Geometry is worked out on rank 0 on the arrays of the input mesh, and only in passes in which a surface starts: the
pattern is the same at any number of ranks.
"""
