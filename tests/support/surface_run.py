"""The split surface of a run on any number of ranks, written on its way and compared afterwards."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from fracsim.fracture.edge_history import EdgeHistory
from fracsim.mesh.fragments import find_fragments
from fracsim.output.surface.surface_output import SurfaceOutput
from fracsim.scene import Scene
from fracsim.timestepping.state import State

from .surface_parts import Arrays, gathered_surface


class WrittenSurface:
    """A frame at the start and at every fourth step."""

    def __init__(self, scene: Scene, state: State, folder: Path) -> None:
        self._scene, self._steps = scene, 0
        self._record = EdgeHistory(scene.fracture.graph)
        self._output = SurfaceOutput(folder, scene.domain, scene.balance.stress.material.density, self._record)
        self._output.write_frame(state, [])

    def step(self, state: State, broken: int) -> None:
        """After each step (collective)."""
        self._steps += 1
        if broken:
            self._record.record_breaks(state.t)
        if self._steps % 4 == 0:
            self._output.write_frame(state, [])

    def result(self, name: str) -> Arrays:
        """The last frame, on rank 0 (collective)."""
        domain, surface = self._scene.domain, self._output.surface
        of_node = domain.input_numbering.gather_nodes(
            find_fragments(self._scene.fracture.graph).node_fragment[: domain.node_count]
        )
        ours = domain.input_numbering.gather_cells(domain.input_numbering.nodes[domain.cell_nodes])
        assert surface is not None
        arrays = gathered_surface(surface)
        if domain.input_mesh is None or of_node is None:
            return {}
        assert np.array_equal(ours, domain.input_mesh.cells)  # patterns are in the local order of the input cells
        return {f"surface-{name}-{key}": values for key, values in {**arrays, "graph-piece": of_node}.items()}
