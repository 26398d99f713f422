"""Struck bodies break along surfaces, and their pieces go on as they moved."""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from fracsim.fracture.brittle.grains import GrainParameters, SurfaceParameters
from fracsim.rigid.bodies import Bodies
from fracsim.rigid.breakage import BreakableBody
from fracsim.rigid.surface_loads import locate_forces
from support.rigid import breakable, density_of, moments_of
from support.solids import copies, lattice

Values = npt.NDArray[np.float64]


def bent(strength: float, **rules: object) -> tuple[BreakableBody, int]:
    """A bar of 3 x 1 x 1 m, struck from above in its middle over two supports, and how many edges broke."""
    body = breakable(lattice(12, 4, 4, size=0.25), strength, SurfaceParameters(**({"surfaces": 1} | rules)))  # type: ignore[arg-type]
    points = np.array([[1.5, 0.5, 1.0], [0.1, 0.5, 0.0], [2.9, 0.5, 0.0]])
    force = 1e5 * np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    return body, body.break_fragments(0, body.distribute_forces(0, points, force))


def test_a_bar_bent_over_two_supports_breaks_across_its_middle() -> None:
    """The largest tension is below the blow and along the bar: two halves, cut where x = 1.5 m within an edge."""
    body, broken = bent(3e5)
    assert broken > 0 and body.fragments.count == 2
    volume, centre = moments_of(body).volume, moments_of(body).centre
    assert np.allclose(volume, 1.5, atol=0.25)
    assert np.allclose(np.sort(centre[:, 0]), [0.75, 2.25], atol=0.15)
    assert bent(8e5)[1] == 0, "the same bar of a stronger stuff stays whole"


def test_pieces_are_struck_in_turn_until_nothing_breaks() -> None:
    """A weaker bar breaks once more in its halves, each of them free and bent by what falls on it."""
    once, _ = bent(1e5, surfaces=1)
    until, _ = bent(1e5, surfaces=20, per_pass=1)
    assert until.fragments.count > once.fragments.count == 2
    assert until.analyses.count > until.fragments.count


def test_pieces_keep_momentum_spin_and_energy() -> None:
    """A bar that flies and tumbles breaks: sums of m v, of m x x v + I w, and of the kinetic energy stay to round-off,
    though each piece is weighed by itself; places of points at rest do not move."""
    body, _ = bent(3e5, surfaces=8)
    assert body.fragments.count > 2
    whole = moments_of(breakable(lattice(12, 4, 4, size=0.25), 1.0, SurfaceParameters(1)))
    start = Bodies.at_rest(density_of(whole), whole)
    turn = Rotation.from_rotvec([[0.3, -1.2, 0.5]]).as_matrix()
    motion = np.array([[3.0, -2.0, 9.0]]), np.array([[4.0, 5.0, -6.0]])
    start = Bodies(start.mass, start.centre, start.inertia, start.position + 7.0, turn, *motion)
    parts = moments_of(body)
    density = float(start.mass[0] / whole.volume[0])
    after = start.at_new_shapes(density, parts, np.zeros(len(parts.volume), int))
    assert np.allclose(after.mass.sum(), start.mass.sum(), rtol=1e-14)
    assert np.allclose(after.momentum, start.momentum, rtol=1e-13)
    assert np.allclose(after.angular_momentum, start.angular_momentum, rtol=1e-13)
    assert after.kinetic_energy == pytest.approx(start.kinetic_energy, rel=1e-13)
    X = np.random.default_rng(0).random((5, 3))
    assert np.allclose(
        after.to_current(X, np.arange(5) % len(after)), start.to_current(X, np.zeros(5, int)), atol=1e-13
    )
    assert np.allclose(after.to_reference(after.to_current(X, np.ones(5, int)), 1), X, atol=1e-13)


def test_a_piece_breaks_alone() -> None:
    """Two bars in one mesh: the one that is struck breaks, and the other is left as it was, whatever its grains."""
    mesh = copies(lattice(6, 2, 2, size=0.25), 2)
    body = breakable(mesh, 1e3, SurfaceParameters(6, grains=GrainParameters(6, seed=2)))
    assert body.fragments.count == 2
    points = np.array([[0.75, 0.25, 0.5], [0.1, 0.25, 0.0], [1.4, 0.25, 0.0]])
    force = 1e5 * np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    body.break_fragments(0, body.distribute_forces(0, points, force))
    other = body.graph.domain.input_numbering.nodes[body.graph.edge_nodes] >= len(mesh.points) // 2
    assert body.fragments.count > 2
    assert body.graph.broken[~other.any(axis=1)].any() and not body.graph.broken[other.all(axis=1)].any()


def test_crumbs_break_no_more() -> None:
    """A piece without a whole cell is a rigid body: no blow is analysed on it."""
    body = breakable(lattice(2, 2, 2), 1.0, SurfaceParameters(5))
    domain = body.graph.domain
    body.graph.break_edges((body.graph.edge_nodes == domain.cell_nodes[0, 0]).any(axis=1))
    body = BreakableBody(body.analyses.stiffness, body.graph, body._criterion, body._average)
    crumb = int(body.fragments.node_fragment[domain.cell_nodes[0, 0]])
    passes = body.analyses.count
    loads = body.distribute_forces(crumb, domain.nodes[domain.cell_nodes[:1, 0]], np.array([[0.0, 0.0, 1e9]]))
    assert body.break_fragments(crumb, loads) == 0 and body.analyses.count == passes


def test_forces_are_handed_to_nodes_with_their_moment() -> None:
    """Points inside and on the body: sum and moment stay. One outside goes to the nearest place of the body."""
    mesh = lattice(3, 3, 3)
    rng = np.random.default_rng(4)
    points, force = 3 * rng.random((30, 3)), rng.normal(size=(30, 3))
    nodal = locate_forces(mesh.points, mesh.cells, points, force).nodal_forces(len(mesh.points))
    assert np.allclose(nodal.sum(axis=0), force.sum(axis=0))
    assert np.allclose(np.cross(mesh.points, nodal).sum(axis=0), np.cross(points, force).sum(axis=0))
    outside = locate_forces(mesh.points, mesh.cells, np.array([[1.3, 1.4, 3.2]]), force[:1])
    at = np.einsum("knd,kn->kd", mesh.points[outside.nodes], outside.weights)
    assert np.allclose(at, [[1.3, 1.4, 3.0]], atol=0.1)


def test_a_crack_that_ends_in_a_body_is_open_and_solved() -> None:
    """Half of the middle section is cut: one piece still, solved for by CG, and bent further at the crack's tip."""
    found = []
    for cut in (False, True):
        body = breakable(lattice(8, 4, 4, size=0.25), 1e9, SurfaceParameters(1))
        X = body.graph.domain.nodes[body.graph.edge_nodes]
        across = (X[:, :, 0] > 1.1).any(axis=1) & (X[:, :, 0] < 1.1).any(axis=1) & (X[:, :, 2] < 0.6).all(axis=1)
        body.graph.break_edges(across & cut)
        body = BreakableBody(body.analyses.stiffness, body.graph, body._criterion, body._average)
        assert body.fragments.count == 1
        points = np.array([[1.0, 0.5, 1.0], [0.1, 0.5, 0.0], [1.9, 0.5, 0.0]])
        force = np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
        found.append(body.analyses.analyse(0, body.distribute_forces(0, points, force))[:, 0].max())
    assert found[1] > 1.5 * found[0]
