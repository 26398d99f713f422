"""Brittle cracks as surfaces: planar cuts against a formula, older cracks, starts, curving, invariance, limits."""

from __future__ import annotations

import csv
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI
from pydantic import ValidationError
from scipy.spatial.distance import cdist

from cases import fracsim, write_study
from fracsim.deformable_run import Run
from fracsim.errors import Stopped
from fracsim.fracture.brittle.crack_level_set import DirectionField
from fracsim.fracture.brittle.surface_cut import (
    CUT,
    SurfaceCutMesh,
    reassign_isolated_nodes,
    sides_of_level_set,
)
from fracsim.fracture.brittle.surface_pass import StartCandidates
from fracsim.fracture.principal_stress import (
    EQUAL_STRESS_TOLERANCE,
    first_principal_directions,
    first_principal_stress,
    material_normals,
)
from fracsim.meshes.data import MeshData
from fracsim.scene import Scene, build_scene
from fracsim.study import MeshSettings
from fracsim.study.mesh_source import build_mesh
from support.brittle import cut_points, enclosed, open_at, scene_surface, volume_above
from support.laws import rotation
from support.scenes import deform, make_scene, make_study, march, mesh_of, positions

EPS = np.finfo(float).eps
UNSTRUCTURED = {"pattern": "unstructured"}
ROUND_OFF = 1e3 * EPS  # of sums over some thousand triangles


def box(dim: int, h: float = 0.1) -> MeshData:
    size = [1.0, 0.8, 0.5][:dim]
    return build_mesh(MeshSettings.model_validate({"builder": "box", "size": size, "h": h, "pattern": "unstructured"}))


def stretched(dim: int, n: list[float], stretch: float = 0.06) -> Any:
    """F that stretches along n."""
    along = np.array(n[:dim]) / np.linalg.norm(n[:dim])
    return np.eye(dim) + stretch * np.outer(along, along)


def strained(dim: int, F: Any, energy: str = "linear", **tables: Any) -> Scene:
    """A block of E = 1, nu = 0 given the homogeneous deformation F; strength 0.05."""
    tables = {"fracture": {"strength": 0.05, "approach": "chi"}, "brittle": {"surfaces": 1}} | tables
    mesh = {"builder": "box", "size": [1.0, 0.8, 0.5][:dim], "h": 0.1, "pattern": "unstructured"}
    material = {"energy": energy, "young": 1.0, "poisson": 0.0, "density": 1.0}
    scene, _ = make_scene(**({"mesh": mesh, "material": material} | tables))
    deform(scene, F)
    return scene


def cuts(scene: Scene) -> tuple[Any, Any]:
    """(n, 2) sorted keys of the edges that surfaces cut, and where."""
    cut = scene.fracture.criterion.cut_positions
    own = np.flatnonzero(~np.isnan(cut))
    keys = scene.fracture.graph.keys.of_edges(own)
    order = np.lexsort(keys.T[::-1])
    return keys[order], cut[own][order]


# --- quadratic cells ---


@pytest.mark.parametrize("dim", (2, 3))
def test_quadratic_cells_are_cut_as_linear_ones(dim: int) -> None:
    """Of one deformation of the whole body: the same edges, at the same places, and the same pieces."""
    found = []
    for order in (1, 2):
        mesh = {"builder": "box", "size": [1.0, 0.8, 0.5][:dim], "h": 0.2, "pattern": "unstructured", "order": order}
        scene = strained(dim, stretched(dim, [1.0, 0.3, 0.2]), "neo-hookean", mesh=mesh)
        assert scene.fracture().broken_edges > 0
        found.append((*cuts(scene), scene.fracture.criterion.starts))
        assert scene_surface(scene).fragment_count == 2
    np.testing.assert_array_equal(found[0][0], found[1][0])
    np.testing.assert_allclose(found[0][1], found[1][1], atol=1e-9)
    np.testing.assert_allclose(found[0][2], found[1][2], atol=1e-12)


