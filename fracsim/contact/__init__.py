"""Contact of a body with obstacles and with itself.

Analytic obstacles need no mesh: a signed distance says how far a point is outside. Contact with obstacles whose
surface is read from a file, and of a body with itself, is computed by ipctk.

obstacle_term               the term of the balance
contact_state, node_contact what touches in a step; barrier and friction at the points of a surface, by their law
contact_surface, step_limit the points that touch; obstacles on their ways
facet_contact, closest_point  facets between their points before round and small obstacles: what acts at their deepest
                            place
closest_point               a step of Newton's method to that; where it would be before what is flat
facet_contact               facets that may be near an obstacle; that, with what acts at the points
obstacle                    one that is held or driven
rigid_obstacle_term         the term with obstacles that move by themselves; obstacle, offset_shape: one of them, on a
                            hinge
obstacle_pairs              other obstacles that a free one meets; inset_points: the points that do
rigid_pose                  where one of them belongs, with the body where it is
rigid_body                  its pose in a step as the least of an incremental potential; what contact does to the pose
rigid_obstacle_state        what terms with free obstacles have in common
pose                        rotation vectors that are not small; where a rigid obstacle is, and derivatives of the
                            distance to it with respect to its pose
initial_overlap             free obstacles that lie in others
supporting_obstacles        obstacles that start nearer to the body, or to a free one, than they act: moved back
step_limit                  how far points may go, first guesses that have passed through nothing; points and obstacle
                            on their way: gaps, and bounds of how fast they close
penalty_obstacles           the term in explicit steps: penalty, and springs that hold and slip
penalty_law, penalty_obstacles  what pushes and what rubs there
penalty_rigid_obstacles     with obstacles that move by themselves, by velocity Verlet
penalty_law                 how stiff a surface may be before it is faster than the body
shapes                      the register of shapes, by the name that a user writes; half space; sphere and capsule (in
                            2D disk and stadium); with rounded edges, so that the distance is C1 outside
shape_base                  what a shape is: distance, normal, curvature, outline, inertia; distance to a quadrant or
                            octant: what boxes and cylinders share
tessellation                volume and second moments of rounded bodies, by slices
drawing                     what is drawn of an obstacle at its pose
tessellation, shape_base    triangles and segments to draw a shape with; frames about an axis
node_contact                the gap to a round obstacle over a step in which a point slides around it
barrier, laws               energy that keeps gaps open (IPC), and how far points may move without passing through;
                            its force as a mean over a step
friction                    Coulomb friction as a lagged, smoothed potential (IPC)
self_contact                the term of the balance
ipc_pairs                   barrier and friction between the elements of a surface; how far points may go; elements
                            that cut each other
ipc_pairs, ipc_friction     which elements are near each other; friction between them
contact_surface, ipc_surface  walls that come to light where there is no room: before obstacles; before the body
                            itself
crack_wall_offset           new walls of a crack, drawn back so that nothing acts as they come to light
penalty_self_contact        the term in explicit steps; penalty_point_facet: a penalty on points before facets
mesh_obstacle_term          the term of the balance; whether the body may be near any of them at all; first guesses
                            that have passed through no solid
mesh_rigid_body, mesh_rigid_term  a solid that moves freely; the term where some do
mesh_obstacles              the split surface of the body before solids, with room for walls that come to light inside
                            one; barrier and friction between the body's surface and one solid; what is felt of
                            several
triangle_mesh_shape         a shape that is a closed surface of triangles; triangles no longer than an edge of the
                            body; how deep closed surfaces lie in one another

All but the terms and what they alone use (contact_state, contact_surface, step_limit, rigid_pose,
supporting_obstacles) are NumPy and SciPy alone: no DOLFINx, no MPI. Every rank asks about its own points.

IPC is M. Li et al., Incremental Potential Contact, ACM Trans. Graph. 39 (2020) 49. Its barrier acts on squared
distances; here it acts on the distance itself and is an energy per area, a law that does not depend on the mesh.
"""
