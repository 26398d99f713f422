"""Scenes of the grid of contact: what is touched, its motion, the scheme; run with mpirun by test_contact_grid."""

from __future__ import annotations

import sys
from collections.abc import Sequence
from functools import partial
from itertools import product
from pathlib import Path
from typing import Any, NamedTuple

import meshio
import numpy as np
import numpy.typing as npt
from mpi4py import MPI

from fracsim.fracture.edge_history import EdgeHistory
from fracsim.mechanics.term_protocols import SurfaceSeparator, fulfilling
from fracsim.meshes.data import MeshData
from fracsim.meshes.write import write_mesh
from fracsim.output.surface.surface_output import SurfaceOutput
from fracsim.scene import Scene
from support.scenes import Walk, break_across, each_step, make_scene, positions
from support.solids import lattice

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]

OBSTACLES = ("analytic", "mesh")
PARTS = ("itself", "fragments", "bodies")  # two parts of the mesh touch
MOTIONS = ("fixed", "prescribed", "free", "hinge")
SCHEMES = ("backward-euler", "newmark", "generalized-alpha", "quasi-static", "explicit")
SOFT = {"energy": "neo-hookean", "young": 4e4, "poisson": 0.3, "density": 100.0}
GAP = 0.05  # m, between the parts at rest
START = 0.03  # m, between what meets as it begins
SIZE = (2.0, 2.0, 0.4)  # m, of obstacles
# s, by partner and whether steps are explicit; others 0.1
END = {("fragments", True): 0.2} | {(partner, False): 0.07 for partner in ("fragments", "bodies", *OBSTACLES)}
TAN = 0.2  # slope of inclines
SIN, COS = TAN / np.hypot(1.0, TAN), 1.0 / np.hypot(1.0, TAN)
G = 10.0
MASS = 50.0  # kg, of an obstacle that slides


class Cell(NamedTuple):
    """A cell of the grid."""

    partner: str
    motion: str
    scheme: str
    dim: int


EVERY = [Cell(*cell) for cell in product((*PARTS, *OBSTACLES), MOTIONS, SCHEMES, (2, 3))]


def refusal(cell: Cell) -> str:
    """Words of the message that a study of a cell is refused with; empty if it runs."""
    if cell.partner in PARTS and cell.motion == "hinge":
        return "hinge"  # a key of obstacles
    if cell.partner in PARTS:
        return "every body held" if (cell.motion, cell.scheme) == ("free", "quasi-static") else ""
    if cell.motion in ("free", "hinge") and cell.scheme == "quasi-static":
        return "inertia"
    return "a 2D mesh has none" if (cell.partner, cell.dim) == ("mesh", 2) else ""


def _on_root(write: Any) -> None:
    """Write a file on rank 0 alone."""
    if MPI.COMM_WORLD.rank == 0:
        write()
    MPI.COMM_WORLD.Barrier()


def _up(dim: int, size: float = 1.0) -> list[float]:
    return [0.0] * (dim - 1) + [size]


# --- obstacles ---


def box_surface(dim: int) -> tuple[Values, Ints]:
    """Corners, m, and sides of a box of SIZE about the origin, turned outwards."""
    half = np.array(SIZE[-dim:]) / 2
    if dim == 2:
        return half * [[-1, -1], [1, -1], [1, 1], [-1, 1]], np.array([[0, 1], [1, 2], [2, 3], [3, 0]])
    corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    sides = [[0, 1, 3], [0, 3, 2], [4, 6, 7], [4, 7, 5], [0, 4, 5], [0, 5, 1], [2, 3, 7], [2, 7, 6],
             [0, 2, 6], [0, 6, 4], [1, 5, 7], [1, 7, 3]]  # fmt: skip
    return half * corners, np.array(sides)


def box_obstacle(kind: str, dim: int, folder: Path) -> dict[str, Any]:
    """A box, analytic or from a file, without its place."""
    if kind == "analytic":
        return {"shape": "box", "size": list(SIZE[-dim:])}
    points, sides = box_surface(3)
    _on_root(lambda: meshio.Mesh(points, [("triangle", sides.astype(np.int32))]).write(folder / "box.stl"))
    return {"shape": "mesh", "file": str(folder / "box.stl")}