@pytest.mark.parametrize("dim", (2, 3))
def test_the_gradient_of_a_quadratic_cell_is_its_mean(dim: int) -> None:
    """u_k = X Q_k X / 2 has the slope Q_k X: its mean is that at the centroid."""
    mesh = {"builder": "box", "size": [1.0, 0.8, 0.5][:dim], "h": 0.5, "pattern": "unstructured", "order": 2}
    scene = strained(dim, np.eye(dim), "neo-hookean", mesh=mesh)
    Q = np.random.default_rng(1).normal(size=(dim, dim, dim))
    Q = 0.05 * (Q + np.swapaxes(Q, 1, 2))
    X, domain = positions(scene), scene.domain
    scene.balance.set_displacement((np.einsum("ni,kij,nj->nk", X, Q, X) / 2).reshape(-1))
    centroids = domain.nodes[domain.cell_nodes].mean(axis=1)
    exact = np.eye(dim) + np.einsum("kij,cj->cki", Q, centroids)
    found = scene.fracture.criterion._gradients(np.arange(domain.cell_count))
    np.testing.assert_allclose(found, exact, atol=1e-12)


# --- planar cuts ----------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("axis", ([1.0, 0.0, 0.0], [1.0, 0.4, -0.3]), ids=("across", "tilted"))
def test_a_planar_cut_halves_a_cylinder(axis: list[float]) -> None:
    """One surface, normal to the stretch, through the centroid of the cell where it starts: two pieces whose volumes
    are those of the mesh on the two sides of that plane, to round-off."""
    mesh = {"builder": "cylinder", "radius": 0.25, "length": 1.0, "h": 0.1, "axis": "x"}
    scene = strained(3, stretched(3, axis), mesh=mesh, fracture={"strength": 0.05, "approach": "edge"})
    assert scene.fracture().broken_edges > 0
    made, start = scene_surface(scene), scene.fracture.criterion.starts
    assert made.fragment_count == 2 and start.shape == (1, 3)
    above = volume_above(mesh_of(scene), start[0], np.array(axis) / np.linalg.norm(axis))
    total = float(scene.domain.volumes.sum())
    assert sorted(enclosed(made)) == pytest.approx(sorted([above, total - above]), rel=ROUND_OFF)


@pytest.mark.parametrize("approach", ("chi", "edge"))
@pytest.mark.parametrize("dim", (2, 3))
def test_a_planar_cut_is_flat(dim: int, approach: str) -> None:
    """Cut points lie on the plane; only beside nodes that went over to the other side (chi) they lie at the node."""
    scene = strained(dim, stretched(dim, [1.0, 0.3, 0.2]), fracture={"strength": 0.05, "approach": approach})
    scene.fracture()
    keys, cut = cuts(scene)
    normal = np.array([1.0, 0.3, 0.2][:dim]) / np.linalg.norm([1.0, 0.3, 0.2][:dim])
    height = (cut_points(mesh_of(scene).points, keys, cut) - scene.fracture.criterion.starts[0]) @ normal
    at_node = np.minimum(cut, 1 - cut) <= 2 * CUT.min_share
    assert np.abs(height[~at_node]).max() < 1e-9
    assert at_node.mean() <= (0.1 if approach == "chi" else 0.0)
    assert scene_surface(scene).fragment_count == 2


def test_split_cells_carry_nothing_and_idle_edges_break() -> None:
    """Every cell that the plane crosses comes apart, so chi is 0 there and 1 elsewhere."""
    scene = strained(3, stretched(3, [1.0, 0.3, 0.2]))
    scene.fracture()
    graph, chi = scene.fracture.graph, scene.balance.stress.chi.x.array
    assert graph.split.any() and np.array_equal(chi == 0, graph.split)
    assert np.all(chi[~graph.damaged] == 1)


def test_nodes_on_the_surface_are_decided_by_the_mesh() -> None:
    """A plane through a layer of nodes of a regular lattice: the same edges whatever the round-off of the direction."""
    mesh = build_mesh(MeshSettings.model_validate({"builder": "box", "size": [1.0, 1.0], "h": 0.125}))
    found = []
    for tilt in (-1e-10, 0.0, 1e-10):
        for sense in (1, -1):  # through the diagonals of the lattice
            made = open_at(mesh, [[0.5, 0.5]], [[sense * (1 + tilt), -sense]])
            found.append(made.opened.keys)
            assert made.surface.fragment_count == 2
            assert sum(made.volumes) == pytest.approx(1.0, rel=ROUND_OFF)
    assert all(np.array_equal(keys, found[0]) for keys in found)


