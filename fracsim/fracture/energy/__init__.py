"""Cracks that take an energy: their tips advance where the configurational force reaches the fracture energy.

    g = - sum_j V_j Sigma_j grad q(x_j),   Sigma = chi psi I - H^T (chi P),   H = grad u

configurational_force  g, the energy that a tip's advance releases for each area of crack
neighbour_search       what lies around a place, on any rank; values of cells of other ranks
cut_cells              the cells that cracks cut, known on every rank
tip_neighbourhoods     what lies around the tips, kept until cracks change
gradient_operators     gradients of fields around tips, by matrices that are kept
crack_front            in space: the crack that an advance makes, by which g is divided; in space: G of tips by
                       themselves, or of the front nearby
tip_fields             the body as tips see it
mixed_mode             where a crack in tension and sliding turns, and what that releases
crack_speed            how fast cracks run that may branch, and where they do
branching              tips that share a disc
cut_plane              the line or plane that cuts a cell
tip_criterion          which tips advance, and where cracks begin: the criterion
release_rate_bound     in space, with inertia: how long tips need not be looked at
front_advance          in space, without inertia: all of a front gets on at once
tip_constraints        the same, without those that would cut a node off
cell_degradation       what is left of a cell that has come apart

docs/theory.md#fracture-energy has the equations, docs/theory.md#rejected-alternatives what was tried. A tip cell is
whole and has a broken edge; a split cell has come apart.
"""
