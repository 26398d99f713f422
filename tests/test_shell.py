"""Shells: their meshes, what strains them, and cracks through their whole thickness."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import pytest
from scipy.spatial.transform import Rotation

from fracsim.errors import InputError
from fracsim.fracture.brittle.grains import GrainParameters, SurfaceParameters
from fracsim.fracture.principal_stress import symmetric_tensors
from fracsim.meshes import BUILDERS, MeshData, MeshError
from fracsim.meshes.check import check_mesh
from fracsim.meshes.shell import extrude_shell, read_shell
from fracsim.meshes.topology import signed_measures
from fracsim.rigid.convex_decomposition import Polyhedron
from fracsim.rigid.fragment_geometry import FragmentGeometry
from fracsim.study.check import check_study
from support.rigid import DENSITY, breakable, moments_of, shell_of
from test_plate import pane
from test_rigid_study import study

Values = npt.NDArray[np.float64]
H = 0.01


def strip(count: int, seed: int = 1) -> MeshData:
    """1 m long, a fifth as wide, H thick."""
    points, triangles = pane(count, seed)
    return extrude_shell(points * [1.0, 0.2, 1.0], triangles, H)


# --- meshes ---


def test_a_shell_encloses_its_area_times_its_thickness() -> None:
    """A plate exactly, a ball (4 pi / 3) (r_o^3 - r_i^3) as far as its triangles are round; normals are as long as a
    fold needs: a right angle is as thick as its sides."""
    assert signed_measures(strip(5).points, strip(5).cells).sum() == pytest.approx(0.2 * H, rel=1e-12)
    ball: Any = BUILDERS["ornament"](neck=0.0, h=0.004)
    mesh = check_mesh(ball.build())
    assert not mesh.notes and [*mesh.facet_groups] == ["inner", "outer"]
    outer, inner = ball.radius + ball.thickness / 2, ball.radius - ball.thickness / 2
    volume = signed_measures(mesh.points, mesh.cells)
    assert volume.min() > 0 and volume.sum() == pytest.approx(4 / 3 * np.pi * (outer**3 - inner**3), rel=0.01)
    flat, triangles = pane(4)
    flat[:, :2] = np.round(4 * flat[:, :2]) / 4
    beyond = np.maximum(flat[:, 0] - 0.5, 0.0)
    corner = extrude_shell(flat + beyond[:, None] * [-1.0, 0.0, 1.0], triangles, H)
    assert signed_measures(corner.points, corner.cells).sum() == pytest.approx(H, rel=1e-3)
    crease = np.linalg.norm(np.diff(corner.points.reshape(2, -1, 3), axis=0)[0], axis=1)[flat[:, 0] == 0.5]
    assert np.allclose(crease, H * np.sqrt(2), rtol=0.02)


def test_a_shell_is_read_open_or_closed(tmp_path: Path) -> None:
    """Triangles that face either side are turned alike; an edge of three is refused, and a fold without room."""
    points, triangles = pane(3)
    triangles[::3] = triangles[::3, ::-1]
    mesh = read_shell(written(tmp_path / "open.obj", points, triangles), H, 2.0)
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(4 * H) and "turned" in mesh.notes[0]
    assert mesh.shell is not None and len(mesh.facet_groups["rim"]) == 2 * 12
    third = np.concatenate([triangles, [[0, 4, len(points)]], [[1, 5, len(points)]], [[0, 5, len(points)]]])
    with pytest.raises(MeshError, match="more than two triangles"):
        read_shell(written(tmp_path / "book.obj", np.concatenate([points, [[0.1, 0.1, 1.0]]]), third), H)
    ball = BUILDERS["ornament"](neck=0.0, h=0.012).build().shell  # type: ignore[call-arg]
    assert ball is not None
    path = written(tmp_path / "ball.obj", ball.middle, ball.triangles)
    assert check_mesh(read_shell(path, 0.001)).facet_groups.keys() == {"inner", "outer"}
    with pytest.raises(MeshError, match="too thick for its folds"):
        read_shell(path, 0.1)


def test_faults_of_a_shell_are_mended(tmp_path: Path) -> None:
    """Two panes that meet at a T junction; a triangle given twice, and one without an area along the edge."""
    points = np.array([[0.0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [1, 0.5, 0], [2, 0, 0], [2, 1, 0]])
    triangles = np.array([[0, 1, 2], [0, 2, 3], [1, 5, 4], [4, 5, 6], [4, 6, 2], [2, 1, 0]])
    mesh = check_mesh(read_shell(written(tmp_path / "panes.obj", points, triangles), H))
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(2 * H, rel=1e-12)
    assert len(mesh.facet_groups["rim"]) == 2 * 6 and len(mesh.cells) == 3 * 6
    assert "given more than once" in mesh.notes[0] and "divided there" in mesh.notes[1]
    flat = read_shell(written(tmp_path / "flat.obj", points, np.concatenate([triangles[:5], [[1, 4, 2]]])), H)
    assert len(flat.cells) == 3 * 6 and "without an area" in flat.notes[0]


def written(path: Path, points: Values, triangles: npt.NDArray[np.int64]) -> Path:
    """A surface file."""
    lines = [f"v {x} {y} {z}" for x, y, z in points] + [f"f {a + 1} {b + 1} {c + 1}" for a, b, c in triangles]
    path.write_text("\n".join(lines) + "\n")
    return path


@pytest.mark.parametrize(
    ("mesh", "said"),
    [
        ({}, "a shell has a thickness"),
        ({"thickness": 0.0}, "a shell has a thickness"),
        ({"thickness": 0.01, "h": 0.1}, "mesh.h is not a known key"),
    ],
)
def test_a_shell_without_thickness_is_refused(mesh: dict[str, Any], said: str, tmp_path: Path) -> None:
    """Issue 13; and what is no key of it."""
    path = written(tmp_path / "pane.obj", *pane(2))
    with pytest.raises(InputError, match=said):
        check_study(study(mesh={"shell": str(path), **mesh}))


def test_a_shell_is_for_rigid_bodies(tmp_path: Path) -> None:
    """One layer of tetrahedra would lock."""
    path = written(tmp_path / "pane.obj", *pane(2))
    with pytest.raises(ValueError, match=r"mesh\.shell is for"):
        study(mesh={"shell": str(path), "thickness": 0.01}, body=None, brittle=None, fracture=None,
              time={"scheme": "newmark", "step": 1e-3, "end": 0.1})  # fmt: skip


# --- strain ---


def bent(force: list[float], at: list[float]) -> tuple[Values, Values]:
    """sigma_x (triangles,) on the face in tension, and x of their middles, of the strip under forces at places."""
    stiffness = shell_of(strip(20))
    domain, body = stiffness.stress.domain, stiffness.whole_body()
    assert body.inertia_relief.mass[:, 0].sum() == pytest.approx(DENSITY * 0.2 * H)
    nodal = np.zeros_like(domain.nodes)
    for each, x in zip(force, at, strict=True):
        on = np.abs(domain.nodes[:, 0] - x) < 1e-9
        nodal[on, 2] = each / on.sum()
    sigma = stiffness.cell_stress(body(nodal), body.cell_fractions)[:, 0]
    return sigma, domain.nodes[domain.cell_nodes].mean(axis=1)[:, 0]


def test_a_strip_bent_over_its_ends_has_the_stress_of_a_beam() -> None:
    """Lines of force -2 in the middle, 1 at the ends, in balance: sigma = 6 M / (b h^2), M = x F."""
    sigma, x = bent([-2.0, 1.0, 1.0], [0.5, 0.0, 1.0])
    for place in (0.2, 0.35, 0.8):
        near = np.abs(x - place) < 0.05
        moment = np.minimum(x, 1 - x)[near].mean()
        assert sigma[near].mean() == pytest.approx(6 * moment / (0.2 * H**2), rel=0.05)


def test_a_strip_that_is_lifted_is_bent_by_its_own_inertia() -> None:
    """By its middle, 1 N in all: M = x^2 / (2 L) of what is beyond."""
    sigma, x = bent([1.0], [0.5])
    for place in (0.25, 0.4, 0.7):
        near = np.abs(x - place) < 0.05
        moment = (np.minimum(x, 1 - x)[near] ** 2 / 2).mean()
        assert sigma[near].mean() == pytest.approx(6 * moment / (0.2 * H**2), rel=0.05)


def test_stress_of_a_shell_does_not_depend_on_the_frame() -> None:
    """An ornament, turned with its load: sigma' = Q sigma Q^T."""
    mesh: MeshData = BUILDERS["ornament"](h=0.012).build()  # type: ignore[call-arg]
    Q = Rotation.from_rotvec([0.4, -0.7, 1.1]).as_matrix()
    shell = mesh.shell
    assert shell is not None
    turned = extrude_shell(shell.middle[: len(shell.middle) // 2] @ Q.T, shell.triangles, shell.thickness)
    found = []
    for each, R in ((mesh, np.eye(3)), (turned, Q)):
        stiffness = shell_of(each)
        domain, body = stiffness.stress.domain, stiffness.whole_body()
        force = np.zeros((len(mesh.points), 3))
        force[[3, 40, 77]] = [[1.0, -2.0, 0.5], [0.3, 0.1, 2.0], [0.0, 1.0, 1.0]]
        u = body((force @ R.T)[domain.input_numbering.nodes])
        found.append(
            (R.T @ symmetric_tensors(stiffness.cell_stress(u, body.cell_fractions), 3) @ R)[
                np.argsort(domain.input_numbering.cells)
            ]
        )
    assert np.allclose(*found, atol=1e-6 * np.abs(found[0]).max())


# --- fracture ---


@pytest.mark.parametrize("grains", [None, GrainParameters(12, seed=3)])
def test_cracks_go_through_the_whole_thickness(grains: GrainParameters | None) -> None:
    """A pane pushed in its middle, held at its corners: both nodes of a place stay in one piece, the pieces weigh what
    the pane weighs, and some broke across its bending."""
    mesh = strip(12)
    body = breakable(mesh, 2e4, SurfaceParameters(8, grains=grains))
    points = np.array([[0.5, 0.1, H / 2], [0.0, 0.1, -H / 2], [1.0, 0.1, -H / 2]])
    force = np.array([[0.0, 0.0, -2.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0]])
    assert body.break_fragments(0, body.distribute_forces(0, points, force, np.full(3, 0.01))) > 0
    of_input = np.empty(len(mesh.points), int)
    of_input[body.graph.domain.input_numbering.nodes] = body.fragments.node_fragment
    below, above = np.split(of_input, 2)
    assert body.fragments.count > 2 and np.array_equal(below, above)
    assert moments_of(body).volume.sum() == pytest.approx(0.2 * H, rel=1e-9)
    assert moments_of(body).volume.min() > 0


def test_a_closed_shell_collides_as_what_it_encloses() -> None:
    """One convex part: nothing is ever inside."""
    mesh = BUILDERS["ornament"](neck=0.0, h=0.012).build()  # type: ignore[call-arg]
    (parts,) = FragmentGeometry(mesh).update_shapes({}).convex_parts
    assert len(parts) == 1
    outer = np.linalg.norm(np.concatenate(parts), axis=1)
    assert outer.min() > 0.04
    box = Polyhedron(np.eye(3), np.array([[0, 1, 2], [0, 2, 1]]))
    assert box.without_cavities is box
