"""The split surface as it is written: files, fields, pieces and their names, at any number of ranks."""

from __future__ import annotations

import csv
import math
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
import pyvista

from fracsim.errors import NotConverged
from fracsim.fracture.edge_history import cut_positions_from_forces
from fracsim.meshes.data import MeshData
from fracsim.output.fields_file import Field
from fracsim.output.surface.body_surface import MAX_COORDINATE, BodySurface, SurfaceFrame
from fracsim.output.surface.fragment_table import FragmentNames, tabulate_fragments
from fracsim.output.surface.vtk_files import SurfaceFiles, fragment_columns
from support.ranks import OnRanks
from support.solids import Values, lattice, patterns, separated
from support.torn import SURFACES

RANKS = (1, 2, 3)


# --- ranks ---


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", RANKS)
def test_pieces_are_those_of_the_distributed_graph(on_ranks: OnRanks, ranks: int) -> None:
    found, _ = on_ranks(ranks)
    for name in SURFACES:
        assert found[f"surface-{name}-piece"].max() > 0
        assert np.array_equal(found[f"surface-{name}-piece"], found[f"surface-{name}-graph-piece"])


@pytest.mark.ranks
@pytest.mark.parametrize("ranks", RANKS[1:])
def test_the_same_surface_at_any_number_of_ranks(on_ranks: OnRanks, ranks: int) -> None:
    """Topology, reference places, parents and names to the last bit; places to what tearing makes of the solver's
    1e-10."""
    (serial, one), (found, other) = on_ranks(1), on_ranks(ranks)
    compared = [name for name in serial if name.startswith("surface-")]
    assert len(compared) == 11 * len(SURFACES)
    for name in compared:
        assert np.array_equal(found[name], serial[name]), name
    for name in SURFACES:
        last = sorted((one / name / "surface").iterdir())[-1]
        expected, read = (pyvista.read(path) for path in (last, other / name / "surface" / last.name))
        assert np.array_equal(read.cells, expected.cells)
        assert np.abs(read.points - expected.points).max() < 1e-6
        for key in ("piece", "origin", "cell"):
            assert np.array_equal(read.cell_data[key], expected.cell_data[key])
        assert np.allclose(read.cell_data["age"], expected.cell_data["age"], equal_nan=True, atol=1e-12)


# --- files ---


def bar(cells: int = 6) -> MeshData:
    """A bar along x with named ends."""
    mesh = lattice(cells, 1, 1)
    from fracsim.meshes.topology import boundary_facets, facets_on_nodes

    facets = boundary_facets(mesh.cells)
    ends = {name: facets_on_nodes(facets, mesh.points[:, 0] == at) for name, at in (("left", 0.0), ("right", cells))}
    return MeshData(mesh.points, mesh.cells, ends | {"tip": ends["right"][:1]})


def torn_at(surface: BodySurface, *places: float) -> npt.NDArray[np.uint8]:
    """Patterns of a bar cut at right angles."""
    skeleton = surface.skeleton
    return patterns(skeleton, separated(skeleton, np.searchsorted(places, skeleton.points[:, 0])))


def frame_of(surface: BodySurface, t: float, **options: object) -> SurfaceFrame:
    points = surface.skeleton.points
    return surface.make_frame(t, 0.1 * points, np.zeros_like(points), **options)  # type: ignore[arg-type]


@pytest.mark.parametrize("precision", ("single", "double"))
def test_a_frame_reads_back(tmp_path: Path, precision: str) -> None:
    """Points where they are now, closed, every field there, groups by name, and the age of the crack."""
    surface, files = BodySurface(bar(), 2.0), SurfaceFiles(tmp_path, 3, precision=precision)
    surface.update(torn_at(surface, 2.5))
    skeleton = surface.skeleton
    broken_at = np.where(surface.split.broken, 0.25, np.nan)
    stress = np.arange(float(len(skeleton.cells)))
    heat = Field("heat", "Node", skeleton.points[:, 0])
    path = files.write_frame(
        frame_of(surface, 1.0, broken_at=broken_at, fields=[Field("von_mises", "Cell", stress), heat])
    )
    grid = pyvista.read(path)
    assert grid.extract_surface().n_open_edges == 0
    reference = grid.points - grid.point_data["displacement"]
    assert reference.dtype == precision
    assert np.abs(reference - surface.split.points).max() < 4 * np.abs(reference).max() * np.finfo(precision).eps
    assert np.array_equal(grid.cell_data["von_mises"], stress[grid.cell_data["cell"]])
    assert set(grid.point_data) == {"displacement", "velocity", "piece", "heat"}
    names = np.array(grid.field_data["origins"])[grid.cell_data["origin"]]
    assert set(names) == {"crack", "boundary", "left", "right", "right + tip"}
    assert np.count_nonzero(names == "right + tip") == 1
    assert np.array_equal(grid.cell_data["age"] == 0.0, names != "crack")  # no NaN, which ParaView draws yellow
    assert np.all(grid.cell_data["age"][names == "crack"] == 0.75)
    # the crack lies half way between nodes 2 and 3
    assert np.all(np.abs(reference[np.unique(grid.cells.reshape(-1, 4)[names == "crack", 1:])][:, 0] - 2.5) < 0.26)


