"""Plates that lie on one another without friction stay where they are: nothing pushes them sideways."""

from __future__ import annotations

from pathlib import Path

import meshio
import numpy as np
import pytest
from scipy.sparse import coo_matrix
from scipy.sparse.csgraph import connected_components

from fracsim.meshes.builders.box import Box
from fracsim.meshes.data import MeshData
from fracsim.meshes.read import read_mesh
from support.ranks import run_on_ranks
from support.scenes import displacement, make_scene, march

pytest.importorskip("ipctk", reason="an environment made without a network")

SIZE = {2: (0.06, 0.01), 3: (0.06, 0.09, 0.01)}  # of a plate, m
GAP = 1e-4  # m
RUBBER = {"energy": "neo-hookean", "young": 1e7, "poisson": 0.3, "density": 1000.0}


def stack_of(path: Path, dim: int, edges: list[float]) -> tuple[str, np.ndarray]:
    """A file with plates on one another, a GAP apart, and the number of the plate of each node.

    Plates have meshes of different edge length (m), so that no vertex lies above another but at the corners.
    """
    at = [(*[0.0] * (dim - 1), i * (0.01 + GAP)) for i in range(len(edges))]
    plates = [Box(size=SIZE[dim], h=h, origin=origin).build() for h, origin in zip(edges, at, strict=True)]
    counts = np.array([len(plate.points) for plate in plates])
    points = np.concatenate([plate.points for plate in plates])
    first = np.cumsum(counts) - counts
    cells = np.concatenate([plate.cells + start for plate, start in zip(plates, first, strict=True)])
    kind = {2: "triangle", 3: "tetra"}[dim]
    meshio.Mesh(np.pad(points, ((0, 0), (0, 3 - dim))), [(kind, cells)]).write(path / "stack.vtu")
    return str(path / "stack.vtu"), np.repeat(np.arange(len(edges)), counts)


def lies_still(file: str, plate: np.ndarray, dim: int, end: float) -> None:
    """Plates fall 0.1 mm on a table and on one another. Then each one's mean place has not moved 1 um across, all are
    lower than before, and none has passed through what is below."""
    up = [0.0] * (dim - 1) + [1.0]
    table = {"name": "table", "shape": "plane", "normal": up, "at": [-GAP * x for x in up], "friction": 0.0}
    scene, state = make_scene(
        mesh={"file": file}, material=RUBBER, load={"gravity": [-9.81 * x for x in up]}, contact={"friction": 0.0},
        obstacle=[table], time={"scheme": "backward-euler", "step": 5e-3, "end": end}, solver={},
    )  # fmt: skip
    march(scene, state)
    u = displacement(scene, state)
    means = np.array([u[plate == i].mean(axis=0) for i in range(plate.max() + 1)])
    assert abs(means[:, :-1]).max() < 1e-6
    assert np.all((means[:, -1] < 0) & (means[:, -1] > -GAP * np.arange(1, len(means) + 1)))


def label_bodies(mesh: MeshData) -> np.ndarray:
    """The number of the connected body of each node."""
    ends = mesh.cells[:, [0, 1, 0, 2, 0, 3]].reshape(-1, 2).T
    return connected_components(coo_matrix((np.ones(ends.shape[1]), tuple(ends)), (len(mesh.points),) * 2))[1]


@pytest.mark.parametrize(("dim", "edges", "end"), [(2, [0.004, 0.005, 0.0035, 0.0045], 0.5), (3, [0.015, 0.02], 0.1)])
def test_a_stack_without_friction_lies_still(tmp_path: Path, dim: int, edges: list[float], end: float) -> None:
    """Before, points on the rims pushed sideways: by 155 um in 0.5 s, and 5 um in 0.1 s."""
    lies_still(*stack_of(tmp_path, dim, edges), dim, end)


@pytest.mark.slow
def test_four_plates_of_gmsh_lie_still() -> None:
    """In 0.5 s. Before, 306 um."""
    file = Path(__file__).parent / "meshes" / "stack.msh"
    lies_still(str(file), label_bodies(read_mesh(file)), 3, 0.5)


@pytest.mark.ranks
def test_it_lands_on_three_ranks(tmp_path: Path) -> None:
    """Before, PETSc coarsened a graph of strong links without end in the second step."""
    energies = run_on_ranks("support.stacked", 3, tmp_path, 240)["energies"]
    assert energies.shape == (2, 2)
    assert np.isfinite(energies).all()