# --- older cracks ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("settle", (False, True))
@pytest.mark.parametrize("dim", (2, 3))
def test_a_surface_ends_at_an_older_crack(dim: int, settle: bool) -> None:
    """The second surface starts to the right of the first and meets it in a T: three pieces, and nothing of it on the
    left. Without the first it cuts the whole body."""
    mesh, at = box(dim), [[0.42, 0.4, 0.25][:dim], [0.75, 0.4, 0.25][:dim]]
    normals = [[1.0, 0.1, 0.05][:dim], [0.1, 1.0, 0.05][:dim]]
    first = open_at(mesh, at[:1], normals[:1], settle)
    both = open_at(mesh, at, normals, settle)
    alone = open_at(mesh, at[1:], normals[1:], settle)
    older = {tuple(key) for key in first.opened.keys.tolist()}
    new = np.array([tuple(key) not in older for key in both.opened.keys.tolist()])
    assert both.surface.fragment_count == 3 and len(both.opened.starts) == 2
    height = (both.places[new] - both.opened.starts[0]) @ np.array(normals[0]) / np.linalg.norm(normals[0])
    assert height.min() > -1e-8 and height.min() < 0.1  # beside the older crack, up to a cell of it
    assert alone.places[:, 0].min() < 0.1 and both.places[new, 0].max() > 0.95
    assert both.volumes.min() > 0 and both.volumes.sum() == pytest.approx(_size(mesh), rel=ROUND_OFF)


def _size(mesh: MeshData) -> float:
    corners = mesh.points[mesh.cells]
    return float(np.abs(np.linalg.det(corners[:, 1:] - corners[:, :1])).sum()) / (2 if mesh.dim == 2 else 6)


def test_a_gap_is_not_jumped() -> None:
    """A plane that meets a U in both of its legs cuts the leg in which it starts only."""
    mesh = box(2, 0.05)
    centre = mesh.points[mesh.cells].mean(axis=1)
    legs = mesh.cells[(np.abs(centre[:, 0] - 0.5) > 0.15) | (centre[:, 1] < 0.2)]
    nodes, place = np.unique(legs, return_inverse=True)
    made = open_at(MeshData(mesh.points[nodes], place.reshape(legs.shape)), [[0.15, 0.5]], [[0.05, 1.0]])
    assert made.surface.fragment_count == 2 and made.places[:, 0].max() < 0.4


def test_a_shell_of_one_cell_is_cut_through() -> None:
    """A plate as thick as a cell: two pieces."""
    mesh = build_mesh(MeshSettings.model_validate({"builder": "box", "size": [1.0, 1.0, 0.1], "h": 0.1}))
    made = open_at(mesh, [[0.52, 0.47, 0.05]], [[1.0, 0.2, 0.1]], settle=True)
    assert made.surface.fragment_count == 2 and made.volumes.min() > 0.3 * 0.1


# --- where surfaces start -------------------------------------------------------------------------------------------


@pytest.mark.parametrize("seed", range(5))
def test_starts_are_those_of_a_greedy_search(seed: int) -> None:
    """Against a loop over the candidates from the highest load down that keeps all kept ones at their distance."""
    random = np.random.default_rng(seed)
    places, load, taken = random.random((200, 3)), random.random(200).round(1), random.random((2, 3))
    kept: list[int] = []
    for candidate in sorted(range(200), key=lambda k: (-load[k], k)):
        others = np.concatenate([taken, places[kept]])
        if cdist(places[candidate][None], others).min() >= 0.25:
            kept.append(candidate)
    starts, found = StartCandidates(places, load, 0.25, taken), []
    while (chosen := starts.pop_most_loaded()) is not None:
        found.append(chosen)
        starts.exclude_near(places[chosen])
    assert found == kept and 5 < len(kept) < 60


