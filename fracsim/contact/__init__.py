"""Contact of a body with obstacles and with itself.

Analytic obstacles need no mesh: they are signed distance functions. Contact with triangle-mesh obstacles, and of a body
with itself, is computed by ipctk.

Terms of the balance:

    rigid_obstacles       motion of all obstacles; groups of obstacles, what they did to the body in a step, contact of
                          the body as they see it, and their tessellation for output
    rigid_pose            free obstacles in implicit steps: poses as unknowns of Newton's method
    obstacle_term         the body before analytic obstacles; contact of few nodes for nonlinear elimination
    contact_state         surface and analytic obstacles in a step
    mesh_obstacle_term    the body before triangle-mesh obstacles; pairs of these
    self_contact          a body with itself, and its fragments with one another
    penalty_obstacles     the body before analytic obstacles in explicit steps
    penalty_contact       the body with itself, and before triangle-mesh obstacles, in explicit steps

Laws and geometry:

    laws                  barrier, penalty, mean force over a step, Coulomb friction
    pose                  rigid poses and distances to shapes
    obstacle              obstacles, their motion, overlaps and tessellation
    shape_base, shapes    signed distances, moments and tessellations of half space, sphere, capsule, box, cylinder
    shape_kernels         compiled distances, closest points of facets and their energy; the modules beside it are plain
    triangle_mesh_shape   closed surfaces of triangles
    clearance             points and facets that may be near an obstacle; bound of the distance over many steps, while
                          all are far; smallest gaps
    supporting_obstacles  obstacles that a body is set down on

Points and facets before analytic obstacles:

    contact_surface       points and facets of the split surface
    crack_faces           cells that show their crack faces; retraction of new ones
    node_contact          forces on points, lagged friction, derivatives by the pose of an obstacle
    closest_point, facet_contact  forces on facets between their nodes
    step_limit            conservative advancement, first guesses, motion of obstacles in a step

Surfaces with ipctk:

    pair_search           points, edges and triangles that may come near one another in a motion
    partitioned_surface   surface distributed over the ranks, built again as edges break
    element_exchange      elements of a rank and of others near them
    retractable_surface   crack faces that are retracted where there is no room
    ipc_pairs, sample_points  pairs of the barrier; sample points and friction at them
    mesh_obstacles        triangle-mesh obstacles; contact of a body with itself or with one of them
    penalty_law           energy, forces, friction, stiffness and history of contacts of a penalty
    penalty_pairs, penalty_edges  points before facets, and edges before edges
    penalty_surface       surface and contacts of the penalty

Free obstacles:

    rigid_body            states of motion; incremental potential of poses
    obstacle_pairs        contact between obstacles of which one at least is analytic
    penalty_obstacle_pairs  contact between obstacles, and motion of free ones, in explicit steps

Modules without DOLFINx and MPI: laws, closest_point, node_contact, obstacle, pose, shape_base, shapes,
triangle_mesh_shape. Every rank evaluates its own points.

Source: M. Li and others (2020), Incremental Potential Contact, ACM Transactions on Graphics 39 (4), 49. Its barrier
acts on squared distances; here it acts on the distance and is an energy per area, independent of the mesh.
"""
