"""Bad input is refused with one message: the key, the value, what is allowed. Nothing is written."""

from __future__ import annotations

import json
import subprocess
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mpi4py import MPI

from cases import BAR, STRIP, changed, command, fracsim, study, write_study
from fracsim.cli import check_folder
from fracsim.errors import InputError
from fracsim.study.check import check_study
from fracsim.study.reader import load_study, validate
from support.ranks import Arrays, run_on_ranks

Data = dict[str, Any]
LEFT: Data = {"on": "left", "fix": "xyz"}


def right(**condition: Any) -> Data:
    """BAR with another condition on its right end."""
    return changed(BAR, boundary=[LEFT, {"on": "right", **condition}])


def moving(time: list[float], value: list[Any], **more: Any) -> Data:
    return right(velocity={"time": time, "value": value, **more})


def held_at(on: Any) -> Data:
    return changed(BAR, boundary=[{"on": on, "fix": "xyz"}])


def probing(**probe: Any) -> Data:
    return changed(BAR, probe=[{"name": "a", **probe}])


def without(name: str, key: str | None = None, base: Data = BAR) -> Data:
    data = changed(base)
    del (data[name] if key else data)[key or name]
    return data


def flowing(base: Data = BAR, **plasticity: Any) -> Data:
    """A study with [plasticity] and an energy that allows it."""
    return changed(base, material={"energy": "stvk"}, plasticity={"yield_stress": 1e3, **plasticity})


def held_2d(**tables: Any) -> Data:
    return changed(STRIP, **tables)


