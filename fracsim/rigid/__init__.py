"""Stiff bodies that move rigidly, are strained by blows, and break (docs/theory.md#rigid-materials).

A step, from the outside to the inside:

rigid_stepper         motion, analyses of impacted bodies, fracture
impact_detection      which contacts are blows, and which are loads
parallel_analyses     analyses of several bodies, spread over ranks

Bodies, and their stress:

bodies                mass, position and motion; rotations in C (rotation_integrator.c)
instance_placement    placement of the instances of a mesh
instances             instances of one mesh, each with damage of its own
breakage              fracture of a body and of its fragments
fragment_analyses     cells and nodes of fragments, and their analyses
denting               plastic flow: dents and bends
free_body_analysis    quasi-static analysis of a free body, with inertia relief
shell_analysis        the same for shells, by flat triangles
surface_loads         Hertz's contact, and contact forces as nodal loads
fragment_geometry     mass properties and collision shapes of fragments
convex_decomposition  unions of convex parts, of solids and of shells

Motion and contact:

engine                a step of motion: events, and searches for contacts in rounds
collision_detection   contacts that may close in a step
mujoco_model          the scene as MuJoCo has it
cylinder_contact      contacts of cylinders that roll, tilt and spin
shell_contact         contacts of the triangles of unbroken shells
plane_contacts        contacts of convex hulls with planes
obstacles             fixed, driven and free obstacles, and their shapes
round_shape           spheres, capsules and cylinders of builders
contact_points        contact points, and the impulses that they transmitted
contact_law           unilateral constraints at contacts, impacts
contact_solver        impulses: MuJoCo for few contacts, projected gradients for many
projected_gradient    Coulomb's law by accelerated projected gradients, in C
impact_sequence       sequences of impact events within a step
fragment_overlap      overlaps that exist from the moment of fracture
core_contact          contact with the cores of fragments, in C
"""
