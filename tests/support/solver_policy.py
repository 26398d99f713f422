"""Other numbers for the solvers that are made from here on."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest

from fracsim.solvers import policy


def set_policy(patch: pytest.MonkeyPatch, **changes: Any) -> policy.SolverPolicy:
    """Change fields of the default policy, on top of earlier changes; returns the policy."""
    changed = replace(policy.DEFAULT_POLICY, **changes)
    patch.setattr(policy, "DEFAULT_POLICY", changed)
    return changed


@contextmanager
def other_policy(**changes: Any) -> Iterator[policy.SolverPolicy]:
    """The same within a block, where no test is at hand."""
    with pytest.MonkeyPatch.context() as patch:
        yield set_policy(patch, **changes)