REFUSED: list[tuple[Data, str]] = [
    # unknown keys at every level, the nearest known one named
    (changed(BAR, tittle="x"), "tittle is not a known key; did you mean title?"),
    (changed(BAR, zzz=1), "zzz is not a known key; known here: body, boundary, brittle, contact, crack, damping,"),
    (changed(BAR, mesh={"sise": [1, 1, 1]}), "mesh.sise is not a known key; did you mean size?"),
    (probing(place="left"), "probe.0.place is not a known key; known here: "),
    (changed(BAR, damping={"masss": 1}), "did you mean mass? Known here: mass, stiffness"),
    (changed(BAR, material={"yung": 1.0}), "material.yung is not a known key; did you mean young?"),
    (changed(BAR, material={"crust": {"yung": 1.0}}), "material.crust.yung is not a known key; did you mean young?"),
    (changed(STRIP, fracture={"strengh": 1.0}), "fracture.strengh is not a known key; did you mean strength?"),
    (right(fixx="x"), "boundary.1.fixx is not a known key; did you mean fix?"),
    (held_at({"bxo": [[0, 0, 0], [1, 1, 1]]}), "boundary.0.on.bxo is not a known key; did you mean box?"),
    (moving([0, 1], [[0, 0, 0]] * 2, values=[]), "boundary.1.velocity.values is not a known key; did you mean value?"),
    (probing(onn="left"), "probe.0.onn is not a known key; did you mean on?"),
    (changed(BAR, load={"graviti": [0, 0, 1]}), "load.graviti is not a known key; did you mean gravity?"),
    (changed(BAR, damping={"masss": 1}), "damping.masss is not a known key; did you mean mass?"),
    (changed(BAR, initial={"spinn": [1]}), "initial.spinn is not a known key; did you mean spin?"),
    (changed(BAR, time={"sheme": "newmark"}), "time.sheme is not a known key; did you mean scheme?"),
    (changed(BAR, output={"evry": 1}), "output.evry is not a known key; did you mean every?"),
    # an unknown key is named before the missing one that it stands for
    (
        changed(without("material", "young"), material={"yung": 1.0}),
        "material.yung is not a known key; did you mean young?",
    ),
    # missing
    (without("title"), "title is missing; every study needs it"),
    (without("mesh"), "mesh is missing; every study needs it"),
    (without("material"), "material is missing; every study needs it"),
    (without("time"), "time is missing; every study needs it"),
    (
        without("material", "density"),
        "material.density is missing; the table [material] needs it. Example: density = 300.0. Meaning: Mass density",
    ),
    (changed(BAR, time={}) | {"time": {}}, "time.step and time.end are missing; the study needs them"),
    (without("fracture", "strength", STRIP), "fracture.strength is missing; the table [fracture] needs it"),
    (right(), "boundary.1: give exactly one of fix, displacement, velocity, traction, force, pressure; found none"),
    (right(fix="x", pressure=1.0), "found fix and pressure"),
    (
        changed(BAR, mesh=None) | {"mesh": {}},
        "mesh: give exactly one of builder, file, surface, outline, shell; found none of them",
    ),
    (changed(BAR, mesh={"file": "a.msh"}), "found builder and file"),
    (held_at({"point": [0, 0, 0]}), "boundary.0.on.normal is missing"),
    # wrong types; a text is not a number, and a number not a truth value
    (changed(BAR, title=3), "title = 3: must be a text in quotes"),
    (changed(BAR, material={"young": "1e6"}), 'material.young = "1e6": must be a number'),
    (changed(BAR, material={"young": True}), "material.young = true: must be a number"),
    (changed(BAR, mesh={"h": "0.1"}), 'mesh.h = "0.1": must be a number'),
    (changed(BAR, mesh={"size": 3}), "mesh.size = 3: must be a list"),
    (changed(BAR, mesh={"size": ["a", 1, 1]}), 'mesh.size.0 = "a": must be a number'),
    (changed(BAR, time={"adapt": 1}), "time.adapt = 1: must be true or false"),
    (changed(BAR, output={"every": 1.5}), "output.every = 1.5: must be a whole number"),
    (changed(BAR, output={"fields": "stress"}), 'output.fields = "stress": must be a list'),
    (changed(BAR) | {"boundary": 3}, "boundary = 3: must be a list"),
    (changed(BAR) | {"time": 3}, "time = 3: must be a table"),
    (held_at(3), "boundary.0.on = 3: must be a text in quotes"),
    (right(fix="w"), 'boundary.1.fix = "w": must name components'),
    (right(velocity=3), "boundary.1.velocity = 3: must be a list"),
    (right(velocity=["fre", 0, 0]), 'boundary.1.velocity.0 = "fre": must be a number or "free"'),
    (right(pressure=[1, 2]), "boundary.1.pressure = [1, 2]: must be a number"),
    (right(traction=["free", 0, 0]), 'boundary.1.traction.0 = "free": must be a number'),
    (changed(BAR, solver={"snes": {"max_it": 3}}), "solver.snes: {'max_it': 3} is not a PETSc option"),
    (probing(on="left", name="a b"), 'probe.0.name = "a b": must be letters, digits and -'),
    # words that are not on the list
    (changed(BAR, mesh={"builder": "boxx"}), 'mesh.builder = "boxx" is not a builder; did you mean box?'),
    (changed(BAR, mesh={"builder": "quiche"}), "is not a builder; there are: boat, box, capsule, cylinder, disk"),
    (changed(BAR, material={"energy": "neohookean"}), "did you mean neo-hookean?"),
    (changed(BAR, material={"energy": "rubber"}), "must be 'linear', 'corotated', 'stvk' or 'neo-hookean'"),
    (changed(BAR, time={"scheme": "newmarks"}), "did you mean newmark?"),
    (changed(STRIP, fracture={"kernel": "gauss"}), "did you mean gaussian?"),
    (changed(BAR, output={"fields": ["stres"]}), 'output.fields.0 = "stres": must be'),
    # ranges; nothing that is not a number
    (changed(BAR, material={"poisson": 0.5}), "material.poisson = 0.5: must be less than 0.5"),
    (changed(BAR, material={"poisson": -1}), "material.poisson = -1: must be greater than -1"),
    (changed(BAR, material={"density": -2.0}), "material.density = -2.0: must be greater than 0"),
    (changed(BAR, material={"young": 0}), "material.young = 0: must be greater than 0"),
    (changed(BAR, material={"young": np.nan}), "material.young = nan: must be a finite number"),
    (changed(BAR, material={"young": np.inf}), "material.young = inf: must be a finite number"),
    (changed(STRIP, fracture={"strength": -1.0}), "fracture.strength = -1.0: must be greater than 0"),
    (changed(STRIP, fracture={"strength": np.nan}), "fracture.strength = nan: must be greater than 0"),
    (changed(STRIP, fracture={"radius": np.inf}), "fracture.radius = inf: must be a finite number"),
    (changed(BAR, mesh={"h": -0.1}), "h = -0.1 must be a positive number"),
    (changed(BAR, mesh={"h": np.nan}), "h = nan must be a positive number"),
    (changed(BAR, mesh={"h": 1e-9}), "take a larger h"),
    (right(velocity=[np.nan, 0, 0]), "boundary.1.velocity.0 = nan: must be a finite number"),
    (changed(BAR, time={"end": -1.0}), "time.end = -1.0: must be greater than 0"),
    (changed(BAR, time={"end": np.inf}), "time.end = inf: must be a finite number"),
    (changed(BAR, time={"step": 1.0}), "time: step = 1 s is longer than the run: end = 0.03 s"),
    (changed(BAR, time={"smallest": 1.0}), "time: smallest = 1 s is longer than step = 0.01 s"),
    (changed(BAR, time={"scheme": "newmark", "beta": 0.1}), "raise beta"),
    (changed(BAR, output={"every": 0}), "output.every = 0: must be greater than or equal to 1"),
    (changed(BAR, time={"step": 5e-324}), "time.step: 4.94066e-324 s is out of reach; allowed are 1e-30 to 1e30 s"),
    (changed(BAR, time={"smallest": 5e-324}), "time.smallest: 4.94066e-324 s is out of reach"),
    (changed(BAR, mesh={"h": 5e-324}), "h = 5e-324 m is out of reach; take 1e-30 m or more"),
    (changed(BAR, mesh={"size": [1e308] * 3}), "size[0] = 1e+308 must be a positive number (metres), at most 1e+30"),
    (changed(BAR, output={"fields": ["stress", "stress"]}), 'output.fields: "stress" is given twice; name each field'),
    (held_at("a\nb"), 'boundary.0.on = "a\\nb": the mesh has no such facet group'),
    (held_at("a" * 10**6), "aaa ... aaa"),
    (changed(BAR, output={"interval": 0.1}), "output: give every (in steps) or interval (in s), not both"),
    (
        changed(STRIP, fracture={"heterogeneity": {"modulus": 1e-300}}),
        "fracture.heterogeneity.modulus = 1e-300: must be greater than or equal to 0.1",
    ),
    # tables over time
    (moving([0, 1], [[0, 0, 0]]), "2 times but 1 values; give one value for each time"),
    (moving([1, 0], [[0, 0, 0]] * 2), "times must increase"),
    (moving([], []), "boundary.1.velocity.time = []: must have 1 or more entries"),
    (moving([0, 1], [[0, 0, 0], [1, 0]]), "boundary.1.velocity = [1.0, 0.0]: this mesh needs 3 numbers"),
    (moving([0, 1], [[0, 0, 0], ["free", 0, 0]]), '"free" at one time must be free at all of them'),
    # what does not fit the mesh
    (
        held_at("lefft"),
        'boundary.0.on = "lefft": the mesh has no such facet group; it has: back, bottom, front, left, right, top',
    ),
    (probing(on="rite"), 'probe.0.on = "rite": the mesh has no such facet group; it has: back'),
    (
        held_at({"box": [[5, 5, 5], [6, 6, 6]]}),
        "boundary.0.on selects no node; the body lies in (0, 0, 0) to (1, 0.25, 0.25)",
    ),
    (held_at({"box": [[1, 1, 1], [0, 0, 0]]}), "give the lower corner first"),
    (held_at({"box": [[0, 0], [1, 1]]}), "boundary.0.on.box = [0.0, 0.0]: this mesh needs 3 numbers"),
    (held_at({"point": [9, 0, 0], "normal": [1, 0, 0]}), "boundary.0.on selects no node; the body lies in"),
    (held_at({"point": [0, 0, 0], "normal": [0, 0, 0]}), "a normal must not be zero"),
    (right(velocity=[1, 0]), "boundary.1.velocity = [1.0, 0.0]: this mesh needs 3 numbers"),
    (
        changed(STRIP, fracture={"fibre": {"direction": [1, 0, 0]}}),
        "fracture.fibre.direction = [1.0, 0.0, 0.0]: this mesh needs 2 numbers",
    ),
    (right(traction=[1, 0]), "boundary.1.traction = [1.0, 0.0]: this mesh needs 3 numbers"),
    (changed(BAR, load={"gravity": [0, -9.81]}), "load.gravity = [0.0, -9.81]: this mesh needs 3 numbers"),
    (
        changed(BAR, load={"body_force": {"time": [0], "value": [[1, 2]]}}),
        "load.body_force = [1.0, 2.0]: this mesh needs 3",
    ),
    (changed(BAR, initial={"velocity": [1, 2]}), "initial.velocity = [1.0, 2.0]: this mesh needs 3 numbers"),
    (changed(BAR, initial={"spin": [1]}), "initial.spin = [1.0]: this mesh needs 3 numbers"),
    (changed(STRIP, initial={"spin": [0, 0, 1]}), "initial.spin = [0.0, 0.0, 1.0]: this mesh needs 1 number"),
    (changed(STRIP, load={"gravity": [0, 0, -9.81]}), "load.gravity = [0.0, 0.0, -9.81]: this mesh needs 2 numbers"),
    (changed(STRIP, boundary=[{"on": "left", "fix": "z"}]), 'boundary.0.fix = "z": a 2D mesh has no z'),
    (changed(STRIP, material={"plane": "stress"}), "is offered by the energies linear and stvk, not by neo-hookean"),
    (changed(BAR, material={"plane": "stress"}), "is for 2D meshes; this one has 3 dimensions"),
    (
        changed(BAR, material={"crust": {"young": 1.0}}),
        "material.crust: the mesh has no region of that name; it has: none",
    ),
    (changed(BAR, material={"crust": {"strength": 1.0}}), "material.crust.strength needs a [fracture] table"),
    (probing(point=[9, 9, 9]), "probe.0.point = [9.0, 9.0, 9.0] lies outside the body, which spans (0, 0, 0) to (1,"),
    (probing(), "probe.0: give either point or on"),
    (probing(point=[0, 0, 0], record="reaction"), "a reaction is summed over a group or selection"),
    (changed(BAR) | {"probe": [{"name": "a", "on": "left"}] * 2}, "two probes have the name a"),
    (changed(BAR, output={"fields": ["damage"]}), 'output.fields has "damage", which needs a [fracture] table'),
    (
        changed(BAR, time={"scheme": "quasi-static"}, boundary=[{"on": "left", "fix": "xy"}]),
        "nothing holds the body against moving along z; a quasi-static study needs every body held",
    ),
    (changed(BAR, time={"scheme": "quasi-static"}, initial={"velocity": [1, 0, 0]}), "[initial] sets a velocity"),
    # plasticity
    (flowing(yield_stress=0.0), "plasticity.yield_stress = 0.0: must be greater than 0"),
    (flowing(yield_stress=np.nan), "plasticity.yield_stress = nan: must be greater than 0"),
    (flowing(flow_rate=-1.0), "plasticity.flow_rate = -1.0: must be greater than 0"),
    (flowing(hardening=np.inf), "plasticity.hardening = inf: must be a finite number"),
    (flowing(hardening=-1.2e6), "plasticity.hardening = -1.2e+06: must be greater than -3 mu = -1.154e+06 Pa"),
    (flowing(measure="mises"), 'plasticity.measure = "mises": must be'),
    (flowing(yeld_stress=1.0), "plasticity.yeld_stress is not a known key; did you mean yield_stress?"),
    (changed(BAR, plasticity={}), "plasticity.yield_stress is missing; the table [plasticity] needs it"),
    (changed(flowing(), material={"energy": "linear"}), 'choose energy = "corotated", the same law at small strain'),
    (
        changed(flowing(STRIP), material={"energy": "stvk", "plane": "stress"}),
        "[plasticity] is for 3D and plane strain",
    ),
    (
        changed(flowing(STRIP), material={"energy": "corotated"}, fracture={"approach": "edge"}),
        'choose approach = "chi" with [plasticity]',
    ),
    (
        changed(BAR, material={"crust": {"yield_stress": 1.0}}),
        "material.crust.yield_stress needs a [plasticity] table",
    ),
    (
        changed(BAR, output={"fields": ["plastic_strain"]}),
        'output.fields has "plastic_strain", which needs a [plasticity] table',
    ),
    # files
    (changed(BAR) | {"mesh": {"file": "/no/such.msh"}}, 'mesh.file = "/no/such.msh": there is no such file'),
    (
        changed(BAR) | {"mesh": {"surface": "/no/such.stl", "h": 1.0}},
        'mesh.surface = "/no/such.stl": there is no such file',
    ),
    (
        changed(BAR) | {"mesh": {"file": __file__, "h": 1.0}},
        "mesh.h is not a known key beside mesh.file; known here: file, scale",
    ),
    (changed(BAR) | {"mesh": {"surface": __file__, "h": np.nan}}, "mesh.h = nan: a surface is filled with cells of"),
    (changed(BAR) | {"mesh": {"surface": __file__, "h": np.inf}}, "mesh.h = inf: a surface is filled with cells of"),
    (changed(BAR) | {"mesh": {"surface": __file__}}, "mesh.h = None: a surface is filled with cells of size h > 0"),
    (changed(BAR) | {"mesh": {"surface": __file__, "h": 1.0, "scale": 0}}, "mesh.scale = 0: metres for each unit of"),
    (changed(BAR) | {"mesh": {"file": __file__, "join": 1}}, "mesh.join = 1: whether nodes of different bodies"),
    (changed(BAR) | {"mesh": {"surface": __file__, "h": 1.0, "join": True}}, "mesh.join is not a known key beside"),
    (changed(BAR) | {"mesh": {"file": __file__, "scale": [1]}}, "mesh.scale = [1]: metres for each unit of length"),
    (changed(BAR) | {"mesh": {"surface": __file__, "h": 1.0, "time_limit": "1"}}, "mesh.time_limit = 1: seconds that"),
    (changed(BAR) | {"mesh": {"file": __file__}}, "is of no known kind; known endings:"),
]


