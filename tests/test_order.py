"""Quadratic displacement: [mesh] order = 2."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI
from scipy.linalg import eigh
from scipy.sparse import csr_matrix

import xdmf_reader
from fracsim.contact.contact_surface import ContactSurface
from fracsim.deformable_run import run_study
from fracsim.mesh.edge_graph import EdgeGraph
from fracsim.output.fracture_log import FractureLog
from fracsim.output.frame_files import surface_output
from fracsim.simulation import Simulation
from fracsim.studies.evidence.precision.manufactured_solution import relative_errors, solve
from fracsim.study.check import check_study
from fracsim.study.mesh_source import build_mesh
from fracsim.timestepping.stable_time_step import cell_frequencies
from support.scenes import make_scene, make_study, march

Values = npt.NDArray[np.float64]


def orders(energy: str, order: int, dim: int, cells: tuple[int, int]) -> list[float]:
    """Of the displacement and of its gradient, between two meshes."""
    coarse, fine = (relative_errors(solve(energy, order, dim, 1 / n)) for n in cells)
    found: list[float] = (np.log(coarse / fine) / np.log(cells[1] / cells[0])).tolist()
    return found


@pytest.mark.parametrize("energy", ["linear", "corotated", "stvk", "neo-hookean"])
def test_orders_of_convergence(energy: str) -> None:
    """3 in the displacement and 2 in its gradient, and so in the energy norm; one less of each with linear cells."""
    assert orders(energy, 2, 2, (6, 12)) == pytest.approx([3, 2], abs=0.2)
    assert orders(energy, 1, 2, (6, 12)) == pytest.approx([2, 1], abs=0.2)


def test_orders_of_convergence_in_space() -> None:
    assert orders("neo-hookean", 2, 3, (3, 6)) == pytest.approx([3, 2], abs=0.2)


# --- round faces ---


def disk(**tables: Any) -> Any:
    """A round plate of radius 1 in 2 x 6 cells or so, free."""
    mesh = {"builder": "disk", "radius": 1.0, "h": 0.5, "arc": 60.0, "order": 2}
    return make_scene(**({"mesh": mesh, "time": {"scheme": "newmark", "step": 0.1, "end": 0.1}} | tables))


def test_round_faces_are_round() -> None:
    """Parabolas through three points of a circle of radius 1: the area is pi but for some s^4 / 180 of itself, s the
    angle of a facet (straight sides: s^2 / 6)."""
    scene, _ = disk()
    straight = scene.domain.volumes.sum()
    s = np.sqrt(6 * (1 - straight / np.pi))
    assert scene.balance.mass.lumped.sum() / 2 == pytest.approx(np.pi, rel=s**4 / 90)
    assert straight < np.pi * (1 - 0.015)
    radius = np.linalg.norm(scene.domain.nodes, axis=1)
    assert np.count_nonzero(np.abs(radius - 1) < 1e-12) == 2 * len(
        np.concatenate([*scene.domain.facets.groups.values()])
    )


def test_a_force_on_a_round_face_is_the_force_given() -> None:
    scene, state = disk(boundary=[{"on": "top", "force": [0.0, 3.0]}])
    march(scene, state)
    assert scene.balance.energies.applied_forces().reshape(-1, 2).sum(axis=0) == pytest.approx([0.0, 3.0], abs=1e-12)


def test_a_body_that_breaks_has_straight_sides() -> None:
    scene, _ = disk(fracture={"strength": 1.0})
    assert not scene.domain.has_curved_cells
    assert scene.balance.mass.lumped.sum() / 2 == pytest.approx(scene.domain.volumes.sum())


# --- files ---


def test_vtk_reads_curved_cells(tmp_path: Path) -> None:
    """VTK's own reader: middles of the round side on the circle, and displacement in all 6 nodes."""
    study = make_study(
        mesh={"builder": "disk", "radius": 1.0, "h": 0.5, "order": 2},
        initial={"velocity": [1.0, 0.0]},
        time={"scheme": "explicit", "step": 1e-3, "end": 1e-3},
        output={"surface": True, "picture": False},
    )
    run_study(MPI.COMM_SELF, study, tmp_path / "out")
    target = tmp_path / "read.npz"
    command = [sys.executable, xdmf_reader.__file__, str(tmp_path / "out" / "fields.xdmf"), str(target)]
    if subprocess.run(command).returncode == xdmf_reader.NO_READER:
        pytest.fail("Debian's VTK has no XDMF reader: run `make readers` first, as `make test` does")
    with np.load(target) as found:
        points, moved, kinds = found["0/points"], found["1/warped"], found["0/kinds"]
    assert set(kinds) == {22}  # VTK_QUADRATIC_TRIANGLE
    rim = np.count_nonzero(np.abs(np.linalg.norm(points, axis=1) - 1) < 1e-12)
    assert rim % 2 == 0 and rim >= 24
    np.testing.assert_allclose(moved - points, np.broadcast_to([1e-3, 0.0, 0.0], points.shape), atol=1e-12)


