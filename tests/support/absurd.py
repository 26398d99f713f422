"""Studies that have every numeric key between them, and each of its values replaced by an absurd one."""

from __future__ import annotations

import copy
import math
import tomllib
from collections.abc import Iterator
from dataclasses import fields, replace
from pathlib import Path as Folder
from typing import Any

import meshio
import numpy as np

from fracsim.meshes import BUILDERS
from fracsim.meshes.topology import boundary_facets
from fracsim.study.mesh_source import save_mesh

Data = dict[str, Any]
Place = tuple[str | int, ...]

VALUES: tuple[float, ...] = (
    1e300, -1e300, 1e-300, -1e-300, 1.7e308, 5e-324, 1e30, 1e-30, 1e9, -1.0, 0.0, math.nan, math.inf, -math.inf,
)  # fmt: skip
WHOLE = (2**62, -1, 0, 10**9)  # in place of whole numbers, beside the others


def _study(text: str) -> Data:
    return tomllib.loads(text)


_HEAD = """
title = "absurd"
[material]
energy = "neo-hookean"
young = 1e6
poisson = 0.3
density = 1000.0
[output]
picture = false
"""
_STRIP = (
    _HEAD
    + """
[mesh]
builder = "box"
size = [1.0, 0.25]
origin = [0.0, 0.0]
h = 0.125
"""
)
_BAR = (
    _HEAD
    + """
[mesh]
builder = "box"
size = [1.0, 0.25, 0.25]
h = 0.25
"""
)

_RIGID = (
    _BAR.replace("neo-hookean", "linear").replace("1e6", "1e10")
    + """
[fracture]
strength = 3e5
kernel = "neighbours"
[brittle]
surfaces = 2
[[body]]
position = [0.0, 0.0, 0.01]
rotation = [0.0, -0.05, 0.0]
velocity = [0.0, 0.0, -4.0]
spin = [0.0, 0.1, 0.0]
copies = [1, 1, 2]
spacing = [1.5, 1.0, 1.0]
[[obstacle]]
name = "floor"
shape = "plane"
at = [0.0, 0.0, -0.1]
normal = [0.0, 0.0, 1.0]
friction = 0.3
[[obstacle]]
name = "ball"
shape = "sphere"
radius = 0.1
at = [0.5, 0.125, 3.0]
mass = 1.0
velocity = [0.0, 0.0, -1.0]
[contact]
friction = 0.2
restitution = 0.1
contact_time = 1e-3
[load]
gravity = [0.0, 0.0, -9.81]
[time]
scheme = "rigid"
step = 2e-3
end = 0.02
"""
)

