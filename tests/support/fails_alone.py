"""`fracsim run` of which one rank fails in the middle of the second step: RANK KIND, and the arguments of run."""

import sys
from typing import Any

from mpi4py import MPI

from fracsim import cli
from fracsim.errors import InputError, NotConverged
from fracsim.mesh import parallel
from fracsim.timestepping import stepper as stepper_module

FAILURES: dict[str, BaseException] = {
    "input": InputError("only here"),
    "not-converged": NotConverged("only here"),
    "exit": SystemExit(7),
    "disk": OSError(28, "No space left on device", "only-here.h5"),
    "fault": ValueError("only here"),
}

rank, kind, *arguments = sys.argv[1:]
parallel.FAILURE_WAIT = 1.0  # as long as the other rank would need to fail in the same place
calls = 0
advance = stepper_module.BalanceStepper.advance


def failing(stepper: stepper_module.BalanceStepper, *given: Any) -> Any:
    global calls
    calls += 1
    if calls == 2 and MPI.COMM_WORLD.rank == int(rank):
        raise FAILURES[kind]
    return advance(stepper, *given)


stepper_module.BalanceStepper.advance = failing  # type: ignore[method-assign]
sys.argv = ["fracsim", "run", *arguments]
cli.main()
