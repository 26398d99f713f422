"""Cost of face-to-face and edge-to-edge self-contact.

    python -m fracsim.studies.evidence.self_contact_cost KIND [--n 8] -o figures.json

Two cubes with different meshes are pressed together, face to face or edge to edge (turned by 45 degrees, with crossing
edges). The numbers of contact pairs differ, so that the cost is given by step and by pair operation. Parallel faces are
the hardest case of continuous collision detection (docs/theory.md#step-limits).
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np

from . import stability_studies
from .report_section import Claim, ReportTable, Section
from .trial import Trial

CONTACT_KINDS = ("flat", "edge")
REPEATS, CONTACT_STEPS = 7, 48  # the first dozen, at impact, cost most with faces and least with edges
MAX_RATIO = 1.25  # of processor times; allows for noise and caches
PAIR_OPERATIONS = ("detection, short way", "detection, long way", "energy", "gradient", "hessian")
COS_45 = np.sqrt(0.5)


def trials() -> list[Trial]:
    """One trial of each kind of contact."""
    script = "fracsim.studies.evidence.self_contact_cost"
    return [
        Trial("ladder", "faces", kind, script=(script, kind), settings={"of": kind}, limit=180.0)
        for kind in CONTACT_KINDS
    ]


def two_cubes(kind: str, n: int, gap: float) -> Any:
    """Mesh of two cubes of side 1 m with n and n + 1 cells along it, the upper one `gap` (m) above the lower."""
    from ...meshes.builders.box import Box
    from ...meshes.data import MeshData

    lower, upper = (Box(size=(1.0,) * 3, h=1 / count, origin=(-0.5,) * 3).build() for count in (n, n + 1))
    rise, aside = 1.0 + gap, np.array([0.013, 0.017, 0.0])
    x, y = lower.points, upper.points
    if kind == "edge":
        x, y = x @ np.array([[1, 0, 0], [0, COS_45, COS_45], [0, -COS_45, COS_45]]), y @ _TURNED_ABOUT_Y
        rise = float(np.sqrt(2)) + gap
    points = np.concatenate([x, y + aside + [0.0, 0.0, rise]])
    return MeshData(points, np.concatenate([lower.cells, upper.cells + len(x)]))


_TURNED_ABOUT_Y = np.array([[COS_45, 0, COS_45], [0, 1, 0], [-COS_45, 0, COS_45]])


def pressed_cubes(kind: str, n: int) -> dict[str, Any]:
    """Study of the upper cube pressed on the lower by a large gravity. Initial gap: the barrier's distance."""
    study = stability_studies.base_study(kind, {"file": "mesh.msh"}, None, 1000)
    study["boundary"] = [{"on": {"box": [[-2.0, -2.0, -2.0], [2.0, 2.0, -0.3]]}, "fix": "xyz"}]
    study["load"] = {"gravity": [0.0, 0.0, -50.0]}
    study["contact"] = {"distance": 0.03 / n}
    study["time"] = {"scheme": "backward-euler", "step": 2e-3, "end": 1.0}
    return study


def measure(kind: str, n: int) -> dict[str, Any]:
    """Mean processor time of a step in contact, and median times of the pair operations at the end, s."""
    from mpi4py import MPI

    from ...deformable_run import Run
    from ...meshes.write import write_mesh
    from ...scene import build_scene
    from ...study.reader import validate

    with tempfile.TemporaryDirectory() as folder:
        write_mesh(two_cubes(kind, n, 0.033 / n), Path(folder, "mesh.msh"))
        study = pressed_cubes(kind, n) | {"mesh": {"file": str(Path(folder, "mesh.msh"))}}
        run = Run(build_scene(MPI.COMM_WORLD, validate(study, kind)), Path(folder, "run"))
        contact: Any = next(term for term in run.scene.balance.terms if term.name == "contact")
        steps = _time_contact_steps(run, contact)
        figures = time_pair_operations(contact.surface.current, contact.end_positions())
    seconds, newton = zip(*steps, strict=True)
    own = {"triangles": 12 * (n**2 + (n + 1) ** 2), "newton": float(np.mean(newton)), "step": float(np.mean(seconds))}
    return own | figures


