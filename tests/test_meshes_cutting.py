"""Hexahedra, wedges, pyramids and quadrilaterals cut into simplices: volumes, facets that agree, groups and regions."""

from __future__ import annotations

from collections import Counter
from itertools import product
from pathlib import Path
from typing import Any

import meshio
import numpy as np
import pytest

from fracsim.meshes import MeshError
from fracsim.meshes.check import check_mesh
from fracsim.meshes.mesh_conversion import Block, MeshFileContents
from fracsim.meshes.read import read_mesh
from fracsim.meshes.topology import signed_measures

N = 3  # cubes in a row
# outward faces of the cells in the order of VTK's manual, written here again by hand
QUADS = {
    "hexahedron": ["0321", "4567", "0154", "1265", "2376", "3047"],
    "wedge": ["0143", "1254", "2035"],
    "pyramid": ["0321"],
    "tetra": [],
}
TURNS = {  # one turn of a cell in itself, about one or two axes
    "hexahedron": ["12305674", "04513762"],
    "wedge": ["120453", "354021"],
    "pyramid": ["12304"],
    "tetra": ["1203"],
}


def mixed_cells(random: np.random.Generator) -> tuple[Any, dict[str, Any]]:
    """A cube of N^3 small ones, its inner nodes moved: hexahedra, a column of wedges, some pyramids and tetrahedra.

    All node numbers are shuffled, all cells turned in themselves, the wedges in the orientation of VTK or of Gmsh."""
    grid = np.arange((N + 1) ** 3).reshape(N + 1, N + 1, N + 1)
    points = np.array(list(product(range(N + 1), repeat=3)), float)
    inner = ((points > 0) & (points < N)).all(axis=1)
    points[inner] += random.uniform(-0.15, 0.15, (inner.sum(), 3))
    cells: dict[str, list[list[int]]] = {kind: [] for kind in QUADS}
    for i, j, k in product(range(N), repeat=3):
        place = ((0, 0, 0), (1, 0, 0), (1, 1, 0), (0, 1, 0), (0, 0, 1), (1, 0, 1), (1, 1, 1), (0, 1, 1))
        hexahedron = [int(grid[i + a, j + b, k + c]) for a, b, c in place]
        if (i, j) == (1, 1):
            for wedge in ("012456", "023467"):
                cells["wedge"].append([hexahedron[int(n)] for n in wedge])
        elif (i + j + k) % 3 == 0:
            points = np.vstack([points, points[hexahedron].mean(axis=0)])
            for face in QUADS["hexahedron"]:
                base = [hexahedron[int(n)] for n in face][::-1]
                if (points[base][:, 2] == 0).all():  # on the outside: two tetrahedra
                    cells["tetra"] += [[*base[:3], len(points) - 1], [base[0], *base[2:], len(points) - 1]]
                else:
                    cells["pyramid"].append([*base, len(points) - 1])
        else:
            cells["hexahedron"].append(hexahedron)
    number = random.permutation(len(points))
    shuffled = np.empty_like(points)
    shuffled[number] = points
    turned = {}
    for kind, rows in cells.items():
        turned[kind] = np.array([_turned(kind, number[row], random) for row in rows])
    return shuffled, turned


def _turned(kind: str, nodes: Any, random: np.random.Generator) -> Any:
    for turn in random.choice(TURNS[kind], 5):
        if random.random() < 0.7:
            nodes = nodes[[int(n) for n in turn]]
    return nodes[[0, 2, 1, 3, 5, 4]] if kind == "wedge" and random.random() < 0.5 else nodes