BASES: dict[str, Data] = {
    "strip": _study(_STRIP + """
[fracture]
strength = 2e4
radius = 0.1
tie_break = 1e-6
passes = 2
cap = 0.5
heterogeneity = { modulus = 8.0, seed = 1 }
fibre = { direction = [1.0, 0.5], ratio = 2.0 }
[damping]
mass = 1.0
stiffness = 1e-4
[load]
gravity = [0.0, -9.81]
body_force = { time = [0.0, 0.01], value = [[0.0, 0.0], [0.0, 10.0]] }
[initial]
velocity = [0.1, 0.0]
spin = [0.1]
[[boundary]]
on = { point = [0.0, 0.0], normal = [1.0, 0.0], within = 1e-3 }
displacement = { time = [0.0, 0.01], value = [[0.0, 0.0], [0.001, 0.0]] }
[[boundary]]
on = "right"
traction = [10.0, 0.0]
[[boundary]]
on = { box = [[0.0, 0.25], [1.0, 0.25]] }
pressure = { time = [0.0, 1.0], value = [0.0, 10.0] }
[[boundary]]
on = "bottom"
force = [0.0, 1.0]
[[probe]]
name = "tip"
point = [1.0, 0.25]
[[probe]]
name = "grip"
on = { box = [[0.0, 0.0], [0.0, 0.25]] }
[time]
scheme = "newmark"
beta = 0.25
gamma = 0.5
step = 0.005
end = 0.01
smallest = 1e-5
breaking_step = 1e-3
until = { drop = 0.5, of = "grip", above = 1.0 }
"""),
    "alpha": _study(_STRIP + """
[[boundary]]
on = "left"
fix = "xy"
[[boundary]]
on = "right"
velocity = { time = [0.0, 0.01], value = [[0.1, "free"], [0.2, "free"]] }
[[probe]]
name = "end"
on = { point = [1.0, 0.0], normal = [1.0, 0.0], within = 1e-3 }
[time]
rho = 0.8
step = { time = [0.0, 0.005], value = [0.005, 0.0025] }
end = 0.01
"""),
    "sheet": _study(_STRIP.replace("neo-hookean", "linear") + """
[fracture]
strength = 2e4
energy = 20.0
[[crack]]
segment = [[0.5, 0.0], [0.5, 0.1]]
[[boundary]]
on = "left"
fix = "xy"
[[boundary]]
on = "right"
displacement = { time = [0.0, 1.0], value = [[0.0, 0.0], [0.01, 0.0]] }
[[probe]]
name = "tip"
point = [0.5, 0.1]
contour = 0.2
[time]
scheme = "quasi-static"
step = 0.5
end = 1.0
"""),
    "cohesive": _study(_STRIP.replace("neo-hookean", "linear") + """
[fracture]
strength = 2e4
energy = 2000.0
law = "cohesive"
[[boundary]]
on = "left"
fix = "xy"
[[boundary]]
on = "right"
displacement = { time = [0.0, 1.0], value = [[0.0, 0.0], [0.05, 0.0]] }
[time]
scheme = "quasi-static"
step = 0.5
end = 1.0
"""),
    "bar": _study(_BAR + """
[fracture]
strength = 2e4
[plasticity]
yield_stress = 1e4
flow_rate = 1e3
hardening = 1e4
[[crack]]
plane = { point = [0.5, 0.0, 0.0], normal = [1.0, 0.0, 0.0] }
[[crack]]
polygon = [[0.7, -1.0, -1.0], [0.7, 1.0, -1.0], [0.7, 0.1, 2.0]]
[initial]
velocity = [0.0, 0.0, -1.0]
spin = [0.0, 0.0, 0.1]
[load]
gravity = [0.0, 0.0, -9.81]
[[obstacle]]
name = "floor"
shape = "plane"
at = [0.0, 0.0, -0.001]
normal = [0.0, 0.0, 1.0]
friction = 0.3
[[obstacle]]
name = "ball"
shape = "sphere"
radius = 0.1
at = [0.5, 0.125, 0.36]
mass = 1.0
velocity = [0.0, 0.0, -1.0]
spin = [0.1, 0.0, 0.0]
[[obstacle]]
name = "pin"
shape = "capsule"
radius = 0.05
length = 0.1
axis = [0.0, 1.0, 0.0]
at = [0.2, 0.125, 0.31]
displacement = { time = [0.0, 1.0], value = [[0.0, 0.0, 0.0], [0.0, 0.0, -0.1]] }
[[obstacle]]
name = "can"
shape = "cylinder"
radius = 0.05
length = 0.1
rounding = 0.005
axis = [0.0, 1.0, 0.0]
at = [0.8, 0.125, 0.31]
velocity = [0.0, 0.0, -0.1]
[[obstacle]]
name = "door"
shape = "box"
size = [0.1, 0.1, 0.1]
rounding = 0.01
at = [-0.2, 0.0, 0.1]
density = 500.0
hinge = { point = [-0.25, 0.0, 0.1], axis = [0.0, 0.0, 1.0] }
spin = [0.1]
[contact]
friction = 0.2
distance = 0.005
stiffness = 1e5
creep = 1e-3
[time]
scheme = "backward-euler"
step = 0.001
end = 0.002
"""),
    "brittle": _study(_BAR + """
[fracture]
strength = 2e4
[brittle]
surfaces = 4
spacing = 0.2
seed = 1
per_pass = 2
grains = { count = 4, seed = 1, spread = 0.1, stretch = [2.0, 1.0, 1.0] }
[[boundary]]
on = "left"
fix = "xyz"
[[boundary]]
on = "right"
velocity = [2.0, 0.0, 0.0]
[time]
scheme = "backward-euler"
step = 0.005
end = 0.01
"""),
    "explicit": _study(_BAR + """
[fracture]
strength = 2e4
[damping]
mass = 1.0
stiffness = 1e-5
[initial]
velocity = [0.0, 0.0, -1.0]
[[obstacle]]
name = "floor"
shape = "plane"
at = [0.0, 0.0, -0.001]
normal = [0.0, 0.0, 1.0]
friction = 0.3
[[obstacle]]
name = "ball"
shape = "sphere"
radius = 0.1
at = [0.5, 0.125, 0.36]
velocity = [0.0, 0.0, -1.0]
[contact]
friction = 0.2
distance = 0.005
stiffness = 1e5
[time]
scheme = "explicit"
step = 0.001
end = 0.005
"""),
    "rigid": _study(_RIGID),
    "dented": _study(_BAR.replace("neo-hookean", "linear").replace("1e6", "1e10") + """
[plasticity]
yield_stress = 1e6
hardening = 1e8
[[body]]
position = [0.0, 0.0, 0.01]
rotation = [0.0, -0.05, 0.0]
velocity = [0.0, 0.0, -4.0]
[[obstacle]]
name = "floor"
shape = "plane"
at = [0.0, 0.0, -0.1]
normal = [0.0, 0.0, 1.0]
[time]
scheme = "rigid"
step = 2e-3
end = 0.02
"""),
}  # fmt: skip
for _data in BASES.values():  # tables of one name once
    _data["output"] |= {"every": 1}
