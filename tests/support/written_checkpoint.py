"""Checkpoints of states that are functions of the numbers in the input mesh, written and read in blocks of few rows."""

from __future__ import annotations

import sys
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fracsim.fracture.edge_history import EdgeHistory
from fracsim.output.checkpoint import read_checkpoint, write_checkpoint
from fracsim.output.checkpoint_file import ArrayWriter, CheckpointNotes, checkpoint_path
from fracsim.scene import Scene, build_scene
from fracsim.study.reader import study_text

from .scenes import make_study

Values = npt.NDArray[np.float64]
BOX = {"builder": "box", "size": [1.0, 1.0, 1.0], "h": 0.25, "pattern": "unstructured"}
CASES: dict[str, dict[str, Any]] = {
    "block": {
        "mesh": BOX, "fracture": {"strength": 1.0, "radius": 0.5}, "plasticity": {"yield_stress": 1.0},
        "material": {"energy": "neo-hookean", "young": 1.0, "poisson": 0.3, "density": 1.0},
    },
    "quadratic": {"mesh": BOX | {"size": [1.0, 1.0], "h": 0.15, "order": 2}},
}  # fmt: skip
NODAL = ("u", "v", "a", "forces")
# rows of a block
FEW = 20


def nodal_values(name: str, nodes: npt.NDArray[np.int64], dim: int) -> Values:
    """(n, d) values of an array at input nodes."""
    return np.sin(1.7 * nodes[:, None] + NODAL.index(name) + np.arange(dim))


def chi_values(cells: npt.NDArray[np.int64]) -> Values:
    return np.cos(cells) ** 2


def plastic_values(cells: npt.NDArray[np.int64], columns: int) -> Values:
    return np.asarray(np.cos(0.3 * cells[:, None] + np.arange(columns)))


def edge_integrity(keys: npt.NDArray[np.int64]) -> Values:
    """(n,) a fifth of the edges are broken, another is weakened."""
    return np.asarray(np.array([0.0, 0.25, 1.0, 1.0, 1.0])[(keys @ [3, 1]) % 5])


def edge_history(keys: npt.NDArray[np.int64]) -> Values:
    """(n, 5) times, cuts, and states of tips."""
    rows = np.sin(keys @ [1.3, 0.7])[:, None] + np.arange(5.0)
    rows[keys[:, 0] % 3 == 0, 1] = np.nan
    return np.asarray(rows)


def in_small_blocks() -> ExitStack:
    """Context in which blocks have few rows."""
    stack = ExitStack()
    for module in ("mesh.parallel", "mesh.edge_graph", "output.checkpoint_file"):
        stack.enter_context(mock.patch(f"fracsim.{module}.MAX_GATHERED_ROWS", FEW))
    stack.enter_context(mock.patch("fracsim.mesh.edge_graph.NODES_PER_RANGE", 1))
    return stack


def build(name: str) -> tuple[Scene, EdgeHistory | None]:
    scene = build_scene(MPI.COMM_WORLD, make_study(**CASES[name]))
    return scene, None if scene.fracture is None else EdgeHistory(scene.fracture.graph)


def write(name: str, folder: Path) -> int:
    """Write the checkpoint of a case; returns the most rows of an array that were written at once."""
    scene, record = build(name)
    domain, stress = scene.domain, scene.balance.stress
    numbering, owned = domain.input_numbering, slice(domain.node_count)
    state = scene.start()
    values = {key: nodal_values(key, numbering.nodes[owned], domain.dim).reshape(-1) for key in NODAL}
    state = replace(state, t=0.5, step=3, elastic=1.0 if domain.comm.rank == 0 else 0.0, **values)
    if record is not None:
        keys = record.graph.keys.of_edges(np.arange(len(record.graph.broken)))
        record.graph.set_integrity(edge_integrity(keys))
        history = edge_history(keys)
        record.break_times, record.cut_positions, record.tip_states = history[:, 0], history[:, 1], history[:, 2:]
        assert stress.chi is not None and stress.material.plastic is not None
        stress.chi.x.array[: domain.cell_count] = chi_values(numbering.cells)
        columns = stress.material.plastic.snapshot().shape[1]
        stress.material.plastic.restore(plastic_values(numbering.cells, columns))
    sizes = []

    def append(self: ArrayWriter, array: str, rows: npt.NDArray[Any]) -> None:
        if not array.startswith("term."):
            sizes.append(len(rows))
        plain(self, array, rows)

    plain = ArrayWriter.append_rows
    with mock.patch.object(ArrayWriter, "append_rows", append):
        write_checkpoint(folder, domain, state, scene.balance, CheckpointNotes(study_text(scene.study), {}), record)
    return max(sizes, default=0)


def read(name: str, folder: Path) -> list[str]:
    """Names of arrays that are not, to the last digit, what the numbers of nodes, cells and edges of this rank say."""
    scene, record = build(name)
    domain, stress = scene.domain, scene.balance.stress
    numbering, owned = domain.input_numbering, slice(domain.node_count)
    state = read_checkpoint(folder, domain, scene.start(), scene.balance, record)
    pairs: dict[str, tuple[Any, Any]] = {
        key: (getattr(state, key).reshape(-1, domain.dim), nodal_values(key, numbering.nodes[owned], domain.dim))
        for key in NODAL
    }
    if record is not None:
        keys = record.graph.keys.of_edges(np.arange(len(record.graph.broken)))
        integrity, history = edge_integrity(keys), edge_history(keys)
        history[integrity == 1] = np.nan
        assert stress.chi is not None and stress.material.plastic is not None
        plastic = stress.material.plastic.snapshot()
        pairs |= {
            "integrity": (record.graph.integrity, integrity), "history": (record.weakened_rows(), history),
            "chi": (stress.chi.x.array[: domain.cell_count], chi_values(numbering.cells)),
            "plastic": (plastic, plastic_values(numbering.cells, plastic.shape[1])),
        }  # fmt: skip
    return [key for key, (values, expected) in pairs.items() if not np.array_equal(values, expected, equal_nan=True)]


def main(path: str) -> None:
    """Save the bytes of the files of all cases, and what was not read as it should be (collective)."""
    comm, folder = MPI.COMM_WORLD, Path(path).with_suffix("")
    results: dict[str, Any] = {}
    for name in CASES:
        for kind, context in (("whole", ExitStack), ("blocks", in_small_blocks)):
            target = folder / f"{name}-{kind}"
            if comm.rank == 0:
                target.mkdir(parents=True)
            with context():
                results[f"{name}-{kind}-rows"] = write(name, target)
                different = comm.allgather(read(name, target))
            results[f"{name}-{kind}-different"] = np.array(sorted(set().union(*different)), str)
            if comm.rank == 0:
                results[f"{name}-{kind}-file"] = np.frombuffer(checkpoint_path(target).read_bytes(), np.uint8)
    if comm.rank == 0:
        np.savez(path, **results)


if __name__ == "__main__":
    main(sys.argv[1])
