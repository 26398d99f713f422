"""Mesh files of which each rank reads a share: whole ones, and ones with faults or something to note."""

from __future__ import annotations

import sys
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from unittest import mock

import h5py
import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fracsim.deformable_run import Run
from fracsim.mesh.domain import Domain
from fracsim.mesh.mesh_shares import MeshShare, distribute_shares, read_share
from fracsim.meshes import BUILDERS, MeshData
from fracsim.meshes.data import mesh_fingerprint
from fracsim.meshes.topology import facets_of
from fracsim.meshes.vtkhdf import find_file_mesh, write_vtkhdf
from fracsim.scene import build_scene
from fracsim.study.mesh_source import build_mesh

from . import torn
from .scenes import make_study

Ints = npt.NDArray[np.int64]


@dataclass
class Parts:
    """What a file has: cells in two regions, facets in groups, and points in space."""

    points: npt.NDArray[np.float64]
    cells: Ints
    facets: Ints
    facet_tags: Ints
    names: list[str]
    cell_tags: Ints = field(default_factory=lambda: np.zeros(0, np.int64))

    @classmethod
    def of_box(cls, dim: int) -> Parts:
        """Unit square or cube with its groups; cells above the middle and below are regions."""
        mesh = BUILDERS["box"](size=(1.0,) * dim, h=0.25, pattern="unstructured").build()
        groups = mesh.facet_groups
        tags = np.repeat(np.arange(1, len(groups) + 1), [len(rows) for rows in groups.values()])
        points = np.pad(mesh.points, ((0, 0), (0, 3 - dim)))
        names = [*groups, "low", "hö her"]
        is_high = points[mesh.cells].mean(axis=1)[:, dim - 1] > 0.5
        regions = len(groups) + 1 + is_high.astype(np.int64)
        return cls(points, mesh.cells, np.concatenate(list(groups.values())), tags, names, regions)

    @property
    def dim(self) -> int:
        return self.cells.shape[1] - 1

    @property
    def inner_node(self) -> int:
        """A node that is on no facet of a group."""
        return int(np.setdiff1d(self.cells, self.facets)[0])

    def add_cells(self, cells: Any, points: Any = ()) -> None:
        """Cells at the end, in the first region, and points."""
        self.points = np.concatenate([self.points, np.reshape(points, (-1, 3))])
        self.cells = np.concatenate([self.cells, np.reshape(cells, (-1, self.dim + 1))])
        self.cell_tags = np.pad(self.cell_tags, (0, len(self.cells) - len(self.cell_tags)), mode="edge")

    def add_copy(self, shift: float) -> None:
        """A second body, moved along all axes, without groups."""
        moved = self.points + np.pad(np.full(self.dim, shift), (0, 3 - self.dim))
        self.add_cells(self.cells + len(self.points), moved)

    def merge(self) -> None:
        """Points at one place are one."""
        _, first, number = np.unique(self.points, axis=0, return_index=True, return_inverse=True)
        order = np.argsort(np.argsort(first))
        self.points, self.cells, self.facets = (
            self.points[np.sort(first)], order[number.ravel()][self.cells], order[number.ravel()][self.facets],
        )  # fmt: skip

    def write(self, path: Path) -> Path:
        write_vtkhdf(path, self.points, [self.cells, self.facets], [self.cell_tags, self.facet_tags], self.names)
        return path


# --- what rank 0 has to mend or to refuse ---


def invert(parts: Parts) -> None:
    parts.cells[5, -2:] = parts.cells[5, :-3:-1]


def overlap(parts: Parts) -> None:
    """A cell on the same side of a facet of the boundary as the cell there."""
    facet = parts.facets[0]
    cell = parts.cells[np.isin(parts.cells, facet).sum(axis=1) == parts.dim][0]
    inside = parts.points[cell].mean(axis=0)
    parts.add_cells(np.where(np.isin(cell, facet), cell, len(parts.points)), inside)


