"""What test_parallel and test_surface_output compare: arrays in the order of the input mesh, on any number of ranks."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
from dolfinx.fem import IntegralType
from mpi4py import MPI

from fracsim.fracture.node_retention import CellRetention
from fracsim.fracture.nonlocal_average import NonlocalAverage
from fracsim.fracture.strength import hash_points
from fracsim.mesh.dolfinx_compat import form_domains
from fracsim.mesh.domain import Domain
from fracsim.mesh.edge_graph import EdgeGraph
from fracsim.mesh.fragments import find_fragments
from fracsim.mesh.node_cells import node_components
from fracsim.mesh.parallel import RemoteRows, sum_over_ranks
from fracsim.scene import Scene, build_scene
from fracsim.timestepping.state import State
from support.solver_policy import other_policy

from .failing import Failing
from .scenes import Values, break_across, each_step, make_scene, make_study
from .surface_run import WrittenSurface

Found = dict[str, npt.NDArray[Any]]

MESHES: dict[str, dict[str, Any]] = {
    "2d": {"builder": "box", "size": [1.0, 0.6], "h": 0.07, "pattern": "unstructured"},
    "3d": {"builder": "box", "size": [1.0, 0.5, 0.5], "h": 0.19, "pattern": "unstructured"},
    "comb": {"builder": "box", "size": [1.0, 1.0], "h": 1 / 24},
    "bar": {"builder": "box", "size": [1.0, 0.25, 0.25], "h": 0.125},
}
KERNELS = ("linear", "constant", "gaussian")
RADIUS = {"2d": 0.2, "3d": 0.3}
TIGHT = {"snes_rtol": 1e-10, "ksp_rtol": 1e-10}


# --- the same definitions on input arrays (in the test) and on distributed ones (here) ---


def cell_field(centroids: Values) -> Values:
    """(cells, 2) a rough field of the place, so that every rank can work it out."""
    return np.column_stack([np.sin(40 * centroids @ np.arange(1, centroids.shape[1] + 1)), centroids[:, 0]])


def is_active(centroids: Values) -> npt.NDArray[np.bool_]:
    """Two cells in three, in stripes that rank boundaries cut, and none at the right end."""
    return (np.floor(30 * centroids[:, 0]) % 3 != 0) & (centroids[:, 0] < 0.7)


def comb(points: Values) -> npt.NDArray[np.int64]:
    """Two interlocking combs: each winds through the whole body, so through every rank, more than once."""
    x, y = points[:, 0] + 1e-3, points[:, 1] + 1e-3  # no node on a border
    tooth = np.floor(8 * x).astype(int) % 2
    return np.where(y < 0.2, 0, np.where(y > 0.8, 1, tooth)).astype(np.int64)


def spiral(points: Values) -> npt.NDArray[np.int64]:
    """A two-armed spiral."""
    x, y = points[:, 0] - 0.501, points[:, 1] - 0.502
    turns = np.arctan2(y, x) / (2 * np.pi) + 3 * np.hypot(x, y)
    return (np.floor(2 * turns) % 2).astype(np.int64)


def slabs(points: Values) -> npt.NDArray[np.int64]:
    """Three cuts between planes of nodes of the bar."""
    return np.searchsorted([0.2, 0.45, 0.8], points[:, 0])


LABELS: dict[str, tuple[str, Callable[[Values], npt.NDArray[np.int64]]]] = {
    "comb": ("comb", comb), "spiral": ("comb", spiral), "slabs": ("bar", slabs),
    "whole": ("bar", lambda points: np.zeros(len(points), np.int64)),
    "dust": ("comb", lambda points: np.round(points @ [24 * 25, 24]).astype(np.int64)),
}  # fmt: skip


# --- checks ---


def averages(domain: Domain, name: str) -> Found:
    """Averages of every kernel, of all cells and of active ones only."""
    centroids = domain.nodes[domain.cell_nodes].mean(axis=1)
    values, active = cell_field(centroids), is_active(centroids)
    found: Found = {}
    for kernel in KERNELS:
        average = NonlocalAverage(domain, RADIUS[name], kernel)
        found[f"average-{name}-{kernel}"] = domain.input_numbering.gather_cells(average(values))
        found[f"active-{name}-{kernel}"] = domain.input_numbering.gather_cells(average(values, active))
    return found


def requested_rows(domain: Domain) -> Found:
    """Numbers and nodes in the input mesh of cells that each rank requests: from the last on, another share each."""
    comm, number = domain.comm, domain.input_numbering.cells
    parts = comm.allgather(number)
    owner, index = np.zeros((2, sum(map(len, parts))), np.int64)
    for rank, cells in enumerate(parts):
        owner[cells], index[cells] = rank, np.arange(len(cells))
    wanted = np.arange(len(owner))[:: -2 - comm.rank]
    exchange = RemoteRows(comm, owner[wanted], index[wanted])
    nodes = domain.input_numbering.nodes[domain.cell_nodes]
    arrived = exchange(number[exchange.requested], nodes[exchange.requested])
    rows = np.concatenate(comm.allgather(np.column_stack([wanted, *arrived])))
    is_once = len(exchange.requested) == len(set(exchange.requested.tolist()))
    return {"requested-rows": rows, "requested-once": np.array(comm.allgather(is_once))}


def pieces(label: str) -> Found:
    """Pieces and their masses with all edges between unlike nodes broken."""
    mesh, law = LABELS[label]
    scene, _ = make_scene(mesh=MESHES[mesh])
    domain, graph = scene.domain, EdgeGraph(scene.domain)
    of_node = law(domain.nodes)
    ends = of_node[graph.edge_nodes]
    count = graph.break_edges(ends[:, 0] != ends[:, 1])
    bodies = find_fragments(graph)
    d = domain.dim
    piece = domain.input_numbering.gather_nodes(bodies.node_fragment[: domain.node_count])
    mass = domain.input_numbering.gather_nodes(scene.balance.mass.lumped[::d])
    return {
        f"pieces-{label}": np.array([bodies.count, count]),
        f"piece-{label}": piece,
        f"piece-mass-{label}": None if piece is None or mass is None else np.bincount(piece, mass),
    }


def edges(domain: Domain) -> Found:
    """Edges broken from the side of single cells, and the hashed number of every edge's mid-point."""
    graph = EdgeGraph(domain)
    flags = np.zeros(len(graph.broken), bool)
    flags[graph.cell_edges[domain.input_numbering.cells % 7 == 0]] = True
    count = graph.break_edges(flags)
    ends = domain.nodes[graph.edge_nodes[: graph.edge_count]]
    keys = graph.keys.of_edges(np.arange(graph.edge_count))
    every = domain.comm.gather((keys, hash_points(ends[:, 0] + ends[:, 1])))
    found = {
        "edges-broken": graph.broken_keys(),
        "edges-count": np.array([count, sum_over_ranks(domain.comm, graph.broken_count)[0]]),
        "edges-patterns": domain.input_numbering.gather_cells(graph.pattern.astype(np.int64)),
    }
    if every is not None:
        keys, noise = (np.concatenate(parts) for parts in zip(*every, strict=True))
        order = np.lexsort(keys.T[::-1])
        found |= {"edges-keys": keys[order], "edges-noise": noise[order]}
    return found


