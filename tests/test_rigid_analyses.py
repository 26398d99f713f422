"""Analyses on other ranks: what rank 0 hears where one of them fails."""

from __future__ import annotations

from typing import Any

import pytest

from fracsim.rigid.parallel_analyses import serve_analyses


class Script:
    """A communicator whose rank 0 says what it is told to, and notes what it is answered."""

    rank, size = 1, 2

    def __init__(self, *said: object) -> None:
        self.said, self.answers, self.looked = list(said), list[Any](), 0

    def iprobe(self, source: int, tag: int) -> bool:
        """Only every other time that it looks."""
        self.looked += 1
        return self.looked % 2 == 0

    def recv(self, source: int, tag: int) -> object:
        assert self.iprobe(0, tag) is False
        return self.said.pop(0)

    def gather(self, found: object) -> None:
        self.answers.append(found)


class Message:
    """What every analysis begins with."""

    state, outcomes, loads = None, (), ()


@pytest.mark.parametrize("begin", [None, "mesh"])
def test_a_rank_that_cannot_make_its_mesh_tells(monkeypatch: pytest.MonkeyPatch, begin: str | None) -> None:
    """Each time that it is asked; and it ends where it is let go, also before it has begun."""

    def make(_: object) -> Any:
        raise ValueError("no mesh here")

    said = [Message, Message, None] if begin else []
    comm: Any = Script(begin, *said)
    monkeypatch.setattr("fracsim.rigid.parallel_analyses.gather", lambda comm, value: comm.gather(value))
    serve_analyses(comm, make)
    assert [str(answer) for answer in comm.answers] == ["no mesh here"] * (2 if begin else 0)
    assert not comm.said