@pytest.mark.parametrize("seed", range(8))
def test_mixed_cells_fill_the_body_and_agree_at_every_face(seed: int) -> None:
    points, cells = mixed_cells(np.random.default_rng(seed))
    assert all(len(rows) for rows in cells.values())
    blocks = [Block(kind, rows) for kind, rows in cells.items()]
    regions = {
        kind: [np.arange(len(rows)) if i == j else np.zeros(0, int) for j, rows in enumerate(cells.values())]
        for i, kind in enumerate(cells)
    }
    mesh = check_mesh(MeshFileContents(points, blocks, regions).simplices("part"))
    # the body's faces are plane, so that its volume is N^3 whatever the cut; each kind has its number of tetrahedra
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(N**3, rel=1e-12)
    assert not [note for note in mesh.notes if "cut into" not in note]
    for kind, parts in {"hexahedron": 6, "wedge": 3, "pyramid": 2, "tetra": 1}.items():
        assert len(mesh.regions[kind]) == parts * len(cells[kind])
    # every facet has one cell or two, and every quadrilateral has the two triangles at its vertex of least number
    facets = Counter(tuple(sorted(cell[:i] + cell[i + 1 :])) for cell in mesh.cells.tolist() for i in range(4))
    assert set(facets.values()) == {1, 2}
    assert sum(count == 1 for count in facets.values()) == 6 * 2 * N**2
    for kind, faces in QUADS.items():
        for cell, face in product(cells[kind].tolist(), faces):
            a, b, c, d = _from_least([cell[int(n)] for n in face])
            assert tuple(sorted((a, b, c))) in facets and tuple(sorted((a, c, d))) in facets


def _from_least(quad: list[int]) -> list[int]:
    first = quad.index(min(quad))
    return quad[first:] + quad[:first]


@pytest.mark.parametrize("seed", range(8))
@pytest.mark.parametrize("kind", ["hexahedron", "wedge", "pyramid"])
def test_one_cell_keeps_its_volume_in_any_order_of_its_nodes(kind: str, seed: int) -> None:
    """A frustum, with plane faces: closed form."""
    random = np.random.default_rng(seed)
    base = {"hexahedron": 4, "wedge": 3, "pyramid": 4}[kind]
    corners = np.array([[0, 0, 0], [2, 0, 0], [2, 1, 0], [0, 1, 0]] if base == 4 else [[0, 0, 0], [2, 0, 0], [0, 1, 0]])
    top, share = np.array([0.3, 0.2, 1.5]), (0.0 if kind == "pyramid" else 0.6)
    upper = top + share * corners if share else top[None]
    area = 2.0 if base == 4 else 1.0
    wanted = 1.5 / 3 * area * (1 + share + share**2)
    points = np.vstack([corners, upper])
    number = random.permutation(len(points))
    shuffled = np.empty_like(points)
    shuffled[number] = points
    block = Block(kind, _turned(kind, number, random)[None])
    mesh = check_mesh(MeshFileContents(shuffled, [block], {}).simplices("part"))
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(wanted, rel=1e-12)


def test_wedge_written_as_a_hexahedron() -> None:
    points = np.array([[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 2], [1, 0, 2], [0, 1, 2]], float)
    block = Block("hexahedron", np.array([[0, 1, 2, 2, 3, 4, 5, 5]]))
    mesh = check_mesh(MeshFileContents(points, [block], {}).simplices("part"))
    assert len(mesh.cells) == 3
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(1.0)


def test_hexahedron_with_nodes_out_of_order_is_refused() -> None:
    points = np.array([[x, y, z] for z in (0.0, 1) for y in (0.0, 1) for x in (0.0, 1)])
    with pytest.raises(MeshError, match=r"part: 1 of 1 hexahedra are folded, .*near \(0.5, 0.5, 0.5\) m.*in order"):
        MeshFileContents(points, [Block("hexahedron", np.arange(8)[None])], {}).simplices("part")


def test_cells_with_nodes_that_do_not_exist_reach_the_check() -> None:
    points = np.array([[x, y, z] for z in (0.0, 1) for y in (0.0, 1) for x in (0.0, 1)])
    block = Block("hexahedron", np.array([[0, 1, 3, 2, 4, 5, 7, 60]]))
    with pytest.raises(MeshError, match="nodes that do not exist"):
        check_mesh(MeshFileContents(points, [block], {}).simplices("part"))