def held(scene: Scene) -> Found:
    """What breaks of a body in 3D where all edges in the middle fail and nodes keep a cell, by loads of a place."""
    domain, graph = scene.domain, EdgeGraph(scene.domain)
    ends = domain.nodes[graph.edge_nodes][..., 0]
    failing = Failing(np.flatnonzero(((ends > 0.3) & (ends < 0.7)).any(axis=1)))
    own = 3.0 + 2.5 * cell_field(domain.nodes[domain.cell_nodes].mean(axis=1))[:, :1]
    stress = own * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
    flags = np.zeros(len(graph.broken), bool)
    flags[CellRetention(failing, scene.balance.stress, graph)(stress, own)[0]] = True  # type: ignore[arg-type]
    graph.break_edges(flags)
    return {"held-broken": graph.broken_keys()}


def weakened(comm: MPI.Intracomm) -> tuple[npt.NDArray[Any] | None, int]:
    """(n, 3) keys and integrities after each rank has lowered what it sees of the edges, on rank 0, and how many broke
    (collective)."""
    mesh = {"builder": "box", "size": [1.0, 1.0], "h": 0.1, "pattern": "unstructured"}
    domain = build_scene(comm, make_study(mesh=mesh)).domain
    graph = EdgeGraph(domain)
    values = np.ones(len(graph.integrity))
    np.minimum.at(
        values, graph.cell_edges, (domain.input_numbering.cells % 5 / 4)[:, None]
    )  # each cell says its own number
    count = graph.weaken(values)[0]
    assert graph.weaken(np.ones(len(values))) == (0, 0)  # never rises
    found = graph.keys.gather(graph.integrity < 1, graph.integrity[:, None])
    return (None if found is None else np.column_stack(found)), count


