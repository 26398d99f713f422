"""Fields of a frame against closed forms."""

from __future__ import annotations

from pathlib import Path

import h5py
import numpy as np
import pytest
from mpi4py import MPI

from cases import BAR, changed, study
from fracsim.deformable_run import Run
from fracsim.scene import build_scene


@pytest.mark.parametrize("size", ([1.0, 0.25, 0.25], [1.0, 0.25]))
def test_equivalent_strain_of_a_bar_held_across(size: list[float], tmp_path: Path) -> None:
    """F = diag(1 + e, 1, 1): E_11 = e + e^2/2 alone, its deviator is E_11 (2, -1, -1)/3, sqrt(2/3 e:e) = 2/3 E_11.

    In 2D plane strain is the same: E_33 = 0 counts in the deviator. von Mises stress is 2 mu E_11 (Hooke, small e).
    """
    e, axes = 1e-3, "xyz"[: len(size)]
    stretched = [{"on": {"box": [[x - 1e-6, *([0.0] * (len(size) - 1))], [x + 1e-6, *size[1:]]]},
                  "displacement": [e * x, *([0.0] * (len(size) - 1))]} for x in (0.0, 1.0)]  # fmt: skip
    everywhere = {"on": {"box": [[0.0] * len(size), size]}, "fix": axes[1:]}
    data = changed(
        BAR, mesh={"size": size}, boundary=[everywhere, *stretched], probe=[],
        time={"scheme": "quasi-static", "step": 0.01, "end": 0.01},
        output={"fields": ["strain", "von_mises", "energy_density"], "precision": "double"},
        solver={"snes_rtol": 1e-12, "ksp_rtol": 1e-12},
    )  # fmt: skip
    Run(build_scene(MPI.COMM_SELF, study(data)), tmp_path)()
    mu, lmbda = 1e6 / 2.6, 1e6 * 0.3 / (1.3 * 0.4)
    with h5py.File(tmp_path / "fields.h5") as file:
        frame = file["frames"][max(file["frames"])]
        np.testing.assert_allclose(frame["strain"][()], 2 / 3 * (e + e**2 / 2), rtol=1e-9)
        np.testing.assert_allclose(frame["von_mises"][()], 2 * mu * e, rtol=1e-9)
        np.testing.assert_allclose(frame["energy_density"][()], (mu + lmbda / 2) * e**2, rtol=1e-9)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("energy", ["linear", "stvk"])
def test_equivalent_strain_of_a_sheet_includes_that_across_it(energy: str, order: int, tmp_path: Path) -> None:
    """Plane stress, F = diag(1.1, 1): E_11 = 0.105, E_22 = 0 and, with nu = 0.3, E_33 = -3/7 E_11.

    Linear: F_33 = 1 - 3/7 * 0.1.
    """
    data = changed(
        BAR, mesh={"size": [1.0, 0.25], "order": order}, probe=[],
        boundary=[
            {"on": {"box": [[0.0, 0.0], [1.0, 0.25]]}, "displacement": ["free", 0.0]},
            {"on": "left", "displacement": [0.0, "free"]},
            {"on": "right", "displacement": [0.1, "free"]},
        ],
        material={"energy": energy, "plane": "stress"}, output={"fields": ["strain"], "precision": "double"},
        time={"scheme": "quasi-static", "step": 0.01, "end": 0.01},
        solver={"snes_rtol": 1e-12, "ksp_rtol": 1e-12},
    )  # fmt: skip
    Run(build_scene(MPI.COMM_SELF, study(data)), tmp_path)()
    E = np.array([0.105, 0.0, -3 / 7 * 0.105 if energy == "stvk" else ((1 - 0.3 / 7) ** 2 - 1) / 2])
    deviator = E - E.mean()
    with h5py.File(tmp_path / "fields.h5") as file:
        frame = file["frames"][max(file["frames"])]
        np.testing.assert_allclose(frame["strain"][()], np.sqrt(2 / 3 * deviator @ deviator), rtol=1e-8)