def flatten(parts: Parts) -> None:
    """A node in the plane of the others of its cell."""
    nodes = next(cell for cell in parts.cells if parts.inner_node in cell)
    others = nodes[nodes != parts.inner_node]
    parts.points[parts.inner_node] = parts.points[others].mean(axis=0)


def lose(parts: Parts) -> None:
    """A facet of a group that is none of a cell."""
    parts.facets = np.concatenate([parts.facets, parts.cells[:1, :-1] * 0 + np.arange(parts.dim)])
    parts.facet_tags = np.append(parts.facet_tags, 1)
    parts.facets[-1, 0] = len(parts.points) - 1


def repeat(parts: Parts) -> None:
    parts.facets = np.concatenate([parts.facets, parts.facets[:1, ::-1]])
    parts.facet_tags = np.append(parts.facet_tags, parts.facet_tags[0])


def set_point(row: int, value: float) -> Callable[[Parts], None]:
    def change(parts: Parts) -> None:
        parts.points[row, 0] = value

    return change


def set_node(name: str, number: int) -> Callable[[Parts], None]:
    def change(parts: Parts) -> None:
        getattr(parts, name)[3, 0] = number if number < 0 else len(parts.points)

    return change


def lift(parts: Parts) -> None:
    """A plane mesh outside the plane z = 0; a solid one is a single point large."""
    if parts.dim == 2:
        parts.points[:, 2] = 0.5
    else:
        parts.points *= 1e-40


FAULTS: dict[str, Callable[[Parts], None]] = {
    "nan": set_point(3, np.nan),
    "infinite": set_point(-1, np.inf),
    "far": set_point(3, 1e31),
    "node": set_node("cells", 1),
    "node below 0": set_node("cells", -1),
    "node of a facet": set_node("facets", 1),
    "inverted": invert,
    "flat": flatten,
    "flat by its nodes": lambda parts: parts.cells.__setitem__((5, -1), parts.cells[5, 0]),
    "twice": lambda parts: parts.add_cells(parts.cells[7]),
    "overlap": overlap,
    "orphan": lambda parts: parts.add_cells([], [0.5, 0.5, 0.0]),
    "lost facet": lose,
    "repeated facet": repeat,
    "facet without a group": lambda parts: parts.facet_tags.__setitem__(0, 0),
    "two groups of one name": lambda parts: parts.names.__setitem__(1, "left"),
    "z or size": lift,
}


# --- what is noted ---


def open_crack(parts: Parts) -> None:
    """One cell has a node of its own in place of an inner one."""
    cell = int(np.flatnonzero((parts.cells == parts.inner_node).any(axis=1))[0])
    old, new = parts.inner_node, len(parts.points)
    parts.add_cells([], parts.points[old])
    parts.cells[cell][parts.cells[cell] == old] = new


def add_hinged(parts: Parts) -> None:
    """A second body that shares a corner."""
    parts.add_copy(1.0)
    parts.merge()


def add_inner_facets(parts: Parts) -> None:
    inner = facets_of(parts.cells[(parts.cells == parts.inner_node).any(axis=1)][:1])[0]
    parts.facets = np.concatenate([parts.facets, inner])
    parts.facet_tags = np.append(parts.facet_tags, np.full(len(inner), len(parts.names) + 1))
    parts.names.append("inside")


NOTED: dict[str, Callable[[Parts], None]] = {
    "nothing": lambda parts: None,
    "two bodies": lambda parts: parts.add_copy(5.0),
    "two bodies that touch": lambda parts: parts.add_copy(1.0),
    "crack": open_crack,
    "hinge": add_hinged,
    "inner facets": add_inner_facets,
}
CASES = [(dim, name) for dim in (2, 3) for name in (*FAULTS, *NOTED)]


def write_case(folder: Path, dim: int, name: str) -> Path:
    """The file of a case."""
    parts = Parts.of_box(dim)
    (FAULTS | NOTED)[name](parts)
    return parts.write(folder / f"{name}-{dim}.vtkhdf".replace(" ", "-"))


