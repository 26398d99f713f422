"""The non-local average (M22 eq. 13) against the dense double sum over all cells, and what it must reproduce."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from fracsim.fracture import nonlocal_average as average_module
from fracsim.fracture.edge_stress import frobenius_norm
from fracsim.fracture.nonlocal_average import NonlocalAverage
from support.scenes import Values, cell_corners, make_scene

EPS = np.finfo(float).eps
KERNELS = ("linear", "constant", "gaussian")
H = 0.125
MESHES = {
    "2d": {"builder": "box", "size": [1.0, 1.0], "h": H},
    "3d": {"builder": "box", "size": [1.0, 1.0, 1.0], "h": 2 * H},
    "2d-unstructured": {"builder": "box", "size": [1.0, 1.0], "h": H, "pattern": "unstructured"},
}


class Body:
    """A mesh with its cells' centroids and volumes, worked out here."""

    def __init__(self, mesh: dict[str, object]) -> None:
        scene, _ = make_scene(mesh=mesh)
        self.domain = scene.domain
        corners = cell_corners(scene)
        self.centroids = corners.mean(axis=1)
        self.volumes = np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1]))  # a common factor does not matter

    def average(self, radius: float, kernel: str) -> NonlocalAverage:
        return NonlocalAverage(self.domain, radius, kernel)


@pytest.fixture(scope="module", params=MESHES)
def body(request: pytest.FixtureRequest) -> Body:
    return Body(MESHES[request.param])


def brute_force(body: Body, radius: float, kernel: str, values: Values, active: Values) -> Values:
    """sum_k V_k g(r_ck / R) s_k / sum_k V_k g(r_ck / R) over all active cells, as a dense matrix."""
    q = cdist(body.centroids, body.centroids) / radius
    shape = {"linear": 1 - q, "constant": np.ones_like(q), "gaussian": np.exp(-((3 * q) ** 2) / 2)}[kernel]
    weights = np.where(q <= 1, shape, 0.0) * body.volumes * active
    sums = weights.sum(axis=1, keepdims=True)
    return np.divide(weights @ values, sums, out=np.zeros_like(values), where=sums > 0)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("radius", (2.7 * H, 10.0), ids=("near", "all"))
def test_equals_the_dense_sum(body: Body, kernel: str, radius: float) -> None:
    """Every cell within R counts once, with weight volume * kernel; round-off of a sum over n cells."""
    values = np.random.default_rng(1).uniform(-1, 1, (len(body.volumes), 3))
    found = body.average(radius, kernel)(values)
    expected = brute_force(body, radius, kernel, values, np.ones(len(values)))
    np.testing.assert_allclose(found, expected, atol=len(values) * EPS)


@pytest.mark.parametrize("kernel", KERNELS)
def test_inactive_cells_enter_no_average(body: Body, kernel: str) -> None:
    """Split cells are left out of numerator and denominator; where no active cell is in reach the average is 0."""
    random = np.random.default_rng(2)
    values, active = random.uniform(-1, 1, (len(body.volumes), 3)), random.random(len(body.volumes)) < 0.5
    active[body.centroids[:, 0] > 0.6] = False
    values[~active] = 1e6  # would be seen
    radius = 1.5 * H
    found = body.average(radius, kernel)(values, active)
    expected = brute_force(body, radius, kernel, values, active)
    np.testing.assert_allclose(found, expected, atol=len(values) * EPS)
    assert not found[body.centroids[:, 0] > 0.6 + radius].any()


@pytest.mark.parametrize("kernel", KERNELS)
def test_constants_are_reproduced(body: Body, kernel: str) -> None:
    """The weights sum to 1, at the boundary of the body too."""
    values = np.tile([1.0, -2.0], (len(body.volumes), 1))
    np.testing.assert_allclose(body.average(3 * H, kernel)(values), values, rtol=len(values) * EPS)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize(("size", "h"), (([1.0, 1.0], 0.125), ([1.0, 1.0, 1.0], 0.2)), ids=("2d", "3d"))
def test_linear_fields_are_reproduced_inside(size: list[float], h: float, kernel: str) -> None:
    """A lattice of simplices is symmetric under inversion, which swaps the cells of a cube in pairs: where no
    neighbourhood is cut off by the boundary the errors of a pair cancel, and the mean over a cube is exact for a
    linear field."""
    body = Body({"builder": "box", "size": size, "h": h})
    values = body.centroids @ np.arange(1.0, len(size) + 1)
    error = body.average(1.4 * h, kernel)(values[:, None])[:, 0] - values
    cube = np.floor(body.centroids / h).astype(int)
    inside = np.all((cube >= 2) & (cube < round(1 / h) - 2), axis=1)
    assert np.any(np.abs(error[inside]) > 1e-3 * h)  # single cells do have an error: the statement is about pairs
    which = np.unique(cube[inside], axis=0, return_inverse=True)[1]
    means = np.bincount(which, error[inside]) / np.bincount(which)
    np.testing.assert_allclose(means, 0, atol=len(error) * EPS)


