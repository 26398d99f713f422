"""Meshes without preferred directions: the measure on meshes of known directions, and what builders make."""

from __future__ import annotations

import os
import re
import subprocess
import sys
import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from fracsim.meshes import BUILDERS
from fracsim.meshes.data import MeshData, MeshError
from fracsim.meshes.directions import preferred_directions
from fracsim.meshes.quality import mesh_quality
from fracsim.meshes.random_points.points import SAMPLING, Outline, circumcircles, scatter, spaced
from fracsim.meshes.sizing import SizeField
from fracsim.meshes.topology import boundary_facets, edges_of, signed_measures
from fracsim.study.mesh_source import build_mesh
from fracsim.study.reader import load_study


def ring(*corners: tuple[float, float], h: float, first: int = 0) -> Outline:
    """A polygon with steps of about h along its sides, its nodes numbered from `first`."""
    ends = np.array(corners)
    steps = [
        start + (end - start) * (np.arange(n) / n)[:, None]
        for start, end in zip(ends, np.roll(ends, -1, axis=0), strict=True)
        for n in [max(1, round(float(np.linalg.norm(end - start)) / h))]
    ]
    points = np.concatenate(steps)
    number = np.arange(len(points))
    return Outline(points, first + np.stack([number, np.roll(number, -1)], axis=1))


SQUARE = [(0.0, 0.0), (1.0, 0.0), (1.0, 1.0), (0.0, 1.0)]


def test_a_lattice_has_three_directions() -> None:
    """All edges lie in three directions, where 6 x 3.5 of 180 degrees would by chance: 180 / 21."""
    for size in ((1.0, 1.0), (2.0, 0.5)):
        mesh = BUILDERS["box"](size=size, h=0.1).build()
        assert preferred_directions(mesh)["directions"] == pytest.approx(180 / 21, rel=1e-12)


def test_the_measure_does_not_depend_on_how_the_body_lies() -> None:
    """A lattice turned by 22.5 degrees is a lattice; in space one direction has its share over that of its cone."""
    flat = BUILDERS["box"](size=(1.0, 1.0), h=0.1).build()
    c, s = np.cos(np.pi / 8), np.sin(np.pi / 8)
    turned = MeshData(flat.points @ np.array([[c, s], [-s, c]]), flat.cells)
    assert preferred_directions(turned)["directions"] == pytest.approx(180 / 21, rel=1e-12)
    solid = BUILDERS["box"](size=(1.0, 1.0, 1.0), h=0.1).build()
    edges, outer = edges_of(solid.cells), set(map(tuple, edges_of(boundary_facets(solid.cells)).tolist()))
    inner = np.array([tuple(edge) not in outer for edge in edges.tolist()])
    spans = np.diff(solid.points[edges], axis=1)[:, 0]
    along = (np.abs(spans[inner]) > 1e-9).astype(int) @ [1, 2, 4]  # Kuhn: seven directions
    share = np.bincount(along).max() / inner.sum()
    assert preferred_directions(solid)["directions"] == pytest.approx(share / (1 - np.cos(np.radians(6))), rel=1e-12)


@pytest.mark.parametrize(
    ("name", "parameters"),
    [
        ("box", {"size": (1.0, 1.0), "h": 0.03, "pattern": "unstructured"}),
        ("disk", {"h": 0.002}),
        ("plate-hole", {"h": 0.0015}),
        ("notched-plate", {}),
        ("notched-bar", {"thickness": 0.0, "h": 6e-4}),
    ],
)
def test_unstructured_bodies_have_none(name: str, parameters: dict[str, object]) -> None:
    assert preferred_directions(BUILDERS[name](**parameters).build())["directions"] < 1.3


def test_flat_and_round_faces_have_none() -> None:
    """Lattices of gmsh have 4.5 (flat) and 5.4 (round); so few edges as here 1.4 by chance."""
    box = preferred_directions(BUILDERS["box"](size=(1.0, 1.0, 1.0), h=0.08, pattern="unstructured").build())
    cylinder = preferred_directions(BUILDERS["cylinder"](h=0.012).build())
    assert max(box["directions_faces"], cylinder["directions_faces"]) < 1.6
    assert max(box["directions"], cylinder["directions"]) < 1.6


def test_points_are_apart_and_leave_no_gap() -> None:
    """No edge is shorter than 0.75 h, no circle around a triangle larger: angles of 30 degrees, and area exact."""
    h = 0.05
    points, cells = scatter(ring(*SQUARE, h=h), SizeField(h).at)
    quality = mesh_quality(MeshData(points, cells))
    assert quality["edge_min"] >= SAMPLING.distance * h * (1 - 1e-12)
    assert quality["edge_max"] <= 2 * SAMPLING.distance * h * 1.001
    assert quality["angle_min"] >= 29.9
    assert signed_measures(points, cells).sum() == pytest.approx(1.0, rel=1e-12)


def test_seeds() -> None:
    """The same seed, the same mesh; another seed, other points."""
    outline = ring(*SQUARE, h=0.1)
    first, again, other = (scatter(outline, SizeField(0.1).at, seed)[0] for seed in (1, 1, 2))
    np.testing.assert_array_equal(first, again)
    assert len(first) != len(other) or not np.allclose(first, other)


