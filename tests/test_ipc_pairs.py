"""Contact of a surface with itself on plain arrays: barrier, friction, collisions, and the sides of a new crack."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI
from scipy.spatial import Delaunay

from fracsim.mesh.split_surface.entity_numbering import EntityNumbering
from fracsim.meshes.builders.cylinder import Cylinder, Disk
from fracsim.meshes.data import MeshData
from support.solids import four_cells, lattice, separated, torn, two_cells

pytest.importorskip("ipctk", reason="an environment made without a network")
from fracsim.contact.ipc_pairs import PAIRS, IpcPairs, PairShare
from fracsim.contact.retractable_surface import offset_crack_faces

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
REACH, STIFF = 0.05, 1e3


def ring(count: int, low: float, high: float) -> tuple[Values, Ints]:
    """A rectangle of width 1 from y = low to high, its long sides cut into `count` segments."""
    across = np.linspace(0, 1, count + 1)
    points = np.concatenate([np.stack([across, 0 * across + low], 1), np.stack([across[::-1], 0 * across + high], 1)])
    here = np.arange(len(points))
    return points, np.stack([here, np.roll(here, -1)], 1)


def sheet(count: int, seed: int) -> tuple[Values, Ints]:
    """A triangulation of the unit square: count x count squares, their inner points moved at random."""
    points = np.stack(np.meshgrid(*[np.linspace(0, 1, count + 1)] * 2, indexing="ij"), -1).reshape(-1, 2)
    inner = np.all((points > 0) & (points < 1), axis=1)
    points[inner] += np.random.default_rng(seed).uniform(-0.3, 0.3, (inner.sum(), 2)) / count
    corners = Delaunay(points).simplices.astype(np.int64)
    turn = np.linalg.det(points[corners[:, 1:]] - points[corners[:, :1]])
    return points, np.where(turn[:, None] > 0, corners, corners[:, ::-1])[np.abs(turn) > 1e-9]


def box(count: int, low: float, high: float, seed: int) -> tuple[Values, Ints]:
    """A box of base 1 x 1 from z = low to high: two triangulations, and quads cut in two around them."""
    (upper, top), (lower, bottom) = sheet(count, seed), sheet(count, seed + 100)
    points = np.concatenate([np.insert(upper, 2, high, axis=1), np.insert(lower, 2, low, axis=1)])
    angle = np.arctan2(*(upper - 0.5).T)
    rim = np.flatnonzero(np.any((upper == 0) | (upper == 1), axis=1))
    rim = rim[np.argsort(-angle[rim])]  # anticlockwise; the rims of both lie above each other, in the same order
    over, under, count = np.roll(rim, -1), rim + len(upper), len(upper)
    sides = [np.stack([under, over + count, over], 1), np.stack([under, over, rim], 1)]
    return points, np.concatenate([top, bottom[:, ::-1] + count, *sides])


def stacked(dim: int, gap: float, counts: tuple[int, int] = (4, 4), seeds: tuple[int, int] = (1, 2)) -> tuple:
    """(points, elements, which points are the upper body's) of two squares (boxes) of height 0.2 with a gap between."""
    if dim == 2:
        lower, upper = ring(counts[0], 0, 0.2), ring(counts[1], 0.2 + gap, 0.4 + gap)
    else:
        lower, upper = box(counts[0], 0, 0.2, seeds[0]), box(counts[1], 0.2 + gap, 0.4 + gap, seeds[1])
    points = np.concatenate([lower[0], upper[0]])
    return points, np.concatenate([lower[1], upper[1] + len(lower[0])]), np.arange(len(points)) >= len(lower[0])


def rough(dim: int) -> tuple[IpcPairs, Values, npt.NDArray[np.bool_]]:
    """Two bodies pressed together aslant; where their points are, and which are the upper one's."""
    points, elements, upper = stacked(dim, 0.7 * REACH, (3, 4))
    rng = np.random.default_rng(3)
    points = points + upper[:, None] * np.array([0.21, 0.13, 0.0])[3 - dim :] + rng.normal(size=points.shape) * 3e-3
    pairs = IpcPairs(points, elements, distance=REACH, stiffness=STIFF, friction=0.5)
    if dim == 3:  # near enough for edges against edges too
        points = points - upper[:, None] * np.array([0, 0, 0.35 * REACH])
    return pairs, points, upper


def slope(function, x: Values, step: float) -> Values:
    """(x.size, ...) central differences."""
    units = np.eye(x.size).reshape(-1, *x.shape) * step
    return np.array([(function(x + each) - function(x - each)) / (2 * step) for each in units])


def assert_derivatives(made, x: Values, step: float) -> None:
    """Gradient and exact Hessian against differences; the projected Hessian has no negative eigenvalue."""
    gradient, hessian = made.gradient(x), made.hessian(x, exact=True).toarray()
    assert np.abs(gradient).max() > 0
    found = slope(made.energy, x, step).reshape(x.shape)
    assert np.abs(found - gradient).max() < 1e-6 * np.abs(gradient).max()
    found = slope(lambda at: made.gradient(at).ravel(), x, step)
    size = np.abs(hessian).max() + np.abs(gradient).max()  # sliding in 2D does not change the force
    assert np.abs(found - hessian).max() < 1e-6 * size
    assert np.linalg.eigvalsh(made.hessian(x).toarray())[0] > -1e-12 * size


@pytest.mark.parametrize("dim", [2, 3])
def test_derivatives(dim):
    pairs, x, _ = rough(dim)
    assert_derivatives(pairs, x, 1e-6)


@pytest.mark.parametrize("dim", [2, 3])
def test_derivatives_of_friction(dim):
    pairs, x, _ = rough(dim)
    friction = pairs.lag_friction(x, x, 1e-3)
    for size in (2e-4, 2e-2):  # sticking, sliding
        assert_derivatives(friction, x + np.random.default_rng(1).normal(size=x.shape) * size, 1e-7)


class OneOfSeveral:
    """Rank `rank` of `size`, alone: nothing is reduced."""

    def __init__(self, rank: int, size: int) -> None:
        self.rank, self.size = rank, size

    def allreduce(self, value, op=MPI.SUM):
        return value

    def Allreduce(self, values, result, op=MPI.SUM):
        result[:] = values


def shares_of(points: Values, elements: Ints, ranks: int, obstacle: int | None) -> list[IpcPairs]:
    """The pairs of each rank; `obstacle`: its number of points behind those of a body, None: a body with itself."""
    law, shares = {"distance": REACH, "stiffness": STIFF, "friction": 0.5}, []
    patch = np.repeat(np.arange(2, dtype=np.int32), [len(points) - (obstacle or 0), obstacle or 0])
    for rank in range(ranks):
        points_of_rank = np.digitize(points[:, 0], np.quantile(points[:, 0], np.arange(1, ranks) / ranks)) == rank
        share = PairShare(OneOfSeveral(rank, ranks), points_of_rank & (patch == 0), np.ones(len(points), bool))
        shares.append(IpcPairs(points, elements, **law, share=share, patch=None if obstacle is None else patch))
    return shares


@pytest.mark.parametrize("of_obstacle", [False, True])
@pytest.mark.parametrize(("dim", "ranks"), [(2, 2), (2, 5), (3, 2), (3, 5)])
def test_shares_of_ranks_add_up(dim, ranks, of_obstacle):
    """Of all pairs at all points, whose features are corners, edges and faces; with friction. No share is all."""
    whole, x, upper = rough(dim)
    points, elements, _ = stacked(dim, 0.7 * REACH, (3, 4))
    end = x - upper[:, None] * np.array([0.0, 0.0, 2 * REACH])[3 - dim :]
    points = whole.collision_mesh.rest_positions
    parts = shares_of(points, elements, ranks, int(upper.sum()) if of_obstacle else None)
    moved = x + np.random.default_rng(1).normal(size=x.shape) * 2e-3
    for of in (lambda pairs: pairs, lambda pairs: pairs.lag_friction(x, x, 1e-3)):
        made, shares = of(whole), [of(part) for part in parts]
        assert sum(part.energy(moved) for part in shares) == pytest.approx(made.energy(moved), rel=1e-12)
        gradient, shared = made.gradient(moved), [part.gradient(moved) for part in shares]
        np.testing.assert_allclose(np.sum(shared, axis=0), gradient, atol=1e-12 * np.abs(gradient).max())
        assert sum(part.any() for part in shared) > 1
        for exact in (True, False):
            H = made.hessian(moved, exact=exact).toarray()
            total = sum(part.hessian(moved, exact=exact) for part in shares).toarray()
            np.testing.assert_allclose(total, H, atol=1e-12 * np.abs(H).max())
    assert min(part.min_gap(x) for part in parts) == whole.min_gap(x)
    assert min(part.free_fraction(x, end) for part in parts) == pytest.approx(whole.free_fraction(x, end), rel=1e-12)
    assert whole.free_fraction(x, end) < 1


@pytest.mark.parametrize("dim", [2, 3])
def test_action_is_reaction(dim):
    pairs, x, _ = rough(dim)
    force = -pairs.gradient(x)
    assert np.abs(force.sum(0)).max() < 1e-12 * np.abs(force).sum()
    torque = np.einsum("ni,nj->ij", x, force)
    assert np.abs(torque - torque.T).max() < 1e-12 * np.abs(force).sum()


def pressure(gap: float, reach: float = REACH) -> float:
    """k |b'(gap)| of the module's equation for a barrier from `reach` on, Pa; 0 beyond it."""
    s = min(gap / reach, 1.0) ** 2
    return STIFF * reach * (2 * (s - 1) * np.log(s) + (s - 1) ** 2 / s) * 2 * gap / reach**2


@pytest.mark.parametrize("share", [0.9, 0.55])
@pytest.mark.parametrize("dim", [2, 3])
def test_pressure_does_not_depend_on_the_mesh(dim, share):
    """Faces of area 1, by their centroids. To vertices on the rim half of the sides' area belongs, 0.8, in 2D half of
    the sides' length; vertices are pressed from vertex_distance of the distance on."""
    gap = share * REACH
    area = 1 + 0.4 if dim == 3 else 1 + 0.2
    expected = pressure(gap) + area * pressure(gap, PAIRS.vertex_distance * REACH)
    for counts, seeds in (((4, 4), (1, 2)), ((4, 4), (3, 3)), ((5, 13), (5, 6)), ((16, 16), (7, 8))):
        x, elements, upper = stacked(dim, gap, counts, seeds)
        force = -IpcPairs(x, elements, distance=REACH, stiffness=STIFF).gradient(x)[upper]
        assert force[:, -1].sum() == pytest.approx(expected, rel=1e-6)


@pytest.mark.parametrize("dim", [2, 3])
def test_faces_with_rims_above_one_another_press_along_their_normal(dim):
    """Shifted by less than a centroid's distance from the rim, too. By vertices it was 0.18 F dx / g across."""
    x, elements, upper = stacked(dim, 0.9 * REACH)
    pairs = IpcPairs(x, elements, distance=REACH, stiffness=STIFF)
    for shift in (0.0, 1e-6, 1e-3, -0.02):
        force = -pairs.gradient(x + upper[:, None] * np.eye(dim)[0] * shift)[upper].sum(axis=0)
        assert abs(force[:-1]).max() < 1e-12 * force[-1]


def test_edges_carry_more_when_pressed_below_half_of_the_distance():
    """What is left of the mesh there: within 15 % between meshes of like size."""
    found = []
    for seeds in ((1, 2), (3, 3), (5, 6)):
        x, elements, upper = stacked(3, 0.3 * REACH, (8, 8), seeds)
        found.append(-IpcPairs(x, elements, distance=REACH, stiffness=STIFF).gradient(x)[upper, -1].sum())
    assert max(found) < 1.15 * min(found)
    assert min(found) > pressure(0.3 * REACH)


@pytest.mark.parametrize("dim", [2, 3])
def test_energy_is_the_work_on_the_way(dim):
    """No jump while points pass over elements, edges and corners, and while candidates are found anew."""
    pairs, x, upper = rough(dim)
    way = upper[:, None] * np.array([0.17, 0.11, 0.03])[3 - dim :]
    share = np.linspace(0, 1, 501)
    energy = np.array([pairs.energy(x + each * way) for each in share])
    rate = np.array([np.sum(pairs.gradient(x + each * way) * way) for each in share])
    work = (rate[1:] + rate[:-1]) / 2 * np.diff(share)
    assert np.abs(np.diff(energy) - work).max() < 1e-3 * np.abs(work).max()
    again = IpcPairs(x, stacked(dim, 0.7 * REACH, (3, 4))[1], distance=REACH, stiffness=STIFF)
    assert again.energy(x + way) == pytest.approx(energy[-1], rel=1e-10)


@pytest.mark.parametrize("dim", [2, 3])
def test_nothing_passes(dim):
    pairs, x, _ = rough(dim)
    rng = np.random.default_rng(5)
    assert pairs.free_fraction(x, x) == 1
    for size in np.repeat([1e-3, 1e-1, 10.0], 30):
        to = x + rng.normal(size=x.shape) * size
        step = pairs.free_fraction(x, to)
        assert 0 < step <= 1
        assert len(pairs.intersections(x + step * (to - x))) == 0


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("gap", [0.3 * REACH, 0.7 * REACH])
def test_ways_too_short_to_meet_ask_no_collision_detection(dim, gap, monkeypatch):
    """The upper box comes down, whole: on either side of the length from which detection is asked, a tenth of the gap
    is left."""
    x, elements, upper = stacked(dim, gap)
    pairs = IpcPairs(x, elements, distance=REACH, stiffness=STIFF)
    asked = []
    free = pairs._piece_fraction
    monkeypatch.setattr(pairs, "_piece_fraction", lambda *ends: asked.append(1) or free(*ends))
    for length in np.linspace(0.02, 1.5, 60) * gap:
        asked.clear()
        way = -length * upper[:, None] * np.eye(dim)[-1]
        share = pairs.free_fraction(x, x + way)
        assert gap - share * length >= 0.09 * gap
        assert share == 1 or asked
        assert asked or length < 0.91 * min(gap, 0.5 * REACH) / max(upper.mean(), 1 - upper.mean()) / 2
    assert asked


@pytest.mark.parametrize("dim", [2, 3])
def test_a_fast_body_is_stopped(dim):
    """The upper one thrown through the lower one, from far off: at the end of the way they are apart again."""
    x, elements, upper = stacked(dim, 3.0)
    pairs = IpcPairs(x, elements, distance=REACH, stiffness=STIFF)
    to = x - upper[:, None] * np.array([0, 0, 7.0])[3 - dim :]
    assert len(pairs.intersections(to)) == 0
    assert 3 / 7 * 0.8 < pairs.free_fraction(x, to) < 3 / 7
    assert pairs.free_fraction(x, x + (x - to)) == 1


@pytest.mark.parametrize("dim", [2, 3])
def test_overlap_at_the_start_is_found(dim):
    x, elements, upper = stacked(dim, 0.02)
    pairs = IpcPairs(x, elements, distance=REACH, stiffness=STIFF)
    assert len(pairs.intersections(x)) == 0
    found = pairs.intersections(x - upper[:, None] * np.array([0.03, 0.05, 0.07])[3 - dim :])
    assert len(found) > 0
    assert found.shape[1] == 2


@pytest.mark.parametrize("dim", [2, 3])
def test_friction_is_coulombs(dim):
    """Full slip: mu N against the sliding, and half of it or less where it sticks."""
    x, elements, upper = stacked(dim, 0.7 * REACH)
    pairs = IpcPairs(x, elements, distance=REACH, stiffness=STIFF, friction=0.3)
    normal = -pairs.gradient(x)[upper, -1].sum()
    friction = pairs.lag_friction(x, x, 1e-3)
    for slid, share in ((5e-3, 1.0), (-5e-3, -1.0), (1e-4, 0.19)):
        to = x + upper[:, None] * np.eye(dim)[0] * slid
        force = -friction.gradient(to)[upper].sum(0)
        assert force[0] == pytest.approx(-share * 0.3 * normal, rel=1e-9)
        assert abs(force[-1]) < 1e-9 * normal
    each = np.linalg.norm(friction.gradient(to), axis=1)
    assert np.all(each <= 0.3 * np.abs(pairs.gradient(x)[:, -1]) * (1 + 1e-9) + 1e-12)
    assert friction.energy(x) == pytest.approx(0.3 * normal * 1e-3 / 3)


def test_points_of_no_element_are_let_alone():
    """As the inner nodes of a 2D mesh: at the very place of a segment."""
    x, elements, _ = stacked(2, 0.7 * REACH)
    more = np.concatenate([x, [[0.5, 0.2]]])
    pairs, other = (IpcPairs(each, elements, distance=REACH, stiffness=STIFF) for each in (x, more))
    assert np.array_equal(other.gradient(more), np.append(pairs.gradient(x), [[0, 0]], axis=0))
    assert other.hessian(more).shape == (2 * len(more),) * 2


# --- the sides of a new crack ---

MESHES = {
    "two": two_cells,
    "four": four_cells,
    "lattice": lambda dim: lattice(*[3] * dim),
    "gmsh": lambda dim: (Disk(radius=1.0, h=0.2) if dim == 2 else Cylinder(radius=0.5, length=1.0, h=0.25)).build(),
}


def cracks(mesh: MeshData) -> dict[str, npt.NDArray[np.bool_]]:
    """Broken edges (E,): a crack through the body, one that ends in it, one edge, a fifth and all of them."""
    skeleton = EntityNumbering(mesh)
    across, up = skeleton.points[skeleton.edges].mean(axis=1)[:, :2].T
    through = separated(skeleton, mesh.points[:, 0] > np.median(mesh.points[:, 0]) + 1e-3)
    some = np.random.default_rng(0).random(len(across))
    half = through & (up < np.median(up))
    return {"through": through, "half": half, "one": some == some.max(), "fifth": some < 0.2, "all": some >= 0}


@pytest.mark.parametrize("dim", [2, 3])
@pytest.mark.parametrize("name", MESHES)
def test_no_force_at_the_moment_of_breaking(name, dim):
    mesh = MESHES[name](dim)
    edge = shortest(mesh)
    for broken in cracks(mesh).values():
        made = torn(mesh, broken)
        x = offset_crack_faces(made, 2 * 0.03 * edge)
        pairs = IpcPairs(x, made.elements, distance=0.03 * edge, stiffness=1.0)
        assert len(pairs.intersections(x)) == 0
        assert pairs.energy(x) == 0
        assert np.all(pairs.gradient(x) == 0)


@pytest.mark.parametrize("dim", [2, 3])
def test_closed_crack_carries_load(dim):
    """A body cut across, its halves pressed together by 0.3 to 0.9 of the reach: they push back, ever harder."""
    mesh = lattice(*[4] * dim, size=0.25)
    skeleton = EntityNumbering(mesh)
    made = torn(mesh, separated(skeleton, mesh.points[:, 0] > 0.6))
    reach = 0.03 * 0.25
    x = offset_crack_faces(made, 1.1 * reach)
    pairs = IpcPairs(x, made.elements, distance=reach, stiffness=1.0)
    right = mesh.points[made.parents.first_parent, 0] > 0.6
    assert pairs.energy(x) == 0
    closed = [x - right[:, None] * np.eye(dim)[0] * share * reach for share in (0.3, 0.6, 0.9)]
    force = [-pairs.gradient(each)[right, 0].sum() for each in closed]
    assert 0 < 3 * force[0] < 2 * force[1] < force[2]
    assert all(len(pairs.intersections(each)) == 0 for each in closed)


def shortest(mesh: MeshData) -> float:
    ends = mesh.points[EntityNumbering(mesh).edges]
    return float(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1).min())
