"""What breaks, and what that takes out of the stress.

fracture_pass     a pass: a criterion, a law of the edge and a degradation, one after the other
criterion         which edges fail
node_retention    which of them are spared, for a node would be left without a whole cell
edge_law          what is left of an edge under a load
degradation       what broken edges take out of the elastic energy
edge_stress       normal stress along edges, and what the intact ones carry
nonlocal_average  average of the stress over a radius
strength          of every edge in every cell: regions, scatter, a fibre, ties
edge_history      when and where edges broke
brittle           surfaces in place of single edges: another criterion
"""
