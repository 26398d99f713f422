"""The counter of messages counts what a program is known to send."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import pytest

from cases import mpirun
from fracsim.studies.message_counts import KINDS, compile_counter

PROGRAM = """
import ctypes
import numpy as np
from mpi4py import MPI
comm = MPI.COMM_WORLD
counts = (ctypes.c_longlong * 4)()
read = ctypes.CDLL(None).message_counts
read(counts); before = list(counts)
other = 1 - comm.rank
for _ in range(3):
    request = comm.Isend(np.zeros(10), other)
    comm.Recv(np.zeros(10), other)
    request.Wait()
persistent = comm.Send_init(np.zeros(5, np.int32), other)
for _ in range(4):
    persistent.Start(), comm.Recv(np.zeros(5, np.int32), other), persistent.Wait()
comm.Allreduce(np.zeros(2), np.zeros(2))
comm.Barrier()
read(counts)
everyone = comm.gather([after - begin for after, begin in zip(counts, before)])
if comm.rank == 0:  # ranks that print at a time may share a line
    print(*everyone, sep="\\n", flush=True)
"""


@pytest.mark.ranks
def test_messages_and_bytes_of_a_known_program(tmp_path: Path) -> None:
    """Three messages of 80 bytes, four of 20 by one request, an Allreduce of 16 bytes and a barrier, on each rank."""
    library = compile_counter(tmp_path)
    command = [*mpirun(2), "env", f"LD_PRELOAD={library}", sys.executable, "-c", PROGRAM]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, env=dict(os.environ), check=False)
    assert done.returncode == 0, done.stderr
    wanted = dict(zip(KINDS, [7, 3 * 80 + 4 * 20, 2, 16], strict=True))
    assert done.stdout.split("\n")[:2] == [str(list(wanted.values()))] * 2
