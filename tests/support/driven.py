"""What test_extremes compares: extremes on any number of ranks."""

from typing import Any

import numpy as np
from mpi4py import MPI

from fracsim.output.result_checks import InvertedCellMonitor
from fracsim.scene import Scene, build_scene
from fracsim.studies.evidence import stability_studies
from fracsim.study.reader import validate

from .scenes import Walk
from .torn import Found


def stepped(study: dict[str, Any], steps: int) -> tuple[Scene, Any, Any]:
    """The scene, its state and the last report after some steps (collective)."""
    study = study | {"solver": {"snes_rtol": 1e-6, "ksp_rtol": 1e-5}}
    scene = build_scene(MPI.COMM_WORLD, validate(study, "driven"))
    state = Walk(scene)
    for _ in range(steps):
        report = state.advance()
    return scene, state, report


def nearly_incompressible(scheme: str) -> list[float]:
    """(attempts that failed, broken edges, elastic energy in J, energy from nowhere over work) of a bar torn at
    nu = 0.4999.
    """
    study = stability_studies.torn_body(
        stability_studies.BAR,
        speed=1.0,
        step=1e-2,
        steps=12,
        strength=2e5,
        material={"poisson": 0.4999},
        scheme=scheme,
    )
    scene, state, report = stepped(study, 12)
    broken = MPI.COMM_WORLD.allreduce(scene.fracture.graph.broken_count)
    gained = report.kinetic + report.elastic + state.dissipated - state.work
    return [scene.stepper.failures.steps_failed, broken, report.elastic, gained / state.work]


def crushed() -> list[float]:
    """(cells, smallest J, s) that are told of a block mirrored along x."""
    scene, state, _ = stepped(stability_studies.stretched_block(-1.0, steps=1, confined=True), 1)
    watch = InvertedCellMonitor(scene.balance.stress)
    watch.record_frame(state.t)
    return [watch.inverted_count, watch.min_jacobian, watch.first_time]


def flown() -> list[float]:
    """(attempts that failed, kinetic energy in J) of a fast body in short steps."""
    scene, _, report = stepped(stability_studies.flying_block(1e3, 1e-6), 20)
    return [scene.stepper.failures.steps_failed, report.kinetic]


def compared() -> Found:
    """All of them, by name."""
    found = {name: nearly_incompressible(name) for name in ("backward-euler", "generalized-alpha")}
    found |= {"crushed": crushed(), "flown": flown()}
    return {name: np.array(values) for name, values in found.items()}
