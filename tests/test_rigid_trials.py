"""The experiments beside the rigid scheme say what docs/theory.md#rigid-materials says of them."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip("mujoco", reason="an environment made without a network")

from fracsim.studies.rigid_trials import (
    ANGLES,
    BAR_SIZE,
    END_FORCE,
    TIME_STEPS,
    bar_stresses,
    broken_edges,
    penalty_force,
    rotation_strains,
)


def test_a_snapshot_of_a_penalty_force_cracks_otherwise_at_another_step() -> None:
    """Their figs. 9 and 10: the force is that of a depth which the step decides."""
    pushes = [penalty_force(step) for step in TIME_STEPS]
    assert max(pushes) > 4 * min(pushes)
    first, last = broken_edges(pushes[0]), broken_edges(pushes[-1])
    assert first.any() and not np.array_equal(first, last)


def test_pins_strain_a_body_where_nothing_pushes_it() -> None:
    """A bar pushed at one end carries F (1 - x / L) / A; with pins several times that where they are."""
    x, relieved, held = bar_stresses()
    far = x > BAR_SIZE[0] / 2
    assert relieved[far].max() < END_FORCE / (BAR_SIZE[1] * BAR_SIZE[2])
    assert held[far].max() > 10 * relieved[far].max()


def test_linear_strain_of_rotations() -> None:
    """Both grow with a^2 / 2."""
    for each in rotation_strains():
        assert each[:3] == pytest.approx(ANGLES[:3] ** 2 / 2, rel=0.02)