def test_holes_and_narrow_slits() -> None:
    """A hole with an island in it, and a slit far narrower than the cells, whose nodes do not face each other."""
    outer, hole = ring(*SQUARE, h=0.1), ring((0.2, 0.2), (0.5, 0.2), (0.5, 0.5), (0.2, 0.5), h=0.1, first=40)
    island = ring((0.3, 0.3), (0.4, 0.3), (0.4, 0.4), (0.3, 0.4), h=0.1, first=52)
    slit = ring((0.6, 0.7), (0.83, 0.702), (0.6, 0.704), h=0.09, first=56)
    parts = [outer, hole, island, slit]
    outline = Outline(np.concatenate([p.points for p in parts]), np.concatenate([p.pieces for p in parts]))
    points, cells = scatter(outline, SizeField(0.1).at)
    assert signed_measures(points, cells).sum() == pytest.approx(1 - 0.09 + 0.01 - 0.23 * 0.004 / 2, rel=1e-12)


def test_points_do_not_depend_on_the_processor(tmp_path: Path) -> None:
    """OpenBLAS rounds otherwise for other processors; the points that are drawn are equal to the last digit."""
    code = "import sys, numpy; from support.squares import square\n"
    code += "numpy.save(sys.argv[1], square('unstructured', 30).points)"
    drawn = []
    has_avx512 = "avx512f" in Path("/proc/cpuinfo").read_text()  # kernels for SkylakeX end a process without it
    for processor in ("Prescott", "Haswell", *(["SkylakeX"] if has_avx512 else [])):
        target = tmp_path / f"{processor}.npy"
        environment = os.environ | {"OPENBLAS_CORETYPE": processor, "PYTHONPATH": str(Path(__file__).parent)}
        subprocess.run([sys.executable, "-c", code, str(target)], env=environment, check=True)
        drawn.append(np.load(target))
    assert all(np.array_equal(points, drawn[0]) for points in drawn)


def test_circles_through_three_points() -> None:
    """The three corners have the same distance from the centre, also where the first span has no x."""
    corners = np.concatenate([np.random.default_rng(3).random((100, 3, 2)), [[[0, 0], [0, 1], [2, 1]]]])
    centres, radii = circumcircles(corners)
    apart = np.linalg.norm(corners - centres[:, None], axis=2)
    np.testing.assert_allclose(apart, np.outer(radii, [1, 1, 1]), rtol=1e-9)


def test_an_outline_that_crosses_itself_is_refused() -> None:
    with pytest.raises(MeshError, match="the outline meets itself near"):
        scatter(ring((0.0, 0.0), (1.0, 1.0), (1.0, 0.0), (0.0, 0.83), h=0.2), SizeField(0.2).at)


def test_graded_meshes_are_as_fine_as_they_are_asked_to_be() -> None:
    """Median edges near the fine place and far from it are those asked for, within 15 %."""
    sizing = SizeField(0.08, 0.01, (0.5, 0.5), (0.5, 0.5))
    points, cells = scatter(ring(*SQUARE, h=0.08), sizing.at)
    edges = edges_of(cells)
    middle, length = points[edges].mean(axis=1), np.linalg.norm(np.diff(points[edges], axis=1)[:, 0], axis=1)
    for low, high in ((0.0, 0.05), (0.1, 0.15), (0.3, 0.5)):
        there = np.abs(np.linalg.norm(middle - 0.5, axis=1) - (low + high) / 2) < (high - low) / 2
        assert np.median((length / sizing.at(middle))[there]) == pytest.approx(0.96, abs=0.15)


def test_the_page_has_what_packaged_studies_have() -> None:
    """Those in the plane, a round body, a thin wall and a figure; the ranges are those that docs/fracture.md quotes."""
    text = (Path(__file__).parent.parent / "docs" / "fracture.md").read_text().replace("\n", " ")
    found = re.search(
        r"random points, 2D \| ([0-9.]+) to ([0-9.]+) \|.*3D \| ([0-9.]+) to ([0-9.]+); ([0-9.]+) to ([0-9.]+) in "
        r"walls of two or three cells; ([0-9.]+) to ([0-9.]+) on faces.*\| lattice \| ([0-9.]+)", text,
    )  # fmt: skip
    assert found is not None
    plane, space, walls, faces = (tuple(map(float, found.group(k, k + 1))) for k in (1, 3, 5, 7))
    inside = {"bar-2d": plane, "charpy": plane, "notched-bar": plane, "granite-cylinder": space, "dropped-vase": walls}
    for name, (low, high) in inside.items():
        values = preferred_directions(build_mesh(load_study(name).mesh))
        assert low <= values["directions"] <= high, name
        assert faces[0] <= values.get("directions_faces", faces[0]) <= faces[1], name
    assert float(found.group(9)) == pytest.approx(180 / 21, abs=0.05)


def test_points_keep_their_distance_from_earlier_ones() -> None:
    """Against all distances, with spacings that vary by a factor of ten."""
    random = np.random.default_rng(2)
    points = random.random((800, 2))
    apart = 0.005 + 0.05 * points[:, 0]
    distances = np.linalg.norm(points[:, None] - points, axis=2)
    near = np.tril(distances < np.maximum(apart[:, None], apart), -1)
    assert 0.2 < near.any(axis=1).mean() < 0.8
    assert np.array_equal(spaced(points, apart), ~near.any(axis=1))


def test_a_strongly_graded_mesh_needs_no_more_memory() -> None:
    """10,000 points within a thousandth of the largest spacing: pairs within that spacing took 0.8 GB."""
    points = np.concatenate([1e-3 * np.random.default_rng(3).random((10_000, 2)), [[5.0, 5.0]]])
    apart = np.append(np.full(10_000, 1e-6), 1.0)
    tracemalloc.start()
    spaced(points, apart)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 20e6
