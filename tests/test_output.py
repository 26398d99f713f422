"""The output folder: every file is complete, agrees with the others, and opens in the programs it is meant for."""

from __future__ import annotations

import csv
import json
import signal
import subprocess
import sys
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import h5py
import meshio
import numpy as np
import numpy.typing as npt
import pytest
from mpi4py import MPI

import xdmf_reader
from cases import BAR, STRIP, command, study, write_study
from fracsim.deformable_run import Run
from fracsim.output.surface.vtk_files import write_vtu
from fracsim.report.pictures.colour_maps import select_array
from fracsim.report.pictures.frames import FrameSource, find_frames, load_grid
from fracsim.scene import build_scene
from fracsim.study import Study
from fracsim.study.reader import load_study
from support import vtu
from support.strained import strained, stress

Values = npt.NDArray[Any]
COLUMNS = [
    "step", "time", "dt", "kinetic", "elastic", "dissipated", "external_work", "broken_edges", "split_cells", "pieces",
    "newton_its", "krylov_its", "wall_step",
]  # fmt: skip
VTK_TENSOR = (0, 3, 5, 3, 1, 4, 5, 4, 2)  # 3 x 3 of the six components in VTK's order: xx yy zz xy yz xz


@dataclass
class Output:
    """A finished run."""

    study: Study
    folder: Path
    summary: dict[str, Any]


