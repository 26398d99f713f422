"""A rigid sphere pressed into a block: force, depth and contact radius by Hertz (1882).

F = 4/3 E* sqrt(R) d^(3/2), a^2 = R d, E* = E / (1 - nu^2); K. L. Johnson: Contact Mechanics (1985), ch. 4.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from fracsim.studies.evidence.precision.sphere_contact import hertz_errors, pressed_study, write_quarter
from support.scenes import make_scene, march


@pytest.mark.slow
def test_a_sphere_on_a_half_space(tmp_path: Path) -> None:
    scene, state = make_scene(**pressed_study({"file": write_quarter(tmp_path / "quarter.vtu", 22)}))
    march(scene, state)
    errors = hertz_errors(scene, state.u)
    assert errors["force"] == pytest.approx(0.0, abs=0.05)
    assert errors["contact radius"] == pytest.approx(0.0, abs=0.1)
