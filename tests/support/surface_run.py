"""What test_surface_output compares: bodies torn on any number of ranks with their split surface written.

`mpirun -n 2 python -m mpi4py -m support.surface_run OUT.npz`
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from mpi4py import MPI

from fracsim.fracture.record import EdgeRecord
from fracsim.mesh.pieces import find_pieces
from fracsim.output.surface.output import SurfaceOutput

from .scenes import each_step, make_scene
from .torn import RUNS, TIGHT, Found


def run(name: str, folder: Path) -> Found:
    """A study to its end with a frame at every tenth step; the last frame."""
    scene, state = make_scene(**{"solver": TIGHT} | RUNS[name])
    domain, graph = scene.domain, scene.fracture.graph
    record = EdgeRecord(graph)
    output = SurfaceOutput(folder, domain, scene.balance.stress.material.density, record)
    output.write(state, [])
    for number, report in enumerate(each_step(scene, state), start=1):
        if report.broken:
            record.note(state.t)
        if number % 10 == 0:
            output.write(state, [])
    of_node = domain.gather_nodes(find_pieces(graph).of_node[: domain.node_count])
    ours = domain.gather_cells(domain.node_input[domain.cell_nodes])
    if output.made is None:
        return {}
    surface, _ = output.made
    made, follow = surface.split, surface.split.follow
    assert domain.source is not None
    assert np.array_equal(ours, domain.source.cells)  # patterns are in the local order of the input cells
    return {
        f"{name}-elements": made.elements, f"{name}-cell": made.cell, f"{name}-edge": made.edge,
        f"{name}-origin": made.origin, f"{name}-points": made.points, f"{name}-start": follow.start,
        f"{name}-parents": follow.parents, f"{name}-fill": made.fill, f"{name}-names": surface.names,
        f"{name}-piece": made.piece_of_node, f"{name}-graph-piece": of_node,
    }  # fmt: skip


def main(path: str) -> None:
    """Both bodies; rank 0 saves. The files lie beside the arrays."""
    target = Path(path)
    found: Found = {}
    for name in ("plate", "block"):
        found |= run(name, target.with_suffix("") / name)
    if MPI.COMM_WORLD.rank == 0:
        np.savez(target, **found)


if __name__ == "__main__":
    main(sys.argv[1])
