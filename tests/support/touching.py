"""Scenes of the grid of contact: obstacle, motion, scheme; run with mpirun by test_contact_grid."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fracsim.meshes.builders.box import Box
from fracsim.scene import Scene
from support.scenes import Walk, each_step, make_scene, positions

Values = npt.NDArray[np.float64]

MOTIONS = ("fixed", "prescribed", "free", "hinge")
SCHEMES = ("backward-euler", "newmark", "generalized-alpha", "quasi-static", "explicit")
SOFT = {"energy": "neo-hookean", "young": 1e4, "poisson": 0.3, "density": 100.0}
TOP = -0.05  # m, of the obstacle below a body that begins at 0


def _write(mesh: meshio.Mesh, path: Path) -> None:
    """A file, written by rank 0 alone."""
    if MPI.COMM_WORLD.rank == 0:
        mesh.write(path)
    MPI.COMM_WORLD.Barrier()


def obstacle(kind: str, motion: str, dim: int, folder: Path) -> dict[str, Any]:
    """A flat obstacle below the body, or beside which it ends on a hinge."""
    size = [2.0, 2.0, 0.4][-dim:]
    middle = [0.5, 0.5, TOP - 0.2][-dim:]
    entry: dict[str, Any] = {"name": "it", "at": middle, "friction": 0.3}
    if kind == "mesh":
        corners = np.array([[x, y, z] for x in (-1.0, 1.0) for y in (-1.0, 1.0) for z in (-0.2, 0.2)])
        sides = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
                 [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip
        _write(meshio.Mesh(corners, [("triangle", np.array(sides, np.int32))]), folder / "flat.stl")
        entry |= {"shape": "mesh", "file": str(folder / "flat.stl")}
    else:
        entry |= {"shape": "box", "size": size}
    up = [0.0] * (dim - 1) + [1.0]
    if motion == "prescribed":
        entry["velocity"] = up
    elif motion != "fixed":
        entry["mass"] = 200.0
        if motion == "free":
            entry["velocity"] = up
        else:
            # it turns upwards about an axis on its left
            entry["hinge"] = {"point": [-2.0, *middle[1:]]} | ({} if dim == 2 else {"axis": [0.0, -1.0, 0.0]})
            entry["spin"] = [0.4]
    return entry


def scene_of(kind: str, motion: str, scheme: str, dim: int, folder: Path) -> tuple[Scene, Walk]:
    """A soft cube of 1 m, and an obstacle that comes from below, or a fixed one that it falls on."""
    still = scheme == "quasi-static"
    tables: dict[str, Any] = {
        "mesh": {"builder": "box", "size": [1.0] * dim, "h": 0.5}, "material": SOFT,
        "obstacle": [obstacle(kind, motion, dim, folder)], "contact": {"itself": False, "distance": 0.02},
        "solver": {} if scheme == "explicit" else {"snes_rtol": 1e-9, "ksp_rtol": 1e-10},
        "time": {"scheme": scheme, "step": 5e-3, "end": 0.15 if motion == "hinge" else 0.1},
    }  # fmt: skip
    if still:  # it is held above, and pressed down where the obstacle does not move
        down = {"velocity": [0.0] * (dim - 1) + [-1.0]} if motion == "fixed" else {"fix": "xyz"[:dim]}
        tables["boundary"] = [{"on": "top"} | down]
    elif motion == "fixed":
        tables["initial"] = {"velocity": [0.0] * (dim - 1) + [-1.0]}
    return make_scene(**tables)


def two_bodies(scheme: str, dim: int, folder: Path) -> tuple[Scene, Walk]:
    """Two cubes in one mesh, of which the upper one falls on the lower one."""
    cubes = [Box(size=(1.0,) * dim, h=0.5, origin=(*[0.0] * (dim - 1), z)).build() for z in (0.0, 1.05)]
    points = np.concatenate([cube.points for cube in cubes])
    cells = np.concatenate([cubes[0].cells, cubes[1].cells + len(cubes[0].points)])
    kind = {2: "triangle", 3: "tetra"}[dim]
    _write(meshio.Mesh(np.pad(points, ((0, 0), (0, 3 - dim))), [(kind, cells)]), folder / "cubes.vtu")
    below = [[-0.1] * (dim - 1) + [-1e-6], [1.1] * (dim - 1) + [1e-6]]
    down = [0.0] * (dim - 1)
    tables: dict[str, Any] = {
        "mesh": {"file": str(folder / "cubes.vtu")}, "material": SOFT | {"young": 1e5},
        "contact": {"friction": 0.3, "distance": 0.02},
        "solver": {} if scheme == "explicit" else {"snes_rtol": 1e-9, "ksp_rtol": 1e-10},
        "time": {"scheme": scheme, "step": 5e-3, "end": 0.1},
    }  # fmt: skip
    if scheme == "quasi-static":
        lid = [[-0.1] * (dim - 1) + [2.05 - 1e-6], [1.1] * (dim - 1) + [2.05 + 1e-6]]
        tables["boundary"] = [
            {"on": {"box": below}, "fix": "xyz"[:dim]},
            {"on": {"box": lid}, "velocity": [*down, -1.0]},
        ]
    else:
        tables["load"] = {"gravity": [*down, -20.0]}
        tables["boundary"] = [{"on": {"box": below}, "fix": "xyz"[:dim]}]
    return make_scene(**tables)


def stack(below: str, above: str, folder: Path) -> tuple[Scene, Walk]:
    """A soft cube that falls askew on a free slab over a held one; analytic or from files, with friction,
    in explicit steps in 3D."""
    held, free = (obstacle(kind, "fixed", 3, folder) for kind in (below, above))
    free |= {"name": "slab", "mass": 200.0, "velocity": [0.2, 0.1, 0.0], "friction": 0.4}
    held |= {"at": [0.5, 0.5, TOP - 0.63]}
    return make_scene(**{
        "mesh": {"builder": "box", "size": [1.0] * 3, "h": 0.5}, "material": SOFT, "obstacle": [held, free],
        "contact": {"itself": False, "distance": 0.02}, "initial": {"velocity": [0.3, 0.0, -1.0]},
        "load": {"gravity": [0.0, 0.0, -5.0]}, "time": {"scheme": "explicit", "step": 5e-3, "end": 0.15},
    })  # fmt: skip


def small_ball(folder: Path) -> tuple[Scene, Walk]:
    """A rubbing ball smaller than an edge that is thrown at facets of a soft cube, in explicit steps."""
    ball = {"name": "it", "shape": "sphere", "radius": 0.15, "at": [0.55, 0.4, 1.17], "mass": 3.0, "friction": 0.4,
            "velocity": [0.3, 0.1, -0.6]}  # fmt: skip
    return make_scene(**{
        "mesh": {"builder": "box", "size": [1.0] * 3, "h": 0.5}, "material": SOFT, "obstacle": [ball],
        "contact": {"itself": False, "distance": 0.02}, "time": {"scheme": "explicit", "step": 5e-3, "end": 0.15},
    })  # fmt: skip


def momentum(scene: Scene, state: Walk) -> Values:
    """(d,) linear momentum of the body and free obstacles, kg m/s (serial)."""
    d = scene.domain.dim
    total = (scene.balance.mass.lumped * state.v).reshape(-1, d).sum(axis=0)
    (bodies,) = [term for term in scene.balance.terms if term.name == "rigid"]
    return np.asarray(total + sum(free.motion.momentum[:d] for free in bodies.free.values()))


def end_of(scene: Scene, state: Walk) -> Values:
    """Sums of displacement and velocity, and the columns, at the end: equal on any number of ranks."""
    for _ in each_step(scene, state):
        pass
    comm, X = scene.domain.comm, positions(scene)
    sums = [
        comm.allreduce(float(part.sum())) for part in (state.u, state.v, (state.u.reshape(X.shape) * X).sum(axis=1))
    ]
    columns = dict(zip(scene.probes.columns, scene.probes(), strict=True))
    return np.array([*sums, *(value for name, value in columns.items() if name.startswith(("contact_", "velocity_")))])


CELLS = (
    ("analytic", "fixed", "newmark", 2), ("analytic", "prescribed", "quasi-static", 3),
    ("analytic", "free", "newmark", 3), ("analytic", "free", "explicit", 2), ("analytic", "hinge", "backward-euler", 2),
    ("mesh", "free", "backward-euler", 3), ("mesh", "prescribed", "generalized-alpha", 3),
    ("mesh", "free", "explicit", 3), ("mesh", "prescribed", "explicit", 3),
    ("bodies", "", "backward-euler", 2), ("bodies", "", "explicit", 3),
    ("stack", "analytic", "analytic", 3), ("stack", "analytic", "mesh", 3), ("stack", "mesh", "mesh", 3),
    ("ball", "", "explicit", 3),
)  # fmt: skip


def main(target: str) -> None:
    """The end of some cells of the grid."""
    folder, found = Path(target).parent, {}
    for kind, motion, scheme, dim in CELLS:
        if kind == "bodies":
            scene, state = two_bodies(scheme, dim, folder)
        elif kind == "stack":
            scene, state = stack(motion, scheme, folder)
        elif kind == "ball":
            scene, state = small_ball(folder)
        else:
            scene, state = scene_of(kind, motion, scheme, dim, folder)
        found[f"{kind} {motion} {scheme} {dim}"] = end_of(scene, state)
    if scene.domain.comm.rank == 0:
        np.savez(target, **found)


if __name__ == "__main__":
    main(sys.argv[1])