def _time_contact_steps(run: Any, contact: Any) -> list[tuple[float, int]]:
    """Processor time (s) and Newton iterations of the first CONTACT_STEPS steps that end in contact."""
    results: list[tuple[float, int]] = []
    while len(results) < CONTACT_STEPS:
        began = time.process_time()
        run.step()
        if contact.stored_energy() > 0:
            results.append((time.process_time() - began, run.scene.stepper.solver.snes.its))
    return results


def time_pair_operations(surface: Any, x: Any) -> dict[str, Any]:
    """Median processor time of each pair operation, s, at positions x (n, d); long displacement: half the body."""
    (part,) = surface.parts
    pairs = part.pairs
    upper = (x[:, 2] > np.median(x[:, 2]))[:, None]
    short, long = (x - upper * np.array([0.0, 0.0, distance]) for distance in (1e-5, 0.5))
    away = x + 1e-12 * np.arange(x.size).reshape(x.shape)  # a change of position avoids cached pairs
    operations: dict[str, Callable[[int], Any]] = {
        "detection, short way": lambda k: pairs.free_fraction(x, short),
        "detection, long way": lambda k: pairs.free_fraction(x, long),
        "energy": lambda k: pairs.energy(away if k % 2 else x),
        "gradient": lambda k: pairs.gradient(away if k % 2 else x),
        "hessian": lambda k: pairs.hessian(away if k % 2 else x),
    }
    touching = sum(len(of_kind) for _, of_kind in pairs._active_pairs(x).of_kinds)
    return {"touching": touching} | {
        name: median(map(_timer(work), range(REPEATS))) for name, work in operations.items()
    }


def _timer(work: Callable[[int], Any]) -> Callable[[int], float]:
    """Function that returns the processor time of `work(number)`."""

    def once(number: int) -> float:
        began = time.process_time()
        work(number)
        return time.process_time() - began

    return once


def section(records: list[dict[str, Any]]) -> Section:
    """Section with both kinds side by side, and the claim on their ratio."""
    times = tuple(f"{name}, ms" for name in PAIR_OPERATIONS)
    counts = ("triangles", "active pairs", "Newton a step", "s a step")
    columns = ("scene", *counts, *times, "outcome")
    text = (
        "Processor time: for steps the mean from first contact to rest, else medians. Face contact has a hundred "
        "times as "
        "many active pairs, whose barriers are summed. Continuous collision detection tests all near pairs; parallel "
        "faces are its hardest case. In the first dozen steps, at impact, faces take 1.8 times as long as edges."
    )
    table = ReportTable("faces", "Costs", columns, tuple(map(_row, records)))
    title = "Contact: face to face, and edge to edge"
    return Section(title, text, _claims({record["name"]: record["figures"] for record in records}), (table,))


def _row(record: dict[str, Any]) -> tuple[Any, ...]:
    """Row of the table."""
    figures = record["figures"]
    milliseconds = (1e3 * figures[of_pair] if of_pair in figures else None for of_pair in PAIR_OPERATIONS)
    outcome = record["outcome"] if record["outcome"] == "done" else f"{record['outcome']}: {record['message']}"
    counts = (figures.get(key) for key in ("triangles", "touching", "newton", "step"))
    return record["name"], *counts, *milliseconds, outcome


def _claims(figures: dict[str, Any]) -> tuple[Claim, ...]:
    """Claim on the ratio of step times; empty if a kind is missing."""
    if not all(figures.get(kind) for kind in CONTACT_KINDS):
        return ()
    flat, edge = (figures[kind] for kind in CONTACT_KINDS)
    ratios = {name: flat[name] / edge[name] for name in ("step", *PAIR_OPERATIONS[:2])}
    measured = ", ".join(f"{name} {ratio:.2f}" for name, ratio in ratios.items())
    text = f"A step of face contact costs no more than one of edge contact (within {MAX_RATIO - 1:.0%})"
    return (Claim(text, measured, ratios["step"] <= MAX_RATIO),)


def main() -> None:
    """Measure and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("kind", choices=CONTACT_KINDS)
    parser.add_argument("--n", type=int, default=8)
    parser.add_argument("-o", dest="out", type=Path, required=True)
    given = parser.parse_args()
    given.out.write_text(json.dumps(measure(given.kind, given.n), indent=1) + "\n")


if __name__ == "__main__":
    main()
