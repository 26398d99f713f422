"""Balance of forces as a sum of terms, and its assembly.

term                        term of the balance; time level of a step
term_protocols              abilities of terms: step limits, history, output; contact and histories of a balance
contact_time_weights        weights of contact forces in a step
balance                     sum of the terms: residual, reactions, energies
tangent                     derivative of the residual
stress                      stress of a body with damage and plastic flow
polar_rotation              rotations of the corotated energy (C)
contour_integral            J-integral around a point
inertia, damping            mass matrix and inertia; drag and viscosity
loads                       dead loads and pressures
node_ties                   ties of nodes without an unsplit cell
prescribed_motion           prescribed displacements; check of supports
time_functions              tables as functions of time
material_fields             material parameters on the mesh
plasticity, return_mapping  history of plastic flow; flow at the end of a step
tensor_functions            eigenvalues and powers of many tensors
cell_energy                 energy, forces and stiffness of single cells
psd_projection              positive semi-definite moduli
stability_limit             stable step from frequencies of single cells; speed of Rayleigh waves
jit                         compiled forms and expressions
kernel_selection            choice between DOLFINx and kernels in C: the one place
matrix_assembly             assembly of vectors and of the tangent
cell_subset_assembly        linear forms over some of their cells
simd_kernels                forms of several cells at a time (C)
block_matrix                tangent in blocks of a node's dofs (C)
extra_couplings             stiffness between nodes that share no cell
"""