def test_outlines_and_filled_faces_in_2d(tmp_path: Path) -> None:
    """Triangles, then segments, in a plane z = 0."""
    surface, files = BodySurface(lattice(4, 2), 1.0), SurfaceFiles(tmp_path, 2)
    surface.update(torn_at(surface, 1.5))
    frame = frame_of(surface, 0.0)
    grid = pyvista.read(files.write_frame(frame))
    assert grid.cells_dict.keys() == {5, 3}
    assert np.array_equal(grid.cells_dict[3], surface.split.elements)
    assert np.all(grid.points[:, 2] == 0)
    origins = np.array(frame.origins)[frame.element_fields["origin"]]
    assert set(origins[: len(frame.triangles)]) == {"body"}
    assert set(origins[len(frame.triangles) :]) == {"boundary", "crack"}


def test_the_collection_is_valid_after_every_frame_and_resumes(tmp_path: Path) -> None:
    """Frames after the time of the checkpoint go, files and rows too, and the next one takes their place."""
    surface, files = BodySurface(bar(), 1.0), SurfaceFiles(tmp_path, 3)
    for count, t in enumerate((0.0, 0.5, 1.0), start=1):
        files.write_frame(frame_of(surface, t))
        assert pyvista.get_reader(tmp_path / "surface.pvd").time_values == [0.0, 0.5, 1.0][:count]
    again = SurfaceFiles(tmp_path, 3, resume_at=0.5)
    assert again.times == [0.0, 0.5]
    assert len(list((tmp_path / "surface").iterdir())) == 2
    again.write_frame(frame_of(surface, 0.7))
    reader = pyvista.get_reader(tmp_path / "surface.pvd")
    assert reader.time_values == [0.0, 0.5, 0.7]
    reader.set_active_time_value(0.7)
    assert reader.read()[0].n_cells == len(surface.split.elements)
    assert [float(row["time"]) for row in rows_of(tmp_path)] == [0.0, 0.5, 0.7]


def rows_of(folder: Path) -> list[dict[str, str]]:
    with (folder / "pieces.csv").open(newline="") as file:
        return list(csv.DictReader(file))


def test_pieces_csv(tmp_path: Path) -> None:
    """A bar of 6 x 1 x 1 m and 2 kg/m^3 cut at 2.5 m: the heavier part keeps the name 0."""
    surface, files = BodySurface(bar(), 2.0), SurfaceFiles(tmp_path, 3)
    surface.update(torn_at(surface, 2.5))
    files.write_frame(frame_of(surface, 0.5))
    rows = rows_of(tmp_path)
    assert list(rows[0]) == fragment_columns(3)
    assert [row["piece"] for row in rows] == ["0", "1"]
    assert [float(row["mass"]) for row in rows] == pytest.approx([7.0, 5.0])
    assert [float(row["volume"]) for row in rows] == pytest.approx([3.5, 2.5])


@pytest.mark.parametrize("what", ["displacement", "velocity"])
@pytest.mark.parametrize("value", [math.nan, math.inf, 10 * MAX_COORDINATE])
def test_lost_nodes_are_reported_not_written(tmp_path: Path, value: float, what: str) -> None:
    """With the time, the piece, the cell and what to do; nothing is written."""
    surface, files = BodySurface(bar(), 1.0), SurfaceFiles(tmp_path, 3)
    surface.update(torn_at(surface, 2.5))
    values = {name: np.zeros_like(surface.skeleton.points) for name in ("displacement", "velocity")}
    values[what][-1, 1] = value
    node = len(values[what]) - 1
    said = rf"t = 0.125 s .* node {node} of piece 0 \(cell \d+\) has the {what}.*time.step"
    with pytest.raises(NotConverged, match=said):
        files.write_frame(surface.make_frame(0.125, *values.values()))
    assert not list((tmp_path / "surface").iterdir())
    assert files.times == []


