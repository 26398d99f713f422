"""Analyses of bodies that were struck in one step, spread over ranks; the engine is on the first of them.

Every rank has the mesh, and the damage of its copies. Strikes of a step do not feel one another: each sees the surfaces
that there were before, and may open its share of those that are left of its copy, so that what comes of it is the same
on any number of ranks. Those that have used theirs up share what the others left.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..mesh.parallel import gather
from .breakage import Opened
from .instances import Copies
from .worker_ranks import lend, tell, told

Values = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Strike:
    """On the body of a name: forces (k, 3) on circles of radii (k,) about points (k, 3) at rest, N and m, that have an
    `energy` to spend, J; at most `share` surfaces may open."""

    name: int
    points: Values
    force: Values
    radius: Values
    share: int = 0
    energy: float = float("inf")


@dataclass(frozen=True)
class _Message:
    """To the other ranks: what to begin with, what opened since, what to analyse."""

    saved: dict[str, Any] | None
    news: list[Opened]
    strikes: list[Strike]


class Analyses:
    """Of one mesh (rank 0 of a communicator)."""

    def __init__(self, bodies: Copies, comm: MPI.Comm = MPI.COMM_SELF, begin: Any = None) -> None:
        """`begin`: what other ranks make their `Copies` of, see `serve`."""
        self._bodies, self._comm, self._begin = bodies, comm, begin
        self._saved: dict[str, Any] | None = None
        self._news: list[Opened] = []

    def restored(self) -> None:
        """The mesh is as a checkpoint said."""
        self._saved, self._news = self._bodies.saved(), []

    def __call__(self, strikes: list[Strike]) -> dict[int, int]:
        """How many edges broke, by the names of bodies. Raises NotConverged."""
        broken = {each.name: 0 for each in strikes}
        while tasks := self._shared(strikes):
            found = self._spread(tasks)
            self._bodies.take(found)
            for opened in found:
                broken[opened.name] += len(opened.keys)
            having = {each.name for each in tasks}
            spent = {each.name for each, task in zip(found, tasks, strict=True) if len(each.starts) == task.share}
            strikes = [each for each in strikes if each.name in spent or each.name not in having]
        return broken

    def _shared(self, strikes: list[Strike]) -> list[Strike]:
        """Strikes with their shares of the surfaces that their copies have left; without those that get none."""
        left = [self._bodies.left(each.name) for each in strikes]
        of, before, tasks = Counter(number for number, _ in left), Counter[int](), list[Strike]()
        for each, (number, many) in zip(strikes, left, strict=True):
            few, more = divmod(many, of[number])
            tasks.append(replace(each, share=few + (before[number] < more)))
            before[number] += 1
        return [each for each in tasks if each.share]

    def _spread(self, strikes: list[Strike]) -> list[Opened]:
        """What opened, in their order."""
        comm = self._comm
        if comm.size == 1 or len(strikes) == 1:
            found = [opened_by(self._bodies, each) for each in strikes]
            self._news += found if comm.size > 1 else []
            return found
        if self._begin is not None:
            tell(comm, self._begin)
            self._begin = None
        tell(comm, _Message(self._saved, self._news, strikes))
        parts = _gathered(comm, self._bodies, strikes)
        assert parts is not None
        for part in parts:
            if isinstance(part, Exception):
                raise part
        found = [parts[k % comm.size][k // comm.size] for k in range(len(strikes))]
        self._saved, self._news = None, found
        return found


def serve(comm: MPI.Comm, make: Callable[[Any], Copies]) -> None:
    """On all other ranks: analyse what rank 0 says, until it sends None; `make`: of what `begin` is."""
    lend(comm)
    if (begin := told(comm)) is None:
        return
    bodies: Copies | None = None
    while (message := told(comm)) is not None:
        try:
            bodies = bodies or make(begin)
            if message.saved is not None:
                bodies.restore(message.saved)
            bodies.take(message.news)
        except Exception as error:  # told instead of what was found: rank 0 waits for it
            gather(comm, error)
        else:
            _gathered(comm, bodies, message.strikes)


def _gathered(comm: MPI.Comm, bodies: Copies, strikes: list[Strike]) -> list[Any] | None:
    """On rank 0 what opened on each rank, or why it failed."""
    result: Any
    try:
        result = [opened_by(bodies, each) for each in strikes[comm.rank :: comm.size]]
    except Exception as error:
        result = error
    return gather(comm, result)


def opened_by(bodies: Copies, strike: Strike) -> Opened:
    """What a strike opens. Raises NotConverged."""
    return bodies.opened(strike.name, strike.points, strike.force, strike.radius, strike.share, strike.energy)