@pytest.mark.parametrize("kernel", KERNELS)
def test_a_small_radius_is_local(body: Body, kernel: str) -> None:
    """With no other centroid in reach each cell keeps its value."""
    values = np.random.default_rng(3).uniform(-1, 1, (len(body.volumes), 3))
    np.testing.assert_allclose(body.average(1e-3 * H, kernel)(values), values, rtol=4 * EPS)


def test_a_large_constant_kernel_is_the_mean_over_the_body(body: Body) -> None:
    """All cells in reach with equal kernel: the volume average, the same everywhere."""
    values = np.random.default_rng(4).uniform(-1, 1, (len(body.volumes), 1))
    mean = np.average(values[:, 0], weights=body.volumes)
    np.testing.assert_allclose(body.average(10.0, "constant")(values), mean, atol=len(values) * EPS)


def limit_weights(monkeypatch: pytest.MonkeyPatch, count: float) -> None:
    """Let a rank compute no more than `count` weights before stress needs them."""
    monkeypatch.setattr(average_module, "LIMITS", replace(average_module.LIMITS, max_initial_weights=count))


@pytest.mark.parametrize("at_once", (0, 5e7), ids=("rows made as needed", "all rows"))
def test_cells_that_may_reach_a_bound_are_found_with_their_averages(
    monkeypatch: pytest.MonkeyPatch, at_once: float
) -> None:
    """None is missed: every cell whose average is as large as the bound is among them, with the same average, whichever
    cells have come apart since the last time, or are whole again."""
    limit_weights(monkeypatch, at_once)
    scene, _ = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.1, "pattern": "unstructured"},
        fracture={"strength": 1.0, "radius": 0.25},
    )
    average, n = NonlocalAverage(scene.domain, 0.25, "linear"), scene.domain.cell_count
    other = NonlocalAverage(scene.domain, 0.25, "linear")
    rng = np.random.default_rng(4)
    some = rng.uniform(size=n) < 0.7
    for active in (None, some, some & (np.arange(n) % 50 > 0), some):
        values = rng.normal(size=(n, 3)) * (1.0 if active is None else active[:, None])
        size = frobenius_norm(values, 2)
        whole = other(values, active)
        bound = float(np.quantile(frobenius_norm(whole, 2), 0.8))
        cells, found = average.find_averages_above(values, size, bound, active)
        np.testing.assert_allclose(found, whole[cells], rtol=1e-12, atol=1e-14)
        assert set(np.flatnonzero(frobenius_norm(whole, 2) >= bound)) <= set(cells)
        assert len(average.find_averages_above(values, size, 1.01 * size.max(), active)[0]) == 0


def test_weights_are_those_of_now_where_few_rows_are_made(monkeypatch: pytest.MonkeyPatch) -> None:
    """A cell that has no row itself, beyond R of the hot one, comes apart: averages between the two leave it out."""
    body = Body(MESHES["2d-unstructured"])
    count, radius = len(body.volumes), 2.7 * H
    limit_weights(monkeypatch, 0)
    few = body.average(radius, "linear")
    size = np.random.default_rng(3).uniform(0.1, 0.3, count)
    size[17] = 5.0
    far = np.linalg.norm(body.centroids - body.centroids[17], axis=1)
    for active in (np.ones(count, bool), ~((far > radius) & (far < 1.5 * radius))):
        values = np.where(active, size, 0.0)[:, None]
        cells, found = few.find_averages_above(values, values[:, 0], 0.3, active)
        np.testing.assert_allclose(found, brute_force(body, radius, "linear", values, active)[cells], rtol=1e-12)
    assert len(cells) > 5 and not np.isin(np.flatnonzero(~active), few._weights.blocks[0].cells).any()


def test_rows_are_made_where_stress_is_high(monkeypatch: pytest.MonkeyPatch) -> None:
    """One hot cell: rows of the cells within R of it and no others, kept from pass to pass, the same to a bit."""
    body = Body(MESHES["2d-unstructured"])
    size = np.zeros(len(body.volumes))
    whole = body.average(2.7 * H, "linear")
    limit_weights(monkeypatch, 0)
    few = body.average(2.7 * H, "linear")
    made = []
    for hot in (17, 17, 90):
        size[:] = np.random.default_rng(hot).uniform(0.1, 0.3, len(size))
        size[hot] = 5.0
        cells, found = few.find_averages_above(size[:, None], size, 0.35)
        expected, averages = whole.find_averages_above(size[:, None], size, 0.35)
        assert len(cells) and np.array_equal(cells, expected) and np.array_equal(found, averages)
        made.append(sum(len(rows.cells) for rows in few._weights.blocks))
    near = np.linalg.norm(body.centroids - body.centroids[[17, 90], None], axis=2) <= 2.7 * H
    assert made == [near[0].sum(), near[0].sum(), near.any(axis=0).sum()] and made[0] < len(size) / 3
    assert np.array_equal(few(size[:, None]), whole(size[:, None])), "all rows, in the order of the cells"
    assert np.array_equal(few.find_averages_above(size[:, None], size, 0.35)[1], averages)
