"""Brittle cracks as surfaces, in place of single edges (docs/theory.md#brittle-surfaces; M22 5.1.2, B07 7.1).

principal_stress   largest principal stress, its direction, and the material plane normal to it
surface_pass       where surfaces start: the cells loaded most, no two closer than a distance; all surfaces so far,
                   and the edges that new ones cut
surface_cut        the edges and triangles of the input mesh; what a level set cuts: from the start through intact
                   material, up to the boundary or an older crack; nodes without a whole cell on their side, moved one
                   after the other
crack_level_set    the surface through a start: a plane, or one that turns with the principal direction
grains             grain boundaries: regions of seeded points
surface_criterion  the part of the fracture pass that starts surfaces and breaks the edges that they cut

Geometry is worked out on rank 0 on the arrays of the input mesh, and only in passes in which a surface starts: the
pattern is the same at any number of ranks.
"""
