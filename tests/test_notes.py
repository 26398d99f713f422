"""What `fracsim check` says of mesh files, of units, of stable steps, and of what overlaps at the start."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import gmsh
import meshio
import numpy as np
import pytest
from mpi4py import MPI

from cases import BAR, STRIP, changed, study
from fracsim.deformable_run import run_study
from fracsim.errors import InputError
from fracsim.scene import build_scene
from fracsim.study.check import build_checked_mesh, check_study
from fracsim.study.check_limits import LIMITS
from fracsim.study.check_report import unit_questions
from fracsim.study.material_library import MATERIALS
from fracsim.study.mesh_source import build_mesh
from fracsim.study.overlap_checks import containment_depth
from fracsim.study.reader import load_study, validate
from fracsim.study.step_checks import estimated_explicit_step

HELD = [{"on": {"point": [0.0, 0.0], "normal": [1.0, 0.0]}, "fix": "xy"}]


def said(data: dict[str, Any]) -> str:
    return "\n".join(check_study(validate(data, "test.toml")))


# --- loads and lengths that do not fit the run ---

LATE = {"time": [5.0, 6.0], "value": [[0.0, 0.0], [1.0, 0.0]]}
JUMP = {"time": [0.0, 1.0], "value": [[0.02, "free"], [0.1, "free"]]}


def pulled(motion: dict[str, Any], **tables: Any) -> dict[str, Any]:
    return changed(STRIP, boundary=[{"on": "left", "fix": "xy"}, {"on": "right"} | motion], **tables)


def test_a_table_after_the_end_of_the_run_is_told() -> None:
    """As it is if its times are in ms; one that begins within the run is not told."""
    words = "note: boundary.1.velocity: its table begins at t = 5 s, and the run ends at"
    assert words in said(pulled({"velocity": LATE}))
    assert words not in said(pulled({"velocity": LATE | {"time": [0.01, 6.0]}}))
    far = {"name": "o", "shape": "sphere", "radius": 0.1, "at": [50.0, 0.0], "displacement": LATE}
    assert "note: obstacle.0.displacement: its table begins at t = 5 s" in said(changed(STRIP, obstacle=[far]))


def test_a_displacement_that_jumps_at_the_start_is_told() -> None:
    """With inertia alone: quasi-static steps have no impact."""
    words = "note: boundary.1.displacement is 0.02 m at t = 0: its nodes jump there"
    assert words in said(pulled({"displacement": JUMP}))
    assert words in said(pulled({"displacement": [-0.02, 0.0]}))
    assert words not in said(pulled({"displacement": JUMP}, time={"scheme": "quasi-static"}))
    assert words not in said(pulled({"displacement": JUMP | {"value": [[0.0, 0.0], [0.1, 0.0]]}}))


def test_a_run_tells_what_check_tells(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    run_study(MPI.COMM_SELF, study(pulled({"displacement": JUMP})), tmp_path / "out")
    assert "fracsim: note: boundary.1.displacement is 0.02 m at t = 0" in capfd.readouterr().err


@pytest.mark.parametrize(
    ("radius", "words"),
    [(300.0, "question: radius is 300 m, the body is"), (1e-6, "h: the stress is not averaged"), (0.0, ""), (0.2, "")],
)
def test_a_radius_that_does_not_fit_body_or_cells_is_told(radius: float, words: str) -> None:
    text = said(changed(STRIP, fracture={"radius": radius}))
    assert words in text
    assert words or not re.search(r"radius is|not averaged", text)


# --- mesh files -----------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def of_gmsh(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A strip of 0.1 m x 0.02 m as gmsh fills it by itself, with cells of 1 mm."""
    path = tmp_path_factory.mktemp("mesh") / "strip.msh"
    gmsh.initialize(interruptible=False)
    try:
        gmsh.option.setNumber("General.Terminal", 0)
        gmsh.model.occ.addRectangle(0, 0, 0, 0.1, 0.02)
        gmsh.model.occ.synchronize()
        gmsh.model.addPhysicalGroup(2, [1], name="all")
        gmsh.option.setNumber("Mesh.MeshSizeMax", 0.001)
        gmsh.model.mesh.generate(2)
        gmsh.write(str(path))
    finally:
        gmsh.finalize()
    return path


