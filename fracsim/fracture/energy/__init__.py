"""Cracks that take an energy: their tips advance where the configurational force reaches the fracture energy.

    g = - sum_j V_j Sigma_j grad q(x_j),   Sigma = chi psi I - H^T (chi P),   H = grad u

force      g, the energy that a tip's advance releases for each area of crack
around     what lies around a place, on any rank
asked      values of cells of other ranks
crack      the cells that cracks cut, known on every rank
neighbourhoods  what lies around the tips, kept until cracks change
patch      gradients of fields around tips, by matrices that are kept
front      in space: the crack that an advance makes, by which g is divided
along      in space: G of tips by themselves, or of the front nearby
seen       the body as tips see it
mixed      where a crack in tension and sliding turns, and what that releases
running    how fast cracks run that may branch, and where they do
branching  tips that share a disc
cutting    the line or plane that cuts a cell
tips       which tips advance, and where cracks begin: the criterion
waiting    in space, with inertia: how long tips need not be looked at
row        in space, without inertia: all of a front gets on at once
joined     the same, without those that would cut a node off
splitting  what is left of a cell that has come apart

docs/theory.md#fracture-energy has the equations, docs/theory.md#rejected-alternatives what was tried. A tip cell is
whole and has a broken edge; a split cell has come apart.
"""