@pytest.fixture(scope="module", params=["bar", "strip"])
def output(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Output:
    """3D without fracture, and 2D with it."""
    fields = {"fields": ["von_mises", "velocity", "stress", "region"]}
    made = study(BAR, output=fields) if request.param == "bar" else study(STRIP)
    folder = tmp_path_factory.mktemp(request.param) / "out"
    return Output(made, folder, Run(build_scene(MPI.COMM_SELF, made), folder)())


def history(folder: Path) -> dict[str, Values]:
    with (folder / "history.csv").open(newline="") as file:
        rows = list(csv.reader(file))
    return dict(zip(rows[0], np.array(rows[1:], float).T, strict=True))


# --- files ----------------------------------------------------------------------------------------------------------


def test_the_files_are_there_and_no_others(output: Output) -> None:
    names = {path.name for path in output.folder.iterdir()}
    surface = {"surface.pvd", "surface", "pieces.csv"} if output.study.fracture is not None else set()
    assert names == {"study.toml", "history.csv", "fields.xdmf", "fields.h5", "summary.json"} | surface


def test_the_study_as_run(output: Output) -> None:
    again = load_study(output.folder / "study.toml")
    assert again.model_copy(update={"mesh": output.study.mesh}) == output.study
    comments = [line for line in (output.folder / "study.toml").read_text().splitlines() if line.startswith("# ")]
    assert [line.split(":")[0] for line in comments] == ["# fracsim", "# dolfinx", "# petsc", "# python", "# ranks"]
    assert comments[-1] == "# ranks: 1"


def test_history_has_its_columns_and_a_row_a_step(output: Output) -> None:
    axes = "xyz" if "bar" in output.study.title else "xy"
    names = ["reaction_grip", *(["probe_tip"] if "strip" in output.study.title else []), "motion_grip"]
    probes = [f"{name}_{axis}" for name in names for axis in axes]
    rows = history(output.folder)
    assert list(rows) == COLUMNS + probes
    assert np.array_equal(rows["step"], np.arange(1, output.summary["steps"] + 1))
    assert np.allclose(rows["time"], np.cumsum(rows["dt"]))
    assert rows["time"][-1] == pytest.approx(output.study.time.end)
    assert all(np.isfinite(column).all() for column in rows.values())


def test_the_probe_at_a_prescribed_point_moves_as_prescribed(output: Output) -> None:
    rows = history(output.folder)
    if "probe_tip_x" not in rows:
        return  # this study has none
    assert np.allclose(rows["probe_tip_x"], 1.0 * rows["time"], rtol=1e-6)
    assert np.allclose(rows["probe_tip_y"], 0.0, atol=1e-12)


def test_the_summary_is_complete(output: Output) -> None:
    summary = json.loads((output.folder / "summary.json").read_text())
    assert summary == output.summary
    rows = history(output.folder)
    assert summary["outcome"] == "done" and summary["title"] == output.study.title
    assert summary["time"] == pytest.approx(output.study.time.end)
    for key, column in (("broken_edges", "broken_edges"), ("split_cells", "split_cells"), ("pieces", "pieces")):
        assert summary[key] == rows[column][-1]
    assert summary["external_work"] == pytest.approx(rows["external_work"][-1])
    assert summary["peak_reactions"]["reaction_grip_x"] == pytest.approx(np.abs(rows["reaction_grip_x"]).max())
    assert set(summary["seconds"]) >= {"setup", "solve", "fracture", "energies", "output"}
    assert summary["ranks"] == 1 and summary["peak_memory_MiB"] > 10 and summary["wall"] > 0
    assert summary["cpu"] > 0  # threads may make it more than the wall time
    assert (summary["nodes"], summary["cells"]) == ((20, 24) if "bar" in output.study.title else (27, 32))


def test_meshio_reads_the_fields(output: Output) -> None:
    """A reader that shares no code with ours: cells, positions and displacements of all frames."""
    with (
        h5py.File(output.folder / "fields.h5") as file,
        meshio.xdmf.TimeSeriesReader(output.folder / "fields.xdmf") as series,
    ):
        points, cells = series.read_points_cells()
        frames = sorted(file["frames"])
        assert series.num_steps == len(frames) > 1
        assert np.array_equal(points, file["points"]) and np.array_equal(cells[0].data, file["cells"])
        for k, name in enumerate(frames):
            _, point_data, _ = series.read_data(k)
            assert np.array_equal(point_data["displacement"], file["frames"][name]["displacement"])


def test_the_strip_tears(output: Output) -> None:
    """So that the fields are of a body with damage: broken edges, split cells and pieces agree with them."""
    with h5py.File(output.folder / "fields.h5") as file:
        last = file["frames"][max(file["frames"])]
        if "damage" not in last:
            assert output.summary["broken_edges"] == output.summary["split_cells"] == 0
            return
        assert output.summary["broken_edges"] > 0
        assert len(np.unique(last["piece"])) == output.summary["pieces"]
        assert np.count_nonzero(last["chi"][()] < 1) == output.summary["split_cells"]
        assert np.all((last["damage"][()] > 0) == (last["chi"][()] < 1))


# --- fields ---------------------------------------------------------------------------------------------------------


def frames_by_hand(folder: Path) -> list[tuple[float, dict[tuple[str, str], Values]]]:
    """(time, (centre, name) -> values) from the XML and what it points at in the HDF5 file."""
    collections = ElementTree.parse(folder / "fields.xdmf").getroot().findall("Domain/Grid")
    assert len(collections) == 1 and collections[0].get("CollectionType") == "Temporal"
    with h5py.File(folder / "fields.h5") as file:
        return [_frame(grid, file) for grid in collections[0].findall("Grid")]


def _frame(grid: ElementTree.Element, file: h5py.File) -> tuple[float, dict[tuple[str, str], Values]]:
    assert grid.get("GridType") == "Uniform"
    found = {("Mesh", part): _item(grid.find(f"{part}/DataItem"), file) for part in ("Topology", "Geometry")}
    for each in grid.findall("Attribute"):
        found[str(each.get("Center")), str(each.get("Name"))] = _item(each.find("DataItem"), file)
    return float(grid.find("Time").get("Value")), found  # type: ignore[union-attr, arg-type]


def _item(element: ElementTree.Element | None, file: h5py.File) -> Values:
    assert element is not None and element.text is not None and element.get("Format") == "HDF"
    name, _, path = element.text.partition(":")
    assert name == Path(file.filename).name
    data = file[path]
    shape = (len(data), 1, 6) if data.shape[1:] == (6,) else data.shape  # a tensor is a matrix of one row
    assert element.get("Dimensions") == " ".join(map(str, shape))
    assert (element.get("NumberType"), element.get("Precision")) == (
        "Int" if data.dtype.kind == "i" else "Float", str(data.dtype.itemsize),
    )  # fmt: skip
    values: Values = data[()]
    return values


def test_one_grid_a_time_carries_all_fields(output: Output) -> None:
    frames = frames_by_hand(output.folder)
    wanted = {"displacement", *(output.study.output.fields or [])}
    for _, fields in frames:
        assert {name for centre, name in fields if centre != "Mesh"} == wanted
    rows = history(output.folder)
    assert np.allclose([t for t, _ in frames], [0.0, *rows["time"]], rtol=1e-9, atol=0)
    centres = {name: centre for centre, name in frames[-1][1]}
    assert centres["displacement"] == centres["velocity"] == "Node" and centres["stress"] == "Cell"


def test_fields_agree_with_each_other(output: Output) -> None:
    """von Mises from the stress components; displacement of the gripped end from the study."""
    t, fields = frames_by_hand(output.folder)[-1]
    s = fields["Cell", "stress"][:, VTK_TENSOR].reshape(-1, 3, 3)
    deviator = s - np.trace(s, axis1=1, axis2=2)[:, None, None] * np.eye(3) / 3
    mises = np.sqrt(1.5 * np.einsum("cij,cij->c", deviator, deviator))
    assert np.allclose(mises, fields["Cell", "von_mises"], rtol=1e-6, atol=1e-6 * mises.max())
    right = fields["Mesh", "Geometry"][:, 0] == 1.0
    speed = 0.1 if "bar" in output.study.title else 1.0
    assert np.allclose(fields["Node", "displacement"][right], [speed * t, 0, 0], atol=1e-9 * speed)
    assert np.allclose(fields["Node", "velocity"][right], [speed, 0, 0], rtol=1e-6, atol=1e-6 * speed)
    assert np.isfinite(np.concatenate([values.ravel() for values in fields.values()])).all()


def test_crushed_cells_have_no_stress(tmp_path: Path) -> None:
    """A body in one point: what is no number there, or infinite, is written as 0."""
    data = study(BAR, material={"energy": "neo-hookean"}, output={"fields": ["stress", "von_mises", "energy_density"]})
    scene = build_scene(MPI.COMM_SELF, data)
    run = Run(scene, tmp_path / "out")
    run.state = replace(run.state, u=-scene.domain.nodes.ravel())
    scene.balance.set_displacement(run.state.u)
    with np.errstate(all="ignore"):
        run.write_frame()
    run.history.close()
    ((_, fields),) = frames_by_hand(tmp_path / "out")
    for name in ("stress", "von_mises", "energy_density"):
        assert np.abs(fields["Cell", name]).max() < 1e12, name


def read_by_vtk(folder: Path, target: Path) -> dict[str, Values]:
    """What VTK's reader makes of fields.xdmf."""
    arguments = [sys.executable, xdmf_reader.__file__, str(folder / "fields.xdmf"), str(target)]
    result = subprocess.run(arguments, capture_output=True, text=True, timeout=60, check=False)
    if result.returncode == xdmf_reader.NO_READER:
        pytest.fail("Debian's VTK has no XDMF reader: run `make readers` first, as `make test` does")
    assert (result.returncode, result.stderr) == (0, "")
    with np.load(target) as read:
        return dict(read)


def test_stress_has_the_order_that_vtk_takes(tmp_path: Path) -> None:
    """Principal stresses by VTK's own filter, of six unlike components, from both files; other orders have others."""
    folder = tmp_path / "out"
    strained(folder)
    wanted = np.linalg.eigvalsh(stress())
    cells = read_by_vtk(folder, tmp_path / "read.npz")["0/principal/stress"]
    np.testing.assert_allclose(cells, np.broadcast_to(wanted, cells.shape), rtol=1e-6)  # VTK has them in single
    grid = vtu.grid(folder / "surface" / "surface_000000.vtu")
    elements = xdmf_reader.principal_values(grid, "stress")
    np.testing.assert_allclose(elements, np.broadcast_to(wanted, elements.shape), rtol=1e-6)


def make_earlier(folder: Path) -> None:
    """Give tensors the order that files had before: xx xy xz yy yz zz."""
    from vtkmodules.util.numpy_support import numpy_to_vtk, vtk_to_numpy

    order = [0, 3, 5, 1, 4, 2]
    with h5py.File(folder / "fields.h5", "r+") as file:
        for frame in file["frames"].values():
            frame["stress"][...] = frame["stress"][()][:, order]
            del frame["stress"].attrs["components"]
    for path in (folder / "surface").glob("*.vtu"):
        grid = vtu.grid(path)
        values = vtk_to_numpy(grid.GetCellData().GetArray("stress"))[:, order]
        array = numpy_to_vtk(np.ascontiguousarray(values), deep=True)
        array.SetName("stress")
        for column, name in enumerate(("xx", "xy", "xz", "yy", "yz", "zz")):
            array.SetComponentName(column, name)
        grid.GetCellData().AddArray(array)
        write_vtu(path, grid)


def stresses(folder: Path) -> tuple[list[Values], list[Values]]:
    """Of every frame: of the cells in fields.h5, and of the elements of the surface with the names of the columns."""
    from vtkmodules.util.numpy_support import vtk_to_numpy

    with h5py.File(folder / "fields.h5") as file:
        cells = [file["frames"][name]["stress"][()] for name in sorted(file["frames"])]
    arrays = [vtu.grid(path).GetCellData().GetArray("stress") for path in sorted((folder / "surface").glob("*.vtu"))]
    assert all(
        [array.GetComponentName(k) for k in range(6)] == ["XX", "YY", "ZZ", "XY", "YZ", "XZ"] for array in arrays
    )
    return cells, [vtk_to_numpy(array).copy() for array in arrays]


def test_a_restart_does_not_mix_orders_of_tensors(tmp_path: Path) -> None:
    """Files of an earlier version are put in today's order, all of them; pictures of such files are right as well."""
    data = study(BAR, output={"fields": ["stress"], "surface": True}, time={"end": 0.04})
    whole, parts = tmp_path / "whole", tmp_path / "parts"
    Run(build_scene(MPI.COMM_SELF, data), whole)()
    run = Run(build_scene(MPI.COMM_SELF, data), parts)
    run.write_frame()
    for _ in range(2):
        run.step()
        run.write_frame()
    run.checkpoint()
    run.history.close()
    make_earlier(parts)
    of_surface, of_mesh = load_grid(find_frames(parts)[2]), load_grid(FrameSource(0.0, parts / "fields.h5", 2))
    cells, elements = stresses(whole)
    scale = np.abs(cells[-1]).max()
    for grid, wanted in ((of_mesh, cells[2]), (of_surface, elements[2])):
        shown = grid.cell_data[select_array(grid, "stress:yy")]
        np.testing.assert_allclose(shown, wanted[:, 1], atol=1e-6 * scale)
    Run(build_scene(MPI.COMM_SELF, data), parts, restart=True)()
    for found, reference in zip(stresses(parts), (cells, elements), strict=True):
        np.testing.assert_allclose(found, reference, atol=1e-6 * scale)  # all five frames


def test_vtk_reads_the_same(output: Output, tmp_path: Path) -> None:
    read = read_by_vtk(output.folder, tmp_path / "read.npz")
    frames = frames_by_hand(output.folder)
    assert np.allclose(read["times"], [t for t, _ in frames])
    for index, (_, fields) in enumerate(frames):
        for (centre, name), values in fields.items():
            if centre == "Mesh":
                continue
            assert np.array_equal(read[f"{index}/{centre}/{name}"], values), name
        points = fields["Mesh", "Geometry"]
        assert np.array_equal(read[f"{index}/points"], points)
        assert read[f"{index}/cells"] == len(fields["Mesh", "Topology"])
        warped = points + fields["Node", "displacement"]
        assert np.allclose(read[f"{index}/warped"], warped, rtol=1e-6, atol=1e-7)  # VTK warps in single precision


def test_frames_come_at_intervals(tmp_path: Path) -> None:
    data = {**BAR, "output": {"interval": 0.02, "picture": False, "fields": []}, "time": {"step": 0.01, "end": 0.05}}
    Run(build_scene(MPI.COMM_SELF, study(data)), tmp_path / "out")()
    assert np.allclose([t for t, _ in frames_by_hand(tmp_path / "out")], [0, 0.02, 0.04, 0.05])


def test_a_killed_run_leaves_whole_files(tmp_path: Path) -> None:
    bar = write_study(tmp_path / "bar.toml", BAR, time={"step": 1e-4, "end": 10.0}, output={"fields": ["stress"]})
    process = subprocess.Popen(command("run", bar, "-o", tmp_path / "out"), stdout=subprocess.DEVNULL)
    xdmf = tmp_path / "out" / "fields.xdmf"
    until = time.monotonic() + 40
    while time.monotonic() < until and (not xdmf.exists() or xdmf.stat().st_size < 20_000):
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    process.wait(timeout=20)
    frames = frames_by_hand(tmp_path / "out")
    assert len(frames) > 5
    assert len(history(tmp_path / "out")["step"]) >= len(frames) - 1


# --- pictures -------------------------------------------------------------------------------------------------------


def test_the_picture_shows_something(output: Output, tmp_path: Path) -> None:
    from matplotlib.image import imread

    from fracsim.report.pictures.picture import render

    pixels = imread(render(output.folder, tmp_path / "shot.png"))[..., :3]
    assert pixels.shape == (900, 1400, 3)
    body = np.abs(pixels - pixels[0, 0]).max(axis=2) > 0.05
    assert 0.03 < body.mean() < 0.9
    assert len(np.unique((pixels[body] * 255).astype(int), axis=0)) > 20


def test_the_colour_of_a_piece_depends_on_its_number_alone() -> None:
    """Not on which other pieces there are, so that it stays from frame to frame; the palette of 20 starts again."""
    from fracsim.report.pictures.colour_maps import map_colours

    ten, zero, twenty = map_colours(np.array([10.0, 0.0, 20.0]), None, "#000000").tolist()
    assert zero == twenty != ten == map_colours(np.array([10.0]), None, "#000000")[0].tolist()
