"""Parts of a body that remember: what they are between two steps is a value in the state.

A step begins with recalling that value, so that a trial which fails, is repeated or starts from an earlier state finds
the body as it was, whatever was tried in between.
"""

from __future__ import annotations

from typing import Protocol


class Remembers(Protocol):
    """A part with a past, such as damage or plastic flow."""

    def memory(self) -> object:
        """What it is now, never to be written to again; the same object as before where nothing has changed."""

    def recall(self, memory: object) -> bool:
        """Be again what `memory` gave, which costs nothing where that is what it is; whether it was anything else.

        Not collective, but the same on all ranks.
        """
