"""Fails on one rank while the others wait: for the test of the harness."""

from mpi4py import MPI

if MPI.COMM_WORLD.rank == 1:
    raise RuntimeError("only on rank 1")
MPI.COMM_WORLD.barrier()
