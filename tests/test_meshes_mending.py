"""Faults of closed surfaces: mended with a note where the shape stays, against the volume in closed form."""

from __future__ import annotations

import struct
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from fracsim.meshes import MeshError
from fracsim.meshes.data import Indices, Points
from fracsim.meshes.surfaces.closed import closed_surface, read_surface

FILES = Path(__file__).parent / "meshes"
CUBE = np.array([[x, y, z] for z in (0.0, 1) for y in (0.0, 1) for x in (0.0, 1)])
QUADS = ((0, 2, 3, 1), (4, 5, 7, 6), (0, 1, 5, 4), (1, 3, 7, 5), (3, 2, 6, 7), (2, 0, 4, 6))  # normals outwards
BOX = 60.0 * 40.0 * 20.0  # of the files, in their unit of length


def soup(size: tuple[float, float, float] = (3.0, 2.0, 1.0)) -> Points:
    """A box as separate triangles: (12, 3, 3)."""
    return np.array([CUBE[list(corners)] * size for a, b, c, d in QUADS for corners in ((a, b, c), (a, c, d))])


def surface_of(triangles: Points) -> tuple[Points, Indices]:
    return triangles.reshape(-1, 3), np.arange(3 * len(triangles)).reshape(-1, 3)


@pytest.mark.parametrize(
    ("name", "unit", "note"),
    [
        ("q1_vt_vn_blender_default.obj", 1e-3, None),
        ("q2_vn_only.obj", 1e-3, None),
        ("q3_colour_meshlab.obj", 1e-3, None),
        ("p2_vertex_index.ply", 1e-3, None),
        ("s4_degenerate.stl", 1.0, "1 surface triangles without an area were left out."),
        ("s6_tjunction.stl", 1.0, "1 edges of the surface had corners of other triangles on them"),
        ("s8_noise.stl", 1.0, "points of the surface within 2e-05 of its size of another point were joined"),
    ],
)
def test_files_of_other_programs(name: str, unit: float, note: str | None) -> None:
    surface = read_surface(FILES / name)
    assert surface.volume == pytest.approx(BOX * unit**3, rel={"s8": 1e-5, "p2": 1e-6}.get(name[:2], 1e-12))
    assert any(note in told for told in surface.notes) if note else surface.notes == ()


@pytest.mark.parametrize("kind", ["uchar uint", "uchar int", "uint8 int32", "uint uint32"])
@pytest.mark.parametrize("name", ["vertex_index", "vertex_indices"])
@pytest.mark.parametrize("end", ["\n", "\r\n"])
def test_binary_ply_of_other_writers(tmp_path: Path, kind: str, name: str, end: str) -> None:
    lines = ["ply", "format binary_little_endian 1.0", "comment  of   a program", "element vertex 8"]
    lines += [f"property float {axis}" for axis in "xyz"] + ["property uchar red", "element face 6"]
    lines += [f"property list {kind} {name}", "end_header"]
    body = b"".join(struct.pack("<3fB", *point, 200) for point in CUBE)
    length = "I" if kind.startswith("uint ") else "B"
    body += b"".join(struct.pack(f"<{length}4I", 4, *quad) for quad in QUADS)
    (tmp_path / "part.ply").write_bytes((end.join(lines) + end).encode() + body)
    assert read_surface(tmp_path / "part.ply").volume == pytest.approx(1.0)
    lines.insert(-1, "property uchar red")
    (tmp_path / "part.ply").write_bytes((end.join(lines) + end).encode() + body)
    with pytest.raises(MeshError, match="a face has 2 properties, and of binary PLY only the corners are supported"):
        read_surface(tmp_path / "part.ply")


