"""The non-local average (M22 eq. 13) against the dense double sum over all cells, and what it must reproduce."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.distance import cdist

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


@pytest.mark.filterwarnings("error:overflow")
@pytest.mark.parametrize("radius", (1e-3 * H, 1e-300))
@pytest.mark.parametrize("kernel", KERNELS)
def test_a_small_radius_is_local(body: Body, kernel: str, radius: float) -> None:
    """With no other centroid in reach each cell keeps its value."""
    values = np.random.default_rng(3).uniform(-1, 1, (len(body.volumes), 3))
    average, norms = body.average(radius, kernel), np.linalg.norm(values, axis=1)
    np.testing.assert_allclose(average(values), values, rtol=4 * EPS)
    bound = float(np.median(norms))
    np.testing.assert_array_equal(average.find_averages_above(values, norms, bound)[0], np.flatnonzero(norms >= bound))


def test_a_large_constant_kernel_is_the_mean_over_the_body(body: Body) -> None:
    """All cells in reach with equal kernel: the volume average, the same everywhere."""
    values = np.random.default_rng(4).uniform(-1, 1, (len(body.volumes), 1))
    mean = np.average(values[:, 0], weights=body.volumes)
    np.testing.assert_allclose(body.average(10.0, "constant")(values), mean, atol=len(values) * EPS)


@pytest.mark.parametrize("kernel", KERNELS)
@pytest.mark.parametrize("shift", (0.0, 1e4), ids=("", "far from the origin"))
@pytest.mark.parametrize("radius", (2.7 * H, 0.8), ids=("near", "far"))
def test_cells_that_reach_a_bound_are_found_with_their_averages(
    body: Body, kernel: str, radius: float, shift: float
) -> None:
    """None is missed by the first look in single precision: exactly the cells whose average of the norms reaches the
    bound are found, whichever cells have come apart since the last time, or are whole again."""
    count, rng = len(body.volumes), np.random.default_rng(4)
    body.domain.nodes[:] += shift
    average = body.average(radius, kernel)
    body.domain.nodes[:] -= shift
    some = rng.uniform(size=count) < 0.7
    for active in (None, some, some & (np.arange(count) % 50 > 0), some):
        enters = np.ones(count) if active is None else active.astype(float)
        values = rng.normal(size=(count, 3)) * enters[:, None]
        norms = np.linalg.norm(values, axis=1)
        expected = brute_force(body, radius, kernel, np.column_stack([norms, values]), enters)
        bound = float(np.quantile(expected[:, 0], 0.8)) * (1 + 1e-9)
        cells, found = average.find_averages_above(values, norms, bound, active)
        np.testing.assert_array_equal(cells, np.flatnonzero(expected[:, 0] >= bound))
        np.testing.assert_allclose(found, expected[cells, 1:], atol=count * EPS * max(shift, 1.0))
        assert len(average.find_averages_above(values, norms, 1.01 * norms.max(), active)[0]) == 0


@pytest.mark.parametrize("kernel", KERNELS)
def test_sums_over_bins_bound_averages(kernel: str) -> None:
    """Of the cells near a loaded end they exclude most whose average is below 1, and none that reaches it."""
    body = Body({"builder": "box", "size": [2.0, 0.5, 0.5], "h": 0.06})
    average = body.average(0.35, kernel)
    load = 1.2 - body.centroids[:, 0]
    bins, order = average._bins, average._bins.order
    assert bins.are_coarse
    active = np.random.default_rng(0).uniform(size=len(load)) < 0.9
    volumes = (body.volumes * active)[order]
    near = bins.near_any((load[order] >= 1) & (volumes > 0))
    may_reach = bins.may_reach_one(load[order], volumes)
    reaches = average(load[:, None], active)[:, 0] >= 1
    assert reaches.any() and np.all(may_reach[reaches]) and np.all(near[reaches])
    assert 2 * np.sum(near & ~may_reach) > np.sum(near & ~reaches)


def test_one_loaded_cell_raises_the_averages_around_it(body: Body) -> None:
    """A load as large as can be is found wherever its weight is not 0, and nowhere else."""
    norms = np.zeros(len(body.volumes))
    norms[17] = 1e250
    radius = 2.7 * H
    cells, _ = body.average(radius, "linear").find_averages_above(norms[:, None], norms, 1.0)
    distance = np.linalg.norm(body.centroids - body.centroids[17], axis=1)
    np.testing.assert_array_equal(cells, np.flatnonzero(distance < radius))