def weaken(scene: Scene) -> None:
    """Give the cells a chi that follows from their place in the input: 0 in one of three, anything in the others."""
    domain, chi = scene.domain, scene.balance.stress.chi
    assert chi is not None
    chi.x.array[: domain.cell_count] = np.where(
        domain.input_numbering.cells % 3, np.cos(domain.input_numbering.cells) ** 2, 0.0
    )


def integrated_cells(scene: Scene) -> npt.NDArray[np.int32]:
    """Owned cells that the residual is assembled over."""
    work = scene.balance._work
    return dict(form_domains(work, IntegralType.cell))[1]


def dead_cells(mass: str, *ways: str) -> Found:
    """Residual and tangent of the damped block with its dead cells, without, and `ways` of it: without their entries,
    and assembled in blocks, and how many cells those are."""
    block = RUNS["block"]
    scene, state = make_scene(**block | {"time": block["time"] | {"mass": mass}})
    domain, balance = scene.domain, scene.balance
    balance.begin_step(0.05, 0.05, state.u, state.v, state.a)
    balance.set_displacement(np.sin(1e3 * domain.nodes[: domain.node_count]).reshape(-1) / 100)
    weaken(scene)
    x, y = balance.work_vector.duplicate(), balance.work_vector.duplicate()
    x.array_w[:] = np.cos(1e3 * domain.nodes[: domain.node_count]).reshape(-1)
    found: Found = {}
    for name in ("with", "without", *(f"{way}-without" for way in ways)):
        if name.startswith("fitted"):
            assert balance.tangent.may_shrink(0.7)
            balance.tangent.shrink()
        blocks = balance.tangent.switch_to_blocks() if name.startswith(("blocks", "brought")) else None
        balance.tangent.assemble(blocks_only=name.startswith("blocks"))
        (balance.tangent.matrix if blocks is None or name.startswith("brought") else blocks).mult(x, y)
        gather_nodes = domain.input_numbering.gather_nodes
        found[f"tangent-{name}-dead"] = gather_nodes(y.array_r.reshape(-1, domain.dim))
        found[f"residual-{name}-dead"] = gather_nodes(balance.update_forces().reshape(-1, domain.dim))
        found[f"cells-{name}-dead"] = sum_over_ranks(domain.comm, len(integrated_cells(scene)))
        balance.damage_changed()
    return {f"{mass}-{key}": values for key, values in found.items()}


