"""J-integrals around points: handbook, independence of the radius, bodies without a crack, and what is refused."""

from __future__ import annotations

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.errors import InputError
from fracsim.scene import build_scene
from fracsim.study.check import check_study
from support.scenes import make_study
from support.tip_rows import LENGTH, edge_crack_intensity, strip

RADII = (0.15, 0.25, 0.38)


def contours(radii: tuple[float, ...], point: tuple[float, float] = (LENGTH, 1.5)) -> list[dict[str, object]]:
    return [{"name": f"r{k}", "point": list(point), "contour": radius} for k, radius in enumerate(radii)]


def test_it_is_that_of_the_handbook_at_any_radius() -> None:
    """J = K^2 / E' of the crack that ends where the cell of its tip begins to carry."""
    mesh = {"builder": "box", "size": [1.0, 3.0], "h": 0.025, "pattern": "unstructured"}
    scene = build_scene(MPI.COMM_SELF, strip(mesh=mesh, probe=contours(RADII)))
    scene.stepper.advance(scene.start())
    assert scene.probes.columns == [f"J_r{k}_{axis}" for k in range(3) for axis in "xy"]
    J = scene.probes().reshape(3, 2)
    expected = edge_crack_intensity(LENGTH) ** 2 * (1 - 0.3**2) / 1e3
    np.testing.assert_allclose(J[:, 0], expected, rtol=0.05)
    np.testing.assert_allclose(J[:, 0], J[0, 0], rtol=0.01)
    assert np.all(np.abs(J[:, 1]) < 0.1 * expected)


@pytest.mark.parametrize("energy", ["linear", "neo-hookean"])
def test_where_nothing_is_cracked_it_vanishes(energy: str) -> None:
    """A bent block without a crack: J against the energy density times the radius."""
    study = make_study(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.05, "pattern": "unstructured"},
        material={"energy": energy, "young": 1.0, "poisson": 0.3, "density": 1.0},
        boundary=[{"on": "left", "fix": "xy"}, {"on": "right", "displacement": [0.3, 0.2]}],
        probe=contours((0.3,), (0.5, 0.5)), time={"scheme": "quasi-static", "step": 1.0, "end": 1.0},
    )  # fmt: skip
    scene = build_scene(MPI.COMM_SELF, study)
    _, report = scene.stepper.advance(scene.start())
    assert np.all(np.abs(scene.probes()) < 0.01 * 0.3 * report.elastic)


@pytest.mark.parametrize("energy", ["linear", "neo-hookean"])
def test_where_nothing_is_cracked_weight_makes_none(energy: str) -> None:
    """A block that hangs by its top: the weight within the radius is not the energy of a crack."""
    study = make_study(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.05, "pattern": "unstructured"},
        material={"energy": energy, "young": 1.0, "poisson": 0.3, "density": 1.0},
        boundary=[{"on": "top", "fix": "xy"}], load={"gravity": [0.0, -0.1], "body_force": [0.05, -0.1]},
        probe=contours((0.3,), (0.5, 0.5)), time={"scheme": "quasi-static", "step": 1.0, "end": 1.0},
    )  # fmt: skip
    scene = build_scene(MPI.COMM_SELF, study)
    _, report = scene.stepper.advance(scene.start())
    assert np.all(np.abs(scene.probes()) < 0.02 * 0.3 * report.elastic)


def test_a_crack_under_weight_releases_the_energy_of_two_layers() -> None:
    """A layer held above and below, with a crack at a quarter of its height H: two layers of h_1 and h_2 behind it.

    G = f^2 (h_1^3 + h_2^3) / 6 E - f^2 H^3 / 24 E without Poisson's ratio.
    """
    mesh = {"builder": "box", "size": [6.0, 1.0], "h": 0.05, "pattern": "unstructured"}
    study = make_study(
        mesh=mesh, fracture={"strength": 1e6}, crack=[{"segment": [[-0.1, 0.75], [3.0, 0.75]]}],
        boundary=[{"on": side, "fix": "xy"} for side in ("bottom", "top")], load={"body_force": [0.0, -1e-2]},
        probe=contours((0.16, 0.24), (3.0, 0.75)), time={"scheme": "quasi-static", "step": 1.0, "end": 1.0},
    )  # fmt: skip
    scene = build_scene(MPI.COMM_SELF, study)
    scene.stepper.advance(scene.start())
    expected = 1e-4 * ((0.75**3 + 0.25**3) / 6 - 1 / 24)
    along = scene.probes().reshape(2, 2)[:, 0]
    assert along == pytest.approx([expected] * 2, rel=0.08)
    assert along[1] == pytest.approx(along[0], rel=0.05)


def test_what_it_needs_is_said() -> None:
    with pytest.raises(ValueError, match="give point, neither on nor record"):
        make_study(probe=[{"name": "a", "on": "left", "contour": 0.1}])
    study = make_study(probe=contours((0.3,), (0.5, 0.5)))
    with pytest.raises(InputError, match=r'probe.0.contour: .* give time.scheme = "quasi-static"'):
        check_study(study)
    small = strip(probe=contours((1e-3,), (0.41, 1.51)))
    with pytest.raises(InputError, match=r"probe.0.contour = 0.001: .* at least three cells"):
        build_scene(MPI.COMM_SELF, small)