def with_motion(entry: dict[str, Any], motion: str, dim: int, rate: float = 1.0) -> dict[str, Any]:
    """An obstacle that moves upwards at `rate`, m/s, or about an axis on its left that lifts its right end."""
    if motion == "prescribed":
        return entry | {"velocity": _up(dim, rate)}
    if motion == "free":
        return entry | {"mass": 200.0, "velocity": _up(dim, rate)}
    if motion == "hinge":
        axis = {} if dim == 2 else {"axis": [0.0, -1.0, 0.0]}
        return entry | {"mass": 200.0, "hinge": {"point": [-2.0, *entry["at"][1:]]} | axis, "spin": [0.4 * rate]}
    return entry


def obstacle_surfaces(scene: Scene, state: Walk) -> list[tuple[Values, Ints]]:
    """Corners, m, and sides of all obstacles at the present time, each of which is a box of SIZE."""
    bodies = [term for term in scene.balance.terms if term.name == "rigid"]
    if not bodies:
        return []
    result = []
    for entry, posed in zip(scene.study.obstacle, bodies[0].posed_at(state.t), strict=True):
        corners, sides = box_surface(scene.domain.dim)
        reference = entry.at if entry.hinge is None else entry.hinge.point
        X = corners + np.array(entry.at) - reference
        result.append((posed.pose.centre + X @ posed.pose.rotation.T, sides))
    return result


# --- bodies ---


def cut_block(partner: str, dim: int) -> MeshData:
    """Two layers, one over the other, GAP apart: two bodies, or a body with the shape of a C that is soft at its back;
    or a block of three layers, the middle one of which is to be broken."""
    x = np.array([0.0, 0.5, 1.0, 1.5]) if partner == "itself" else np.array([0.5, 1.0, 1.5])
    z = np.array([0.0, 0.5, 1.0, 1.5]) if partner == "fragments" else np.array([0.0, 0.5, 0.5 + GAP, 1.0 + GAP])
    lines = [x, *[np.array([0.0, 0.5, 1.0])] * (dim - 2), z]
    mesh = lattice(*(len(line) - 1 for line in lines))
    points = np.column_stack([line[index] for line, index in zip(lines, mesh.points.astype(int).T, strict=True)])
    middle = points[mesh.cells].mean(axis=1)
    in_gap = (middle[:, -1] > 0.5) & (middle[:, -1] < 0.5 + GAP) & (partner != "fragments")
    cells = mesh.cells[~(in_gap & (middle[:, 0] > 0.5))]
    used = np.unique(cells)
    middle = points[cells].mean(axis=1)
    back = np.flatnonzero((middle[:, 0] < 0.5) & (middle[:, -1] > 0.5))
    return MeshData(points[used], np.searchsorted(used, cells), regions={"back": back} if len(back) else {})


def block_tables(
    partner: str, dim: int, folder: Path, young: float = 4e4, *, soft_back: bool = False, still: bool = False
) -> dict[str, Any]:
    """[mesh], [material] and, for fragments, [fracture] and [[crack]] of the parts.

    `still`: without inertia, where a [[crack]] through the body is refused.
    """
    mesh = cut_block(partner, dim)
    _on_root(lambda: write_mesh(mesh, folder / "parts.msh"))
    material: dict[str, Any] = SOFT | {"young": young}
    if mesh.regions and soft_back:
        material |= {"back": {"young": 1e-6 * young, "density": 1e-2}}
    tables: dict[str, Any] = {"mesh": {"file": str(folder / "parts.msh")}, "material": material}
    if partner == "fragments":
        crack = [] if still else [{"plane": {"point": _up(dim, 0.75), "normal": _up(dim)}}]
        tables |= {"fracture": {"strength": 1e12}, "crack": crack}
    return tables


def is_upper(scene: Scene) -> npt.NDArray[np.bool_]:
    """(nodes,) owned nodes of the upper part; of a C without its back."""
    X = positions(scene)
    height = 0.75 if scene.fracture is not None else 0.5 + GAP / 2
    return (X[:, -1] > height) & (X[:, 0] > 0.5 - 1e-9)


def begin(scene: Scene, state: Walk, gap: float, upper: Values, lower: Values, *, bends: bool) -> None:
    """Parts that are `gap` apart, m, with velocities (d,), m/s; `bends`: of the tips of a C."""
    above, dim = is_upper(scene)[:, None], scene.domain.dim
    u = np.where(above, _up(dim, gap if scene.fracture is not None else gap - GAP), 0.0)
    state.u = u.reshape(-1)
    # the tip of a C bends towards the other one
    share = np.clip(positions(scene)[:, :1] - 0.5, 0.0, 1.0) if bends else 1.0
    state.v = (share * np.where(above, upper, lower)).reshape(-1)
    if scene.fracture is not None and not scene.study.crack:
        break_across(scene, _up(dim), 0.75)
        state.remember()
    state.settle()


