"""Contact with analytic obstacles, which need no mesh: a signed distance says how far a point is outside.

obstacles         the term of the balance
touching, touch   what touches in a step; barrier and friction at the points of a surface, by their law
skin, course      the points that touch; obstacles on their ways
facets, deepest   facets between their points before round and small obstacles: what acts at their deepest place
shares, flat      a step of Newton's method to that; where it would be before what is flat
candidates        facets that may be near an obstacle
joined            that, with what acts at the points
obstacle          one that is held or driven
free_obstacles    the term with obstacles that move by themselves; free_obstacle, shifted: one of them, on a hinge
stops, stop       other obstacles that a free one meets; skeleton: the points that do
free_pose         where one of them belongs, with the body where it is
rigid_step, push  its pose in a step as the least of an incremental potential; what contact does to the pose
flights           what terms with free obstacles have in common
turn              rotation vectors that are not small
overlap           free obstacles that lie in others
set_down          obstacles that start nearer to the body, or to a free one, than they act: moved back
reach             how far points may go, first guesses that have passed through nothing

explicit_obstacles  the term in explicit steps: penalty, and springs that hold and slip
penalty, springs  what pushes and what rubs there
explicit_free, drift  with obstacles that move by themselves, by velocity Verlet
carried           how stiff a surface may be before it is faster than the body

shapes            the register of shapes, by the name that a user writes
shape             what a shape is: distance, normal, curvature, outline, inertia
plane, ball       half space; sphere and capsule (in 2D disk and stadium)
box, cylinder     with rounded edges, so that the distance is C1 outside
corner            distance to a quadrant or octant: what boxes and cylinders share
moments           volume and second moments of rounded bodies, by slices
drawing           what is drawn of an obstacle at its pose
outlines, axes    triangles and segments to draw a shape with; frames about an axis
pose, placed      where a rigid obstacle is, and derivatives of the distance to it with respect to its pose
motion            points and obstacle on their way: gaps, and bounds of how fast they close
bent              the gap to a round obstacle over a step in which a point slides around it
barrier, along    energy that keeps gaps open (IPC), and how far points may move without passing through; its force
                  as a mean over a step
friction          Coulomb friction as a lagged, smoothed potential (IPC)

Contact of a body with itself, by ipctk:

itself            the term of the balance
pairs             barrier and friction between the elements of a surface; how far points may go
near, slip        which elements are near each other; friction between them
room, crowd       walls that come to light where there is no room: before obstacles; before the body itself
recede            new walls of a crack, drawn back so that nothing acts as they come to light
crossings         elements that cut each other
explicit_itself   the term in explicit steps; pushing: a penalty on points before facets

solids            obstacles whose surface is read from a file, by the same

All but the terms, what they alone use (touching, skin, course, free_pose, set_down) and `reach` are NumPy and SciPy
alone: no DOLFINx, no MPI. Every rank asks about its own points.

IPC is M. Li et al., Incremental Potential Contact, ACM Trans. Graph. 39 (2020) 49. Its barrier acts on squared
distances; here it acts on the distance itself and is an energy per area, a law that does not depend on the mesh.
"""