@pytest.mark.parametrize("size", [[1.0, 0.5], [1.0, 0.5, 0.5]])
def test_middles_in_fields_h5_are_in_the_order_of_vtk(tmp_path: Path, size: list[float]) -> None:
    """Each half-way along the edge that vtkQuadraticTriangle and vtkQuadraticTetra have at its place."""
    study = make_study(
        mesh={"builder": "box", "size": size, "h": 0.25, "order": 2}, output={"picture": False},
        time={"scheme": "explicit", "step": 1e-3, "end": 1e-3},
    )  # fmt: skip
    run_study(MPI.COMM_SELF, study, tmp_path / "out")
    with h5py.File(tmp_path / "out" / "fields.h5") as file:
        points, cells = file["points"][:], file["cells"][:]
    d, mesh = len(size), build_mesh(study.mesh)
    ends = [(0, 1), (1, 2), (2, 0), (0, 3), (1, 3), (2, 3)][: 3 * (d - 1)]
    np.testing.assert_array_equal(cells[:, : d + 1], mesh.cells)
    np.testing.assert_array_equal(points[: len(mesh.points), :d], mesh.points)
    np.testing.assert_allclose(points[cells[:, d + 1 :]], points[cells[:, ends]].mean(axis=2), atol=1e-15)


# --- what it does not go with ---


SLOW = {"scheme": "quasi-static", "step": 1.0, "end": 1.0}


@pytest.mark.parametrize(
    ("tables", "key"),
    [
        ({"fracture": {"strength": 1.0, "approach": "edge"}}, "fracture.approach"),
        ({"fracture": {"strength": 1.0, "energy": 1.0, "law": "cohesive"}, "time": SLOW}, "fracture.law"),
        ({"fracture": {"strength": 1.0}, "output": {"cut": "forces"}}, "output.cut"),
    ],
)
def test_what_needs_straight_cells_is_refused(tables: dict[str, Any], key: str) -> None:
    with pytest.raises(ValueError, match=rf"mesh.order = 2 .* does not go with .*{key}.*choose order = 1"):
        make_study(**({"mesh": {"builder": "box", "size": [1.0, 1.0], "h": 0.5, "order": 2}} | tables))


# --- flow ---


def bar(order: int, update: str) -> Any:
    """A bar of steel in plane strain, clamped on rollers and pulled past yield: one stress everywhere."""
    return make_scene(
        mesh={"builder": "box", "size": [1.0, 0.5], "h": 0.5, "order": order},
        material={"energy": "neo-hookean", "young": 1e3, "poisson": 0.3, "density": 1.0},
        plasticity={"yield_stress": 1.0, "hardening": 50.0, "update": update},
        boundary=[
            {"on": "left", "displacement": [0.0, "free"]},
            {"on": "bottom", "displacement": ["free", 0.0]},
            {"on": "right", "displacement": {"time": [0.0, 1.0], "value": [[0.0, "free"], [0.01, "free"]]}},
        ],
        time={"scheme": "quasi-static", "step": 0.2, "end": 1.0},
    )


