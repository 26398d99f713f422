"""The list of repeats names cases that exist."""

from __future__ import annotations

import pytest

from conftest import LOST_REPEATS


def test_every_repeat_is_a_case(request: pytest.FixtureRequest) -> None:
    """By the collection of all tests; a worker that refused its collection ended the run without this sentence."""
    lost = request.config.stash[LOST_REPEATS]
    assert not lost, f"tests/repeats.py names what is no case: {', '.join(lost)}"