def test_surfaces_are_counted_over_the_run_and_keep_their_distance() -> None:
    """At most `surfaces` in all and `per_pass` in one; then nothing breaks, however high the stress."""
    scene = strained(2, stretched(2, [1.0, 0.3]), brittle={"surfaces": 5, "per_pass": 2, "spacing": 0.15})
    counts = []
    for _ in range(5):
        scene.fracture()
        counts.append(len(scene.fracture.criterion.starts))
    assert counts == [2, 4, 5, 5, 5]
    distance = cdist(*(scene.fracture.criterion.starts,) * 2) + np.eye(5)
    assert distance.min() >= 0.15


def test_the_cell_over_its_strength_starts_first() -> None:
    """Stress 0.056 everywhere (E e = 0.06 at most): the weak region breaks, and with it off nothing does."""
    weak = {"strength": 1.0, "approach": "chi"}
    scene = strained(2, stretched(2, [1.0, 0.0]), fracture=weak)
    assert scene.fracture().broken_edges == 0 and len(scene.fracture.criterion.starts) == 0
    scene = strained(2, stretched(2, [1.0, 0.0]), fracture={"strength": 0.06 * (1 - 1e-5)})
    assert scene.fracture().broken_edges > 0
    scene = strained(2, stretched(2, [1.0, 0.0]), fracture={"strength": 0.06 * (1 + 1e-5)})
    assert scene.fracture().broken_edges == 0


def test_compression_starts_nothing() -> None:
    scene = strained(3, stretched(3, [1.0, 0.0, 0.0], -0.5))
    assert scene.fracture().broken_edges == 0


# --- directions -----------------------------------------------------------------------------------------------------


def test_principal_stress_by_its_definition() -> None:
    """n . s . n of the direction is the largest over many directions, and the cheap bound is above it."""
    random = np.random.default_rng(1)
    s = random.normal(size=(50, 3, 3))
    s = s + np.swapaxes(s, 1, 2)
    n = first_principal_directions(s, random.random((50, 3)), 1.0)
    top = np.einsum("ni,nij,nj->n", n, s, n)
    tries = random.normal(size=(2000, 3))
    tries /= np.linalg.norm(tries, axis=1)[:, None]
    assert np.all(np.einsum("ki,nij,kj->nk", tries, s, tries).max(axis=1) <= top + 1e-12)
    np.testing.assert_allclose(first_principal_stress(s), top, atol=1e-12)


def test_equal_principal_stresses_give_a_drawn_direction() -> None:
    """Biaxial tension with noise: a direction in its plane that the noise does not change, but the seed does."""
    place, noise = np.array([[0.1, 0.2, 0.3]]), np.random.default_rng(0).normal(size=(3, 3)) * 1e-9
    s = np.diag([1.0, 1.0, 0.2])
    plain = first_principal_directions(s[None], place, 1.0)[0]
    noisy = first_principal_directions((s + noise + noise.T)[None], place, 1.0)[0]
    other = first_principal_directions(s[None], place, 1.0, 1)[0]
    assert (
        abs(plain[2]) < 1e-12 and 1 - abs(plain @ noisy) < 1e-8 / EQUAL_STRESS_TOLERANCE and abs(plain @ other) < 0.999
    )
    np.testing.assert_allclose(abs(plain @ noisy), 1.0, atol=1e-6)


def test_normals_are_those_of_material_planes() -> None:
    """Every tangent of the reference plane, moved by F, is normal to the present direction."""
    random = np.random.default_rng(2)
    F, n = np.eye(3) + 0.4 * random.normal(size=(20, 3, 3)), random.normal(size=(20, 3))
    N = material_normals(n, F)
    tangents = np.linalg.svd(N[:, None, :])[2][:, 1:]
    np.testing.assert_allclose(np.einsum("nij,nkj,ni->nk", F, tangents, n), 0.0, atol=1e-12)


@pytest.mark.parametrize("dim", (2, 3))
def test_a_turned_body_has_the_same_cuts(dim: int) -> None:
    """F = Q U: stress turns with the body, its material planes stay."""
    U = stretched(dim, [1.0, 0.5, 0.2], 0.3)
    found = [strained(dim, Q @ U, "neo-hookean", brittle={"surfaces": 4}) for Q in (np.eye(dim), rotation(dim, 3))]
    for scene in found:
        assert scene.fracture().broken_edges > 0
    (keys, cut), (turned_keys, turned_cut) = map(cuts, found)
    assert np.array_equal(keys, turned_keys)
    np.testing.assert_allclose(cut, turned_cut, atol=1e-8)


