"""Other numbers for the solvers that are made from here on, and a record of their nonlinear elimination."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import pytest

from fracsim.solvers import nonlinear_elimination, policy


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


def record_relaxations(patch: pytest.MonkeyPatch) -> list[bool]:
    """For each nonlinear elimination from here on: whether any node has moved."""
    moved, relax = list[bool](), nonlinear_elimination.NonlinearElimination.relax_nodes

    def recorded(self: nonlinear_elimination.NonlinearElimination, solved_norm: float) -> bool:
        moved.append(relax(self, solved_norm))
        return moved[-1]

    patch.setattr(nonlinear_elimination.NonlinearElimination, "relax_nodes", recorded)
    return moved