def glass(mesh: dict[str, Any], **fracture: Any) -> dict[str, Any]:
    data = changed(STRIP, boundary=HELD, probe=[], output=None, material=None, fracture=None)
    return data | {"mesh": mesh, "material": {"like": "soda-lime glass"}, "fracture": fracture}


def mean_edge(path: Path) -> float:
    """By a set of pairs of nodes."""
    mesh = meshio.read(path)
    cells = mesh.cells_dict["triangle"]
    edges = {tuple(sorted((a, b))) for cell in cells for a, b in zip(cell, np.roll(cell, 1), strict=True)}
    return float(np.mean([np.linalg.norm(mesh.points[a] - mesh.points[b]) for a, b in edges]))


def test_notes_on_lengths_are_those_of_the_mesh_that_was_read(of_gmsh: Path) -> None:
    """Strength against energy, h against l_ch and 6 h, by the mean edge of the file: 1.0 mm."""
    h, glassy = mean_edge(of_gmsh), MATERIALS["soda-lime glass"]
    stiff = glassy.young / (1 - glassy.poisson**2)
    assert 0.9e-3 < h < 1.1e-3
    single = said(glass({"file": str(of_gmsh)}))
    assert f"a crack takes about f_t^2 h / 2 E' = {glassy.strength**2 * h / 2 / stiff:.2g} J/m^2" in single
    large = said(glass({"file": str(of_gmsh), "scale": 10.0}))
    assert "note: soda-lime glass takes 7.6 J/m^2: give fracture.energy = true" in large and "takes 7.6" not in single
    by_energy = said(glass({"file": str(of_gmsh)}, energy=True))
    assert f"l_ch = E' G_c / f_t^2 = 0.000276 m = {glassy.length / h:.3g} h" in by_energy
    assert f"note: that is less than h = {h:.3g} m" in by_energy
    narrow = said(glass({"file": str(of_gmsh), "scale": 1e-3}, energy=True))
    assert f"= {glassy.length / h * 1e3:.3g} h" in narrow and "tips need" not in narrow


def test_a_coarse_file_has_no_room_for_tips(tmp_path: Path) -> None:
    mesh = build_mesh(study(STRIP, mesh={"size": [0.4, 0.1], "h": 0.02}).mesh)
    meshio.Mesh(mesh.points, [("triangle", mesh.cells)]).write(tmp_path / "strip.vtu")
    h = mean_edge(tmp_path / "strip.vtu")
    found = said(glass({"file": str(tmp_path / "strip.vtu")}, energy=True))
    assert f"note: tips need 6 h on every side, the body is {0.1 / h:.3g} h across: h below 0.0083 m" in found


def test_preferred_directions_are_said(of_gmsh: Path) -> None:
    """gmsh's rows of equilateral triangles have 5 to 6, where random points have 1.1 to 1.4."""
    found = re.search(r"note: the mesh has ([0-9.]+) times as many edges", said(glass({"file": str(of_gmsh)})))
    assert found is not None and 4 < float(found.group(1)) < 8
    by_energy = said(glass({"file": str(of_gmsh)}, energy=True))
    assert "times as many edges" in by_energy and "note: the mesh has" not in by_energy
    loaded = [*HELD, {"on": "right", "traction": [1.0, 0.0]}]  # so that the mesh is built
    random = glass({"builder": "box", "size": [0.1, 0.02], "h": 0.002, "pattern": "unstructured"})
    assert "times as many edges" not in said(random | {"boundary": loaded})
    lattice = glass({"builder": "box", "size": [0.1, 0.02], "h": 0.002})
    assert "note: the mesh has 8.6 times as many edges" in said(lattice | {"boundary": loaded})


# --- units ----------------------------------------------------------------------------------------------------------