def side(dim: int, height: float) -> dict[str, Any]:
    """A selector of nodes at a height."""
    return {"box": [[-0.1] * (dim - 1) + [height - 1e-6], [1.6] * (dim - 1) + [height + 1e-6]]}


# --- scenes ---


def scene_of(cell: Cell, folder: Path) -> tuple[Scene, Walk]:
    """A soft cube and an obstacle that comes from below, or a fixed one that it falls on; or two parts that meet."""
    partner, motion, scheme, dim = cell
    explicit, still, fix = scheme == "explicit", scheme == "quasi-static", "xyz"[:dim]
    tables: dict[str, Any] = {
        "solver": {} if explicit else {"snes_rtol": 1e-9, "ksp_rtol": 1e-10},
        "time": {"scheme": scheme, "step": 0.01, "end": END.get((partner, explicit), 0.1)},
    }
    # m/s; the penalty of explicit steps lets parts overlap that meet at a twentieth of the speed of sound, 20 m/s
    rate = {"fragments": 0.3, "bodies": 0.3, "itself": 0.6}.get(partner, 1.0) if explicit else 1.0
    up, down = _up(dim, rate), _up(dim, -rate)
    if partner in OBSTACLES:
        middle = [0.5, 0.5, -START - SIZE[2] / 2][-dim:]
        entry = box_obstacle(partner, dim, folder) | {"name": "it", "at": middle, "friction": 0.3}
        tables |= {
            "mesh": {"builder": "box", "size": [1.0] * dim, "h": 0.5}, "material": SOFT,
            "obstacle": [with_motion(entry, motion, dim)], "contact": {"itself": False, "distance": 0.02},
        }  # fmt: skip
        if still:  # it is held above, and pressed down where the obstacle does not move
            tables["boundary"] = [{"on": "top"} | ({"velocity": down} if motion == "fixed" else {"fix": fix})]
        elif motion == "fixed":
            tables["initial"] = {"velocity": down}
        return make_scene(**tables)
    tables |= block_tables(partner, dim, folder, still=still) | {"contact": {"friction": 0.3, "distance": 0.02}}
    top = 1.5 if partner == "fragments" else 1.0 + GAP
    ends = {"lower": side(dim, 0.0), "upper": side(dim, top)}
    held = {"fixed": [{"on": ends["lower"], "fix": fix}], "free": [],
            "prescribed": [{"on": ends["lower"], "velocity": up}]}  # fmt: skip
    tables["boundary"] = [{"on": ends["lower"], "hinge": {}}] if motion == "hinge" else held[motion]
    if still and motion != "free":
        tables["boundary"] += [{"on": ends["upper"]} | ({"fix": fix} if motion == "prescribed" else {"velocity": down})]
    scene, state = make_scene(**tables)
    moves = 0.0 if still or motion == "prescribed" else 1.0
    lower = moves * (motion == "free") * np.array(up)
    bends = partner == "itself"
    begin(scene, state, GAP if bends else START, moves * np.array(down), lower, bends=bends)
    return scene, state


def stack(below: str, above: str, folder: Path) -> tuple[Scene, Walk]:
    """A soft cube that falls askew on a free slab over a held one; analytic or from files, with friction, in explicit
    steps in 3D."""
    held = box_obstacle(below, 3, folder) | {"name": "held", "at": [0.5, 0.5, -0.68], "friction": 0.3}
    slab = box_obstacle(above, 3, folder) | {"name": "slab", "at": [0.5, 0.5, -0.25], "friction": 0.4}
    slab |= {"mass": 200.0, "velocity": [0.2, 0.1, 0.0]}
    return make_scene(**{
        "mesh": {"builder": "box", "size": [1.0] * 3, "h": 0.5}, "material": SOFT, "obstacle": [held, slab],
        "contact": {"itself": False, "distance": 0.02}, "initial": {"velocity": [0.3, 0.0, -1.0]},
        "load": {"gravity": [0.0, 0.0, -5.0]}, "time": {"scheme": "explicit", "step": 5e-3, "end": 0.15},
    })  # fmt: skip