# --- curved surfaces ------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("dim", (2, 3))
def test_a_curved_surface_follows_its_field(dim: int) -> None:
    """Tension along rays from a point: the surface normal to it is a circle or sphere around that point. The deviation
    is of second order in h: a quarter when h is halved (at most 0.4 here; on random points by two halvings)."""
    centre = np.array([-0.5, 0.2, 0.1][:dim])

    def rays(places: Any) -> Any:
        away = places - centre
        return away / np.linalg.norm(away, axis=1)[:, None]

    deviation = []
    halvings = 2 if dim == 2 else 1
    for h in (0.1, 0.1 / 2**halvings):
        mesh = box(dim, h)
        start = [0.5, 0.3, 0.25][:dim]
        made = open_at(mesh, [start], [(np.array(start) - centre).tolist()], field=rays, curved=True)
        radius = np.linalg.norm(made.opened.starts[0] - centre)
        deviation.append(np.abs(np.linalg.norm(made.places - centre, axis=1) - radius).max())
        assert made.surface.fragment_count == 2
    assert deviation[0] < 0.01 and deviation[1] < 0.4**halvings * deviation[0]


def test_without_tension_a_curved_surface_goes_straight_on() -> None:
    """Where the body carries nothing the weight is 0: the plane of the start, to round-off."""
    made = open_at(box(3), [[0.5, 0.4, 0.25]], [[1.0, 0.3, 0.2]], field=np.zeros_like, curved=True)
    normal = np.array([1.0, 0.3, 0.2]) / np.linalg.norm([1.0, 0.3, 0.2])
    assert np.abs((made.places - made.opened.starts[0]) @ normal).max() < 1e-12
    assert made.surface.fragment_count == 2


def test_weights_are_a_share_of_the_strength() -> None:
    """Uniaxial stress of half the strength: weight 1/2 along it; equal principal stresses: direction without weight."""
    from fracsim.fracture.brittle.surface_cut import SurfaceCutMesh

    body = SurfaceCutMesh(box(2, 0.25))
    rest = np.broadcast_to(np.eye(2), (len(body.cells), 2, 2))
    field = DirectionField.from_cells(body, rest * np.array([[1.0, 0.0], [0.0, 0.0]]), rest, np.full(len(rest), 2.0))
    np.testing.assert_allclose(field.weight, 0.5, rtol=1e-12)
    np.testing.assert_allclose(np.abs(field.direction[:, 0]), 1.0, rtol=1e-12)


@pytest.mark.parametrize("dim", (2, 3))
def test_moving_nodes_over_spares_a_curved_surface(dim: int) -> None:
    """A curved surface is known beside itself only; still hardly a node of it is without a cell on its own side."""
    at, normal = [0.5, 0.3, 0.25][:dim], [1.0, 0.3, 0.2][:dim]
    plain, moved = (
        open_at(box(dim, 0.05), [at], [normal], settle, field=np.zeros_like, curved=True) for settle in (False, True)
    )
    common = {tuple(key) for key in plain.opened.keys.tolist()} & {tuple(key) for key in moved.opened.keys.tolist()}
    assert len(common) > 0.9 * len(plain.opened.keys) and moved.surface.fragment_count == 2


def test_a_scene_with_curved_surfaces_in_uniform_stress_cuts_planes() -> None:
    """Uniform stress: the curved surface is the planar one."""
    tables = {"fracture": {"strength": 0.05, "approach": "edge"}}
    planar, curved = (
        strained(3, stretched(3, [1.0, 0.3, 0.2]), brittle={"surfaces": 2, "shape": shape}, **tables)
        for shape in ("planar", "curved")
    )
    for scene in (planar, curved):
        scene.fracture()
    assert np.array_equal(cuts(planar)[0], cuts(curved)[0])
    np.testing.assert_allclose(cuts(planar)[1], cuts(curved)[1], atol=1e-7)


# --- runs -----------------------------------------------------------------------------------------------------------

