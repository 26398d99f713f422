"""Multigrid V cycle in single precision, on block CSR matrices.

vcycle          V cycle as a preconditioner
hierarchy       levels copied from PETSc's multigrid
levels          a level and its Chebyshev smoother; the finest level, whose products serve CG as well
bcsr            products with block CSR matrices and prolongations (C)
"""
