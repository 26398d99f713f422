"""Cracks with a fracture energy: tips advance where the configurational force reaches G_c (Griffith).

    g = - sum_j V_j Sigma_j grad q(x_j),   Sigma = chi psi I - H^T (chi P),   H = grad u

tip_criterion          criterion: which tips advance, and which cells would detach a node
crack_initiation       criterion: where cracks start, and which cells are cut in one pass
front_advance          3D without inertia: a stretch of a front advances at once
crack_speed            2D with inertia: speed of tips, and where they branch
branching              2D: several tips in one disc
tip_fields             stress, Eshelby stress and inertia around tips; gradients as matrices
tip_neighbourhoods     cells around tips, and weighted sums over them
configurational_force  Eshelby stress, weight function, springs of closed cracks
crack_front            3D: area that an advance makes, energy release rate along a front
mixed_mode             2D: stress intensities, kink angle, energy release of a kink
cut_plane              the line or plane that cuts a cell
hinges                 nodes by which parts without a ligament still hang on one another
cut_cells              cut positions, cut polygons, and the cut cells of all ranks
neighbour_search       cells near points, and values of cells of other ranks
tip_parameters         lengths and thresholds
tip_record             tips of a step before they advance, for tips.csv

Equations: docs/theory.md#fracture-energy; what was tried: docs/theory.md#rejected-alternatives. A tip is a cell that is
cut and not split.
"""
