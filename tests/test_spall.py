"""Spall of a bar: closed form and characteristics, and cohesive cracks with inertia against them."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from fracsim.fracture.cohesive_cracks import CohesiveFracturePass
from fracsim.mesh.domain import distribute
from fracsim.meshes import BUILDERS
from fracsim.scene import build_scene_on
from fracsim.studies.evidence.spalling import Pulse, SpalledBar, spall
from support.scenes import Walk, make_study

# 10 MPa on 250 mm: the front is sharp, and the pulse 100 mm long.
SHARP = Pulse(young=5e10, density=2500.0, length=0.25, peak=1e7, rise=0.0, fall=22.36e-6)
# The pulse of shared/cases/spall.toml.
STEEP = Pulse(young=3e10, density=2400.0, length=0.2, peak=2e7, rise=3e-6, fall=17e-6)
STRENGTH, ENERGY = 8e6, 30.0  # Pa, J/m^2: l_ch = 14 mm


def end_speed(bar: SpalledBar, plane: float) -> float:
    """Mean velocity nearer to the free end than `plane`, m."""
    return float(bar.velocity[bar.distance < plane * (1 - 1e-9)].mean())


def test_a_sharp_pulse_spalls_once() -> None:
    """At 30 mm, and the piece leaves with 1.252 m/s; places beyond have the release and the peak at the same time."""
    strength = 6e6
    assert SHARP.first_plane(strength) == pytest.approx(0.030, rel=1e-4)
    assert SHARP.piece_speed(strength) == pytest.approx(1.252, rel=1e-3)
    bar = spall(SHARP, np.full(2501, strength), 0.0, 1.05e-4)
    planes = bar.distance[bar.opening > 0]
    np.testing.assert_allclose(planes, 0.030, rtol=0.005)
    assert end_speed(bar, planes.min()) == pytest.approx(1.252, rel=0.005)


def test_a_pulse_that_rises_breaks_every_place() -> None:
    """A rise of 3 us: the first plane and its piece are those of the closed form, and beyond it the strength is reached
    before any release arrives: planes a third of a millimetre apart on nodes of 0.1 mm."""
    bar = spall(STEEP, np.full(2001, STRENGTH), 0.0, 9e-5)
    planes = np.sort(bar.distance[bar.opening > 0])
    assert planes[0] == pytest.approx(STEEP.first_plane(STRENGTH), abs=2e-4)
    assert planes[0] == pytest.approx(0.01202, abs=2e-4)
    assert end_speed(bar, planes[0]) == pytest.approx(STEEP.piece_speed(STRENGTH), rel=0.002)
    assert len(planes) > 40 and np.diff(planes).max() < 5e-4


# --- cohesive cracks -------------------------------------------------------------------------------------------------


def spalled(scheme: str, dt: float, size: tuple[float, ...], pattern: str = "structured") -> tuple[Any, Walk, float]:
    """A bar that is weak from 39 to 42 mm before its free end: scene, state, and kinetic energy in J at the end."""
    pulse, d = replace(STEEP, length=size[0]), len(size)
    mesh = BUILDERS["box"](size=size, h=1e-3, pattern=pattern).build()
    weak = np.abs(size[0] - 0.0405 - mesh.points[mesh.cells].mean(axis=1)[:, 0]) < 1.5e-3
    mesh = replace(mesh, regions={"weak": np.flatnonzero(weak), "strong": np.flatnonzero(~weak)})
    times = [0.0, pulse.rise, pulse.rise + pulse.fall, 1.0]
    sides = [{"on": name, "fix": axis} for name, axis in
             (("bottom", "xyz"[d - 1]), ("top", "xyz"[d - 1]), ("front", "y"), ("back", "y"))[: 2 * d - 2]]  # fmt: skip
    study = make_study(
        material={"energy": "linear", "young": pulse.young, "poisson": 0.0, "density": pulse.density,
                  "strong": {"strength": 1e3 * STRENGTH}},
        fracture={"strength": STRENGTH, "energy": ENERGY, "law": "cohesive"},
        boundary=[*sides, {"on": "left", "pressure": {"time": times, "value": [0.0, pulse.peak, 0.0, 0.0]}}],
        time={"scheme": scheme, "step": dt, "end": 7.5e-5},
    )  # fmt: skip
    scene = build_scene_on(distribute(MPI.COMM_SELF, mesh), study)
    state, kinetic = Walk(scene), 0.0
    while not scene.ended(state.state):
        kinetic = state.advance().kinetic
    return scene, state, kinetic


@pytest.mark.parametrize(
    ("scheme", "dt", "size"),
    [
        ("explicit", 1e-6, (0.15, 0.003)),
        ("newmark", 4e-7, (0.15, 0.003)),
        ("generalized-alpha", 1e-7, (0.15, 0.003)),
        ("generalized-alpha", 4e-7, (0.15, 0.003)),
        ("explicit", 1e-6, (0.15, 0.002, 0.002)),
    ],
)
def test_a_cohesive_plane_with_inertia(scheme: str, dt: float, size: tuple[float, ...]) -> None:
    """A bar with one weak place: the piece leaves as fast as by characteristics, the crack takes G_c, and the books are
    closed."""
    scene, state, kinetic = spalled(scheme, dt, size)
    d, breaking = len(size), scene.fracture
    assert isinstance(breaking, CohesiveFracturePass)
    cuts = breaking.criterion.cut_positions
    assert cuts is not None
    edges = np.flatnonzero(~np.isnan(cuts))
    x = breaking.criterion.field_evaluator.cut_points(edges, cuts)[:, 0]
    assert np.ptp(x) < 1e-4
    strength, node = np.full(1501, np.inf), round(float(x.mean()) * 1e4)
    strength[node] = STRENGTH
    bar = spall(replace(STEEP, length=size[0]), strength, ENERGY, 7.5e-5)
    free = scene.domain.nodes[: len(state.v) // d, 0] > x.max() + 5e-4
    mass, velocity = scene.balance.mass.lumped[::d][free], state.v[::d][free]
    assert mass @ velocity / mass.sum() == pytest.approx(end_speed(bar, bar.distance[node]), rel=0.025)
    assert state.dissipated == pytest.approx(ENERGY * np.prod(size[1:]), rel=0.025)
    assert state.work == pytest.approx(kinetic + state.elastic + state.dissipated, rel=2e-3)