@pytest.mark.parametrize(("data", "message"), REFUSED, ids=[message[:50] for _, message in REFUSED])
def test_check_refuses(data: Data, message: str) -> None:
    with pytest.raises(InputError) as refusal:
        check_study(validate(data, "test.toml"))
    assert message in str(refusal.value)
    assert "\n" not in str(refusal.value)


# --- [solver]: a study is data ----------------------------------------------------------------------------------------

NO_CODE = "options of [solver] load no code"
NO_FILE = "options of [solver] neither load code nor read or write files"
NO_TARGET = "that name neither a file nor a viewer"
NO_DATA: list[tuple[Data, str]] = [
    # code: types at any prefix of an inner solver, in a list, and what names the class
    ({"pc_type": "python"}, NO_CODE),
    ({"ksp_type": "python"}, NO_CODE),
    ({"snes_type": "python"}, NO_CODE),
    ({"tao_type": "python"}, NO_CODE),
    ({"snes_linesearch_type": "shell"}, NO_CODE),
    ({"mg_levels_pc_type": "python"}, NO_CODE),
    ({"fieldsplit_0_pc_type": "PYTHON"}, NO_CODE),
    ({"pc_composite_pcs": "ilu,python"}, NO_CODE),
    ({"pc_composite_pcs": "python,ilu"}, NO_CODE),
    ({"pc_python_type": "module.Class"}, NO_FILE),
    ({"mg_levels_1_pc_python_type": "evil"}, NO_FILE),
    ({"mat_python_type": "a.b"}, NO_FILE),
    ({"ksp_monitor_python": "evil.look"}, NO_FILE),
    ({"dll_append": "evil"}, NO_FILE),
    ({"library_preload": True}, NO_FILE),
    # files
    ({"options_file": "more"}, NO_FILE),
    ({"pc_mg_dump_binary": True}, NO_FILE),
    ({"pc_bddc_save": 0}, NO_FILE),
    ({"mat_mumps_ooc_tmpdir": "here"}, NO_FILE),
    ({"snes_mf_noise_file": "noise"}, NO_FILE),
    ({"malloc_dump": True}, NO_FILE),
    ({"log_view": ":log.txt"}, NO_TARGET),
    ({"ksp_view": "ascii:study.toml"}, NO_TARGET),
    ({"ksp_view_mat": "binary:F"}, NO_TARGET),
    ({"ksp_view_mat": "binary"}, NO_TARGET),  # writes "binaryoutput"
    ({"ksp_view_mat": "xbinary"}, NO_TARGET),  # PETSc compares the end only
    ({"ksp_view_rhs": "ascii,hdf5"}, NO_TARGET),
    ({"snes_view_solution": "hdf5:u.h5"}, NO_TARGET),
    ({"snes_view_solution": "vtk"}, NO_TARGET),
    ({"snes_monitor": ":F"}, NO_TARGET),
    ({"snes_linesearch_monitor": "ascii:F"}, NO_TARGET),
    ({"ksp_converged_reason": "::ascii_info:append"}, NO_TARGET),
    ({"mg_levels_ksp_monitor": "socket"}, NO_TARGET),
    ({"pc_hypre_type": "/tmp/evil.so"}, NO_TARGET),
    ({"pc_hypre_type": "..\\evil"}, NO_TARGET),
    ({"ksp_rtol": "1e-3 -pc_type lu"}, NO_TARGET),
    ({"ksp_rtol": "1e-3\n-pc_type"}, NO_TARGET),
    ({"ksp_rtol": "1e-3\n"}, NO_TARGET),
    # values that PETSc fails with
    ({"ksp_rtol": 0.0}, "above 0 and below 1"),
    ({"ksp_rtol": 0}, "above 0 and below 1"),
    ({"ksp_rtol": float("nan")}, "above 0 and below 1"),
    ({"ksp_rtol": "-1"}, "above 0 and below 1"),
    ({"pc_type": "fieldsplit"}, "choose another"),
    # keys that are no name of an option
    ({"-ksp_rtol": 1e-3}, "no - before it"),
    ({"ksp_rtol\n": 1e-3}, "a letter first"),
    ({"ksp_rtol 1 -x_pc_type": "lu"}, "a letter first"),
    ({"": 1}, "a letter first"),
    ({"k" * 600: 1}, "a letter first"),
]