# --- only where damage changed ---


def test_built_again_only_where_edges_broke() -> None:
    surface = BodySurface(bar(), 1.0)
    assert surface.build_count == 1
    pattern = torn_at(surface, 2.5)
    assert surface.update(pattern)
    assert not surface.update(pattern.copy())
    frame_of(surface, 1.0)
    assert surface.build_count == 2


# --- pieces ---


def test_names_stay_with_the_heaviest_part() -> None:
    """10 nodes of 1 kg: cut after 3 the right part stays 0; cut that after 7, its left part (4 of 7) stays 0."""
    names, mass = FragmentNames(), np.ones(10)
    cuts = ((), (3,), (3, 7), (1, 3, 7, 9), (1, 3, 5, 7, 9))
    of_node = []
    for cut in cuts:
        piece = np.searchsorted(cut, np.arange(10), side="right")
        of_node.append(names.update(len(cut) + 1, piece, mass)[piece].tolist())
    assert of_node == [
        [0] * 10,
        [1] * 3 + [0] * 7,
        [1] * 3 + [0] * 4 + [2] * 3,
        [3] + [1] * 2 + [0] * 4 + [2] * 2 + [4],
        [3] + [1] * 2 + [0] * 2 + [5] * 2 + [2] * 2 + [4],  # halves: the one with the lowest node stays
    ]


def test_names_after_a_restart() -> None:
    """Breaks replayed at the times of the earlier frames give the names of the run that was not broken off."""
    whole, again = BodySurface(bar(), 1.0), BodySurface(bar(), 1.0)
    when = np.full(len(whole.skeleton.edges), np.nan)
    for t, places in ((1.0, (4.5,)), (2.0, (1.5, 4.5)), (3.0, (1.5, 2.5, 4.5))):
        whole.update(torn_at(whole, *places))
        when[whole.split.broken & np.isnan(when)] = t
    again.replay_fragment_names(when, [0.0, 1.0, 2.0])
    again.update(torn_at(again, 1.5, 2.5, 4.5))
    assert np.array_equal(again.fragment_names, whole.fragment_names)
    assert len(set(whole.fragment_names)) == 4


@pytest.mark.parametrize("dim", [2, 3])
def test_spin_of_rigid_pieces(dim: int) -> None:
    """v = V + omega x r gives back V and omega; nodes in line know no spin about their line, single ones none."""
    random = np.random.default_rng(2)
    x, omega, V = (
        random.random((12, dim)),
        np.array([0.3, -0.5, 0.7])[-(1 if dim == 2 else 3) :],
        np.arange(1.0, dim + 1),
    )
    piece = np.array([0] * 9 + [1] * 2 + [2])
    mass = random.uniform(1, 2, 12)
    centre = np.stack([np.average(x[piece == k], axis=0, weights=mass[piece == k]) for k in range(3)])
    v = V + spun(omega, x - centre[piece])
    found = tabulate_fragments(np.arange(3), piece, mass, np.ones(3), x, v)
    assert np.allclose(found.centre, centre)
    assert np.allclose(found.velocity, np.tile(V, (3, 1)))
    line = np.diff(x[9:11], axis=0)[0]
    across = omega - line * (omega @ line) / (line @ line) if dim == 3 else omega
    assert np.allclose(found.spin, [omega, across, 0 * omega], atol=1e-12)


def spun(omega: Values, r: Values) -> Values:
    if r.shape[1] == 2:
        return omega[0] * np.stack([-r[:, 1], r[:, 0]], axis=1)
    return np.cross(omega, r)


def test_cut_by_forces() -> None:
    """M22 fig. 12: sections in inverse proportion to the forces at their ends; equal or no forces: the middle."""
    force = np.array([[3.0, 0.0], [0.0, 1.0], [0.0, 0.0], [0.0, 0.0]])
    cut = cut_positions_from_forces(force, np.array([[0, 1], [1, 0], [0, 0], [2, 3]]))
    assert np.allclose(cut, [0.25, 0.75, 0.5, 0.5])
    assert np.all((cut >= 0.1) & (cut <= 0.9))
