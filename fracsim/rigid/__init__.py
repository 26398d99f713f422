"""Stiff bodies that move rigidly, are strained by blows and break (docs/theory.md#rigid-materials).

Strain and fracture, of copies of one mesh:

relief       what a load accelerates a free body with is taken off it
free_body    the quasi-static analysis of one body, or of one piece of a broken one
plate        flat shell triangles: membrane and bending
shell_body   the same analysis of a shell
pinned       B07's three pinned points, to compare with
point_loads  forces at points of a surface, handed to the nodes of the cells behind
patches      forces on circles of contact, with Hertz's pressure
analyses     of several bodies at once, spread over ranks
breakable    a struck piece breaks, and its pieces in turn
denting      or it flows, and keeps a dent
copies       each with damage of its own, all with one operator while they are whole
placing      where copies are at the start

Motion:

bodies       mass, place and motion of pieces, and of what they break into
geometry     what pieces weigh and which shapes they have, from the split surface
hulls        unions of convex parts
clusters     of pieces of shells, all at once
primitives   shapes of obstacles
obstacles    those that stand, and those that move freely, as bodies do
model        the scene as MuJoCo has it; this and the next two alone import it
finding      MuJoCo finds contacts
newton       MuJoCo solves for what few contacts give
crowd        and projected gradients for what many do, in C (crowd.c)
engine       a step of motion: rounds of what meets what, and what that gives
striking     what meets in the events of a step, and where bodies are then
pushing      what the contacts of an event give
motion       how bodies fly, and are driven on
course       how far things come in a step
contacts     where they are, and how fast things come together there
planes       those of hulls with planes
meeting      the law that they follow
events       what strikes bodies in a step, one thing after the other
lifting      what rests does not sink in as it flies to where it is struck
siblings     pieces that lie in one another from birth
tumbling     how bodies turn, by their angular momentum, in C (tumbling.c)
touches      what touched in a step
blows        which contacts are blows, and which are loads
hertz        how long a blow lasts, and what it presses on
stepper      a step: motion, blows, analyses, pieces
"""