def small_ball() -> tuple[Scene, Walk]:
    """A rubbing ball smaller than an edge that is thrown at facets of a soft cube, in explicit steps."""
    ball = {"name": "it", "shape": "sphere", "radius": 0.15, "at": [0.55, 0.4, 1.17], "mass": 3.0, "friction": 0.4,
            "velocity": [0.3, 0.1, -0.6]}  # fmt: skip
    return make_scene(**{
        "mesh": {"builder": "box", "size": [1.0] * 3, "h": 0.5}, "material": SOFT, "obstacle": [ball],
        "contact": {"itself": False, "distance": 0.02}, "time": {"scheme": "explicit", "step": 5e-3, "end": 0.15},
    })  # fmt: skip


# --- friction ---


def incline(cell: Cell, ratio: float, folder: Path, lift: float = 0.0) -> tuple[Scene, Walk]:
    """What slides under gravity that is turned by atan(TAN), with mu = `ratio` TAN, pressed by its weight at the start.

    It is a cube on an obstacle, a free obstacle on a held block, or the upper part of a mesh on the lower one. All are
    hard beside the contact, so that the pressure stays about constant.

    Args:
        cell: of the grid, not quasi-static.
        ratio: mu over TAN.
        folder: of files.
        lift: displacement of the bottom of a held block, m; 0: it is found.
    """
    partner, motion, scheme, dim = cell
    slides, explicit = partner in OBSTACLES and motion == "free", scheme == "explicit"
    tables: dict[str, Any] = {
        "load": {"gravity": [G * SIN, *[0.0] * (dim - 2), -G * COS]},
        "contact": {"distance": 0.02, "stiffness": 4e4 if explicit else 4e3},
        "solver": {} if explicit else {"snes_rtol": 1e-8, "ksp_rtol": 1e-9},
        "time": {"scheme": scheme, "step": 0.01, "end": 0.4 if explicit else 0.12},
    }
    if partner in PARTS:
        tables |= block_tables(partner, dim, folder, 4e6, soft_back=True)
        tables["contact"]["friction"] = ratio * TAN
        if partner == "fragments":  # whose faces are drawn in by the distance, and so less rough
            tables["contact"] |= {"itself": "pieces"}
        tables["boundary"] = [{"on": side(dim, 0.0), "fix": "xyz"[:dim]}]
        scene, state = make_scene(**tables)
        press(scene, state, is_upper(scene)[:, None] * _up(dim))
        return scene, state
    middle = [0.5, 0.5, (0.5 + GAP + SIZE[2] / 2) if slides else -GAP - SIZE[2] / 2][-dim:]
    entry = box_obstacle(partner, dim, folder) | {"name": "it", "at": middle, "friction": ratio * TAN}
    tables["contact"]["itself"] = False
    size, origin = ([1.0] * (dim - 1) + [0.5], [0.0] * dim) if slides else ([0.5] * dim, [0.25] * (dim - 1) + [0.0])
    tables["mesh"] = {"builder": "box", "size": size, "h": 0.5, "origin": origin}
    tables["material"] = SOFT | {"young": 4e6}
    if slides:
        entry["mass"] = MASS
        tables["boundary"] = [{"on": "bottom", "displacement": _up(dim, lift)}]
    elif motion == "prescribed":
        entry["velocity"] = [1.0] + [0.0] * (dim - 1)
        tables["initial"] = {"velocity": entry["velocity"]}
    elif motion == "hinge":  # so heavy that it turns by nothing
        entry |= {"mass": 1e7, "hinge": {"point": middle} | ({} if dim == 2 else {"axis": [0.0, 1.0, 0.0]})}
    scene, state = make_scene(**tables | {"obstacle": [entry]})
    found = press(scene, state, np.array([_up(dim)]), MASS * slides)
    return incline(cell, ratio, folder, found) if slides and not lift else (scene, state)