BASES["strip"]["material"] |= {"thickness": 0.1}
BASES["alpha"]["output"] = {"picture": False, "interval": 0.005, "checkpoint": 10.0}


def from_files(folder: Folder) -> dict[str, Data]:
    """Studies whose meshes are files that are written into the folder: a mesh with a region, three others."""
    box = BUILDERS["box"](size=(1.0, 0.25, 0.25), h=0.125).build()
    crust = {"crust": np.flatnonzero(box.points[box.cells].mean(axis=1)[:, 0] > 0.5)}
    save_mesh(replace(box, regions=crust), folder / "box.msh")
    meshio.Mesh(box.points, [("triangle", boundary_facets(box.cells))]).write(folder / "box.stl")
    (folder / "box.csv").write_text("0, 0, left\n1, 0\n1, 1\n0, 1\n")
    base: Data = {
        "title": "from a file", "material": {"young": 1e5, "poisson": 0.3, "density": 300.0},
        "fracture": {"strength": 2e4}, "time": {"step": 0.005, "end": 0.01}, "output": {"every": 1, "picture": False},
        "solver": {"ksp_rtol": 1e-6},
    }  # fmt: skip
    file = {"file": str(folder / "box.msh"), "scale": 1.0}
    torn = {"young": 2e5, "poisson": 0.2, "density": 400.0, "strength": 2e4, "fracture_energy": 20.0}
    soft = {"yield_stress": 2e4, "strength": 3e4}
    solid = {"name": "block", "shape": "mesh", "file": str(folder / "box.stl"), "scale": 0.5, "at": [0.2, 0.0, -0.2],
             "spin": [0.0, 0.0, 0.1]}  # fmt: skip
    rigid = _study(_RIGID) | {"mesh": {"shell": str(folder / "box.stl"), "thickness": 0.01, "scale": 1.0}}
    return {
        "file": base | {
            "mesh": file, "material": base["material"] | {"crust": torn}, "fracture": {"strength": 2e4, "energy": 10.0},
        },
        "soft file": base | {
            "mesh": file, "material": base["material"] | {"crust": soft}, "plasticity": {"yield_stress": 1e4},
            "load": {"gravity": [0.0, 0.0, -9.81]}, "obstacle": [solid],
        },
        "surface": base | {"mesh": {"surface": str(folder / "box.stl"), "h": 0.1, "scale": 1.0, "time_limit": 60.0}},
        "outline": base | {"mesh": {"outline": str(folder / "box.csv"), "h": 0.25, "scale": 1.0, "seed": 1}},
        "shell": rigid,
    }  # fmt: skip


def of_builders() -> dict[str, Data]:
    """A study of each builder, with its numbers as they are where they are left out."""
    found = {}
    for name, kind in BUILDERS.items():
        defaults = {field.name: field.default for field in fields(kind)}  # type: ignore[arg-type]
        kept = {key: value for key, value in defaults.items() if not isinstance(value, bool | str) and value != ()}
        numbers = {key: list(value) if isinstance(value, tuple) else value for key, value in kept.items()
                   if isinstance(value, int | float | tuple)}  # fmt: skip
        numbers |= {key: numbers["h"] / 2 for key in defaults if key.startswith("h_") and "h" in numbers}
        found[name] = {
            "title": name, "mesh": {"builder": name} | numbers, "time": {"step": 0.005, "end": 0.01},
            "material": {"young": 1e5, "poisson": 0.3, "density": 300.0},
        }  # fmt: skip
    return found


def leaves(value: Any, at: Place = ()) -> Iterator[Place]:
    """Places of all numbers of a study."""
    if isinstance(value, dict | list):
        for key, inner in value.items() if isinstance(value, dict) else enumerate(value):
            yield from leaves(inner, (*at, key))
    elif isinstance(value, int | float) and not isinstance(value, bool):
        yield at


def mutated(data: Data, at: Place, value: float) -> Data:
    """The study with another value at a place."""
    result = copy.deepcopy(data)
    place: Any = result
    for key in at[:-1]:
        place = place[key]
    place[at[-1]] = value
    return result


def absurd(data: Data, share: int = 1) -> Iterator[tuple[str, Data]]:
    """Every place of a study with every absurd value, by a name; `share`: of each so many values, one."""
    for number, at in enumerate(leaves(data)):
        now: Any = data
        for key in at:
            now = now[key]
        for value in (*VALUES, *(WHOLE if isinstance(now, int) else ()))[number % share :: share]:
            yield f"{'.'.join(map(str, at))} = {value!r}", mutated(data, at, value)
