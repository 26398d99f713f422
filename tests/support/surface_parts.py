"""Split surfaces of bodies broken by rule, whose parts are on all ranks, beside those of whole meshes on one rank."""

from __future__ import annotations

import shutil
import sys
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fracsim.fracture.edge_history import EdgeHistory
from fracsim.mesh.domain import Domain, distribute
from fracsim.mesh.edge_graph import EdgeGraph
from fracsim.mesh.fragments import find_fragments
from fracsim.mesh.parallel import Gather
from fracsim.mesh.split_surface.entity_numbering import EntityNumbering
from fracsim.mesh.split_surface.mesh_part import WholeMesh
from fracsim.meshes.data import MeshData
from fracsim.meshes.topology import boundary_facets, facets_on_nodes
from fracsim.output.fields_file import Field
from fracsim.output.result_checks import InterpenetrationMonitor
from fracsim.output.surface.body_surface import BodySurface
from fracsim.output.surface.surface_output import RankValues, SurfaceOutput
from fracsim.scene import Scene, build_scene_on

from .scenes import Values, make_study
from .solids import lattice

Arrays = dict[str, npt.NDArray[Any]]
FRAMES = 4
RANK_KINDS = ("", "-restarted", "-smooth")
WHOLE_KINDS = ("-whole", "-whole-smooth")
KINDS = (*RANK_KINDS, *WHOLE_KINDS)


def noise(points: Values) -> Values:
    """(n,) numbers of 0 to 1 that depend on the place alone."""
    # in whole numbers: the rounding of a sum depends on how many are added at once
    factors = np.array([12_711, 31_173, 7_477])[: points.shape[1]]
    return np.asarray((np.round(1e6 * points).astype(np.int64) * factors).sum(axis=1) * 69_621 % 100_003 / 100_003)


def box(*counts: int) -> MeshData:
    """A shuffled box with two groups that share facets."""
    mesh = lattice(*counts)
    random = np.random.default_rng(7)
    number = random.permutation(len(mesh.points))
    points = np.empty_like(mesh.points)
    points[number] = mesh.points
    cells = number[mesh.cells][random.permutation(len(mesh.cells))]
    facets = boundary_facets(cells)
    groups = {name: facets_on_nodes(facets, points[:, axis] == 0) for axis, name in enumerate(("left", "low"))}
    return MeshData(points, cells, groups | {"both": np.concatenate(list(groups.values()))})


def sliced(midpoints: Values, ends: Values) -> Values:
    """(edges,) time at which each edge breaks: three planes, nodes that come loose, and cracks that end in the body."""
    across = np.any(np.floor(ends[:, 0] / 1.7) != np.floor(ends[:, 1] / 1.7), axis=1)
    loose = (noise(ends.reshape(-1, ends.shape[2])).reshape(-1, 2) > 0.85).any(axis=1)
    times = np.where(across, 1.0, np.inf)
    times[loose] = 2.0
    times[noise(midpoints) < 0.15] = np.minimum(times, 3.0)[noise(midpoints) < 0.15]
    return times


def shattered(midpoints: Values, ends: Values) -> Values:
    """(edges,) all but a few break, so that most nodes have no unsplit cell."""
    return np.where(noise(midpoints) < 0.7, 1.0 + np.floor(3 * noise(midpoints)), np.inf)


Law = Callable[[Values, Values], Values]
BODIES: dict[str, tuple[MeshData, Law, int]] = {
    "solid": (box(5, 4, 3), sliced, 1), "plate": (box(7, 6), sliced, 1), "curved": (box(3, 3, 3), sliced, 2),
    "dust": (box(3, 3, 4), shattered, 1), "square": (box(1, 1), sliced, 1),
}  # fmt: skip


def frames(scene: Scene, law: Law, record: EdgeHistory) -> Iterator[tuple[Any, list[Field]]]:
    """States and cell fields while the body turns, stretches and breaks (collective)."""
    domain, state = scene.domain, scene.start()
    graph, nodes = record.graph, domain.nodes
    ends = nodes[graph.edge_nodes]
    times, size = law(ends.mean(axis=1), ends), domain.bounds.diagonal
    for t in range(FRAMES):
        graph.break_edges(times <= t)
        record.record_breaks(float(t), np.clip(noise(ends.mean(axis=1)), 0.2, 0.8) if t > 1 else None)
        turn = np.eye(domain.dim)
        turn[:2, :2] = [[np.cos(t), -np.sin(t)], [np.sin(t), np.cos(t)]]
        x = (1 + 0.02 * np.sin(3 * nodes / size)) * nodes @ turn.T
        fragment = find_fragments(graph).node_fragment
        # fragments come nearer
        u = (x - nodes - 0.9 * (fragment[:, None] % 3))[: domain.node_count].reshape(-1)
        v = np.column_stack([noise(nodes + axis) for axis in range(domain.dim)])[: domain.node_count].reshape(-1)
        centroids = nodes[domain.cell_nodes].mean(axis=1)
        fields = [Field("stress", "Cell", np.outer(noise(centroids), np.arange(1.0, 7.0)))]
        fields.append(Field("region", "Cell", np.floor(9 * noise(centroids)).astype(np.int32)))
        yield replace(state, t=float(t), u=u, v=v), fields