def press(scene: Scene, state: Walk, along: Values, above: float = 0.0) -> float:
    """Displace nodes along a direction (1 or nodes, d) until contact carries their weight; returns by how much, m.

    `above`: mass of an obstacle that lies on them, kg; 0: they lie on something.
    """
    X = positions(scene)
    moved = np.broadcast_to(along, X.shape)
    weight = G * COS * (above or float((scene.balance.mass.lumped.reshape(X.shape) * moved).sum()))

    def energy(way: float) -> float:
        u = (way * moved).reshape(-1)
        scene.balance.evaluate_at(0.0, u, 0 * u, dt=1e-3)
        return contact_energy(scene)

    far, near, h = (0.0, GAP, 1e-6) if above else (GAP, -GAP, -1e-6)
    for _ in range(20):
        middle = (far + near) / 2
        presses = not (energy(middle + h) - energy(middle - h)) / (2 * abs(h)) < weight
        far, near = (far, middle) if presses else (middle, near)
    state.u = (far * moved).reshape(-1)
    state.settle()
    return far


def dragged(cell: Cell, mu: float, folder: Path) -> tuple[Scene, Walk]:
    """A soft cube or upper part, without inertia, whose top is pressed down and then moved along; or, prescribed, what
    lies below moves. Its top has the probe "grip"."""
    partner, motion, scheme, dim = cell
    gap, push, way = {"fragments": START, "bodies": GAP, "itself": GAP}.get(partner, START), 0.02, 0.01
    push += 0.04 * (partner == "fragments")  # whose faces are drawn in
    lifted = gap if partner == "fragments" else 0.0

    def course(press: float, move: float, start: float = 0.0) -> dict[str, Any]:
        across = [0.0] * (dim - 2)
        return {
            "time": [0.0, 0.4, 0.8],
            "value": [_up(dim, start), _up(dim, start - press), [move, *across, start - press]],
        }

    top, below = (course(gap + push, way, lifted), course(0.0, 0.0))
    if motion == "prescribed":
        top, below = (course(gap + push, 0.0, lifted), course(0.0, -way))
    material = {"poisson": 0.0, "energy": "linear" if partner in OBSTACLES else "neo-hookean"}
    tables: dict[str, Any] = {
        "contact": {"distance": 0.02},
        "solver": {"snes_rtol": 1e-9, "ksp_rtol": 1e-10},
        "time": {"scheme": scheme, "step": 0.1, "end": 0.8},
    }
    if partner in PARTS:
        tables |= block_tables(partner, dim, folder, soft_back=True, still=True)
        tables["material"] |= material
        tables["contact"] |= {"friction": mu} | ({"itself": "pieces"} if partner == "fragments" else {})
        at = side(dim, 1.5 if partner == "fragments" else 1.0 + GAP)
        tables["boundary"] = [{"on": at, "displacement": top}, {"on": side(dim, 0.0), "displacement": below}]
    else:
        at = "top"
        middle = [0.5, 0.5, -gap - SIZE[2] / 2][-dim:]
        entry = box_obstacle(partner, dim, folder) | {"name": "it", "at": middle, "friction": mu}
        tables["obstacle"] = [entry | ({"displacement": below} if motion == "prescribed" else {})]
        tables["contact"]["itself"] = False
        tables["mesh"] = {"builder": "box", "size": [0.5] * dim, "h": 0.5, "origin": [0.25] * (dim - 1) + [0.0]}
        tables["material"] = SOFT | material
        tables["boundary"] = [{"on": "top", "displacement": top}]
    scene, state = make_scene(**tables | {"probe": [{"name": "grip", "on": at}]})
    if partner == "fragments":
        begin(scene, state, gap, np.zeros(dim), np.zeros(dim), bends=False)
    return scene, state


def obstacles_meet(above: str, below: str, motion: str, scheme: str, dim: int, folder: Path) -> tuple[Scene, Walk]:
    """A free obstacle that falls on another one, beside a body that is out of the way."""
    # the penalty of explicit steps lets heavy obstacles overlap that meet faster
    explicit = scheme == "explicit"
    rate = 0.2 if explicit else 1.0
    entry = with_motion(box_obstacle(below, dim, folder) | {"at": [0.5, 0.5, -0.2 - START][-dim:]}, motion, dim, rate)
    upper = with_motion(box_obstacle(above, dim, folder) | {"at": [0.5, 0.5, 0.2][-dim:]}, "free", dim)
    upper["velocity"] = _up(dim, -rate)
    return make_scene(**{
        "mesh": {"builder": "box", "size": [1.0] * dim, "h": 1.0, "origin": [-9.0] * dim}, "material": SOFT,
        "boundary": [{"on": "bottom", "fix": "xyz"[:dim]}], "contact": {"itself": False, "distance": 0.02},
        "obstacle": [entry | {"name": "lower", "friction": 0.3}, upper | {"name": "upper"}],
        "solver": {} if explicit else {"snes_rtol": 1e-9, "ksp_rtol": 1e-10},
        "time": {"scheme": scheme, "step": 0.01, "end": 0.2 if explicit else 0.07},
    })  # fmt: skip