STEEL: dict[str, Any] = {"young": 2.1e11, "poisson": 0.3, "density": 7850.0, "energy": "linear"}
SI: dict[str, Any] = changed(BAR, fracture={"strength": 6e8, "energy": 2e4}, output={"picture": False}) | {
    "material": STEEL, "mesh": {"builder": "box", "size": [0.1, 0.02, 0.02], "h": 0.01}
}  # fmt: skip
SLIPS: dict[str, tuple[dict[str, Any], str]] = {
    "mesh in mm": ({"mesh": {"size": [100.0, 20.0, 20.0], "h": 10.0}}, "the body is 100 m long: is the mesh in mm?"),
    "E in MPa": ({"material": {"young": 2.1e5}}, "is it in MPa? Then it is 2.1e+11 Pa"),
    "E in GPa": ({"material": {"young": 210.0}}, "is it in GPa? Then it is 2.1e+11 Pa"),
    "E of PMMA in GPa": ({"material": {"young": 3.0, "density": 1190.0}}, "is it in GPa? Then it is 3e+09 Pa"),
    "g/cm^3": ({"material": {"density": 7.85}}, "is it in g/cm^3? Then it is 7850 kg/m^3"),
    "gold in g/cm^3": ({"material": {"density": 19.3}}, "is it in g/cm^3? Then it is 1.93e+04 kg/m^3"),
    "t/mm^3": ({"material": {"density": 7.85e-9}}, "is it in t/mm^3? Then it is 7850 kg/m^3"),
    "too dense": ({"material": {"density": 7.85e6}}, "is more than that of any metal"),
    "too stiff": ({"material": {"young": 2.1e14}}, "faster than in diamond"),
    "strength in MPa": ({"fracture": {"strength": 600.0}}, "strength = 600 Pa is 3e-09 of young: is it in MPa?"),
    "G_c in J/mm^2": ({"fracture": {"energy": 2e-5}}, "l_ch is shorter than an atom is wide"),
    "gravity in mm/s^2": ({"load": {"gravity": [0.0, 0.0, -9810.0]}}, "is it in mm/s^2?"),
    "a region in MPa": ({"material": {"rim": {"young": 2.1e5}}}, "question: material.rim.young = 210000 Pa"),
}  # fmt: skip


def asked(data: dict[str, Any], side: float = 0.1) -> list[str]:
    return [line for line in unit_questions(validate(data, "test.toml"), side) if line.startswith("question")]


@pytest.mark.parametrize("slip", SLIPS)
def test_a_figure_of_another_unit_is_asked_about(slip: str) -> None:
    """That figure alone."""
    tables, question = SLIPS[slip]
    data = changed(SI, **tables)
    side = max(data["mesh"]["size"])
    assert question in "\n".join(unit_questions(validate(data, "test.toml"), side)) and len(asked(data, side)) == 1


def test_questions_are_part_of_check() -> None:
    assert "question:" not in said(SI)
    assert "question: material.young = 210000 Pa" in said(changed(SI, material={"young": 2.1e5}))
    rigid = {"time": {"scheme": "rigid", "step": 1e-3, "end": 1e-2}, "boundary": [], "probe": [], "fracture": None}
    assert "question: the body is 100 m long" in said(
        changed(SI, mesh={"size": [100.0, 20.0, 20.0], "h": 10.0}, **rigid) | {"boundary": [], "probe": []}
    )


def test_all_that_is_in_mm_tonnes_and_megapascals_is_asked_about() -> None:
    """A study of Abaqus' habits: side, density and Young's modulus."""
    habits = changed(SI, material={"young": 2.1e5, "density": 7.85e-9}, fracture={"strength": 600.0, "energy": 20.0})
    found = "\n".join(unit_questions(validate(habits, "test.toml"), 100.0))
    for part in ("is the mesh in mm?", "is it in t/mm^3?", "is it in MPa? Then it is 2.1e+11 Pa"):
        assert part in found