@pytest.mark.parametrize("seed", range(6))
def test_t_junctions_on_every_edge(seed: int) -> None:
    """Each triangle is cut anew at places of its own on all its edges, so that no two neighbours agree."""
    random = np.random.default_rng(seed)
    cut = []
    for a, b, c in soup():
        u, v, w = random.uniform(0.1, 0.9, 3)
        p, q, r = a + u * (b - a), b + v * (c - b), c + w * (a - c)
        cut += [(a, p, r), (p, b, q), (q, c, r), (p, q, r)]
    turned = 1e-3 * np.array(cut) @ Rotation.random(random_state=seed).as_matrix().T + random.uniform(-1, 1, 3)
    surface = closed_surface(*surface_of(turned), "S")
    assert surface.volume == pytest.approx(6e-9, rel=1e-6)
    assert len(surface.notes) == 1 and "were divided there" in surface.notes[0]


def test_collinear_and_doubled_triangles() -> None:
    """One edge of a face is halved by a triangle without an area; three triangles come twice, one the other way."""
    triangles = soup()
    a, b, c = triangles[0]
    middle = (a + b) / 2
    faces = [*triangles[1:], (a, middle, c), (middle, b, c), (a, b, middle), *triangles[4:6], triangles[7][::-1]]
    surface = closed_surface(*surface_of(np.array(faces)), "S")
    assert surface.volume == pytest.approx(6.0, rel=1e-12)
    assert surface.notes[:2] == (
        "3 surface triangles were given more than once, and are taken once.",
        "1 surface triangles without an area were left out.",
    )


@pytest.mark.parametrize(("noise", "notes"), [(0.0, 0), (1e-7, 0), (3e-6, 1)])
def test_noise_between_points_that_are_one(noise: float, notes: int) -> None:
    triangles = soup()
    triangles += 3.0 * noise * np.random.default_rng(1).uniform(-1, 1, triangles.shape)
    surface = closed_surface(*surface_of(triangles), "S")
    assert surface.volume == pytest.approx(6.0, rel=1e-4)
    assert len(surface.triangles) == 12 and len(surface.notes) == notes


def test_inward_normals_are_turned() -> None:
    surface = closed_surface(*surface_of(soup()[:, ::-1]), "S")
    assert surface.volume == pytest.approx(6.0) and "inside out" in surface.notes[0]


def test_what_would_change_the_shape_is_refused() -> None:
    with pytest.raises(MeshError, match=r"is open: 3 edges .* first at \(.*MeshLab: .*Close Holes"):
        closed_surface(*surface_of(soup()[1:]), "S")
    sheet = np.concatenate([soup(), soup()[:1] + np.array([0, 0, 0.5])])
    with pytest.raises(MeshError, match="is open: 3 edges"):
        closed_surface(*surface_of(sheet), "S")


@pytest.mark.parametrize("start", range(12))
def test_concave_polygons_of_an_obj(tmp_path: Path, start: int) -> None:
    """A prism below a star of twelve corners, whose faces begin at any corner; two objects in one file."""
    angles = np.arange(12) * np.pi / 6
    radii = np.where(np.arange(12) % 2, 0.3, 1.0)
    star = np.stack([radii * np.cos(angles), radii * np.sin(angles)], axis=1)
    area = 12 * 0.5 * 1.0 * 0.3 * np.sin(np.pi / 6)
    lines = []
    for name, away in (("one", 0.0), ("two", 5.0)):
        lines += [f"o {name}"] + [f"v {x + away} {y} {z}" for z in (0, 2) for x, y in star]
        around = [(start + i) % 12 for i in range(12)]
        faces = [around[::-1], [12 + i for i in around]]
        faces += [[i, (i + 1) % 12, 12 + (i + 1) % 12, 12 + i] for i in range(12)]
        lines += ["f " + " ".join(str(i - 24) for i in face) for face in faces]
    (tmp_path / "star.obj").write_text("\n".join(lines) + "\n")
    surface = read_surface(tmp_path / "star.obj")
    assert len(surface.bodies) == 2
    assert surface.volume == pytest.approx(2 * 2 * area, rel=1e-12)
    assert surface.area == pytest.approx(2 * (2 * area + 12 * 2 * np.linalg.norm(star[1] - star[0])), rel=1e-12)
