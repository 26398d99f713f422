"""The quasi-static analysis of a shell, and of pieces of one, by flat triangles (rigid.shell_triangles).

    K (u, r) = (f - M a, m),   a node held, which a load in balance leaves without a force

A piece is a set of triangles with the share of each that is its own, as of cells in `free_body`: the mean of the three
cells that are its thickness. Forces on these fall on the middle surface with their moment about it. The stress that is
told is that of the face where the greater tension is.
"""

from __future__ import annotations

import numpy as np
import numpy.typing as npt
from scipy.sparse import coo_matrix, csc_matrix
from scipy.sparse.linalg import splu

from ..errors import NotConverged
from ..forms.kinematics import SYMMETRIC_COMPONENTS
from ..mechanics.stress import Stress
from ..meshes.data import Shell
from ..solvers.petsc_options import PetscOptions
from .free_body_analysis import Relief
from .shell_triangles import Plates

Values = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]


class ShellStiffness:
    """K of triangles of one shell, for one body after the other (one rank).

    Attributes:
        stress: of its cells, which says what mesh there is.    shell, plates: triangles in the order of the input mesh.
    """

    def __init__(self, stress: Stress, shell: Shell, young: float, poisson: float, density: float) -> None:
        """Of one material; `density`: kg/m^3."""
        self.stress, self.shell = stress, shell
        self.nodes = shell.middle[: len(shell.middle) // 2]
        self.plates = Plates.of(self.nodes[shell.triangles])
        self._each = self.plates.stiffness(young, poisson, shell.thickness)
        self._stressing = self.plates.stressing(young, poisson, shell.thickness)
        self.weight = density * shell.thickness * self.plates.area
        domain = stress.domain
        assert domain.source is not None
        count = len(self.nodes)
        above = domain.source.points[count:] - domain.source.points[:count]
        self._half: Values = above / np.linalg.norm(above, axis=1)[:, None] * shell.thickness / 2
        self._whole: ShellBody | None = None

    @property
    def finest(self) -> float:
        """m: a strip a triangle wide is bent as a beam of this side would be, 6 / (b h^2) = 2 / side^3."""
        edge = float(np.sqrt(2.3 * self.plates.area.mean()))
        return float(np.cbrt(edge * self.shell.thickness**2 / 3))

    def whole(self, options: PetscOptions | None = None) -> ShellBody:
        """The body of all triangles; kept, for all copies of the mesh."""
        if self._whole is None:
            self._whole = self.body(np.ones(self.stress.domain.cell_count), options)
        return self._whole

    def body(self, share: Values, _: PetscOptions | None = None) -> ShellBody:
        """Of the cells with a share (cells,); there are factors, and no options."""
        return ShellBody(self, share)

    def of_triangles(self, share: Values) -> Values:
        """(triangles,) means over their cells, of (cells,)."""
        of_input = np.empty_like(share)
        of_input[self.stress.domain.cell_input] = share
        return np.asarray(of_input.reshape(-1, 3).mean(axis=1))

    def matrix(self, triangles: Ints, share: Values, place: Ints) -> csc_matrix:
        """Of some triangles (n,) with their shares (n,), of nodes that are at places (nodes,) in it."""
        dofs = (6 * place[self.shell.triangles[triangles]][:, :, None] + np.arange(6)).reshape(-1, 18)
        rows, columns = np.repeat(dofs, 18, axis=1).ravel(), np.tile(dofs, 18).ravel()
        size = 6 * (int(place.max()) + 1)
        entries = share[:, None, None] * self._each[triangles]
        return coo_matrix((entries.ravel(), (rows, columns)), shape=(size, size)).tocsc()

    def on_middle(self, force: Values) -> Values:
        """(n, 6) forces and moments on the middle surface of forces (nodes, 3) on those of the domain, N and N m."""
        of_input = np.empty_like(force)
        of_input[self.stress.domain.node_input] = force
        below, above = np.split(of_input, 2)
        return np.concatenate([below + above, np.cross(self._half, above - below)], axis=1)

    def tensor(self, u: Values, share: Values) -> Values:
        """(cells, 6) stress of displacements and rotations u (n, 6) in the cells with a share, 0 in all others, Pa."""
        mine = np.flatnonzero(self.of_triangles(share))
        faces = self._stressing.of(u[self.shell.triangles[mine]], mine)
        mean, apart = (faces[:, :, 0] + faces[:, :, 1]) / 2, (faces[:, :, 0] - faces[:, :, 1]) / 2
        tension = mean + np.hypot(apart, faces[:, :, 2])
        flat = np.take_along_axis(faces, tension.argmax(axis=1)[:, None, None], axis=1)[:, 0]
        in_plane = flat[:, [0, 2, 2, 1]].reshape(-1, 2, 2)
        axes = self.plates.axes[mine, :2]
        sigma = np.einsum("nai,nab,nbj->nij", axes, in_plane, axes)
        result = np.zeros((len(self.plates.area), 6))
        result[mine] = np.stack([sigma[:, i, j] for i, j in SYMMETRIC_COMPONENTS[3]], axis=1)
        cells = np.repeat(result, 3, axis=0)[self.stress.domain.cell_input]
        cells[share == 0] = 0.0
        return np.asarray(cells)


class ShellBody:
    """A shell, or a piece of one, that nothing holds.

    Attributes:
        share: (cells,) of each cell of the mesh, 0 to 1.    nodes: (n,) of the middle surface, those of its triangles.
        relief: takes the rigid acceleration off a load.    matrix: K (6 n, 6 n).    iterations: none.
    """

    iterations = 0

    def __init__(self, stiffness: ShellStiffness, share: Values) -> None:
        self._stiffness, self.share = stiffness, share
        of = stiffness.of_triangles(share)
        mine = np.flatnonzero(of)
        corners = stiffness.shell.triangles[mine]
        self.nodes = np.unique(corners)
        place = np.full(len(stiffness.nodes), -1)
        place[self.nodes] = np.arange(len(self.nodes))
        self.matrix = stiffness.matrix(mine, of[mine], place)
        mass = np.bincount(place[corners].ravel(), np.repeat(of[mine] * stiffness.weight[mine] / 3, 3))
        # what turning itself weighs is h^2 / 12 of that, over h^2 of an edge: nothing
        weight = np.repeat(mass[:, None], 6, axis=1) * np.array([1.0, 1.0, 1.0, 0.0, 0.0, 0.0])
        self.relief = Relief(weight, _rigid(stiffness.nodes[self.nodes]))
        free = np.arange(6 * int(mass.argmax()), 6 * int(mass.argmax()) + 6)
        self._free = np.setdiff1d(np.arange(6 * len(self.nodes)), free)
        self._factors = self._factored(self.matrix[self._free][:, self._free])

    def _factored(self, matrix: csc_matrix) -> object:
        """Of a positive definite matrix: no pivots are looked for. NotConverged where it is singular."""
        try:
            return splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
        except RuntimeError:
            raise NotConverged(
                f"the analysis of a struck shell ({len(self.nodes)} nodes) has no solution: a part of it hangs by "
                "nothing; give a better mesh"
            ) from None

    def __call__(self, force: Values) -> Values:
        """(nodes of the middle surface, 6) displacement and rotation under forces (nodes of the mesh, 3), N; 0
        elsewhere, m and rad."""
        left = self.relief(self._stiffness.on_middle(force)[self.nodes]).reshape(-1)
        own = np.zeros(len(left))
        own[self._free] = self._factors.solve(left[self._free])  # type: ignore[attr-defined]
        u = np.zeros((len(self._stiffness.nodes), 6))
        u[self.nodes] = own.reshape(-1, 6)
        return u

    def destroy(self) -> None:
        """The factors go with it."""


def _rigid(places: Values) -> Values:
    """(6 n, 6) motions and turns of nodes (n, 3) about their middle, with the rotations."""
    n, arm = len(places), places - places.mean(axis=0)
    modes = np.zeros((n, 6, 6))
    modes[:, np.arange(3), np.arange(3)] = 1.0
    size = float(np.abs(arm).max())
    for axis, w in enumerate(np.eye(3) / size):
        modes[:, :3, 3 + axis], modes[:, 3:, 3 + axis] = np.cross(w, arm), w
    return modes.reshape(-1, 6)
