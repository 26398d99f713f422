"""Three comparisons with the rigid scheme, after Bao et al. (2007).

    python3 -m fracsim.studies.rigid_trials [PICTURE.png]

1. (Figs. 9, 10) A bar falls on a floor at an angle. Its crack under a penalty force, sampled at the end of the first
   step in contact, for several steps; and under the impulse force J / tau of the scheme.
2. (Sec. 5) The same bar pushed at one end: stress with three pinned nodes, and with inertia relief.
3. (Fig. 7) Linear strain of a finite rotation, and stretch of a linearised rotation.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import numpy.typing as npt
from mpi4py import MPI
from petsc4py import PETSc
from scipy.sparse import bmat, csr_matrix
from scipy.sparse.linalg import spsolve

from ..fracture.principal_stress import symmetric_tensors
from ..rigid.breakage import BreakableBody
from ..scene.rigid_scene import build_rigid_scene
from ..study import Study

Values = npt.NDArray[np.float64]
TIME_STEPS = (4e-4, 2e-4, 1e-4, 5e-5)  # s
IMPACT_SPEED, MASS, PENALTY = 4.0, 48.0, 2e8  # m/s, kg; N/m of the penalty
BAR_SIZE = (0.6, 0.2, 0.2)  # m
END_FORCE = 1e4  # N
ANGLES = np.radians([1, 3, 10, 30, 60])
IMPACT_POINT = np.array([[0.0, 0.1, 0.0]])  # where the bar comes down, its middle a quarter of its length off
BAR_STUDY = {
    "title": "A bar that comes down askew",
    "mesh": {"builder": "box", "size": list(BAR_SIZE), "h": 0.05},
    "material": {"energy": "linear", "young": 1e10, "poisson": 0.2, "density": 2000.0},
    "fracture": {"strength": 2.5e6, "kernel": "neighbours"},
    "brittle": {"surfaces": 12},
    "time": {"scheme": "rigid", "step": 1e-3, "end": 1.0},
}


def falling_bar() -> BreakableBody:
    """The unbroken bar as a breakable body of the rigid scheme."""
    scene = build_rigid_scene(Study.model_validate(BAR_STUDY), MPI.COMM_SELF)
    return scene.stepper.instances.get(0)


def broken_edges(force: float) -> npt.NDArray[np.bool_]:
    """(edges,) flags of the edges that break under an upward force (N) at the impact point."""
    body = falling_bar()
    body.break_fragments(0, body.distribute_forces(0, IMPACT_POINT, np.array([[0.0, 0.0, force]])))
    return body.graph.broken.copy()


def penalty_force(step: float, gap: float = 3e-5) -> float:
    """Penalty force (N) at the end of the first step in contact, for a bar that starts `gap` m above the floor."""
    depth = -gap
    while depth <= 0:
        depth += IMPACT_SPEED * step
    return PENALTY * depth


def impulse_force() -> float:
    """Impulse force J / tau of the same spring, N: 2 m v / (pi sqrt(m / k))."""
    return float(2 * MASS * IMPACT_SPEED / (np.pi * np.sqrt(MASS / PENALTY)))


def bar_stresses() -> tuple[Values, Values, Values]:
    """Largest principal stress along the bar.

    Returns:
        Positions x (cells,) in m; stress (cells,) in Pa with inertia relief; stress (cells,) in Pa with pinned nodes.
    """
    body = falling_bar()
    loads = body.distribute_forces(0, np.array([[0.0, 0.1, 0.1]]), np.array([[END_FORCE, 0.0, 0.0]]))
    domain, free = body.graph.domain, body.analyses.stiffness.whole_body()
    force = loads.nodal_forces(len(domain.nodes))
    share = np.ones(domain.cell_count)
    relieved = body.analyses.stiffness.cell_stress(free(force), share)
    held = body.analyses.stiffness.cell_stress(solve_pinned(free.matrix, domain.nodes, force), share)  # type: ignore[attr-defined]
    x = domain.nodes[domain.cell_nodes].mean(axis=1)[:, 0]
    return x, *(
        np.asarray(np.abs(np.linalg.eigvalsh(symmetric_tensors(item, 3))).max(axis=1)) for item in (relieved, held)
    )


def pin_constraints(nodes: Values) -> Values:
    """Constraint rows (k, n d) of three pinned nodes: k = 3 in 2D, 6 in 3D, one component a row.

    Of the nodes (n, d), node a is the farthest from the centre, b the farthest from a, c the farthest from the line ab.
    Node a is fixed in all directions, b normal to ab, c normal to the plane abc (B07, section 5).
    """
    n, d = nodes.shape
    a = int(np.argmax(np.linalg.norm(nodes - nodes.mean(axis=0), axis=1)))
    b = int(np.argmax(np.linalg.norm(nodes - nodes[a], axis=1)))
    along = (nodes[b] - nodes[a]) / np.linalg.norm(nodes[b] - nodes[a])
    arm = nodes - nodes[a]
    across = arm - np.outer(arm @ along, along)
    c = int(np.argmax(np.linalg.norm(across, axis=1)))
    first = across[c] / np.linalg.norm(across[c])
    held = [(a, axis) for axis in np.eye(d)] + [(b, first)]
    if d == 3:
        normal = np.cross(along, first)
        held += [(b, normal), (c, normal)]
    rows = np.zeros((len(held), n, d))
    for row, (node, direction) in zip(rows, held, strict=True):
        row[node] = direction
    return rows.reshape(len(held), -1)


def solve_pinned(matrix: PETSc.Mat, nodes: Values, force: Values) -> Values:
    """Displacements (n, d) of nodes (n, d) with K u = f and three pinned nodes, by a direct solver (one rank)."""
    constraints = pin_constraints(nodes)
    start, columns, entries = matrix.getValuesCSR()
    K, C = csr_matrix((entries, columns, start), shape=matrix.size), csr_matrix(constraints)
    saddle = bmat([[K, C.T], [C, None]], format="csc")
    u = spsolve(saddle, np.concatenate([force.reshape(-1), np.zeros(len(constraints))]))[: force.size]
    return np.asarray(u).reshape(nodes.shape)


def rotation_strains() -> tuple[Values, Values]:
    """1 - cos a, linear strain of a rotation; and sqrt(1 + a^2) - 1, stretch of a linearised rotation."""
    return np.asarray(1 - np.cos(ANGLES)), np.asarray(np.hypot(1, ANGLES) - 1)


def main() -> None:
    """Print the figures; draw the picture if a file is given."""
    true = broken_edges(impulse_force())
    pushes = [penalty_force(step) for step in TIME_STEPS]
    cracks = [broken_edges(push) for push in pushes]
    print(f"blow: {impulse_force():.3g} N, {true.sum()} edges broken, at any step")
    for step, push, item in zip(TIME_STEPS, pushes, cracks, strict=True):
        alike = (item & true).sum() / max((item | true).sum(), 1)
        print(f"snapshot at {step:g} s: {push:.3g} N, {item.sum()} edges broken, {alike:.0%} of both alike")
    x, relieved, held = bar_stresses()
    far = x > BAR_SIZE[0] / 2
    print(f"far from the push: at most {relieved[far].max():.3g} Pa with relief, {held[far].max():.3g} Pa with pins")
    for angle, strain, swell in zip(ANGLES, *rotation_strains(), strict=True):
        print(f"turned by {np.degrees(angle):.0f} degrees: strain {strain:.2g}; linearised: {swell:.2g} longer")
    if len(sys.argv) > 1:
        draw_picture(Path(sys.argv[1]), [int(item.sum()) for item in cracks], int(true.sum()), (x, relieved, held))


def draw_picture(path: Path, snapshots: list[int], true: int, stress: tuple[Values, Values, Values]) -> None:
    """Draw the three comparisons as panels of one picture."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(12, 3.4), layout="constrained")
    first, second, third = figure.subplots(1, 3)
    first.bar([f"{1e3 * step:g}" for step in TIME_STEPS], snapshots, color="#b0835c")
    first.axhline(true, color="#222222", label="blow, any step")
    first.set(
        ylim=(0, 1.3 * max(*snapshots, true)),
        xlabel="step / ms",
        ylabel="broken edges",
        title="Penalty force, looked at once",
    )
    x, relieved, held = stress
    second.semilogy(x, held, ".", ms=3, color="#b0835c", label="three points pinned")
    second.semilogy(x, relieved, ".", ms=3, color="#222222", label="inertia relief")
    second.set(xlabel="x / m", ylabel="largest principal stress, size, Pa", title="Pushed at x = 0", ylim=(1e2, None))
    strain, swell = rotation_strains()
    third.loglog(np.degrees(ANGLES), strain, "o-", color="#b0835c", label="linear strain of a rotation")
    third.loglog(np.degrees(ANGLES), swell, "s--", color="#222222", label="stretch of a linearised one")
    third.set(xlabel="angle / degrees", title="Rotations and linear strain")
    for item in (first, second, third):
        item.legend(frameon=False)
    figure.savefig(path, dpi=90)


if __name__ == "__main__":
    main()
