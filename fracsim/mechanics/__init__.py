"""The balance of forces, a sum of terms, and what the terms are made of.

term                        what a term is, and what it is told at the begin of a step
balance                     the sum: residual, tangent, reactions
stress                      the stress of a body as damage and flow leave it: a term
inertia, damping            M a and its mass matrix; drag and viscosity: terms
surface_data                what is drawn beside the body
extra_couplings             stiffness between nodes that share no cell
loads                       dead loads and following pressure: terms
prescribed_motion           dofs whose displacement is a function of time; whether a quasi-static study holds every
                            body
time_functions              constants and tables as functions of time
material_fields             Young's modulus, density, ... on the mesh
plasticity                  what cells remember of plastic flow; what flow takes off the stress while a step is solved
return_mapping              flow at the end of a step
rotation, tensor_functions  polar rotation of every cell; eigenvalues and powers of many tensors
jit                         compiled forms and expressions
matrix_assembly             assembling
tie_matrix                  stiffness between few nodes, beside blocks
simd_kernels, bcsr_matvec   forms several cells at a time; products with blocks of the tangent: in C (compiled)
"""
