"""M22's two rejected ways to remove broken edges from a nonlinear energy (its supplement, section 6), reproduced.

    python -m fracsim.studies.evidence.rejected_approaches APPROACH -o figures.json

A 2D bar of Saint Venant-Kirchhoff rubber is pulled. Half of a cross-section is broken, then all of it, and the load is
removed. No work is done from then on: the kinetic energy cannot exceed the stored energy. In each cell

    C = sum_l tau_l^2 R_l,  tau_l = l / L of edge l,  E = (C - I) / 2,  S = A E,  f = V sum_l (R_l . S) / 2 d tau_l^2/du

pseudo-inverse     R_l = [sum Q x Q]^+ Q_l over the intact edges alone (M22s eq. 7); A = D of Hooke

projected-stress   R_l of the whole cell; A = T^-1 diag(integrity) T D (M22s eq. 26): not symmetric, hence no energy

projected-strain   R_l of the whole cell, intact edges alone, on tau_l^2 - 1: `edge` with Green's strain (refused)

chi                R_l of the whole cell; A = chi D: fracsim's approach

Backward Euler and Newton in dense NumPy. Only the lattice of points is shared with the program.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from .report_section import ReportTable, Section

Values = npt.NDArray[np.float64]
APPROACHES = ("pseudo-inverse", "projected-stress", "projected-strain", "chi")
YOUNG, POISSON, DENSITY = 1e5, 0.3, 1e3  # Pa, 1, kg/m^3
STEP, LOAD_STEPS, STEPS = 5e-3, 60, 200  # s; steps under load; steps after the first break
TRACTION = 1e4  # Pa on the right end
EDGES = np.array([[0, 1], [0, 2], [1, 2]])
IDENTITY = np.array([1.0, 1.0, 0.0])  # Mandel's notation: c11, c22, sqrt(2) c12


def plane_strain_stiffness() -> Values:
    """Hooke's matrix (3, 3) for plane strain in Mandel's notation, Pa."""
    mu, lmbda = YOUNG / (2 * (1 + POISSON)), YOUNG * POISSON / ((1 + POISSON) * (1 - 2 * POISSON))
    return 2 * mu * np.eye(3) + lmbda * np.outer(IDENTITY, IDENTITY)


@dataclass
class DamagedBar:
    """Triangles with broken edges.

    Attributes:
        points: (n, 2) m.
        cells: (m, 3) nodes.
        approach: how broken edges are removed, of APPROACHES.
        intact: (m, 3) flags of the edges of each cell.
        R: (m, 3, 3), R[c, l] of edge l.
        A: (m, 3, 3) Pa.
        target: (m, 3), reference of E.
    """

    points: Values
    cells: npt.NDArray[np.int64]
    approach: str

    def __post_init__(self) -> None:
        d = self._edges(self.points)
        self.length2 = (d**2).sum(axis=2)
        xx, yy, xy = d[:, :, 0] ** 2, d[:, :, 1] ** 2, np.sqrt(2) * d[:, :, 0] * d[:, :, 1]
        self.Q = np.stack([xx, yy, xy], axis=2) / self.length2[:, :, None]
        corners = self.points[self.cells]
        self.area = np.linalg.det(corners[:, 1:] - corners[:, :1]) / 2
        self.intact = np.ones((len(self.cells), 3), bool)
        self.chi: Values = np.ones(len(self.cells))
        self._update_operators(np.zeros_like(self.points))

    def _edges(self, x: Values) -> Values:
        """Edge vectors (m, 3, 2) of cells at positions x (n, 2)."""
        corners = x[self.cells]
        return corners[:, EDGES[:, 1]] - corners[:, EDGES[:, 0]]

    def break_edges(self, crossing: npt.NDArray[np.bool_], u: Values) -> None:
        """Break the (m, 3) edges and update the operators at the displacement u."""
        self.intact &= ~crossing
        self._update_operators(u)

    def _update_operators(self, u: Values) -> None:
        """Set R, A and target from the intact edges."""
        whole = np.linalg.inv(self.Q).transpose(0, 2, 1)
        kept, D = self.intact[:, :, None], plane_strain_stiffness()
        self.R, self.A = whole, np.broadcast_to(D, (len(self.cells), 3, 3))
        self.target: Values = np.broadcast_to(IDENTITY, (len(self.cells), 3))
        if self.approach == "pseudo-inverse":
            self.R = np.linalg.pinv(self.Q * kept).transpose(0, 2, 1) * kept
        elif self.approach == "projected-stress":
            self.A = np.einsum("cli,cl,clj->cij", whole, self.intact, self.Q) @ D
        elif self.approach == "projected-strain":
            self.R = whole * kept
            self.target = self.R.sum(axis=1)
        else:
            self.chi = np.minimum(self.chi, self._intact_share(u))
            self.A = self.chi[:, None, None] * D

    def _intact_share(self, u: Values) -> Values:
        """chi: sum of |stress| over intact edges, relative to all edges; 0 in split cells (two broken edges)."""
        load = np.abs(np.einsum("clj,cj->cl", self.Q, self.stress(u)))
        whole = load.sum(axis=1)
        share = np.divide((load * self.intact).sum(axis=1), whole, out=np.ones(len(whole)), where=whole > 0)
        return np.asarray(np.where((~self.intact).sum(axis=1) >= 2, 0.0, share))

    def stress(self, u: Values) -> Values:
        """Second Piola-Kirchhoff stress S = A E (m, 3), Pa."""
        return np.einsum("cij,cj->ci", self.A, self.strain(u))

    def strain(self, u: Values) -> Values:
        """Strain E = (sum_l tau_l^2 R_l - target) / 2 (m, 3)."""
        stretch2 = (self._edges(self.points + u) ** 2).sum(axis=2) / self.length2
        return (np.einsum("cl,cli->ci", stretch2, self.R) - self.target) / 2

    def energy(self, u: Values) -> float:
        """Energy, J per m of thickness. Projected stress has no energy; the number is formal."""
        return float(0.5 * self.area @ np.einsum("ci,ci->c", self.strain(u), self.stress(u)))

    def force_and_tangent(self, u: Values) -> tuple[Values, Values]:
        """Internal force (2n,) in N/m and exact tangent (2n, 2n)."""
        gradients = 2 * self._edges(self.points + u) / self.length2[:, :, None]
        signs = np.zeros((3, 3))
        signs[np.arange(3), EDGES[:, 0]], signs[np.arange(3), EDGES[:, 1]] = -1.0, 1.0
        g = np.einsum("la,cld->clad", signs, gradients).reshape(len(self.cells), 3, 6)
        weight = np.einsum("cli,ci->cl", self.R, self.stress(u)) / 2
        inner = np.einsum("cli,cij,cmj->clm", self.R, self.A, self.R) / 4
        second = np.einsum("la,lb,de->ladbe", signs, signs, np.eye(2)).reshape(3, 6, 6)
        f = self.area[:, None] * np.einsum("cl,cla->ca", weight, g)
        K = np.einsum("cla,clm,cmb->cab", g, inner, g)
        K += np.einsum("cl,lab->cab", 2 * weight / self.length2, second)
        return self._assemble(f, self.area[:, None, None] * K)

    def _assemble(self, f: Values, K: Values) -> tuple[Values, Values]:
        """Assembled force and tangent of cell vectors f and matrices K."""
        dofs = (2 * self.cells[:, :, None] + np.arange(2)).reshape(len(self.cells), 6)
        size = self.points.size
        force, tangent = np.zeros(size), np.zeros((size, size))
        np.add.at(force, dofs, f)
        np.add.at(tangent, (dofs[:, :, None], dofs[:, None, :]), K)
        return force, tangent


def lattice_bar(approach: str) -> DamagedBar:
    """Bar of 1 x 0.25 m with 9 x 3 squares; its middle plane contains no nodes."""
    from ...meshes.builders.box import lattice

    points, cells = lattice((9, 3))
    return DamagedBar(points * [1.0, 0.25], cells, approach)


def simulate(approach: str, frames: list[tuple[float, Values]] | None = None) -> dict[str, Any]:
    """Figures of the experiment with one approach.

    Args:
        approach: of APPROACHES.
        frames: list to which (time since the first break, s; displacement (n, 2), m) of each solved step is appended.
    """
    bar = lattice_bar(approach)
    motion = _BackwardEuler(bar)
    load = np.zeros_like(bar.points)
    end = np.flatnonzero(bar.points[:, 0] == 1.0)
    load[end, 0] = TRACTION * 0.25 / len(end)
    for _ in range(LOAD_STEPS):
        motion.step(load)
    stored = bar.energy(motion.u) + motion.kinetic()
    figures: dict[str, Any] = {"stored": stored, "rest_stress": 0.0, "newton_failed_at": 0.0, "peak": 0.0, "jump": 0.0}
    for number in range(STEPS):
        if number in (0, STEPS // 4):
            before = bar.energy(motion.u)
            bar.break_edges(_crossing_edges(bar, 0.125 if number == 0 else 1.0), motion.u)
            figures["jump"] = max(figures["jump"], bar.energy(motion.u) / before)
            figures["rest_stress"] = float(np.abs(bar.stress(np.zeros_like(bar.points))).max() / YOUNG)
        if not motion.step(np.zeros_like(load)):
            figures["newton_failed_at"] = (number + 1) * STEP
            break
        figures["peak"] = max(figures["peak"], motion.kinetic() / stored)
        if frames is not None:
            frames.append(((number + 1) * STEP, motion.u))
    figures |= {"reach": float(np.abs(motion.u).max()), "loop": cycle_work(approach), "finite": True}
    figures["lowest"] = lowest_eigenvalue(approach)
    return figures


class _BackwardEuler:
    """Backward Euler with plain Newton; the left end is fixed."""

    def __init__(self, bar: DamagedBar) -> None:
        self.bar = bar
        self.u: Values = np.zeros_like(bar.points)
        self.v: Values = np.zeros_like(bar.points)
        mass = np.zeros(len(bar.points))
        np.add.at(mass, bar.cells, (DENSITY * bar.area / 3)[:, None])
        self.mass = np.repeat(mass, 2)
        self.free = np.repeat(bar.points[:, 0] > 0, 2)

    def kinetic(self) -> float:
        """Kinetic energy, J per m of thickness."""
        return float(0.5 * self.mass @ self.v.ravel() ** 2)

    def step(self, load: Values) -> bool:
        """Advance one step. Returns False, with the state unchanged, if Newton did not converge in 50 iterations."""
        free, start = self.free, self.u.ravel() + STEP * self.v.ravel()
        x: Values = np.where(free, start, 0.0)
        scale = TRACTION * 0.25
        for _ in range(50):
            f, K = self.bar.force_and_tangent(x.reshape(-1, 2))
            r = self.mass * (x - start) / STEP**2 + f - load.ravel()
            if not np.isfinite(r).all():
                return False
            if np.linalg.norm(r[free]) < 1e-9 * scale:
                u: Values = x.reshape(-1, 2)
                self.v = np.asarray((u - self.u) / STEP)
                self.u = u
                return True
            K[np.diag_indices_from(K)] += self.mass / STEP**2
            x[free] -= np.linalg.solve(K[np.ix_(free, free)], r[free])
        return False


def _crossing_edges(bar: DamagedBar, height: float) -> npt.NDArray[np.bool_]:
    """Flags (m, 3) of edges that cross the plane x = 1/2 below a height, m."""
    ends = bar.points[bar.cells][:, EDGES]
    middle = ends.mean(axis=2)
    return np.asarray((np.sign(ends[:, :, :, 0] - 0.5).prod(axis=2) < 0) & (middle[:, :, 1] < height))


def cell_with_broken_edge(approach: str) -> DamagedBar:
    """A cell without load, one of its three edges broken."""
    bar = DamagedBar(np.array([[0.0, 0.0], [1.0, 0.0], [0.2, 0.9]]), np.array([[0, 1, 2]]), approach)
    stretched = bar.points @ np.array([[0.1, 0.0], [0.0, -0.03]])
    bar.break_edges(np.array([[True, False, False]]), stretched)
    return bar


def cycle_work(approach: str, turns: int = 4000) -> float:
    """Work of a closed strain cycle on a cell with a broken edge, relative to its largest energy.

    u = X (s1 cos a, s2 sin a) stretches the cell in x and y in turn; midpoint rule of a smooth periodic integrand. The
    work is 0 if the force derives from an energy.
    """
    bar, work, most = cell_with_broken_edge(approach), 0.0, 0.0
    angle = (np.arange(turns) + 0.5) * 2 * np.pi / turns
    for a in angle:
        u = bar.points * (0.1 * np.array([np.cos(a), np.sin(a)]))
        rate = bar.points * (0.1 * np.array([-np.sin(a), np.cos(a)]))
        work += float(bar.force_and_tangent(u)[0] @ rate.ravel()) * 2 * np.pi / turns
        most = max(most, abs(bar.energy(u)))
    return abs(work) / most


def lowest_eigenvalue(approach: str) -> float:
    """Smallest eigenvalue of sym K over its largest, at rest with a broken edge; a negative value is unstable."""
    bar = cell_with_broken_edge(approach)
    K = bar.force_and_tangent(np.zeros_like(bar.points))[1]
    values = np.linalg.eigvalsh((K + K.T) / 2)
    return float(values[0] / values[-1])


def section(records: list[dict[str, Any]]) -> Section:
    """Section with the figures and verdict of each approach."""
    columns = (
        "approach", "elastic energy after a break / before", "kinetic energy / stored", "stress at rest / Y",
        "work of a closed cycle / energy", "lowest eigenvalue of K / largest", "Newton failed at, s", "largest |u|, m",
        "ends in",
    )  # fmt: skip
    keys = ("jump", "peak", "rest_stress", "loop", "lowest", "newton_failed_at", "reach")
    rows = []
    for record in records:
        figures = record["figures"]
        rows.append((record["settings"]["of"], *(figures.get(key) for key in keys), judge(figures)))
    text = (
        "Section 6 of the supplement of Mandal et al. 2022, repeated: a pulled 2D bar of Saint Venant-Kirchhoff "
        "rubber, half of a cross-section broken, then all of it, without load from the first break on. From then on no "
        "kinetic energy may exceed the stored energy. With the pseudo-inverse of edge lengths a cell with a "
        "broken edge "
        "is strained at rest. The projected stress has no energy, so that a closed cycle does work and the bar gains "
        "energy. Projecting Green's strain, which fracsim refuses beside nonlinear energies, holds in "
        "this small bar. fracsim uses the degraded energy `chi`."
    )
    name = "Two rejected approaches"
    return Section(name, text, tables=(ReportTable("failed-approaches", "After the break", columns, tuple(rows)),))


def judge(figures: dict[str, Any]) -> str:
    """Verdict "fails" with its reasons (energy created, no Newton solution, ...), or "holds"."""
    if not figures:
        return "not run to its end"
    reasons = []
    if figures["peak"] > 1.0 or figures["jump"] > 1.0:
        reasons.append("energy created")
    if figures["newton_failed_at"]:
        reasons.append("no solution")
    if figures["rest_stress"] > 1e-9:
        reasons.append("stressed at rest")
    if figures["lowest"] < -1e-9:
        reasons.append("not stable at rest")
    if figures["loop"] > 1e-6:
        reasons.append("a cycle does work")
    return f"fails: {', '.join(reasons)}" if reasons else "holds"


def main() -> None:
    """Simulate and write the figures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("approach", choices=APPROACHES)
    parser.add_argument("-o", dest="out", type=Path)
    given = parser.parse_args()
    given.out.write_text(json.dumps(simulate(given.approach)) + "\n")


if __name__ == "__main__":
    main()