@pytest.mark.parametrize("name", MATERIALS)
def test_no_material_that_there_is_is_asked_about(name: str) -> None:
    """In pieces from 0.1 mm to 10 m."""
    data = changed(SI, fracture=None, material=None) | {"material": {"like": name}}
    data["fracture"] = {"energy": True} if MATERIALS[name].energy is not None else {}
    assert [asked(data, side) for side in (1e-4, 0.1, 10.0)] == [[], [], []]


def test_no_packaged_study_is_asked_about() -> None:
    for path in (Path(__file__).parent.parent / "studies").glob("*.toml"):
        assert list(unit_questions(load_study(path), 1.0)) == [], path.name


def test_a_mesh_of_tens_of_millions_of_cells_is_asked_about() -> None:
    """A step of h that has slipped by a digit: the check says what it costs and which h is a million cells."""
    loaf = load_study("loaf", ["mesh.h=0.0008"])
    (line,) = [line for line in check_study(loaf) if "are so many" in line]
    cells, gigabytes = (float(number.replace(",", "")) for number in re.findall(r"([\d,]+) (?:cells|GB)", line))
    assert cells > 4e7 and gigabytes == pytest.approx(2.5e-6 * cells, abs=1)
    assert not any("are so many" in line for line in check_study(load_study("loaf", ["mesh.h=0.0028"])))


def test_large_strains_of_glass_are_not_worth_their_price() -> None:
    """In quasi-static steps; bread stretches, and with inertia pieces turn."""
    slow = {"scheme": "quasi-static", "step": 0.5, "end": 1.0}
    strip = {"builder": "box", "size": [0.1, 0.02], "h": 0.002}
    for like, energy, time, told in (
        ("soda-lime glass", "neo-hookean", slow, True), ("soda-lime glass", "stvk", slow, True),
        ("soda-lime glass", "linear", slow, False), ("soda-lime glass", "neo-hookean", STRIP["time"], False),
        ("bread", "neo-hookean", slow, False),
    ):  # fmt: skip
        data = glass(strip) | {"material": {"like": like, "energy": energy}, "time": time}
        found = said(data | {"boundary": [{"on": "left", "fix": "xy"}]})
        assert ("gives the same loads in less time" in found) == told
        assert not told or "strains stay below strength / young = 0.064 %" in found


# --- explicit steps -------------------------------------------------------------------------------------------------

QUICK = {"scheme": "explicit", "step": 5e-2, "end": 30.0}


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("base", [BAR, STRIP])
def test_the_step_that_check_tells_is_the_one_that_is_taken(base: dict[str, Any], order: int) -> None:
    """Of the mesh as it is, and roughly of one that is not built; with damping, and of a part that is stiffer."""
    random = {"pattern": "unstructured", "h": 0.06, "order": order}
    tables = {key: value for key, value in base.items() if key != "fracture"}
    time, output = {**QUICK, "step": 30.0}, {"fields": []}
    of = validate(changed(tables, mesh=random, damping={"stiffness": 1e-4}, time=time, output=output), "test.toml")
    scene = build_scene(MPI.COMM_SELF, of)
    _, report = scene.stepper.advance(scene.start())
    mesh = build_mesh(of.mesh)
    told = estimated_explicit_step(of, mesh.dim, 0.06, mesh)
    assert report.dt == pytest.approx(told, rel=1e-3)
    assert estimated_explicit_step(of, mesh.dim, 0.06, None) == pytest.approx(told, rel=0.35)


def test_quadratic_cells_have_the_bound_of_the_stepper() -> None:
    from fracsim.timestepping.stable_time_step import quadratic_gain

    assert {dim: quadratic_gain(dim) for dim in (2, 3)} == pytest.approx(LIMITS.quadratic_frequency_factor, rel=1e-3)


