"""What terms with free obstacles have in common: how these fly is their past, and told in history.csv."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from functools import partial
from typing import Protocol, cast

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from ..meshes.text import AXES
from .obstacle import Flight, FreeObstacle, rows_of
from .obstacle_term import Obstacles
from .pose import Placed

Values = npt.NDArray[np.float64]


class Flying(Protocol):
    """A free obstacle, and how it moves at the start of a step until that is over."""

    body: FreeObstacle
    flight: Flight


class Placeable(Flying, Protocol):
    """One that is placed by its flight."""

    def look(self) -> Placed:
        """Where it is between two steps."""


class Flights(Obstacles):
    """Obstacles of which some are free.

    Attributes:
        free: those by their number.
    """

    free: Mapping[int, Placeable]

    def _led(self) -> list[int]:
        return [number for number in super()._led() if number not in self.free]

    def flights(self) -> dict[int, Flight]:
        """How each moves, by its number."""
        return {number: each.flight for number, each in self.free.items()}

    def fly(self, flights: Mapping[int, Flight]) -> None:
        """Move again as `flights` gave it."""
        for number, each in self.free.items():
            each.flight = flights[number]

    def _take_places(self, start: float, end: float) -> None:
        super()._take_places(start, end)
        for number, each in self.free.items():
            self._course.put_at_start(number, each.look())

    def snapshot(self) -> object:
        """That of the points, and how obstacles move."""
        return super().snapshot(), self.flights()

    def restore(self, memory: object) -> None:
        """Be again what `memory` gave (not collective)."""
        points, flights = cast("tuple[object, dict[int, Flight]]", memory)
        super().restore(points)
        self.fly(flights)

    def to_checkpoint(self) -> dict[str, Values]:
        """With rows of how obstacles move (collective)."""
        return super().to_checkpoint() | {"flights": rows_of(each.flight for each in self.free.values())}

    def from_checkpoint(self, saved: dict[str, Values]) -> None:
        """Be again what `saved` gave."""
        super().from_checkpoint(saved)
        for k, each in enumerate(self.free.values()):
            each.flight = each.flight.like(saved["flights"][k])

    def where(self, t: float) -> list[Placed]:
        """Each obstacle at the time t of the state, s (not collective)."""
        here = super().where(t)
        for number, each in self.free.items():
            here[number] = Placed(here[number].shape, each.flight.pose)
        return here

    def kinetic_energy(self) -> float:
        """Energy of motion of the free obstacles, on rank 0, J."""
        if self.comm.rank:
            return 0.0
        return float(sum(each.body.told(each.flight)[-1] for each in self.free.values()))

    def summed_columns(self) -> dict[str, Callable[[], Values]]:
        """With position_NAME_x, velocity_NAME_x of the centre of mass, m and m/s, turn_NAME_z, spin_NAME_z in rad and
        rad/s, and kinetic_NAME in J of each that is free."""
        return super().summed_columns() | columns_of(self.free.values(), self.comm)


def columns_of(free: Iterable[Flying], comm: MPI.Intracomm) -> dict[str, Callable[[], Values]]:
    """Columns of history.csv that tell how obstacles fly, each with a function that gives this rank's share, (1,)."""
    tellers = [(_Teller(each, comm), columns(each.body)) for each in free]
    return {name: partial(teller, place) for teller, names in tellers for place, name in enumerate(names)}


class _Teller:
    """What an obstacle tells of how it flies: asked for each column, found once for each flight."""

    def __init__(self, flying: Flying, comm: MPI.Intracomm) -> None:
        self._flying, self._root = flying, comm.rank == 0
        self._flight: Flight | None = None
        self._told: Values = np.empty(0)

    def __call__(self, place: int) -> Values:
        """(1,) the column there; 0 where it is not this rank's to tell."""
        if not self._root:
            return np.zeros(1)
        if self._flight is not self._flying.flight:
            self._flight = self._flying.flight
            self._told = self._flying.body.told(self._flight)
        return self._told[place : place + 1]


def columns(body: FreeObstacle) -> list[str]:
    """Names of what `told` gives."""
    d = len(body.at)
    axes, turns = AXES[:d], AXES[2:] if d == 2 else AXES
    kinds = [("position", axes), ("velocity", axes), ("turn", turns), ("spin", turns)]
    return [*[f"{kind}_{body.name}_{axis}" for kind, over in kinds for axis in over], f"kinetic_{body.name}"]
