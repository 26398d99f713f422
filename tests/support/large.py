"""Collectives with a communicator whose counts end early, as those of MPI end at 2^31; saved for test_large."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fracsim.mesh.parallel import Gather, GatherSubset, RankHalo, allgather, alltoall, bcast, gather

END = 1500  # elements
UNIT = 2**31 // 1024


class Narrow:
    """A communicator with large messages refused, in whatever they are counted."""

    def __init__(self, comm: MPI.Intracomm) -> None:
        self._comm = comm

    def __getattr__(self, name: str) -> Any:
        found = getattr(self._comm, name)
        if name in ("gather", "allgather", "alltoall", "scatter"):
            raise AssertionError(f"{name} counts bytes of what it pickles")
        if not name.endswith(("gatherv", "tterv", "toallv", "Bcast")):
            return found

        def checked(*messages: Any, **more: Any) -> Any:
            for each in filter(None, messages):
                counts = each[1] if isinstance(each, tuple) else [each.size]
                counts = counts[0] if isinstance(counts, tuple) else counts
                assert np.sum(counts) <= END, f"{name} of {np.sum(counts)} elements"
            return found(*messages, **more)

        return checked


def rows_of(rank: int, shape: tuple[int, ...]) -> npt.NDArray[np.float64]:
    return np.random.default_rng(rank).standard_normal(shape)


def main(path: str) -> None:
    """Gather and scatter of rows, values near other ranks, and objects."""
    world = MPI.COMM_WORLD
    comm: Any = Narrow(world)
    rank, size = world.rank, world.size
    every = np.random.default_rng(7).permutation(300 * size)
    own = np.sort(every[300 * rank : 300 * (rank + 1)])
    whole = np.random.default_rng(8).standard_normal((300 * size, 3, 3))
    result: dict[str, Any] = {}
    for name, values in {
        "rows": whole,
        "numbers": whole[:, 0, 0],
        "flags": whole[:, 0] > 0,
        "none": whole[:, :, :0],
    }.items():
        found = Gather(comm, own)(values[own])
        result[f"gathered-{name}"] = found is None or np.array_equal(found, values)
        result[f"scattered-{name}"] = np.array_equal(
            Gather(comm, own).scatter(values if rank == 0 else None), values[own]
        )
    which = own % 2 == 0
    some = GatherSubset(comm, own // 2, which)
    there = some(whole[own])
    result["some"] = there is None or np.array_equal(there, whole[::2])
    back = some.scatter(whole[::2] if rank == 0 else None)
    result["some-back"] = np.array_equal(back, whole[own] * which[:, None, None])
    near = RankHalo(comm, np.zeros((300, 2)), 1.0)(rows_of(rank, (300, 9)))
    others = [rows_of(each, (300, 9)) for each in range(size) if each != rank]
    result["halo"] = np.array_equal(near, np.concatenate([rows_of(rank, (300, 9)), *others]))
    sent = [rows_of(10 * rank + each, (5000 + 100 * each,)) for each in range(size)]
    objects = [{"rank": each, "rows": rows_of(each, (5000 + each,))} for each in range(size)]
    result["allgather"] = _same(allgather(comm, objects[rank]), objects)
    found_objects = gather(comm, objects[rank])
    result["gather"] = _same(found_objects, objects) if rank == 0 else found_objects is None
    result["bcast"] = _same([bcast(comm, objects[0] if rank == 0 else None)], objects[:1])
    arrived = alltoall(comm, sent)
    expected = [rows_of(10 * each + rank, (5000 + 100 * rank,)) for each in range(size)]
    result["alltoall"] = all(map(np.array_equal, arrived, expected))
    good = {name: np.array(world.allreduce(bool(each), op=MPI.LAND)) for name, each in result.items()}
    if rank == 0:
        np.savez(path, **good)


def _same(found: Any, expected: list[dict[str, Any]]) -> bool:
    pairs = zip(found, expected, strict=True)
    return all(a["rank"] == b["rank"] and np.array_equal(a["rows"], b["rows"]) for a, b in pairs)


def beyond() -> None:
    """Rows of more than 2^31 bytes from the last rank to the first: 2.1 GB, three times."""
    comm = MPI.COMM_WORLD
    count = UNIT + 1000 if comm.rank == comm.size - 1 else 1
    first = comm.exscan(count) or 0
    every = Gather(comm, first + np.arange(count))
    rows = np.zeros((count, 1024), np.uint8)
    rows[:, :8] = (first + np.arange(count))[:, None].view(np.uint8).reshape(-1, 8)
    found = every(rows)
    if found is not None:
        assert found.nbytes > 2**31
        numbers = np.ascontiguousarray(found[:, :8]).view(np.int64).reshape(-1)
        assert np.array_equal(numbers, np.arange(len(found)))
        print("all there", len(found))


if __name__ == "__main__":
    beyond() if sys.argv[1:] == ["beyond"] else main(sys.argv[1])