PULL = {
    "mesh": {"builder": "box", "size": [1.0, 0.3, 0.3], "h": 0.1, "pattern": "unstructured"},
    "material": {"energy": "linear", "young": 1.0, "poisson": 0.0, "density": 1e-9},  # hardly any inertia
    "boundary": [
        {"on": "left", "fix": "x"},
        {"on": {"box": [[0, 0, 0], [0, 0.3, 0]]}, "fix": "z"},
        {"on": {"box": [[0, 0, 0], [0, 0, 0.3]]}, "fix": "y"},
        {"on": "right", "displacement": {"time": [0, 10], "value": [[0, "free", "free"], [0.1, "free", "free"]]}},
    ],
    "fracture": {"strength": 0.035, "approach": "edge"},
    "brittle": {"surfaces": 1},
    "time": {"scheme": "newmark", "step": 1.0, "end": 6.0},
    "output": {"every": 1, "picture": False},
}


def test_a_run_writes_the_exact_halves(tmp_path: Path) -> None:
    """pieces.csv: volumes are those on the two sides of x = start; the bar snaps and nothing breaks after that.

    What inertia adds to the stress, rho a L^2 of 1e-11 Pa to 0.04 Pa, turns the plane by no more than 1e-9.
    """
    run = Run(build_scene(MPI.COMM_SELF, make_study(**PULL)), tmp_path)
    run()
    x = run.scene.fracture.criterion.starts[0]
    above = volume_above(mesh_of(run.scene), x, np.array([1.0, 0.0, 0.0]))
    assert above == pytest.approx((1 - x[0]) * 0.09, rel=1e-12)
    with (tmp_path / "pieces.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if float(row["time"]) == 6.0]
    assert sorted(float(row["volume"]) for row in rows) == pytest.approx(sorted([above, 0.09 - above]), rel=1e-7)
    with (tmp_path / "history.csv").open(newline="") as file:
        broken = [int(row["broken_edges"]) for row in csv.DictReader(file)]
    assert broken[2] == 0 and broken[3] == broken[-1] > 0  # E t / 100 reaches 0.035 in the fourth step


def film() -> dict[str, Any]:
    """A film on a ground that stretches: however often it cracks, what is left is loaded again."""
    ground = [
        {
            "on": {"box": [[x - 1e-9, 0.0], [x + 1e-9, 0.0]]},
            "displacement": {"time": [0.0, 10.0], "value": [[0.0, 0.0], [x, 0.0]]},
        }
        for x in np.linspace(0, 1, 11).tolist()
    ]
    return PULL | {
        "mesh": {"builder": "box", "size": [1.0, 0.3], "h": 0.1, "pattern": "unstructured"},
        "boundary": ground,
        "fracture": PULL["fracture"] | {"passes": 1},
        "brittle": {"surfaces": 4, "per_pass": 1, "spacing": 0.1},
        "time": {"scheme": "quasi-static", "step": 0.1, "end": 1.2},
    }


def test_a_restart_remembers_its_surfaces(tmp_path: Path) -> None:
    """Stopped after the first surface and continued: the same starts, edges and cuts as without the stop."""
    tables = film()
    whole = Run(build_scene(MPI.COMM_SELF, make_study(**tables)), tmp_path / "whole")
    whole()
    stopped = Run(build_scene(MPI.COMM_SELF, make_study(**tables)), tmp_path / "parts")
    surfaces = stopped.scene.fracture.criterion
    stopped.interrupt.stop_reason = lambda: "the test" if len(surfaces.starts) else ""  # type: ignore[method-assign]
    with pytest.raises(Stopped):
        stopped()
    assert len(surfaces.starts) == 1 and len(whole.scene.fracture.criterion.starts) == 4
    again = Run(build_scene(MPI.COMM_SELF, make_study(**tables)), tmp_path / "parts", restart=True)
    again()
    np.testing.assert_allclose(again.scene.fracture.criterion.starts, whole.scene.fracture.criterion.starts, rtol=1e-14)
    assert again.breaks.record is not None and whole.breaks.record is not None
    assert np.array_equal(again.breaks.record.graph.broken, whole.breaks.record.graph.broken)
    np.testing.assert_allclose(again.breaks.record.cut_positions, whole.breaks.record.cut_positions, atol=1e-8)


def test_several_passes_open_surfaces_one_after_the_other() -> None:
    """One surface a pass and passes to spare: the bar is relieved by the first, so no second starts in that step."""
    tables = PULL | {
        "fracture": PULL["fracture"] | {"passes": 10},
        "brittle": {"surfaces": 5, "per_pass": 1},
        "time": {"scheme": "quasi-static", "step": 1.0, "end": 4.0},
    }
    tables["boundary"] = [{"on": "left", "fix": "xyz"}, PULL["boundary"][3]]  # type: ignore[index]
    tables["boundary"][1] = {"on": "right", "displacement": {"time": [0, 10], "value": [[0, 0, 0], [0.1, 0, 0]]}}
    scene, state = make_scene(**{key: value for key, value in tables.items() if key != "output"})
    march(scene, state)
    assert len(scene.fracture.criterion.starts) == 1


# --- what is off, and what is wrong ---------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"fracture": None}, "needs a \\[fracture\\] table"),
        ({"fracture": {"strength": 1.0, "cap": 0.1}}, "set brittle.per_pass instead"),
        ({"output": {"cut": "forces"}}, 'output.cut = "forces" is for single edges'),
        ({"brittle": {"surfaces": 0}}, "greater than or equal to 1"),
        ({"brittle": {"surfaces": 1.5}}, "valid integer"),
        ({"brittle": {"surfaces": 1, "spacing": 0.0}}, "greater than 0"),
        ({"brittle": {"surfaces": 1, "shape": "wavy"}}, "'planar' or 'curved'"),
        ({"brittle": {"surfaces": 1, "grains": {"count": 1}}}, "greater than or equal to 2"),
        ({"brittle": {"surfaces": 1, "grains": {"count": 9, "spread": 1.0}}}, "less than 1"),
        ({"brittle": {"surfaces": 1, "shape": "curved", "grains": {"count": 9}}}, 'grains.mode = "replace"'),
    ],
)
def test_what_a_study_may_not_say(tables: dict[str, Any], message: str) -> None:
    good: dict[str, Any] = {"fracture": {"strength": 1.0}, "brittle": {"surfaces": 1}}
    with pytest.raises(ValidationError, match=message):
        make_study(**(good | tables))


