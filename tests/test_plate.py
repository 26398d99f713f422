"""Flat shell triangles against Kirchhoff's plates, plane stress and rigid motions."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import spsolve
from scipy.spatial.transform import Rotation

from fracsim.rigid.shell_analysis import ShellTriangles

Ints = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
YOUNG, POISSON, H = 7e10, 0.3, 0.01
D = YOUNG * H**3 / 12 / (1 - POISSON**2)


def pane(count: int, seed: int = 0) -> tuple[Values, Ints]:
    """A square of 1 m in the plane z = 0, cut into triangles, its inner nodes moved about."""
    k = np.arange(count + 1)
    x, y = np.meshgrid(k, k, indexing="ij")
    points = np.stack([x, y, 0 * x], axis=2).reshape(-1, 3) / count
    inside = (points[:, :2] > 0).all(axis=1) & (points[:, :2] < 1).all(axis=1)
    points[inside, :2] += np.random.default_rng(seed).uniform(-0.2, 0.2, (inside.sum(), 2)) / count
    corner = ((count + 1) * x + y)[:-1, :-1].reshape(-1)
    a, b, c, d = corner, corner + count + 1, corner + count + 2, corner + 1
    return points, np.concatenate([np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)])


def matrix_of(points: Values, triangles: Ints) -> csc_matrix:
    """K of all nodes."""
    K = ShellTriangles.from_corners(points[triangles]).stiffness(YOUNG, POISSON, H)
    dofs = (6 * triangles[:, :, None] + np.arange(6)).reshape(-1, 18)
    rows, columns = np.repeat(dofs, 18, axis=1).ravel(), np.tile(dofs, 18).ravel()
    return coo_matrix((K.ravel(), (rows, columns)), shape=(6 * len(points),) * 2).tocsc()


def clamped(points: Values, triangles: Ints, force: Values) -> Values:
    """(n, 6) under forces (n,) across, with all edges held."""
    held = ((points[:, :2] == 0) | (points[:, :2] == 1)).any(axis=1)
    free = np.flatnonzero(np.repeat(~held, 6))
    load = np.zeros((len(points), 6))
    load[:, 2] = force
    u = np.zeros(6 * len(points))
    u[free] = spsolve(matrix_of(points, triangles)[free][:, free], load.ravel()[free])
    return u.reshape(-1, 6)


def test_a_clamped_pane_bends_as_kirchhoff_says() -> None:
    """Issue 13: within 5 %. S. Timoshenko, S. Woinowsky-Krieger, Theory of Plates and Shells, tables 35 and 37 (nu =
    0.3): under q, w = 0.00126 q a^4 / D and M = 0.0231 q a^2 in the middle and M = -0.0513 q a^2 in the middle
    of an edge, where the parabola through three rows of triangles leads to; under P in the
    middle, w = 0.0056 P a^2 / D."""
    points, triangles = pane(16)
    plates = ShellTriangles.from_corners(points[triangles])
    area = np.bincount(triangles.ravel(), np.repeat(plates.area / 3, 3))
    u = clamped(points, triangles, area)
    assert np.abs(u[:, 2]).max() == pytest.approx(0.00126 / D, rel=0.02)
    top = plates.stress(u[triangles], YOUNG, POISSON, H)[:, 1]
    at, moment = points[triangles].mean(axis=1), -normal_along_x(plates, top) * H**2 / 6
    centre = np.linalg.norm(at[:, :2] - 0.5, axis=1) < 0.08
    assert moment[centre].mean() == pytest.approx(-0.0231, rel=0.05)
    rows = [(at[:, 0] > low / 16) & (at[:, 0] < (low + 1) / 16) & (np.abs(at[:, 1] - 0.5) < 0.1) for low in (0, 1, 2)]
    a, b, c = (moment[row].mean() for row in rows)
    assert 1.875 * a - 1.25 * b + 0.375 * c == pytest.approx(0.0513, rel=0.05)
    middle = np.zeros(len(points))
    middle[np.linalg.norm(points - [0.5, 0.5, 0.0], axis=1).argmin()] = 1.0
    assert np.abs(clamped(points, triangles, middle)[:, 2]).max() == pytest.approx(0.0056 / D, rel=0.05)


def normal_along_x(plates: ShellTriangles, stress: Values) -> Values:
    """(n,) sigma_xx in space of stresses (n, 3) in the axes of the triangles."""
    x, y = plates.axes[:, 0, 0], plates.axes[:, 1, 0]
    return np.asarray(stress[:, 0] * x**2 + stress[:, 1] * y**2 + 2 * stress[:, 2] * x * y)


def test_constant_curvature_and_strain_are_exact() -> None:
    """w = x^2 / 2 + x y and u = (x + 2 y, 3 y) at irregular nodes, turned in space: strain, energy, and forces on the
    boundary alone (patch test)."""
    points, triangles = pane(4)
    x, y = points[:, :2].T
    u = np.stack([x + 2 * y, 3 * y, x**2 / 2 + x * y, x, -(x + y), -np.ones(len(x))], axis=1)  # r_x = w_y, r_y = -w_x
    Q = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix()
    there = u.reshape(-1, 2, 3) @ Q.T
    turned = points @ Q.T
    E = YOUNG / (1 - POISSON**2)
    plates = ShellTriangles.from_corners(turned[triangles])
    low, high = np.moveaxis(plates.stress(there.reshape(-1, 6)[triangles], YOUNG, POISSON, H), 1, 0)
    own = ShellTriangles.from_corners(points[triangles])
    assert np.allclose(normal_along_x(own, (low + high) / 2), E * (1 + 3 * POISSON))
    assert np.allclose(normal_along_x(own, (high - low) / 2), -E * H / 2)
    force = (matrix_of(turned, triangles) @ there.ravel()).reshape(-1, 6)
    inside = ((points[:, :2] > 0) & (points[:, :2] < 1)).all(axis=1)
    assert np.abs(force[inside]).max() < 1e-9 * np.abs(force).max()
    bent = YOUNG * H**3 / 12 / (1 - POISSON**2) * (1 + 2 * (1 - POISSON)) / 2
    drawn = E * H * (1 + 9 + 6 * POISSON + (1 - POISSON) / 2 * 4) / 2
    assert there.ravel() @ force.ravel() / 2 == pytest.approx(bent + drawn, rel=1e-9)


def test_rigid_motions_alone_have_no_energy() -> None:
    """Of a folded strip: six eigenvalues are 0, all others are not."""
    points, triangles = pane(3)
    points[:, 2] = np.abs(points[:, 0] - 0.4) * 0.7
    values = np.linalg.eigvalsh(matrix_of(points, triangles).toarray())
    assert np.abs(values[:6]).max() < 1e-9 * values[-1]
    assert values[6] > 1e-7 * values[-1]