# --- files that gmsh writes -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("version", "order", "incomplete"), [(2.2, 1, 0), (2.2, 2, 0), (4.1, 1, 0), (4.1, 2, 0), (4.1, 2, 1)]
)
@pytest.mark.parametrize("recombine", [True, False])
def test_extruded_cells_of_gmsh(tmp_path: Path, version: float, order: int, incomplete: int, recombine: bool) -> None:
    from fracsim.meshes.gmsh_session import session

    path = tmp_path / "part.msh"
    with session() as gmsh:
        base = gmsh.model.occ.addRectangle(0, 0, 0, 2, 1)
        gmsh.model.occ.synchronize()
        gmsh.model.occ.extrude([(2, base)], 0, 0, 1, [3], recombine=True)
        gmsh.model.occ.synchronize()
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.5)
        if recombine:
            gmsh.model.mesh.setRecombine(2, base)
        gmsh.model.addPhysicalGroup(3, [1], 3, "body")
        gmsh.model.addPhysicalGroup(2, [2], 2, "side")
        gmsh.option.setNumber("Mesh.SecondOrderIncomplete", incomplete)
        gmsh.model.mesh.generate(3)
        gmsh.model.mesh.setOrder(order)
        gmsh.option.setNumber("Mesh.MshFileVersion", version)
        gmsh.write(str(path))
        kinds = {kind: len(tags) for kind, tags in zip(*gmsh.model.mesh.getElements(3)[:2], strict=True)}
        count = sum(kinds.values())
        side = gmsh.model.occ.getMass(2, 2)
    mesh = check_mesh(read_mesh(path))
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(2.0, rel=1e-9)
    assert len(mesh.cells) == (6 if recombine else 3) * count == len(mesh.regions["body"])
    corners = mesh.points[mesh.facet_groups["side"]]
    areas = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1) / 2
    assert areas.sum() == pytest.approx(side)
    assert any(
        f"{count} {'hexahedra' if recombine else 'wedges'} were cut into {len(mesh.cells)}" in note
        for note in mesh.notes
    )
    assert not any("belong to no cell" in note or "inverted" in note for note in mesh.notes)


def test_plane_quadrilaterals(tmp_path: Path) -> None:
    x, y = np.meshgrid(np.arange(4.0), np.arange(3.0), indexing="ij")
    points = np.stack([x.ravel(), y.ravel(), 0 * x.ravel()], axis=1)
    grid = np.arange(12).reshape(4, 3)
    quads = np.stack([grid[:-1, :-1], grid[1:, :-1], grid[1:, 1:], grid[:-1, 1:]], axis=-1).reshape(-1, 4)
    path = tmp_path / "plane.vtu"
    meshio.Mesh(
        points,
        [("quad", quads[:5]), ("triangle", quads[5:, [0, 1, 2]]), ("triangle", quads[5:, [0, 2, 3]])],
        cell_data={"tag": [np.full(5, 1), np.full(1, 2), np.full(1, 2)]},
    ).write(path)
    mesh = check_mesh(read_mesh(path))
    assert signed_measures(mesh.points, mesh.cells).sum() == pytest.approx(6.0)
    assert [len(mesh.regions[name]) for name in ("tag-1", "tag-2")] == [10, 2]
    assert mesh.notes == ("5 quadrilaterals were cut into 10 triangles.",)


def test_join_of_a_study_makes_parts_one_body(tmp_path: Path) -> None:
    """Two boxes with a common face, in millimetres, of hexahedra and of tetrahedra."""
    from fracsim.study import MeshSettings
    from fracsim.study.mesh_source import build_mesh

    box = np.array([[x, y, z] for z in (0.0, 1) for y in (0.0, 1) for x in (0.0, 1)])
    first = np.array([[0, 1, 3, 2, 4, 5, 7, 6]])
    path = tmp_path / "two.vtu"
    points, cells = np.concatenate([box, box + np.eye(3)[0]]), np.concatenate([first, first + 8])
    meshio.Mesh(points, [("hexahedron", cells)]).write(path)
    apart = build_mesh(MeshSettings.model_validate({"file": path, "scale": 1e-3}))
    assert any("8 nodes coincide with nodes of another body" in note for note in apart.notes)
    joined = build_mesh(MeshSettings.model_validate({"file": path, "scale": 1e-3, "join": True}))
    assert (len(apart.points), len(joined.points)) == (16, 12)
    assert joined.notes[-1] == "4 nodes were joined with coincident nodes of another body: 2 bodies are 1 now."