@pytest.mark.parametrize(("options", "message"), NO_DATA, ids=[ascii(each)[:50] for each, _ in NO_DATA])
def test_options_that_are_no_data_are_refused(options: Data, message: str) -> None:
    """By `validate` alone, which every command goes through, with PETSc or without."""
    with pytest.raises(InputError) as refusal:
        study(BAR, solver={"ksp_rtol": 1e-6, **options})
    assert message in str(refusal.value)
    key = next(iter(options)).replace("\n", "\\n")
    assert f"solver.{key[:57]}" in str(refusal.value)
    assert "\n" not in str(refusal.value)


@pytest.mark.parametrize("kind", ["bddc", "composite", "galerkin", "lsc"])
def test_preconditioners_that_need_more_are_one_message(kind: str, tmp_path: Path) -> None:
    """PETSc refuses them as it sets them up, in the first step."""
    path = write_study(tmp_path / "bar.toml", BAR, solver={"pc_type": kind})
    result = fracsim("run", path, "-o", tmp_path / "out")
    assert result.returncode == 2
    assert f"pc_type = {kind}" in result.stderr and "Traceback" not in result.stderr


def test_a_refused_option_runs_no_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """What used to: a class of Python beside the study, named by the study."""
    evil = tmp_path / "evil.py"
    evil.write_text("open('was-here', 'w').close()\nclass PC: pass\n")
    path = write_study(tmp_path / "bar.toml", BAR)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.chdir(tmp_path)
    for name in ("check", "run"):
        options = ["--set", "solver.pc_type=python", "--set", "solver.pc_python_type=evil.PC"]
        result = fracsim(name, path, *options)
        assert result.returncode == 2
        assert result.stderr.count("fracsim: ") == 1 and 'solver.pc_type = "python"' in result.stderr
    assert sorted(each.name for each in tmp_path.iterdir() if each.name != "__pycache__") == ["bar.toml", "evil.py"]


