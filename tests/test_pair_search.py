"""The search for pairs beside all pairs, with distances from points that are spread over both simplices."""

from itertools import product

import numpy as np
import pytest
from scipy.spatial import Delaunay

from fracsim.contact.pair_search import (
    PairFilter,
    PairSearch,
    SimplexPairs,
    free_fractions,
    intersecting_pairs,
    near_pairs,
    pair_distances,
)
from support.intersections import intersecting_elements

COUNT, SIZE, STEPS = 40, 0.15, 16


def soup(dim, corners, seed):
    """(COUNT corners, d) points of simplices that lie about, and (COUNT, corners) their vertices; some share one."""
    rng = np.random.default_rng(seed)
    x = (rng.random((COUNT, 1, dim)) + SIZE * rng.random((COUNT, corners, dim))).reshape(-1, dim)
    simplices = np.arange(COUNT * corners).reshape(COUNT, corners)
    simplices[1::4, 0] = simplices[::4, 0]
    return x, simplices


def spread(corners):
    """(k, corners) barycentric coordinates of points spread over a simplex."""
    numbers = np.array([n for n in product(range(STEPS + 1), repeat=corners) if sum(n) == STEPS])
    return numbers / STEPS


def all_distances(x, pairs):
    """(m, n) distances of all pairs, too large by up to the mesh of the points that are spread."""
    sets = []
    for simplices, centroids in ((pairs.first, pairs.centroids), (pairs.second, False)):
        weights = np.full((1, simplices.shape[1]), 1 / simplices.shape[1]) if centroids else spread(simplices.shape[1])
        sets.append(np.einsum("pc,ncd->npd", weights, x[simplices]))
    return np.array([[np.linalg.norm(a[:, None] - b[None], axis=2).min() for b in sets[1]] for a in sets[0]])


CASES = {"point-segment": (2, 1), "centroid-segment": (2, 2), "point-triangle": (3, 1), "centroid-triangle": (3, 3),
         "edge-edge": (3, 2)}  # fmt: skip


def case(name, seed=1):
    """Points, pairs of a case, and (m, n) flags of those that count."""
    dim, corners = CASES[name]
    x, second = soup(dim, 2 if name.endswith(("segment", "edge")) else 3, seed)
    first = np.arange(len(x))[:, None] if corners == 1 else second
    pairs = SimplexPairs.of(first, second, 0.05, centroids=name.startswith("centroid"))
    counts = ~(first[:, None, :, None] == second[None, :, None, :]).any(axis=(2, 3))
    return x, pairs, np.triu(counts, 1) if name == "edge-edge" else counts


def flags(found, shape):
    result = np.zeros(shape, int)
    np.add.at(result, tuple(found.T), 1)
    assert result.max(initial=0) <= 1
    return result.astype(bool)


@pytest.mark.parametrize("name", CASES)
def test_pairs_at_rest_are_those_within_the_distance(name):
    x, pairs, counts = case(name)
    distance = all_distances(x, pairs)
    found = flags(near_pairs(pairs, PairFilter.of(len(x)), x, x, pairs.distance), distance.shape)
    assert (distance[counts & found] < pairs.distance + 2 * SIZE / STEPS).all()
    assert found[counts & (distance <= pairs.distance)].all() and not found[~counts].any() and found.any()


@pytest.mark.parametrize("name", CASES)
def test_no_pair_that_comes_near_on_the_way_is_missed(name):
    x, pairs, counts = case(name)
    motion = 0.3 * np.random.default_rng(2).normal(size=x.shape)
    found = near_pairs(pairs, PairFilter.of(len(x)), x, x + motion, pairs.distance)
    found = flags(found, counts.shape)
    near = [all_distances(x + t * motion, pairs) <= pairs.distance for t in np.linspace(0, 1, 9)]
    assert found[counts & np.any(near, axis=0)].all() and found.sum() < counts.sum()


@pytest.mark.parametrize("name", CASES)
def test_pairs_of_a_search_serve_all_positions_within_its_margin(name):
    """Near the way, at any time of it; farther away, and beside it, pairs are searched again."""
    x, pairs, counts = case(name)
    rng, margin = np.random.default_rng(3), 0.03
    search, way = PairSearch(PairFilter.of(len(x)), [pairs], margin), 0.1 * rng.normal(size=x.shape)
    along = search.pairs_along(x, x + way)
    for t in (0.0, 0.4, 1.0):
        noise = rng.normal(size=x.shape)
        y = x + t * way + 0.4 * margin * noise / np.linalg.norm(noise, axis=1).max() + 7.0
        assert search.pairs(y) is along
        assert flags(along[0], counts.shape)[counts & (all_distances(y, pairs) <= pairs.distance)].all()
    assert search.pairs_along(x, x + 0.5 * way) is along


