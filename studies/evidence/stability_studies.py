"""Studies of the stability table as TOML data: small scenes with known results at extremes of their parameters."""

from __future__ import annotations

from typing import Any

Data = dict[str, Any]
RUBBER: Data = {"energy": "neo-hookean", "young": 1e6, "poisson": 0.3, "density": 1e3}
BAR: Data = {"builder": "box", "size": [1.0, 0.25, 0.25], "h": 0.125}


def stretched_block(
    stretch: float,
    *,
    mesh: Data = BAR,
    material: Data | None = None,
    steps: int = 20,
    confined: bool = False,
    strength: float | None = None,
) -> Data:
    """Block whose right face moves to `stretch` times its length, quasi-statically, with free or fixed lateral sides.

    The strain is homogeneous on any mesh, so that force and break are known (block_stretch.stretch_error).
    """
    sides = {"front": ["free", 0.0, "free"], "bottom": ["free", "free", 0.0]}
    if confined:
        sides |= {"back": sides["front"], "top": sides["bottom"]}
    end = (stretch - 1) * mesh["size"][0]
    pull = {"time": [0.0, 1.0], "value": [[0.0, "free", "free"], [end, "free", "free"]]}
    held = [{"on": "left", "displacement": [0.0, "free", "free"]}]
    held += [{"on": group, "displacement": motion} for group, motion in sides.items()]
    study = base_study("a block stretched", mesh, material, steps)
    study["boundary"] = [*held, {"on": "right", "displacement": pull}]
    study["probe"] = [{"name": "pull", "on": "right"}]
    study["time"] = {"scheme": "quasi-static", "step": 1.0 / steps, "end": 1.0}
    return study if strength is None else with_fracture(study, strength)


def accelerated_bar(
    step: float, *, scheme: str = "backward-euler", steps: int = 40, material: Data | None = None
) -> Data:
    """Free bar under a dead load on one end, which breaks it if the steps are long enough for waves to travel."""
    study = base_study("a free bar thrown by one end", BAR, material, steps)
    study["boundary"] = [{"on": "right", "traction": [5e4, 0.0, 0.0]}]
    study["time"] = {"scheme": scheme, "step": step, "end": steps * step}
    return with_fracture(study, 3e4)


def torn_body(
    mesh: Data, *, speed: float, step: float, steps: int, strength: float, ends: tuple[str, str] = ("left", "right"),
    material: Data | None = None, approach: str = "chi", axis: int = 0, scheme: str = "generalized-alpha",
) -> Data:  # fmt: skip
    """Body fixed at one end and pulled at the other until it breaks, with inertia."""
    study = base_study("a body torn", mesh, material, steps)
    velocity = [0.0, 0.0, 0.0]
    velocity[axis] = speed
    study["boundary"] = [{"on": ends[0], "fix": "xyz"}, {"on": ends[1], "velocity": velocity}]
    study["time"] = {"scheme": scheme, "step": step, "end": steps * step}
    return with_fracture(study, strength, approach)


def flying_block(speed: float, step: float, steps: int = 40) -> Data:
    """Free block with a high velocity and spin. In short steps round-off of the inertia exceeds the elastic forces."""
    study = base_study("a block flying", BAR, None, steps)
    study["initial"] = {"velocity": [speed, 0.0, 0.0], "spin": [0.0, 0.0, 1.0]}
    study["time"] = {"step": step, "end": steps * step}
    return with_fracture(study, 1e5)


def spinning_block(mesh: Data, *, spin: float, step: float, steps: int, strength: float) -> Data:
    """Free block that spins until it breaks."""
    study = base_study("a block spun to pieces", mesh, None, steps)
    study["initial"] = {"spin": [0.0, 0.0, spin]}
    study["time"] = {"step": step, "end": steps * step}
    return with_fracture(study, strength)


def hanging_body(mesh: Data, material: Data) -> Data:
    """Body along x that hangs from its top side; its weight is known."""
    study = base_study("a body hanging by its weight", mesh, material, 10)
    study["boundary"] = [{"on": "top", "fix": "xyz"}]
    study["load"] = {"gravity": [0.0, 0.0, -9.81]}
    study["probe"] = [{"name": "grip", "on": "top"}]
    study["time"] = {"scheme": "quasi-static", "step": 0.1, "end": 1.0}
    study["output"]["surface"] = True
    return study


def with_fracture(study: Data, strength: float, approach: str = "chi") -> Data:
    """The study with [fracture] and the field that marks cells without load."""
    fields = ["chi"] if approach == "chi" else ["damage"]
    return study | {
        "fracture": {"strength": strength, "approach": approach},
        "output": study["output"] | {"fields": fields},
    }


def base_study(title: str, mesh: Data, material: Data | None, steps: int) -> Data:
    """Study without boundary conditions and time; a frame every quarter of the steps."""
    return {
        "title": title,
        "mesh": dict(mesh),
        "material": RUBBER | (material or {}),
        "output": {"every": max(1, steps // 4), "picture": False},
    }