def test_monitors_print(tmp_path: Path) -> None:
    """To the terminal: true, or an empty text; false is as if it were not there."""
    options = {"ksp_monitor": True, "snes_monitor": "", "ksp_view": "ascii", "ksp_converged_reason": False}
    assert study(BAR, solver=options).solver == {"ksp_monitor": "", "snes_monitor": "", "ksp_view": "ascii"}
    path = write_study(tmp_path / "bar.toml", BAR, time={"end": 0.01}, solver=options)
    result = fracsim("run", path, "-o", tmp_path / "out")
    assert result.returncode == 0, result.stderr
    assert "KSP Residual norm" in result.stdout and "SNES Function norm" in result.stdout
    assert "KSP Object" in result.stdout and "converged due to" not in result.stdout


# --- what only the mesh tells ---------------------------------------------------------------------------------------

ENDS = [{"on": "left", "fix": "xyz"}, {"on": "right", "traction": [1.0, 0.0, 0.0]}]
QUASI = {"scheme": "quasi-static"}
NEEDS_MESH: list[tuple[Data, str]] = [
    (
        held_at({"box": [[0.05, 0.05, 0.05], [0.06, 0.06, 0.06]]}),
        "boundary.0.on: box [0.05, 0.05, 0.05] to [0.06, 0.06, 0.06] selects no node; the body lies in (0, 0, 0)",
    ),
    (
        changed(BAR, boundary=[LEFT, {"on": {"point": [0.5, 0, 0], "normal": [1, 0, 0]}, "pressure": 1.0}]),
        "selects no boundary facet",
    ),
    (
        changed(BAR, time=QUASI, boundary=[{"on": {"box": [[0, 0, 0], [0, 0, 0.25]]}, "fix": "xyz"}]),
        "nothing holds the body against turning about z",
    ),
]