def test_check_tells_and_a_typing_error_is_named(tmp_path: Path) -> None:
    from cases import STRIP

    path = write_study(tmp_path / "s.toml", STRIP, brittle={"surfaces": 7, "grains": {"count": 30, "seed": 2}})
    told = fracsim("check", path)
    assert "up to 7 surfaces, each frees one of 30 grains (seed 2" in " ".join(told.stdout.split()), told.stdout
    wrong = fracsim("check", path, "--set", "brittle.surfaecs=3")
    assert wrong.returncode == 2 and "did you mean surfaces?" in wrong.stderr


def test_no_node_of_a_thin_plate_is_left_without_a_whole_cell() -> None:
    """Planes at any angle through a plate about one cell thick, which as they are would leave two nodes each, or so."""
    body = SurfaceCutMesh(
        build_mesh(MeshSettings.model_validate({"builder": "box", "size": [1.0, 0.8, 0.07], "h": 0.06} | UNSTRUCTURED))
    )
    draw, every = np.random.default_rng(0), np.ones(len(body.cells), bool)
    left = np.zeros((100, 2), int)
    for trial in left:
        origin, normal = draw.uniform(0.2, 0.8, 3) * [1.0, 0.8, 0.07], draw.normal(size=3) * [1.0, 1.0, 0.3]
        plane = sides_of_level_set((body.points - origin) @ (normal / np.linalg.norm(normal)), body.tolerance)
        moved = reassign_isolated_nodes(body, plane, every)
        assert moved.any() and not moved.all()
        trial[:] = [without_a_cell(body, plane), without_a_cell(body, moved)]
    assert left[:, 0].sum() > 100 and left[:, 1].sum() == 0


def without_a_cell(body: SurfaceCutMesh, sides: Any) -> int:
    """Nodes none of whose cells lie on their side as a whole."""
    whole = np.ptp(np.asarray(sides, int)[body.cells], axis=1) == 0
    return len(body.points) - len(np.unique(body.cells[whole]))
