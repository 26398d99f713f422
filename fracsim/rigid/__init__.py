"""Stiff bodies that move rigidly, are strained by blows and break (docs/theory.md#rigid-materials).

Strain and fracture, of copies of one mesh:

free_body_analysis    what a load accelerates a free body with is taken off it; the quasi-static analysis of one body,
                      or of one piece of a broken one
shell_triangles       flat shell triangles: membrane and bending
shell_analysis        the same analysis of a shell
pinned_analysis       B07's three pinned points, to compare with
surface_loads         forces at points of a surface, handed to the nodes of the cells behind; forces on circles of
                      contact, with Hertz's pressure
parallel_analyses     of several bodies at once, spread over ranks
breakage              a struck piece breaks, and its pieces in turn
denting               or it flows, and keeps a dent
instances             each with damage of its own, all with one operator while they are whole
instance_placement    where copies are at the start
bodies                mass, place and motion of pieces, and of what they break into; how bodies turn, by their angular
                      momentum, in C (rotation_integrator.c)
fragment_geometry     what pieces weigh and which shapes they have, from the split surface
convex_decomposition  unions of convex parts
shell_clusters        of pieces of shells, all at once
obstacle_shapes       shapes of obstacles
obstacles             those that stand, and those that move freely, as bodies do
mujoco_model          the scene as MuJoCo has it; this and the next two alone import it; those of hulls with planes
collision_detection   MuJoCo finds contacts
contact_solver        MuJoCo solves for what few contacts give; and projected gradients for what many do, in C
                      (projected_gradient.c); what the contacts of an event give
engine                a step of motion: rounds of what meets what, and what that gives
impact_step           what meets in the events of a step, and where bodies are then; what rests does not sink in as it
                      flies to where it is struck
free_flight           how bodies fly, and are driven on
swept_bounds          how far things come in a step
contact_points        where they are, and how fast things come together there
contact_law           the law that they follow
impact_sequence       what strikes bodies in a step, one thing after the other
fragment_overlap      pieces that lie in one another from birth
contact_records       what touched in a step
impact_detection      which contacts are blows, and which are loads
hertz                 how long a blow lasts, and what it presses on
rigid_stepper         a step: motion, blows, analyses, pieces

Motion:
"""
