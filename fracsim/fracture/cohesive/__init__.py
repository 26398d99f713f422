"""Cracks that hold on while they open: where a tip's process zone is resolved by the mesh (concrete).

    sigma = f_t exp(-w f_t / G_c)      of a crack that opens by w

softening      what is left of the stiffness of a cell that a crack cuts
cohesive_tips  which cells are cut next, by strength alone
cohesive_pass  a pass: cells are cut, soften, and let go in the end

A cell is cut where stress reaches the strength, and takes the fracture energy as it opens: a tip's force has no part
in it, or the energy would count twice. A cut edge is broken once what is cut around it carries nothing any more.
docs/theory.md#cohesive-cracks has the equations.
"""