def test_check_counts_the_steps_that_are_stable() -> None:
    """600 steps of 50 ms are asked for; a wave of 36.7 m/s passes a cell of 62.5 mm in 1.7 ms. And of 62.5 um."""
    data = changed(BAR, mesh={"h": 0.0625}, time=QUICK)
    found = re.search(r"time        explicit, some ([0-9,]+) steps of ([0-9.e-]+) s", said(data))
    assert found is not None
    count, step = int(found.group(1).replace(",", "")), float(found.group(2))
    assert 0.4e-3 < step < 1.7e-3 and count == pytest.approx(30.0 / step, rel=0.05)
    assert "more than a million steps" not in said(data)
    assert "note: that is more than a million steps" in said(changed(data, mesh={"size": [1e-3] * 3, "h": 6.25e-5}))
    assert "time        explicit, 300000 steps of 0.0001 s, which are stable (up to" in said(
        changed(data, time={"step": 1e-4})
    )


# --- what overlaps at the start -------------------------------------------------------------------------------------

SCHEMES = [{}, {"scheme": "explicit", "step": 1e-4}]


def ball(at: list[float], **more: Any) -> dict[str, Any]:
    return {"name": "ball", "shape": "sphere", "radius": 0.05, "at": at} | more


OVERLAPS: dict[str, tuple[dict[str, Any], list[dict[str, Any]], str]] = {
    "a node in a ball": (BAR, [ball([0.5, 0.0, 0.28])], "obstacle.0: ball overlaps the body at the start, by 0.02 m"),
    "a ball inside": (BAR, [ball([0.5, 0.125, 0.125], radius=0.1)], "obstacle.0: ball lies in the body at the start"),
    "a small one": (BAR, [ball([0.33, 0.111, 0.07], radius=1e-3)], "obstacle.0: ball lies in the body at the start"),
    "one that moves": (
        BAR, [ball([0.5, 0.125, 0.125], velocity=[0.0, 0.0, 1.0])], "obstacle.0: ball lies in the body",
    ),
    "a free one": (BAR, [ball([0.5, 0.125, 0.125], mass=1.0)], "obstacle.0: ball lies in the body at the start"),
    "a disk inside": (STRIP, [ball([0.56, 0.06], radius=0.02)], "obstacle.0: ball lies in the body at the start"),
    "a box through a side": (
        BAR, [{"name": "rod", "shape": "box", "size": [0.02, 0.02, 0.3], "at": [0.6, 0.1, 0.3]}],
        "obstacle.0: rod lies in the body at the start",
    ),
    "a plane": (BAR, [{"name": "floor", "shape": "plane", "normal": [0, 0, 1], "at": [0, 0, 0.1]}], "floor overlaps"),
    "displaced at t = 0": (
        BAR, [ball([0.5, 0.0, 9.0], displacement={"time": [0.0, 1.0], "value": [[0, 0, -8.72], [0, 0, 0]]})],
        "obstacle.0: ball overlaps the body at the start, by 0.02 m",
    ),
    "a free one in another": (
        BAR, [ball([0.5, 0.1, 1.0], mass=1.0), ball([0.5, 0.1, 1.05], name="other")], "moves freely and overlaps other"
    ),
    "no direction": (BAR, [{"name": "floor", "shape": "plane", "normal": [0, 0, 0], "at": [0, 0, -1]}], "obstacle.0"),
}  # fmt: skip


@pytest.mark.parametrize("time", SCHEMES, ids=["implicit", "explicit"])
@pytest.mark.parametrize("name", OVERLAPS)
def test_what_overlaps_at_the_start_is_refused_by_check_and_by_the_run(name: str, time: dict[str, Any]) -> None:
    base, entries, message = OVERLAPS[name]
    data = changed(base, obstacle=entries, time=time)
    if time and "fracture" in data:
        data["time"]["end"] = 0.01
    for work in (check_study, build_checked_mesh):
        with pytest.raises(InputError, match=re.escape(message)):
            work(validate(data, "test.toml"))


