"""Brittle cracks as surfaces, in place of single edges (docs/theory.md#brittle-surfaces; M22, 5.1.2; B07, 7.1).

surface_criterion  criterion: where surfaces start, and the edges that they break
surface_pass       pass on rank 0: starts by load and spacing, one surface after the other
crack_level_set    level set of a surface: a plane, or curved with the principal direction
surface_cut        cells and edges that a level set cuts, up to the boundary and older cracks
grains             grain boundaries between seeded points
"""