@pytest.mark.parametrize("name", CASES)
@pytest.mark.parametrize("share", [0.05, 0.2, 0.6])
def test_pairs_of_vertices_that_leave_the_motion_are_searched_again(name, share):
    """Few or many vertices leave it, others after them, and all return: no near pair is missing or doubled."""
    x, pairs, counts = case(name)
    rng, margin = np.random.default_rng(4), 0.02
    search, way = PairSearch(PairFilter.of(len(x)), [pairs], margin), 0.1 * rng.normal(size=x.shape)
    along, y = search.pairs_along(x, x + way), x + 0.5 * way
    for _ in range(4):
        moved = rng.random(len(x)) < share
        end = y + 10 * margin * moved[:, None] * rng.normal(size=x.shape) + rng.normal(size=x.shape[1])
        found, near = flags(search.pairs_along(y, end)[0], counts.shape), np.zeros(counts.shape, bool)
        for t in (0.0, 0.3, 1.0):
            near |= all_distances(y + t * (end - y), pairs) <= pairs.distance
        assert found[counts & near].all() and not found[~counts].any()
        y = end
    found = flags(search.pairs(x + 0.7 * way)[0], counts.shape)
    assert found[counts & (all_distances(x + 0.7 * way, pairs) <= pairs.distance)].all()
    if share < 0.1:
        assert search.pairs(x + 0.7 * way) is along


@pytest.mark.parametrize("name", CASES)
def test_pairs_of_moved_vertices_are_those_of_all_that_have_one(name):
    x, pairs, _ = case(name)
    where, moved = PairFilter.of(len(x)), np.random.default_rng(6).random(len(x)) < 0.1
    all_pairs = near_pairs(pairs, where, x, x, 0.1)
    found = near_pairs(pairs, where, x, x, 0.1, moved)
    wanted = moved[pairs.first[all_pairs[:, 0]]].any(axis=1) | moved[pairs.second[all_pairs[:, 1]]].any(axis=1)
    assert 0 < wanted.sum() < len(wanted)
    assert {tuple(pair) for pair in found} == {tuple(pair) for pair in all_pairs[wanted]} and len(found) == wanted.sum()


@pytest.mark.parametrize("dim", [2, 3])
def test_intersecting_elements_are_those_of_another_test(dim):
    """Of elements without a common vertex: those with one cross in the support's test by other rules."""
    rng = np.random.default_rng(7)
    x = (0.6 * rng.random((COUNT, 1, dim)) + 0.4 * rng.random((COUNT, dim, dim))).reshape(-1, dim)
    elements = np.arange(COUNT * dim).reshape(COUNT, dim)
    found = intersecting_pairs(elements, PairFilter.of(len(x)), x)
    wanted = intersecting_elements(x, elements)
    assert len(found) > 10 and {tuple(sorted(pair)) for pair in found} == {tuple(sorted(pair)) for pair in wanted}
    patches = np.repeat(np.arange(COUNT) % 2, dim).astype(np.int32)
    apart = intersecting_pairs(elements, PairFilter(patches, np.ones(len(x), bool)), x)
    assert np.array_equal(apart, found[found.sum(axis=1) % 2 == 1]) and len(apart)


def test_an_edge_opposite_to_a_common_vertex_may_pass_through():
    """Two triangles with a common vertex, one folded through the other; unfolded they do not intersect."""
    x = np.array([[0, 0, 0], [2.0, -1, 0], [2, 1, 0], [1.5, 0.0, 1], [1.5, 0.1, -1]])
    elements = np.array([[0, 1, 2], [0, 3, 4]])
    where = PairFilter.of(len(x))
    assert len(intersecting_pairs(elements, where, x)) == 1
    x[4, 2] = 0.5
    assert not len(intersecting_pairs(elements, where, x))


# Heights over the plane; the search counts those below 1e-10 of the sizes as zero.
@pytest.mark.parametrize("height", [1e-3, 1e-8, 1e-9, 1e-10, 1e-11])
def test_triangles_of_a_bent_sheet_do_not_intersect(height):
    """Beside a Delaunay triangulation, whose triangles lie beside each other in the plane and in each bent sheet."""
    rng = np.random.default_rng(8)
    plane = rng.random((600, 2))
    bent = height * (plane[:, 0] ** 2 - 0.7 * plane[:, 1] ** 2 + 0.3 * plane[:, 0] * plane[:, 1])
    x = np.column_stack([plane, bent + 0.1 * height * rng.random(len(plane))])
    elements = Delaunay(plane).simplices
    assert not len(intersecting_pairs(elements, PairFilter.of(len(x)), x))