class WholeValues:
    """Values of the whole body in the order of the input mesh, in place of RankValues (one rank)."""

    def __init__(self, domain: Domain) -> None:
        mesh, self._domain = domain.input_mesh, domain
        assert mesh is not None
        self.part = WholeMesh(EntityNumbering(mesh))
        self.part.part_node = domain.input_numbering.nodes  # type: ignore[attr-defined]

    def of_nodes(self, values: Values) -> Values:
        rows = self._domain.input_numbering.gather_nodes(values.reshape(-1, self._domain.dim))
        return np.asarray(rows)[: len(self.part.node_numbers)]

    def of_cells(self, values: npt.NDArray[Any]) -> npt.NDArray[Any]:
        return np.asarray(self._domain.input_numbering.gather_cells(values))

    def of_drawn_cells(self, values: npt.NDArray[Any], drawn: npt.NDArray[np.bool_]) -> npt.NDArray[Any]:
        return self.of_cells(np.where(drawn.reshape(-1, *np.ones(values.ndim - 1, int)), values, 0))

    def of_broken_edges(self, history: EdgeHistory) -> tuple[Values, Values]:
        values = np.column_stack([history.break_times, history.cut_positions])
        edges, (times, cuts) = (rows.T for rows in history.graph.gather_broken(values))  # type: ignore[union-attr]
        return self.part.skeleton.edge_values(edges.T, times), self.part.skeleton.edge_values(edges.T, cuts)


def written(name: str, folder: Path) -> Arrays:
    """Surfaces of a body, restarted and smooth ones too, and on one rank those of the whole mesh (collective)."""
    mesh, law, order = BODIES[name]
    comm = MPI.COMM_WORLD
    domain = distribute(comm, mesh if comm.rank == 0 else None, order)
    scene = build_scene_on(domain, make_study(fracture={"strength": 1.0}))
    density, found = scene.balance.stress.material.density, Arrays()
    for kind in KINDS if comm.size == 1 else RANK_KINDS:
        target, record, monitor = folder / f"{name}{kind}", EdgeHistory(EdgeGraph(domain)), InterpenetrationMonitor()
        options: Any = {"passing": monitor, "smooth": "smooth" in kind}
        if kind == "-restarted":
            if comm.rank == 0:
                shutil.copytree(folder / name, target)
            comm.barrier()
            options["resume_at"] = 1.0
        output = None
        for state, fields in frames(scene, law, record):
            if kind == "-restarted" and state.t < 1:
                continue
            if output is None:
                values = WholeValues if kind in WHOLE_KINDS else RankValues
                with mock.patch("fracsim.output.surface.surface_output.RankValues", values):
                    output = SurfaceOutput(target, domain, density, record, **options)
            output.write_frame(state, fields)
        assert output is not None
        frame = output.make_frame(state, fields).gather()
        arrays = gathered_surface(output.surface) | {"overlap": np.array([str(monitor.first_overlap)])}
        if frame is not None:
            arrays |= {"frame-triangles": frame.triangles, "frame-segments": frame.segments}
            arrays |= {f"frame-{key}": values for key, values in frame.element_fields.items()}
            arrays["frame-velocity"] = frame.point_fields["velocity"]
        found |= {f"{name}{kind}:{key}": values for key, values in arrays.items()}
    piece = domain.input_numbering.gather_corners(find_fragments(record.graph).node_fragment[: domain.node_count])
    return found | {f"{name}:graph-piece": piece}


def gathered_surface(surface: BodySurface) -> Arrays:
    """Topology, reference places, parents and names of the surface of all ranks, None on ranks other than 0."""
    part, split, numbering = surface.part, surface.split, surface.numbering
    numbers, own, flat = part.node_numbers, numbering.is_own, part.skeleton.dim == 2
    owned = part.owner == part.comm.rank
    gather_nodes, gather_points = Gather(part.comm, numbers[owned]), Gather(part.comm, numbering.points[own])
    first = numbering.triangle_count if flat else 0
    gather_elements = Gather(part.comm, numbering.elements[len(split.fill) :] - first)
    gather_fill = Gather(part.comm, numbering.elements[: len(split.fill)])
    parents = np.full((len(own), part.skeleton.dim + 1), -1)
    counts = np.diff(split.parents.start)
    parents[np.arange(parents.shape[1]) < counts[:, None]] = numbers[split.parents.parents]
    edges = np.where(split.edge[:, None] >= 0, numbers[part.skeleton.edges[split.edge]], -1)
    found: dict[str, Any] = {
        "elements": gather_elements(numbering.points[split.elements]),
        "cell": gather_elements(part.cell_numbers[split.cell]), "edge": gather_elements(edges),
        "origin": gather_elements(split.origin), "points": gather_points(split.points[own]),
        "parents": gather_points(parents[own]), "fill": gather_fill(numbering.points[split.fill]),
        "names": surface.fragment_names, "piece": gather_nodes(split.node_fragment[owned]),
        "nodes": surface.fragment_nodes,
    }  # fmt: skip
    return found


def main(path: str) -> None:
    """Save the last surfaces; the files, of many blocks, are in a folder beside the path."""
    folder = Path(path).with_suffix("")
    found = Arrays()
    for name in BODIES:
        if MPI.COMM_WORLD.rank == 0:
            for kind in KINDS:
                if kind != "-restarted":
                    (folder / f"{name}{kind}").mkdir(parents=True, exist_ok=True)
        MPI.COMM_WORLD.barrier()
        with mock.patch("fracsim.output.surface.vtu_file.ROWS_PER_BLOCK", 50):
            found |= written(name, folder)
    if MPI.COMM_WORLD.rank == 0:
        np.savez(path, **found)


if __name__ == "__main__":
    main(sys.argv[1])