@pytest.mark.parametrize("update", ["extrapolated", "implicit", "staggered"])
def test_uniform_flow_is_that_of_linear_cells(update: str) -> None:
    """Every point flows as the one of a linear cell does: the same energy, loss and plastic strain."""
    figures, strains = [], []
    for order in (1, 2):
        scene, state = bar(order, update)
        report = list(march(scene, state))[-1]
        figures.append([report.elastic, state.dissipated, state.work])
        strains.append(scene.balance.stress.material.plastic.accumulated_strain)
    assert figures[1] == pytest.approx(figures[0], rel=1e-7)
    assert len(strains[1]) == 3 * len(strains[0])
    np.testing.assert_allclose(strains[1], strains[0][0], rtol=1e-6)


def test_plastic_bending_does_not_lock() -> None:
    """A clamped beam (L = 4 H) bent past its fully plastic moment, 2/sqrt(3) Y H^2/4 in plane strain, which its end
    carries as P L: linear triangles, which lock in plane plastic flow, carry some three times that on twice as fine a
    mesh, quadratic ones on two cells over H a fifth to a third more, most of it in what the clamp adds."""
    loads = {}
    for order, h in ((1, 0.025), (2, 0.05)):
        scene, state = make_scene(
            mesh={"builder": "box", "size": [0.4, 0.1], "h": h, "order": order},
            material={"energy": "corotated", "young": 1e9, "poisson": 0.3, "density": 1.0},
            plasticity={"yield_stress": 1e6, "update": "implicit"},
            boundary=[
                {"on": "left", "fix": "xy"},
                {"on": "right", "displacement": {"time": [0.0, 1.0], "value": [["free", 0.0], ["free", -0.02]]}},
            ],
            time={"scheme": "quasi-static", "step": 0.1, "end": 1.0},
            probe=[{"name": "end", "on": "right", "record": "reaction"}],
        )
        march(scene, state)
        loads[order] = -scene.probes()[1] * 0.4 / (2 / np.sqrt(3) * 1e6 * 0.1**2 / 4)
    assert 1 < loads[2] < 1.35
    assert loads[1] > 2.5


# --- contact ---


