"""Forces on circles of contact: Hertz's stress below them, whatever the mesh."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest

from fracsim.meshes.data import MeshData
from fracsim.rigid.impact_detection import _circle_radii
from fracsim.rigid.surface_loads import HertzContact, distribute_on_circles, locate_forces
from support.rigid import stiffness_of
from support.solids import lattice

Values = npt.NDArray[np.float64]


def test_a_patch_keeps_force_and_moment_and_has_hertzs_pressure() -> None:
    """What acts within r is F (1 - (1 - r^2/a^2)^(3/2)), the integral of the pressure; in the plane across the force;
    what is much smaller than a cell stays a point."""
    points, force = np.array([[0.3, 0.1, 2.0], [1.0, 0.0, 0.0]]), np.array([[1.0, -2.0, 2.0], [0.0, 3.0, 0.0]])
    at, share = distribute_on_circles(points, force, np.array([0.5, 1e-4]), 0.1)
    assert np.array_equal(at[0], points[1]) and np.array_equal(share[0], force[1])
    arm = at[1:] - points[0]
    assert np.allclose(share.sum(axis=0), force.sum(axis=0))
    assert np.allclose(np.cross(at, share).sum(axis=0), np.cross(points, force).sum(axis=0))
    assert np.allclose(arm @ force[0], 0.0, atol=1e-12)
    r = np.linalg.norm(arm, axis=1)
    for within in (0.1, 0.25, 0.4, 0.5):
        assert np.mean(r < within) == pytest.approx(1 - (1 - within**2 / 0.25) ** 1.5, abs=0.01)


def test_the_circle_is_hertzs() -> None:
    """a^3 = 3 F R / (4 E*), by the approach of two spheres d = a^2 / R, F = 4/3 E* sqrt(R) d^(3/2)."""
    hertz, R = HertzContact(2e9, 0.3), np.array([0.2])
    for both, E in ((True, 1e9), (False, 2e9)):
        force = np.array([[0.0, 300.0, 400.0]])
        (a,) = _circle_radii(hertz.radius_cubed_per_force(R, np.array([both])), force)
        assert 4 / 3 * E / (1 - 0.3**2) * np.sqrt(R) * (a**2 / R) ** 1.5 == pytest.approx(500.0)


def graded(count: int) -> MeshData:
    """A block of 2 x 2 x 1 m, its cells small around the middle of its top, where it is at the origin."""
    mesh = lattice(2 * count, 2 * count, count)
    s = mesh.points / count - [1.0, 1.0, 1.0]
    return MeshData(np.sign(s) * (0.25 * np.abs(s) + 0.75 * np.abs(s) ** 3), mesh.cells)


def stress_below(count: int, radius: float) -> tuple[Values, Values, Values]:
    """Volumes (n,) and middles (n, 3) of cells, m, and their stress (n, 6), Pa, under 1 N on a circle at the origin."""
    stiffness = stiffness_of(graded(count))
    body, domain = stiffness.whole_body(), stiffness.stress.domain
    at, force = distribute_on_circles(np.zeros((1, 3)), np.array([[0.0, 0.0, -1.0]]), np.array([radius]), 0.02)
    loads = locate_forces(domain.nodes, domain.cell_nodes.astype(np.int64), at, force)
    sigma = stiffness.cell_stress(body(loads.nodal_forces(len(domain.nodes))), body.cell_fractions)
    return domain.volumes, domain.nodes[domain.cell_nodes].mean(axis=1), sigma


def hubers(r: Values, z: Values, a: float) -> Values:
    """(n,) sigma_z at distances r from the axis and depths z below the pressure of 1 N on a circle of radius a (M. T.
    Huber 1904; on the axis Johnson's eq. 3.45b), Pa."""
    b = r**2 + z**2 - a**2
    u = (b + np.sqrt(b**2 + 4 * a**2 * z**2)) / 2
    return np.asarray(-1.5 / (np.pi * a**2) * (z / np.sqrt(u)) ** 3 * a**2 * u / (u**2 + a**2 * z**2))


def test_stress_below_a_patch_is_hertzs() -> None:
    """Means by volume over columns of cells below it. Linear tetrahedra of a fifth of its radius are some 8 % off, a
    force at a point by more than half: the column is as wide as half the circle."""
    a = 0.2
    (volume, at, sigma), (_, _, point) = (stress_below(10, radius) for radius in (a, 0.0))
    r, depth = np.hypot(*at[:, :2].T), -at[:, 2]
    for low, high in ((0.2, 0.6), (0.6, 1.2)):
        mine = (r < 0.5 * a) & (depth > low * a) & (depth < high * a)
        weight = volume[mine] / volume[mine].sum()
        expected = weight @ hubers(r[mine], depth[mine], a)
        assert weight @ sigma[mine, 2] == pytest.approx(expected, rel=0.1)
        assert weight @ point[mine, 2] < 1.2 * expected


def test_stress_at_a_patch_does_not_grow_as_cells_get_smaller() -> None:
    """Its peak is near p_0 on both meshes; that of a force at a point more than doubles."""
    peaks = {radius: [np.abs(stress_below(count, radius)[2][:, 2]).max() for count in (5, 8)] for radius in (0.0, 0.2)}
    assert np.allclose(peaks[0.2], 1.5 / (np.pi * 0.2**2), rtol=0.2)
    assert peaks[0.0][1] > 2 * peaks[0.0][0]