# --- what is measured ---


class DrawnSurfaces:
    """Surfaces of the body, as output draws them, and of obstacles (one rank)."""

    def __init__(self, scene: Scene) -> None:
        self._scene = scene
        terms, record = fulfilling(scene.balance.terms, SurfaceSeparator), None
        if scene.fracture is not None:
            record = EdgeHistory(scene.fracture.graph)
        self._output = SurfaceOutput(None, scene.domain, 1.0, record, apart=terms)

    def at(self, state: Walk) -> tuple[Values, Ints]:
        """Points (n, d), m, and elements (m, d) of all surfaces at the present time."""
        frame = self._output.make_frame(state.state, [])
        surfaces = [(frame.points, self._output.surface.split.elements), *obstacle_surfaces(self._scene, state)]
        first = np.cumsum([0, *(len(points) for points, _ in surfaces)])
        elements = [sides + start for (_, sides), start in zip(surfaces, first, strict=False)]
        return np.concatenate([points for points, _ in surfaces]), np.concatenate(elements)


def momentum(scene: Scene, state: Walk, of: npt.NDArray[np.bool_] | None = None) -> Values:
    """(d,) linear momentum, kg m/s, of nodes (nodes,); of free obstacles if none is flagged; without flags of both
    (serial)."""
    p = (scene.balance.mass.lumped * state.v).reshape(-1, scene.domain.dim)
    if of is not None and of.any():
        return np.asarray(p[of].sum(axis=0))
    total = p.sum(axis=0) if of is None else np.zeros(scene.domain.dim)
    for term in scene.balance.terms:
        if term.name == "rigid":
            total = total + sum(free.motion.momentum[: len(total)] for free in term.free.values())
    return np.asarray(total)


def sliding_part(scene: Scene, cell: Cell) -> tuple[npt.NDArray[np.bool_], float]:
    """(nodes,) nodes of what slides on an incline, none for a free obstacle; and its mass, kg (serial)."""
    mass = scene.balance.mass.lumped.reshape(-1, cell.dim)[:, 0]
    of = is_upper(scene) if cell.partner in PARTS else np.full(len(mass), cell.motion != "free")
    return of, float(mass[of].sum()) or MASS


def contact_energy(scene: Scene) -> float:
    """Energy of contact, J."""
    names = ("obstacles", "solids", "contact", "rigid")
    return float(sum(term.stored_energy() for term in scene.balance.terms if term.name in names))


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


# one of each partner, motion and scheme
FEW = (
    Cell("analytic", "fixed", "newmark", 2), Cell("analytic", "prescribed", "quasi-static", 3),
    Cell("analytic", "free", "explicit", 2), Cell("analytic", "hinge", "explicit", 3),
    Cell("mesh", "free", "newmark", 3), Cell("mesh", "prescribed", "explicit", 3),
    Cell("mesh", "free", "explicit", 3), Cell("bodies", "fixed", "backward-euler", 2),
    Cell("bodies", "free", "explicit", 3), Cell("itself", "free", "newmark", 2),
    Cell("itself", "prescribed", "quasi-static", 2), Cell("fragments", "free", "newmark", 2),
    Cell("fragments", "fixed", "explicit", 2),
)  # fmt: skip


def main(target: str, cells: Sequence[Cell] = FEW) -> None:
    """The end of some cells of the grid, of stacks of obstacles and of a small ball."""
    folder, found = Path(target).parent, {}
    scenes = {" ".join(map(str, cell)): partial(scene_of, cell, folder) for cell in cells}
    stacks = (("analytic", "analytic"), ("analytic", "mesh"), ("mesh", "mesh"))
    scenes |= {f"{above} on {below}": partial(stack, below, above, folder) for below, above in stacks}
    for name, build in (scenes | {"ball": small_ball}).items():
        scene, state = build()
        found[name] = end_of(scene, state)
        scene.destroy()
    if MPI.COMM_WORLD.rank == 0:
        np.savez(target, **found)


if __name__ == "__main__":
    main(sys.argv[1])