def pressed(order: int, **more: Any) -> tuple[float, Any]:
    """Force of a plate that presses a block by a twentieth of its height, and the displacement of the block's top."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.5, "order": order},
        material={"energy": "neo-hookean", "young": 1.0, "poisson": 0.0, "density": 1.0},
        boundary=[
            {"on": "bottom", "displacement": ["free", 0.0]},
            {"on": "left", "displacement": [0.0, "free"]},
        ],
        obstacle=[
            {
                "name": "plate",
                "shape": "plane",
                "at": [0.0, 1.001],
                "normal": [0.0, -1.0],
                "displacement": {"time": [0.0, 1.0], "value": [[0.0, 0.0], [0.0, -0.05]]},
            }
        ],
        time={"scheme": "quasi-static", "step": 0.2, "end": 1.0},
        **more,
    )
    march(scene, state)
    top = np.abs(scene.domain.nodes[:, 1] - 1) < 1e-9
    force = dict(zip(scene.probes.columns, scene.probes(), strict=True))["contact_plate_y"]
    return force, state.u.reshape(-1, 2)[top, 1]


@pytest.mark.parametrize(
    ("mesh", "exact"),
    [
        ({"builder": "disk", "radius": 1.0, "h": 0.25}, 2 * np.pi),
        ({"builder": "cylinder", "radius": 1.0, "length": 1.0, "h": 0.4}, 4 * np.pi),
    ],
)
def test_all_of_a_round_body_touches(mesh: dict[str, Any], exact: float) -> None:
    """The area of its contact surface is that of the body, and midside nodes are on the circle."""
    scene, _ = make_scene(mesh=mesh | {"order": 2})
    assert scene.domain.has_curved_cells
    surface = ContactSurface(scene.domain, 0.01)
    assert surface.area.sum() == pytest.approx(exact, rel=0.02)
    nodes, points = (
        np.count_nonzero(np.abs(np.linalg.norm(positions[:, :2], axis=1) - 1) < 1e-9)
        for positions in (scene.domain.nodes, surface.rest_positions)
    )
    assert points == nodes


def test_middles_touch_too() -> None:
    """A flat plate leaves the top flat, and a bar of linear cells carries the same; with contact at corners alone the
    top bulges by a twentieth of an edge and the force is an eighth too low."""
    linear, _ = pressed(1)
    force, top = pressed(2)
    assert force == pytest.approx(linear, rel=0.02)
    assert np.ptp(top) < 0.01 * 0.5


def test_what_may_break_is_touched_alike() -> None:
    """As long as it is whole."""
    force, top = pressed(2)
    found, at = pressed(2, fracture={"strength": 1e9})
    assert found == pytest.approx(force, rel=1e-9)
    np.testing.assert_allclose(at, top, atol=1e-12)


def test_cells_with_broken_edges_are_touched_by_their_corners() -> None:
    """Middles are points of the facets of whole cells alone, and the surface is as large as that of linear cells."""
    area = {}
    for order in (1, 2):
        scene, _ = make_scene(mesh={"builder": "box", "size": [1.0, 1.0, 0.5], "h": 0.25, "order": order})
        domain = scene.domain
        surface, graph = ContactSurface(domain, 0.01), EdgeGraph(domain)
        ends = domain.nodes[graph.edge_nodes][:, :, 0]
        graph.break_edges((ends.min(axis=1) < 0.5) & (ends.max(axis=1) > 0.4))
        surface.update_damage(graph.pattern)
        area[order] = surface.area.sum()
        if order == 2:
            touched = surface.columns[abs(surface.point_map.weights).max(axis=0).toarray().ravel() > 1e-12]
            cells = np.flatnonzero(graph.pattern)
            of_whole = domain.cell_midside_nodes.of_edges[np.flatnonzero(graph.pattern == 0)]
            only_broken = np.setdiff1d(domain.cell_midside_nodes.of_edges[cells], of_whole)
            assert len(only_broken) and not np.isin(only_broken, touched).any()
            assert np.isin(of_whole, touched).any()
    assert area[2] == pytest.approx(area[1], rel=1e-12)


# --- mass ---


def spectrum(dim: int, cells: int, order: int, mass: str) -> tuple[Values, float]:
    """omega^2 of a box on rollers but for one free end, from K and M as they are assembled, and the bound of its
    fastest cell, 1/s^2."""
    sides = ("left", "bottom", "top", "front", "back")[: 2 * dim - 1]
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0] * dim, "h": 1.0 / cells, "order": order},
        material={"energy": "linear", "young": 1.0, "poisson": 0.3, "density": 1.0},
        boundary=[{"on": side, "fix": "xyyzz"[at] if dim == 2 else "xzzyy"[at]} for at, side in enumerate(sides)],
        time={"scheme": "newmark", "step": 1.0, "end": 1.0, "mass": mass},
    )
    balance = scene.balance
    balance.evaluate_at(0.0, state.u, state.v, dt=1.0)
    free = np.flatnonzero(balance.motion.free_dofs)
    K, M = (np.zeros((len(free), len(free))) for _ in range(2))
    balance.tangent.assemble()
    K[:] = dense(balance.tangent.matrix)[np.ix_(free, free)]
    for column, dof in enumerate(free):
        M[:, column] = balance.mass.multiply(np.eye(1, balance.owned_dof_count, dof)[0])[free]
    K -= balance.c_a * M
    return eigh(K, M, eigvals_only=True), float(cell_frequencies(balance.stress).max())


def dense(matrix: Any) -> Values:
    return csr_matrix(matrix.getValuesCSR()[::-1], shape=matrix.size).toarray()


@pytest.mark.parametrize(("dim", "cells"), [(2, 3), (3, 1)])
def test_no_body_is_faster_than_its_fastest_cell(dim: int, cells: int) -> None:
    """The bound from a constant of the reference cell: above the fastest motion, and not by so much that steps are
    half as long as they could be."""
    values, bound = spectrum(dim, cells, 2, "lumped")
    assert values.min() > 0
    assert values.max() < bound < 4 * values.max()


def test_lumped_mass_costs_the_order_of_frequencies() -> None:
    """The slowest motion along x, (pi/2)^2 (lambda + 2 mu) / rho: an error in omega^2 of h^2 with the lumped mass, of
    h^4 with the consistent one."""
    exact = (np.pi / 2) ** 2 * 0.7 / (1.3 * 0.4)
    for mass, order in (("lumped", 2), ("consistent", 4)):
        found = [abs(np.abs(spectrum(2, n, 2, mass)[0] - exact).min()) for n in (2, 4)]
        assert np.log2(found[0] / found[1]) == pytest.approx(order, abs=0.3)


@pytest.mark.parametrize("mass", ["lumped", "consistent"])
@pytest.mark.parametrize("dim", [2, 3])
def test_a_body_in_free_fall_has_no_stress(dim: int, mass: str) -> None:
    """All nodes fall by g t^2 / 2: gravity is M g with the mass matrix of inertia."""
    g, steps, dt = np.array([2.0, 0.0, -9.81])[-dim:], 10, 0.02
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0] * dim, "h": 0.5, "pattern": "unstructured", "order": 2},
        material={"young": 1e4, "poisson": 0.3, "density": 1000.0},
        load={"gravity": g.tolist()},
        time={"scheme": "newmark", "step": dt, "end": 1.0, "mass": mass},
    )
    fallen = g * (steps * dt) ** 2 / 2
    march(scene, state, steps)
    u = state.u.reshape(-1, dim)
    np.testing.assert_allclose(u, np.broadcast_to(fallen, u.shape), atol=1e-6 * np.abs(fallen).max())


def test_check_says_what_is_built() -> None:
    mesh = {"builder": "disk", "radius": 1.0, "h": 0.5, "order": 2}
    assert "cells of 6 nodes, round sides" in "\n".join(check_study(make_study(mesh=mesh)))
    broken = "\n".join(check_study(make_study(mesh=mesh, fracture={"strength": 1.0})))
    assert "cells of 6 nodes, 4 times" in broken
    assert "quadratic" not in "\n".join(check_study(make_study()))


def test_contact_on_corners_alone_is_told(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """Where edges may break midside nodes penetrate: two blocks pressed together have 7/8 of their force."""
    mesh = {"builder": "box", "size": [1.0, 1.0], "h": 0.5, "order": 2}
    tables: dict[str, Any] = {"mesh": mesh, "fracture": {"strength": 1.0}, "contact": {"itself": True}}
    said = "acts on corners alone, and may lack an eighth of its force"
    assert said in " ".join("\n".join(check_study(make_study(**tables))).split())
    without = [{"mesh": mesh | {"order": 1}}, {"contact": None}, {"fracture": None}]
    for changed in without:
        assert "on corners" not in "\n".join(check_study(make_study(**(tables | changed))))
    time = {"scheme": "newmark", "step": 0.1, "end": 0.1}
    run_study(MPI.COMM_WORLD, make_study(**tables, time=time, output={"picture": False}), tmp_path / "out")
    assert said in capfd.readouterr().err


def test_check_notes_linear_cells_that_lock() -> None:
    rubber = {"energy": "linear", "young": 1.0, "poisson": 0.49, "density": 1.0}
    assert "linear cells lock at a Poisson's ratio of 0.49" in "\n".join(check_study(make_study(material=rubber)))
    mesh = {"builder": "box", "size": [1.0, 1.0], "h": 0.5, "order": 2}
    for tables in ({"mesh": mesh, "material": rubber}, {"material": rubber | {"plane": "stress"}}, {}):
        assert "lock" not in "\n".join(check_study(make_study(**tables)))


# --- pieces ---


def test_dust_is_what_has_one_corner() -> None:
    """All edges of a square broken by hand: a piece a corner, though middles go with them, and all of the mass."""
    scene, _ = make_scene(mesh={"builder": "box", "size": [1.0, 1.0], "h": 1.0, "order": 2}, fracture={"strength": 1.0})
    graph = scene.fracture.graph
    graph.break_edges(np.ones(len(graph.broken), bool))
    breaks = FractureLog(scene.balance.stress, scene.fracture)
    corners = len(scene.domain.input_mesh.points)
    assert breaks.counts[2] == corners
    assert breaks.count_single_nodes(scene.domain.volumes) == (corners, pytest.approx(1.0))


@pytest.mark.parametrize("dim", [2, 3])
def test_momentum_of_a_piece_is_the_impulse_of_its_floor(dim: int) -> None:
    """A block bounces and vibrates: midside nodes have most of its mass and a velocity of their own."""
    down = [0.0] * (dim - 1)
    study = make_study(
        mesh={"builder": "box", "size": [0.1] * dim, "h": 0.05, "order": 2},
        material={"young": 1e6, "poisson": 0.3, "density": 1000.0},
        initial={"velocity": [*down, -2.0]},
        obstacle=[{"name": "floor", "shape": "plane", "at": [*down, -0.002], "normal": [*down, 1.0]}],
        time={"scheme": "newmark", "step": 2e-4, "end": 0.01},
    )
    with Simulation(study) as simulation:
        axis, before = "xyz"[dim - 1], simulation.fragments()
        rows = []
        while not simulation.ended:
            rows.append(simulation.step())
        after = simulation.fragments()
    assert before["mass"] == pytest.approx(1000.0 * 0.1**dim)
    assert before[f"velocity_{axis}"] == pytest.approx(-2.0)
    impulse = -sum(row["dt"] * row[f"contact_floor_{axis}"] for row in rows)
    gained = after["mass"] * (after[f"velocity_{axis}"] - before[f"velocity_{axis}"])
    assert gained == pytest.approx(impulse, rel=1e-4)


def test_mass_of_a_round_piece_is_that_of_round_sides() -> None:
    """The drawn surface has straight sides; the mass that moves does not."""
    scene, state = disk()
    output = surface_output(None, scene.balance, FractureLog(scene.balance.stress, None), None, None, 1.0, smooth=False)
    state.v = np.tile([1.0, 0.0], len(state.v) // 2)
    fragments = output.make_frame(state.state, []).fragments
    assert fragments.mass == pytest.approx([scene.balance.mass.lumped.sum() / 2])
    assert fragments.volume == pytest.approx([scene.domain.volumes.sum()])
    assert fragments.velocity == pytest.approx(np.array([[1.0, 0.0]]))


def test_midside_nodes_between_pieces_do_not_move_the_pieces() -> None:
    """Two columns of nodes of a square torn off by hand: midside nodes of the broken edges are far away, pieces are
    not."""
    scene, state = make_scene(
        mesh={"builder": "box", "size": [1.0, 1.0], "h": 0.25, "order": 2}, fracture={"strength": 1.0}
    )
    graph, x = scene.fracture.graph, scene.domain.nodes[:, 0]
    ends = np.sort(x[graph.edge_nodes], axis=1)
    graph.break_edges((ends[:, 0] < 0.6) & (ends[:, 1] > 0.6))
    far = np.where(np.abs(x - 0.625) < 0.01, 10.0, 0.0)
    state.u = state.v = np.stack([far, far], axis=1).ravel()
    breaks = FractureLog(scene.balance.stress, scene.fracture)
    output = surface_output(None, scene.balance, breaks, None, None, 1.0, smooth=False)
    found = output.make_frame(state.state, []).fragments
    assert found.mass == pytest.approx([0.625, 0.375])
    assert found.centre[:, 0] == pytest.approx([0.3, 0.3125 / 0.375])
    assert np.abs(found.velocity).max() == 0.0