def share_of(path: Path, comm: MPI.Comm = MPI.COMM_SELF, scale: float = 1.0) -> MeshShare | None:
    file = find_file_mesh(path)
    assert file is not None
    return read_share(comm, file, scale)


def read_by_all(path: Path, comm: MPI.Comm = MPI.COMM_SELF, scale: float = 1.0) -> Domain:
    share = share_of(path, comm, scale)
    assert share is not None
    return distribute_shares(comm, share)


# --- on ranks ---


def save(mesh: MeshData, path: Path) -> None:
    from fracsim.meshes.write import write_mesh

    write_mesh(mesh, path)


def run_from_file(name: str, path: Path) -> dict[str, Any]:
    """A run of support/torn.py with its mesh from a file."""
    with mock.patch.dict(torn.RUNS, {name: torn.RUNS[name] | {"mesh": {"file": str(path)}}}):
        return torn.run(name)


def gathered_by_a_run(path: Path, folder: Path, surface: dict[str, Any], **more: Any) -> tuple[bool, int]:
    """Whether rank 0 has the whole mesh after a run with frames, breaks and a checkpoint; broken edges (collective)."""
    comm = MPI.COMM_WORLD
    study = make_study(**torn.RUNS["block"] | {"mesh": {"file": str(path)}, "solver": torn.TIGHT}
                       | {"output": {"every": 2, "picture": False, **surface}} | more)  # fmt: skip
    scene = build_scene(comm, study)
    run = Run(scene, folder)
    summary = run()
    run.checkpoint()
    assert scene.domain.whole_mesh is None
    gathered = comm.allgather("input_mesh" in vars(scene.domain))
    assert len(set(gathered)) == 1
    return gathered[0], summary["broken_edges"]


def main(path: str) -> None:
    """Save what shares of all cases are, and runs (collective)."""
    comm, folder = MPI.COMM_WORLD, Path(path).with_suffix("")
    files = {name: folder / f"{name}.vtkhdf" for name in ("plate", "block")}
    if comm.rank == 0:
        folder.mkdir()
        for dim, name in CASES:
            write_case(folder, dim, name)
        for name, file in files.items():
            save(build_mesh(make_study(**torn.RUNS[name]).mesh), file)
    comm.Barrier()
    found: dict[str, Any] = {}
    for dim, name in CASES:
        file = folder / f"{name}-{dim}.vtkhdf".replace(" ", "-")
        share = share_of(file, comm)
        refused = comm.allgather(share is None)
        assert len(set(refused)) == 1
        found[f"refused-{dim}-{name}"] = np.array(refused[0])
        if share is not None:
            domain = distribute_shares(comm, share)
            with mock.patch("fracsim.mesh.parallel.MAX_GATHERED_ROWS", 50):
                fingerprint = domain.fingerprint
            assert "input_mesh" not in vars(domain)
            mesh = domain.input_mesh
            assert (mesh is None) == (comm.rank > 0)
            if mesh is not None:
                found[f"notes-{dim}-{name}"] = np.array(domain.notes, str)
                found[f"mesh-{dim}-{name}"] = np.array([mesh_fingerprint(mesh), fingerprint])
    for name, file in files.items():
        found |= {f"run-{key}": values for key, values in run_from_file(name, file).items()}
        share = share_of(file, comm)
        assert share is not None
        found[f"shares-{name}"] = np.array(comm.allgather((len(share.points), len(share.cells))))
    surfaces = {"none": {"surface": False}, "surface": {"surface": True}, "smooth": {"surface": True, "cut": "smooth"}}
    for kind, surface in surfaces.items():
        found[f"gathered-{kind}"] = np.array(gathered_by_a_run(files["block"], folder / f"out-{kind}", surface))
    found["gathered-contact"] = np.array(
        gathered_by_a_run(files["block"], folder / "out-contact", {"surface": True}, contact={})
    )
    if comm.rank == 0:
        with h5py.File(folder / "out-none" / "fields.h5") as file:
            found |= {f"fields-{name}": file[name][:] for name in ("points", "cells")}
        np.savez(path, **found)


if __name__ == "__main__":
    main(sys.argv[1])