@pytest.mark.parametrize(("data", "message"), NEEDS_MESH, ids=[message[:50] for _, message in NEEDS_MESH])
def test_the_scene_refuses(data: Data, message: str) -> None:
    from fracsim.scene import build_scene

    with pytest.raises(InputError) as refusal:
        build_scene(MPI.COMM_SELF, validate(data, "test.toml"))
    assert message in str(refusal.value)


@pytest.mark.parametrize(
    ("option", "message"),
    [
        ({"ksp_type": "cgg"}, "Unable to find requested KSP type cgg"),
        ({"kps_type": "cg"}, "kps_type"),
        ({"snes_max_it": "many"}, "many has no integer value"),
        ({"mg_levels_pc_type": "jacobbi"}, "Unable to find requested PC type jacobbi"),
        ({"mg_levles_pc_type": "jacobi"}, "mg_levles_pc_type"),
    ],
)
def test_petsc_options_are_refused(option: Data, message: str) -> None:
    from fracsim.scene import build_scene

    with pytest.raises(InputError) as refusal:
        build_scene(MPI.COMM_SELF, study(BAR, solver=option))
    assert message in str(refusal.value)


# --- mesh files -----------------------------------------------------------------------------------------------------


def mesh_file(path: Path, points: list[Any], cells: list[list[int]]) -> Data:
    import meshio

    meshio.Mesh(np.array(points, float), [("tetra", np.array(cells))]).write(path)
    free = {"mesh": {"file": str(path)}, "boundary": [], "probe": []}
    return changed(BAR) | free


