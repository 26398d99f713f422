"""Fracture: which edges of the mesh break, and how broken edges degrade the energy of their cells.

fracture_pass     pass at the end of a step: criterion, law of the edge, degradation
criterion         criterion: normal stress of edges over their strength
node_retention    edges that are spared so that no node becomes a fragment
degradation       energy that broken edges take out of their cells
edge_stress       normal stress along edges, stress that intact edges carry
effective_stress  stress and energy density without damage
principal_stress  principal stress and its direction
nonlocal_average  averages over a radius or over neighbouring cells
strength          strength of edges: regions, scatter, fibre, tie-break
initial_cracks    cracks that are there before the start
edge_history      times and positions of breaks
brittle           criterion of brittle surfaces
energy            criterion of cracks with a fracture energy
cohesive_cracks   pass, criterion and softening of cohesive cracks
"""
