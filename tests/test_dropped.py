"""Scenes that are dropped without `destroy` are freed: no object of PETSc, communicator or option of theirs stays."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from support.dropped import KINDS


def used(kind: str, count: int, steps: int, every: int, often: int) -> list[Any]:
    """The most of what is in use in the first half of so many scenes and in the second; freed after `often` of them."""
    words = map(str, (count, steps, every, often))
    command = [sys.executable, "-m", "support.dropped", kind, *words]
    done = subprocess.run(
        command, capture_output=True, text=True, timeout=280, cwd=Path(__file__).parent, check=False
    )  # fmt: skip
    assert done.returncode == 0, done.stderr[-2000:]
    result: list[Any] = json.loads(done.stdout)
    return result


@pytest.mark.parametrize("kind", KINDS)
def test_a_dropped_scene_leaves_nothing(kind: str) -> None:
    """Where all before it are freed as the next one is built there are no more after 24 than after twelve."""
    first, second = used(kind, 24, 1, 1, 1)
    # scenes are freed in no fixed order, which may take one communicator more; a leak of each scene would take twelve
    assert all(there <= here + 1 for here, there in zip(first[:3], second[:3], strict=True))


@pytest.mark.slow
@pytest.mark.parametrize("kind", ["strip", "contact"])
def test_300_scenes_in_one_process_do_not_grow(kind: str) -> None:
    """As often as they are freed by themselves: far from the 2,048 communicators that MPICH has."""
    first, second = used(kind, 300, 1, 5, 0)
    assert max(first[1], second[1]) < 1000
    assert all(there < 1.2 * here for here, there in zip(first[:3], second[:3], strict=True))
    assert second[3] < first[3] + 10
