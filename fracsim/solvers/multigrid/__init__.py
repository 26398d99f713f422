"""Multigrid's cycle in single precision, on rows of blocks.

block_operator  products with the tangent in blocks of a node's dofs
vcycle          multigrid's cycle in single precision; hierarchy: PETSc's, copied; smoother: how they are smoothed
fine_level      its finest level, which CG goes by, too; bcsr: products on levels and between them in C
"""