TET = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 1]]
FLAT = [[0, 0, 0], [1, 0, 0], [0, 1, 0], [1, 1, 0]]
APART = [[x + 5, y, z] for x, y, z in TET]


def test_a_degenerate_mesh_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InputError, match=r"1 cells have no volume: cell 0, the first near"):
        check_study(validate(mesh_file(tmp_path / "flat.vtu", FLAT, [[0, 1, 2, 3]]), "test.toml"))


def test_a_mesh_without_numbers_is_refused(tmp_path: Path) -> None:
    points = [*TET[:3], [np.nan, 0, 0]]
    with pytest.raises(InputError, match="coordinates that are not finite numbers"):
        check_study(validate(mesh_file(tmp_path / "nan.vtu", points, [[0, 1, 2, 3]]), "test.toml"))


@pytest.mark.parametrize("ending", ["vtu", "msh", "xdmf", "mesh"])
def test_an_unreadable_mesh_is_refused(tmp_path: Path, ending: str, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / f"junk.{ending}"
    path.write_bytes(b"\x00junk" * 40)
    with pytest.raises(InputError, match=f"^mesh: Mesh file '{path}' could not be read"):
        check_study(validate(changed(BAR) | {"mesh": {"file": str(path)}}, "test.toml"))
    assert capfd.readouterr() == ("", "")


def test_each_body_must_be_held(tmp_path: Path) -> None:
    from fracsim.scene import build_scene

    data = mesh_file(tmp_path / "two.vtu", TET + APART, [[0, 1, 2, 3], [4, 5, 6, 7]])
    data |= {"boundary": [{"on": {"box": [[0, 0, 0], [2, 1, 1]]}, "fix": "xyz"}], "time": BAR["time"] | QUASI}
    with pytest.raises(
        InputError, match=r"nothing holds the body around \(5\.25, 0\.25, 0\.25\) m \(one of 2\) against moving"
    ):
        build_scene(MPI.COMM_SELF, validate(data, "test.toml"))


# --- study files ----------------------------------------------------------------------------------------------------


def test_a_study_that_is_not_toml_names_the_line(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_text('title = "x"\n[mesh\n')
    with pytest.raises(InputError, match=r"bad\.toml is not TOML: .*line 2"):
        load_study(path)


def test_a_study_that_is_not_text(tmp_path: Path) -> None:
    path = tmp_path / "bad.toml"
    path.write_bytes(b"\xff\xfe\x00")
    with pytest.raises(InputError, match="cannot read the study file"):
        load_study(path)


DEEP = {
    "study": ('title = "x"\nmesh = ' + "[" * 5000, []),
    "--set": ("", ["--set", "mesh.size=" + "[" * 5000]),
    "digits": ("title = " + "1" * 5000, []),
    "bits": ("", ["--set", "time.end=0x1" + "0" * 5000]),
    "an index of digits": ("", ["--set", f"boundary.{'9' * 5000}.fix=x"]),
    "an index that is none": ("", ["--set", "boundary.\u00b2.fix=x"]),
    "into a number": ("", ["--set", "boundary.1.velocity.0.x=1"]),
    "a path": ("", ["--set", 'mesh={file="\\u0000"}']),
    "a step": ("", ["--set", "time.step=5e-324"]),
    "a size": ("", ["--set", "mesh.h=5e-324"]),
    "a field": ("", ["--set", 'output.fields=["stress", "stress"]']),
    "a missing study": (None, []),
}


def told(folder: Path, case: str) -> list[str]:
    """Arguments of `fracsim check` of such a study."""
    text, options = DEEP[case]
    path = write_study(folder / "bar.toml", BAR)
    if text:
        path.write_text(text)
    return ["check", str(path) if text is not None else "x" * 5000, *options]


@pytest.mark.parametrize("case", DEEP)
def test_no_traceback(tmp_path: Path, case: str) -> None:
    assert_one_message(fracsim(*told(tmp_path, case)))


@pytest.mark.parametrize("case", ("study", "a path"))
def test_no_traceback_of_a_process(tmp_path: Path, case: str) -> None:
    """Two of them with what the interpreter says when it ends: one of parsing, one of what follows."""
    done = subprocess.run(command(*told(tmp_path, case)), capture_output=True, text=True, timeout=60, check=False)
    assert_one_message(done)


def assert_one_message(done: subprocess.CompletedProcess[str]) -> None:
    assert done.returncode == 2
    assert "Traceback" not in done.stderr and done.stderr.startswith("fracsim: ")
    assert done.stderr.count("\n") == 1 and len(done.stderr) < 1100


def test_a_missing_study() -> None:
    with pytest.raises(InputError, match=r"there is no study file nope\.toml; `fracsim list` shows"):
        load_study(Path("nope.toml"))


# --- output folders -------------------------------------------------------------------------------------------------


def test_a_file_in_the_way_of_the_output_folder(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="file is not a folder; give another one"):
        check_folder(tmp_path / "file" / "out")
    check_folder(tmp_path / "new" / "out")
    assert not (tmp_path / "new").exists()


def test_an_output_folder_without_permission(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.access", lambda *_: False)  # as root, everything is allowed
    with pytest.raises(InputError, match=f"no permission to write in {tmp_path}; give another one"):
        check_folder(tmp_path / "out")


# --- on two ranks ---------------------------------------------------------------------------------------------------

TWO_RANKS: dict[str, tuple[list[str], str]] = {
    "parse": (["--set", "material.poisson=0.5"], "material.poisson = 0.5: must be less than 0.5"),
    "mesh": (["--set", "mesh.h=-1.0"], "must be a positive number"),
    "scene": (["--set", "boundary.0.on={box=[[0.05,0.05,0.05],[0.06,0.06,0.06]]}"], "selects no node"),
    "solver": (["--set", "solver.ksp_type=cgg"], "cgg"),
    "restart": (["--restart"], "--restart: there is no checkpoint"),
    "option": (["--frob"], "No such option: --frob"),
}


@pytest.fixture(scope="module")
def refused(tmp_path_factory: pytest.TempPathFactory) -> tuple[Arrays, Path]:
    """Exit codes and words of all cases on two ranks, and the folder of what they would have written."""
    folder = tmp_path_factory.mktemp("refused")
    bar = write_study(folder / "bar.toml", BAR)
    lines = [["run", str(bar), "-o", str(folder / name), *options] for name, (options, _) in TWO_RANKS.items()]
    (folder / "lines.json").write_text(json.dumps(lines))
    return run_on_ranks("support.refused", 2, folder, seconds=60), folder


@pytest.mark.parametrize("case", TWO_RANKS)
def test_one_message_on_two_ranks_and_nothing_written(refused: tuple[Arrays, Path], case: str) -> None:
    found, folder = refused
    place = list(TWO_RANKS).index(case)
    assert found["codes"][place].tolist() == [2, 2]
    root, other = found["said"][place]
    assert root.startswith("fracsim: ") and root.count("\n") == 1
    assert TWO_RANKS[case][1] in root and other == ""
    assert not (folder / case).exists()


def test_one_message_of_two_processes(tmp_path: Path) -> None:
    """One of them with what mpirun makes of it."""
    options, message = TWO_RANKS["scene"]
    bar = write_study(tmp_path / "bar.toml", BAR)
    result = fracsim("run", bar, "-o", tmp_path / "out", *options, ranks=2)
    assert result.returncode == 2
    assert result.stderr.count("fracsim: ") == 1 and message in result.stderr
    assert "Traceback" not in result.stderr + result.stdout
    assert result.stdout == "" or result.stdout.startswith("-----")  # what mpirun says of the exit code
    assert not (tmp_path / "out").exists()
