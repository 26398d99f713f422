"""Analyses of the bodies that were impacted in one step, spread over ranks; the engine is on rank 0.

Every rank has the mesh and the damage of its instances. Analyses of one step are independent: each starts from the
cracks that existed before, and may open its share of the surfaces that are left in its instance. So the result is the
same on any number of ranks. Bodies that used up their share divide what others left.

The other ranks sleep while they wait for a message, since waiting in MPI would occupy their cores.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mesh.parallel import gather
from .breakage import ImpactOutcome
from .instances import Instances

Values = npt.NDArray[np.float64]

# Seconds between two looks for a message.
MESSAGE_TAG = 1


@dataclass(frozen=True)
class ImpactLoads:
    """Contact forces on one body.

    Attributes:
        body_name: name of the body.
        points: (k, 3) at rest, m.
        force: (k, 3) at rest, N.
        circle_radii: (k,) radii of the circles that the forces press on, m.
        max_surfaces: surfaces that may open.
        energy: that plastic flow may dissipate, J.
    """

    body_name: int
    points: Values
    force: Values
    circle_radii: Values
    max_surfaces: int = 0
    energy: float = float("inf")


@dataclass(frozen=True)
class _Message:
    """Message to the other ranks.

    Attributes:
        state: arrays to start from; None: go on.
        outcomes: of analyses since the last message.
        loads: to analyse.
    """

    state: dict[str, Any] | None
    outcomes: list[ImpactOutcome]
    loads: list[ImpactLoads]


class ParallelAnalyses:
    """Analyses of the instances of one mesh (rank 0 of a communicator)."""

    def __init__(self, instances: Instances, comm: MPI.Comm = MPI.COMM_SELF, setup: Any = None) -> None:
        """Keep the instances; `setup`: what the other ranks make theirs from, see `serve_analyses`."""
        self._instances, self._comm, self._setup = instances, comm, setup
        self._state: dict[str, Any] | None = None
        self._outcomes: list[ImpactOutcome] = []

    def reset_workers(self) -> None:
        """Note that the instances were restored from a checkpoint; the other ranks are told with the next message."""
        self._state, self._outcomes = self._instances.to_checkpoint(), []

    def __call__(self, loads: list[ImpactLoads]) -> dict[int, int]:
        """Analyse bodies and apply the outcomes; return the number of broken edges by name. Raises NotConverged."""
        broken = {load.body_name: 0 for load in loads}
        while tasks := self._divide_surfaces(loads):
            outcomes = self._analyse(tasks)
            self._instances.apply_outcomes(outcomes)
            for outcome in outcomes:
                broken[outcome.body_name] += len(outcome.edge_keys)
            analysed = {task.body_name for task in tasks}
            used_up = {
                outcome.body_name
                for outcome, task in zip(outcomes, tasks, strict=True)
                if len(outcome.surface_starts) == task.max_surfaces
            }
            loads = [load for load in loads if load.body_name in used_up or load.body_name not in analysed]
        return broken

    def _divide_surfaces(self, loads: list[ImpactLoads]) -> list[ImpactLoads]:
        """Return the loads with their shares of the surfaces left in their instances, without those that get none."""
        left = [self._instances.surfaces_left(load.body_name) for load in loads]
        competitors, earlier, tasks = Counter(number for number, _ in left), Counter[int](), list[ImpactLoads]()
        for load, (number, surfaces) in zip(loads, left, strict=True):
            share, remainder = divmod(surfaces, competitors[number])
            # the first ones get one more each
            tasks.append(replace(load, max_surfaces=share + (earlier[number] < remainder)))
            earlier[number] += 1
        return [task for task in tasks if task.max_surfaces]

    def _analyse(self, loads: list[ImpactLoads]) -> list[ImpactOutcome]:
        """Return the outcomes of the loads in their order."""
        comm = self._comm
        if comm.size == 1 or len(loads) == 1:
            outcomes = [analyse_impact(self._instances, load) for load in loads]
            self._outcomes += outcomes if comm.size > 1 else []
            return outcomes
        if self._setup is not None:
            send_to_workers(comm, self._setup)
            self._setup = None
        send_to_workers(comm, _Message(self._state, self._outcomes, loads))
        parts = _analyse_own_share(comm, self._instances, loads)
        assert parts is not None
        for part in parts:
            if isinstance(part, Exception):
                raise part
        outcomes = [parts[k % comm.size][k // comm.size] for k in range(len(loads))]
        self._state, self._outcomes = None, outcomes
        return outcomes


def serve_analyses(comm: MPI.Comm, make: Callable[[Any], Instances]) -> None:
    """Analyse what rank 0 asks for, on all other ranks, until it sends None.

    `make`: returns the instances from the `setup` that rank 0 sends first.
    """
    if (setup := wait_for_message(comm)) is None:
        return
    instances: Instances | None = None
    while (message := wait_for_message(comm)) is not None:
        try:
            instances = instances or make(setup)
            if message.state is not None:
                instances.from_checkpoint(message.state)
            instances.apply_outcomes(message.outcomes)
        except Exception as error:
            # rank 0 waits for an answer
            gather(comm, error)
        else:
            _analyse_own_share(comm, instances, message.loads)


def _analyse_own_share(comm: MPI.Comm, instances: Instances, loads: list[ImpactLoads]) -> list[Any] | None:
    """Analyse every n-th load; return on rank 0 the outcomes of each rank, or the exception that it raised."""
    result: Any
    try:
        result = [analyse_impact(instances, load) for load in loads[comm.rank :: comm.size]]
    except Exception as error:
        result = error
    return gather(comm, result)


def analyse_impact(instances: Instances, load: ImpactLoads) -> ImpactOutcome:
    """Return the outcome of one load. Raises NotConverged."""
    return instances.find_outcome(
        load.body_name, load.points, load.force, load.circle_radii, load.max_surfaces, load.energy
    )


# --- messages ---


def send_to_workers(comm: MPI.Comm, message: Any) -> None:
    """Send a message from rank 0 to all other ranks."""
    for request in [comm.isend(message, rank, MESSAGE_TAG) for rank in range(1, comm.size)]:
        request.wait()


def wait_for_message(comm: MPI.Comm) -> Any:
    """Return the next message from rank 0."""
    while not comm.iprobe(source=0, tag=MESSAGE_TAG):
        # a worker that sleeps leaves its core to others
        time.sleep(1e-3)
    return comm.recv(source=0, tag=MESSAGE_TAG)