def test_what_only_touches_is_let_be() -> None:
    """A box that lies on a side, a ball next to it, a bowl around all of it; nothing of it is looked at from afar."""
    resting = {"name": "load", "shape": "box", "size": [0.1, 0.1, 0.1], "at": [0.6, 0.12, 0.3 + 1e-9]}
    bowl = {"name": "bowl", "shape": "sphere", "radius": 0.6, "at": [0.5, 0.125, 0.125], "hollow": True}
    for entry in (resting, bowl, ball([0.5, 0.125, 0.31])):
        data = validate(changed(BAR, obstacle=[entry]), "test.toml")
        check_study(data)
        build_scene(MPI.COMM_SELF, data).destroy()


def test_solids_that_overlap_are_refused_by_check(tmp_path: Path) -> None:
    """A block read from a file: in the body, around it, through it, and beside it."""
    block = build_mesh(study(BAR, mesh={"size": [0.1] * 3, "h": 0.1}).mesh)
    from fracsim.meshes.topology import boundary_facets

    meshio.Mesh(block.points, [("triangle", boundary_facets(block.cells))]).write(tmp_path / "block.stl")

    def with_block(at: list[float], scale: float = 1.0) -> dict[str, Any]:
        entry = {"name": "block", "shape": "mesh", "file": str(tmp_path / "block.stl"), "at": at, "scale": scale}
        return changed(BAR, obstacle=[entry])

    for data, how in (
        (with_block([0.4, 0.06, 0.07]), "overlaps"), (with_block([-5.0, -5.0, -5.0], 100.0), "overlaps"),
        (with_block([0.4, 0.06, 0.2]), "overlaps"),
    ):  # fmt: skip
        with pytest.raises(InputError, match=f"obstacle.0: block {how} the body at the start, by"):
            check_study(validate(data, "test.toml"))
    check_study(validate(with_block([0.4, 0.06, 0.26]), "test.toml"))


def test_rigid_bodies_in_an_obstacle_are_refused_by_check() -> None:
    rigid = changed(BAR, time={"scheme": "rigid"}, boundary=[], probe=[])
    below = {"position": [0.0, 0.0, -0.2], "copies": [1, 1, 2], "spacing": [0.0, 0.0, 5.0]}
    floor = {"name": "floor", "shape": "plane", "normal": [0, 0, 1], "at": [0, 0, 0]}
    for bodies in ([below], [{"rotation": [-0.3, 0.0, 0.0]}, {"position": [0, 0, 9.0]}]):
        with pytest.raises(InputError, match=r"body \d around .* lies in obstacle floor at the start, by"):
            check_study(validate(changed(rigid, body=bodies, obstacle=[floor]), "test.toml"))
    check_study(validate(changed(rigid, body=[{"position": [0, 0, 0.01]}], obstacle=[floor]), "test.toml"))


def test_points_of_a_mesh_lie_in_it() -> None:
    """Random mixtures of corners, with the least weight as coordinate; points outside have none."""
    random = np.random.default_rng(3)
    for base in (BAR, STRIP):
        mesh = build_mesh(study(base, mesh={"pattern": "unstructured", "h": 0.1}).mesh)
        weights = random.dirichlet(np.ones(mesh.dim + 1), 300)
        x = np.einsum("nk,nkd->nd", weights, mesh.points[mesh.cells[random.integers(len(mesh.cells), size=300)]])
        np.testing.assert_allclose(containment_depth(x, mesh), weights.min(axis=1), atol=1e-9)
        assert (containment_depth(x + 2.0, mesh) == -1.0).all()


@pytest.mark.parametrize("copies", [[1000, 1000, 100], [100, 100, 20]])
def test_more_copies_than_can_be_held_are_refused(copies: list[int]) -> None:
    """Cells times copies, and bodies; 1e8 copies took all memory before anything was said."""
    body = [{"position": [0.0, 0.0, 0.1], "copies": copies, "spacing": [2.0, 1.0, 1.0]}]
    data = changed(BAR, time={"scheme": "rigid"}, boundary=[], probe=[], body=body)
    with pytest.raises(InputError, match=r"body.N.copies: .* copies of a mesh of about 24 cells are"):
        check_study(validate(data, "test.toml"))