def test_a_vertex_in_a_triangle_touches_it_and_one_beside_it_does_not():
    triangle = np.array([[0.0, 0, 0], [1, 0, 0], [0, 1, 0]])
    for place, touches in (((0.2, 0.2), True), ((0.5, 0.5), True), ((0.6, 0.5), False), ((-0.1, 0.5), False)):
        for slope in (1.0, 1e-8):  # of an edge that would pass through the triangle beyond its end
            first, upward = np.array([*place, 0.0]), np.array([0.0, 0.0, 1.0])
            second = np.array([1 / 3, 1 / 3, slope])
            x = np.vstack([triangle, first, second, second + upward])
            found = intersecting_pairs(np.arange(6).reshape(2, 3), PairFilter.of(6), x)
            assert bool(len(found)) == touches, (place, slope)


@pytest.mark.parametrize("name", CASES)
def test_patches_and_marks_leave_out_pairs(name):
    x, pairs, _ = case(name)
    all_pairs, reach = near_pairs(pairs, PairFilter.of(len(x)), x, x, 0.1), 0.1
    patches, own = np.zeros(len(x), np.int32), np.zeros(len(x), bool)
    patches[np.unique(pairs.second[: COUNT // 2])] = 1
    patches[pairs.second[COUNT // 2 :]] = 2
    own[pairs.second[: COUNT // 4]] = True
    first, second = pairs.first[all_pairs[:, 0]], pairs.second[all_pairs[:, 1]]
    differ, marked = patches[first[:, 0]] != patches[second[:, 0]], own[first].any(axis=1) | own[second].any(axis=1)
    for where, wanted in ((PairFilter(patches, np.ones(len(x), bool)), differ),
                          (PairFilter(PairFilter.of(len(x)).patches, own), marked)):  # fmt: skip
        assert 0 < wanted.sum() < len(wanted)
        assert np.array_equal(near_pairs(pairs, where, x, x, reach), all_pairs[wanted])


def test_positions_that_are_no_numbers_end_the_search():
    x, pairs, _ = case("point-triangle")
    for value in (np.nan, np.inf):
        y = x.copy()
        y[5] = value
        near_pairs(pairs, PairFilter.of(len(x)), x, y, 0.05)


@pytest.mark.parametrize("name", CASES)
def test_distances_of_pairs_are_those_of_points_spread_over_both(name):
    x, pairs, counts = case(name)
    numbers = np.argwhere(counts)
    found, above = pair_distances(pairs, numbers, x), all_distances(x, pairs)[counts]
    sizes = [np.ptp(x[corners], axis=1).sum(axis=1) for corners in (pairs.first, pairs.second)]
    spacing = (sizes[0][numbers[:, 0]] + sizes[1][numbers[:, 1]]) / STEPS
    assert (found <= above + 1e-12).all() and (found >= above - spacing).all()


@pytest.mark.parametrize("name", ["point-segment", "point-triangle", "edge-edge"])
def test_pairs_keep_a_tenth_of_their_distance_and_move_as_far_as_they_may(name):
    """Along the free part of the way no pair is nearer; beyond it, pairs that were stopped are."""
    x, pairs, counts = case(name)
    numbers, end = np.argwhere(counts), x + 0.3 * np.random.default_rng(3).normal(size=x.shape)
    free, first = free_fractions(pairs, numbers, x, end, 0.1, 100), pair_distances(pairs, numbers, x)
    stopped = free < 1
    assert 20 < stopped.sum() < len(free) and (free[first > 0] > 0).all()
    for pair, fraction, least in zip(numbers, free, 0.1 * first, strict=True):
        way = [float(pair_distances(pairs, pair[None], x + t * (end - x))[0]) for t in np.linspace(0, fraction, 20)]
        assert min(way) >= least * (1 - 1e-9)
    beyond = np.linspace(1, 1.03, 13)
    for pair, fraction, least in zip(numbers[stopped], free[stopped], 0.1 * first[stopped], strict=True):
        ways = fraction * beyond
        assert min(float(pair_distances(pairs, pair[None], x + t * (end - x))[0]) for t in ways) < 1.3 * least


@pytest.mark.parametrize("height", [1e-9, 1e-3])
def test_pairs_that_slide_are_free(height):
    """A point and an edge over a triangle and an edge, moved along them by many times the height."""
    x = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0.2, 0.2, height], [0.6, 0.2, height]])
    end = x + np.array([[0, 0, 0]] * 3 + [[0.3, 0.3, 0]] * 2)
    over_triangle = SimplexPairs.of(np.array([[3]]), np.array([[0, 1, 2]]), 0.1)
    edges = np.array([[0, 1], [3, 4]])
    for pairs, numbers in ((over_triangle, [[0, 0]]), (SimplexPairs.of(edges, edges, 0.1), [[0, 1]])):
        assert free_fractions(pairs, np.array(numbers), x, end, 0.1, 100)[0] == 1