def some_whole(cells: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """Two thirds of the cells, of input numbers (n,)."""
    return np.cos(cells) > -0.5


def parts() -> Found:
    """Components of the cells of a body of which a third is split: number of the largest one at each node."""
    domain = make_scene(mesh=MESHES["3d"], material=SOFT)[0].domain
    count, part = node_components(domain, some_whole(domain.input_numbering.cells))
    return {"parts-of-node": domain.input_numbering.gather_nodes(part), "parts-count": np.array(count)}


def result_of(name: str, scene: Scene, state: State, rows: list[list[float]]) -> Found:
    """Everything that must not depend on the partition."""
    domain, found = scene.domain, {f"{name}-history": np.array(rows)}
    found[f"{name}-u"] = domain.input_numbering.gather_nodes(state.u.reshape(-1, domain.dim))
    found[f"{name}-v"] = domain.input_numbering.gather_nodes(state.v.reshape(-1, domain.dim))
    found[f"{name}-energy"] = np.array([state.work, state.dissipated])
    found[f"{name}-mass"] = domain.input_numbering.gather_nodes(scene.balance.mass.lumped.reshape(-1, domain.dim))
    if scene.balance.stress.material.plastic is not None:
        memory = scene.balance.stress.material.plastic.snapshot()
        found[f"{name}-plastic"] = domain.input_numbering.gather_cells(
            memory.reshape(domain.cell_count, -1, memory.shape[1])
        )
    if scene.fracture is not None and scene.balance.stress.chi is not None:
        found[f"{name}-chi"] = domain.input_numbering.gather_cells(
            scene.balance.stress.chi.x.array[: domain.cell_count]
        )
    if scene.fracture is not None:
        found[f"{name}-broken"] = scene.fracture.graph.broken_keys()
        found[f"{name}-pieces"] = np.array([find_fragments(scene.fracture.graph).count])
    return found


SOFT = {"young": 1.0, "poisson": 0.3, "density": 1.0}
# All break within their first steps and most are followed for a few more.
RUNS: dict[str, dict[str, Any]] = {
    # unstructured, finite strain, averaged, torn to pieces
    "plate": {
        "mesh": MESHES["2d"], "material": SOFT | {"energy": "neo-hookean"},
        "boundary": [{"on": "left", "fix": "xy"}, {"on": "right", "velocity": [0.4, 0.1]}],
        "fracture": {"strength": 0.2, "radius": 0.15}, "time": {"scheme": "backward-euler", "step": 0.05, "end": 0.25},
        "probe": [{"name": "grip", "on": "right"}, {"name": "tip", "point": [0.5, 0.3]}],
    },
    "block": {
        "mesh": MESHES["3d"], "material": SOFT | {"energy": "corotated"}, "load": {"gravity": [0.0, 0.0, -0.01]},
        "boundary": [{"on": "left", "fix": "xyz"}, {"on": "right", "velocity": [0.4, 0.0, 0.1]}],
        "fracture": {"strength": 0.15, "radius": 0.25, "kernel": "gaussian"},
        "damping": {"mass": 0.1, "stiffness": 0.01},
        "time": {"scheme": "newmark", "step": 0.05, "end": 0.2},
        "probe": [{"name": "grip", "on": "right"}],
    },
    # yields, then tears
    "ductile": {
        "mesh": MESHES["2d"], "material": SOFT | {"energy": "neo-hookean"},
        "boundary": [{"on": "left", "fix": "xy"}, {"on": "right", "velocity": [0.4, 0.1]}],
        "plasticity": {"yield_stress": 0.06, "hardening": 0.5, "flow_rate": 20.0},
        "fracture": {"strength": 0.2, "radius": 0.15, "passes": 3},
        "time": {"scheme": "backward-euler", "step": 0.05, "end": 0.25},
        "probe": [{"name": "grip", "on": "right"}],
    },
    # a symmetric lattice in uniform stress: all aligned edges are tied, and only the hashed noise decides
    "ties": {
        "mesh": {"builder": "box", "size": [1.0, 0.5], "h": 0.0625},
        "material": SOFT | {"energy": "linear", "poisson": 0.0},
        "boundary": [{"on": "left", "fix": "xy"}, {"on": "right", "displacement": {
            "time": [0.0, 1.0], "value": [[0.0, "free"], [0.2, "free"]]}}],
        "fracture": {"strength": 0.1, "radius": 0.15, "tie_break": 1e-6},
        "time": {"scheme": "quasi-static", "step": 0.125, "end": 0.75},
        "probe": [{"name": "grip", "on": "right"}],
        # without inertia a piece hangs by 1e-8 of its stiffness: iterations to 1e-10 of all forces leave its place open
        "solver": {"ksp_type": "preonly", "pc_type": "lu", "pc_factor_mat_solver_type": "mumps", "snes_rtol": 1e-11},
    },
    # torn, then pushed together again
    "closing": {
        "mesh": MESHES["2d"], "material": SOFT | {"energy": "neo-hookean"},
        "boundary": [{"on": "left", "fix": "xy"}, {"on": "right", "displacement": {
            "time": [0.0, 0.1, 0.3], "value": [[0.0, 0.0], [0.07, 0.02], [-0.05, 0.0]]}}],
        "fracture": {"strength": 0.2, "radius": 0.1, "unilateral": True},
        "time": {"scheme": "generalized-alpha", "step": 0.025, "end": 0.3},
        "probe": [{"name": "grip", "on": "right"}],
    },
    # broken by a hammer that it does not pass, and rubbed by it
    "struck": {
        "mesh": MESHES["2d"], "material": SOFT | {"energy": "neo-hookean"}, "boundary": [{"on": "left", "fix": "xy"}],
        "fracture": {"strength": 0.06, "radius": 0.1},
        "obstacle": [{"name": "hammer", "shape": "sphere", "radius": 0.15, "at": [0.8, 0.76], "velocity": [0.05, -0.8],
                      "friction": 0.3}],
        "time": {"scheme": "backward-euler", "step": 0.05, "end": 0.15}, "probe": [{"name": "grip", "on": "left"}],
    },
    # the same in explicit steps, and by a stone that flies. It is so round that no point comes in deeper than its
    # rounding, where the nearest face, and so the direction of the force, would be a matter of round-off.
    "rapped": {
        "mesh": MESHES["2d"], "material": SOFT | {"energy": "neo-hookean"}, "boundary": [{"on": "left", "fix": "xy"}],
        "fracture": {"strength": 0.1, "radius": 0.1},
        "obstacle": [{"name": "hammer", "shape": "sphere", "radius": 0.15, "at": [0.8, 0.756], "velocity": [0.05, -0.5],
                      "friction": 0.3},
                     {"name": "stone", "shape": "box", "size": [0.2, 0.2], "rounding": 0.06,
                      "at": [0.8, -0.106], "velocity": [0.0, 0.5], "spin": [0.2], "mass": 0.2, "friction": 0.3}],
        "time": {"scheme": "explicit", "step": 0.05, "end": 0.3}, "probe": [{"name": "grip", "on": "left"}],
    },
    # broken by a stone that flies, falls, spins and rubs, with another one after it
    "thrown": {
        "mesh": MESHES["2d"], "material": SOFT | {"energy": "neo-hookean"}, "boundary": [{"on": "left", "fix": "xy"}],
        "fracture": {"strength": 0.006, "radius": 0.1}, "load": {"gravity": [0.0, -0.1]},
        "obstacle": [{"name": "stone", "shape": "sphere", "radius": 0.15, "at": [0.8, 0.77], "velocity": [0.05, -1.2],
                      "spin": [1.0], "mass": 0.02, "friction": 0.3},
                      {"name": "second", "shape": "box", "size": [0.2, 0.1], "at": [0.85, 1.0], "velocity": [0.0, -2.0],
                       "mass": 0.01}],
        "time": {"scheme": "generalized-alpha", "step": 0.025, "end": 0.1},
    },
    # torn, then pushed together until its pieces touch one another
    "shut": {
        "mesh": MESHES["2d"], "material": SOFT | {"energy": "neo-hookean"},
        "boundary": [{"on": "left", "fix": "xy"}, {"on": "right", "displacement": {
            "time": [0.0, 0.125, 0.4], "value": [[0.0, 0.0], [0.07, 0.02], [-0.1, 0.0]]}}],
        "fracture": {"strength": 0.1, "radius": 0.1}, "contact": {"friction": 0.2},
        "time": {"scheme": "backward-euler", "step": 0.025, "end": 0.275}, "probe": [{"name": "grip", "on": "right"}],
    },
    # broken as it is crushed, pieces touching one another alone
    "crushed": {
        "mesh": MESHES["2d"], "material": SOFT | {"energy": "neo-hookean"},
        "boundary": [{"on": "left", "fix": "xy"}, {"on": "right", "displacement": {
            "time": [0.0, 0.4], "value": [[0.0, 0.0], [-0.4, 0.2]]}}],
        "fracture": {"strength": 0.03, "radius": 0.1}, "contact": {"itself": "pieces", "friction": 0.2},
        "time": {"scheme": "backward-euler", "step": 0.05, "end": 0.4}, "probe": [{"name": "grip", "on": "right"}],
    },
    # the same in explicit steps, walls inside pieces touching and rubbing, too
    "rammed": {
        "mesh": MESHES["2d"], "material": SOFT | {"energy": "neo-hookean"},
        "boundary": [{"on": "left", "fix": "xy"}, {"on": "right", "displacement": {
            "time": [0.0, 0.4], "value": [[0.0, 0.0], [-0.3, 0.15]]}}],
        "fracture": {"strength": 0.03, "radius": 0.1}, "contact": {"friction": 0.3},
        "time": {"scheme": "explicit", "step": 0.05, "end": 0.3}, "probe": [{"name": "grip", "on": "right"}],
    },
    # broken by an axe that is read from a file
    "hewn": {
        "mesh": MESHES["3d"], "material": SOFT | {"energy": "neo-hookean"}, "boundary": [{"on": "left", "fix": "xyz"}],
        "fracture": {"strength": 0.1, "radius": 0.2},
        "obstacle": [{"name": "axe", "shape": "mesh", "file": str(Path(__file__).parent / "axe.obj"), "scale": 0.1,
                      "at": [0.8, 0.25, 0.52], "velocity": [0.05, 0.0, -0.8], "friction": 0.3},
                     {"name": "chip", "shape": "mesh", "file": str(Path(__file__).parent / "axe.obj"), "scale": 0.05,
                      "at": [0.4, 0.25, 0.515], "velocity": [0.0, 0.1, -0.8], "spin": [1.0, 2.0, 0.0], "friction": 0.3,
                      "density": 5.0}],
        "time": {"scheme": "backward-euler", "step": 0.05, "end": 0.2}, "probe": [{"name": "grip", "on": "left"}],
    },
}  # fmt: skip
# a plate, in which nodes that have lost their last whole cell stay joined to others
RUNS["joined"] = RUNS["plate"] | {
    "fracture": {"strength": 0.09, "radius": 0.05, "crumbs": False},
    "time": {"scheme": "newmark", "step": 0.05, "end": 0.6},
}
SURFACES = ("plate", "block")  # whose split surface is written
# the same, each step solved with its own flow
RUNS["ductile-implicit"] = RUNS["ductile"] | {"plasticity": RUNS["ductile"]["plasticity"] | {"update": "implicit"}}


def run(name: str, folder: Path | None = None) -> Found:
    """A study to its end; rows of (broken, kinetic, elastic, probes), and its split surface where a folder is given."""
    scene, state = make_scene(**{"solver": TIGHT} | RUNS[name])
    surface = None if folder is None else WrittenSurface(scene, state, folder / name)
    rows = []
    for report in each_step(scene, state):
        rows.append([report.broken, report.kinetic, report.elastic, *scene.probes()])
        if surface is not None:
            surface.step(state, report.broken)
    return result_of(name, scene, state, rows) | ({} if surface is None else surface.result(name))


def squeezed() -> Found:
    """A body pressed to two thirds of its height, then cut through aslant: which walls find no room and are drawn in or
    left out, at once and two steps later; and where the body is then."""
    way = {"time": [0.0, 0.1], "value": [[0.0, 0.0], [0.03, -0.2]]}
    scene, state = make_scene(
        mesh=MESHES["2d"], material=SOFT | {"energy": "neo-hookean"}, fracture={"strength": 1e9, "radius": 0.1},
        boundary=[{"on": "bottom", "fix": "xy"}, {"on": "top", "displacement": way}], contact={},
        time={"scheme": "backward-euler", "step": 0.05, "end": 0.2}, solver=TIGHT,
    )  # fmt: skip
    steps = each_step(scene, state)
    next(steps), next(steps)
    break_across(scene, [0.3, 1.0], 0.4)
    state.remember()
    at_once = scene.balance.histories.to_checkpoint()
    next(steps), next(steps)
    later, u = (
        scene.balance.histories.to_checkpoint(),
        scene.domain.input_numbering.gather_nodes(state.u.reshape(-1, 2)),
    )
    walls = {f"squeezed-{when}-{name.removeprefix('contact.')}": np.array(values)
             for when, saved in (("at-once", at_once), ("later", later)) for name, values in saved.items()}  # fmt: skip
    return walls | {"squeezed-u": u}


def in_blocks() -> Found:
    """Edges that the block breaks where its tangent is multiplied with in blocks."""
    with other_policy(min_block_dofs=0):
        found = run("block") | run("joined")
    return {f"{key}-in-blocks": found[key] for key in ("block-broken", "block-u", "joined-broken", "joined-u")}


def compared(folder: Path) -> Found:
    """All checks, with the files of surfaces in a folder."""
    found: Found = {}
    for name in ("2d", "3d"):
        scene, _ = make_scene(mesh=MESHES[name])
        found |= averages(scene.domain, name)
        if name == "3d":
            found |= edges(scene.domain) | held(scene) | requested_rows(scene.domain)
    for label in LABELS:
        found |= pieces(label)
    for name in RUNS:
        found |= run(name, folder if name in SURFACES else None)
    integrity, count = weakened(MPI.COMM_WORLD)
    found |= {"weakened-integrity": integrity, "weakened-count": np.array(count)}
    found |= dead_cells("lumped", "fitted", "blocks", "brought") | dead_cells("consistent", "blocks", "brought")
    return found | parts() | squeezed() | in_blocks()
