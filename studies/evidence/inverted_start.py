"""A body that starts inverted: python -m fracsim.studies.evidence.inverted_start ENERGY -o figures.json.

No study file can describe this initial state: F = -diag(0.9, 1, 1.1) in every cell, by a displacement about the centre.
Backward Euler then advances the free body, which should recover J = 1 or report a failure.
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from . import stability_studies


def main() -> None:
    """Advance until the end and write the figures."""
    parser = argparse.ArgumentParser()
    parser.add_argument("energy")
    parser.add_argument("-o", dest="out", type=Path)
    given = parser.parse_args()
    from mpi4py import MPI

    from ...errors import NotConverged

    try:
        figures = advance_inverted_body(MPI.COMM_WORLD, given.energy)
    except NotConverged as error:
        if MPI.COMM_WORLD.rank == 0:
            print(f"fracsim: {error}", file=sys.stderr)
        sys.exit(int(error.exit_code))
    if MPI.COMM_WORLD.rank == 0:
        given.out.write_text(json.dumps(figures) + "\n")


def advance_inverted_body(comm: Any, energy: str, steps: int = 400) -> dict[str, Any]:
    """Figures of the run; the smallest J is taken at the end and should be 1 (collective)."""
    from ...mesh.parallel import sum_over_ranks
    from ...output.result_checks import InvertedCellMonitor
    from ...scene import build_scene
    from ...study.reader import validate

    study = stability_studies.base_study("inside out", stability_studies.BAR, {"energy": energy}, steps)
    study["damping"] = {"mass": 5.0}
    study["time"] = {"scheme": "backward-euler", "step": 0.01, "end": steps * 0.01}  # it has to come to rest
    scene = build_scene(comm, validate(study, "inverted"))
    domain, stepper = scene.domain, scene.stepper
    middle = (domain.bounds.lower + domain.bounds.upper) / 2
    u = (-np.array([1.9, 2.0, 2.1]) * (domain.nodes[: domain.node_count] - middle)).reshape(-1)
    state = stepper.with_forces(replace(scene.start(), u=u))
    energies, newton = [sum_over_ranks(comm, scene.balance.stress.stored_energy())[0]], []
    while state.t < study["time"]["end"] * (1 - 1e-12):
        state, report = stepper.advance(state)
        energies.append(report.elastic + report.kinetic)
        newton.append(report.solve.newton_iterations)
    watch = InvertedCellMonitor(scene.balance.stress)
    watch.record_frame(state.t)
    if comm.rank == 0 and (note := watch.note(energy)):
        print(f"fracsim: note: {note}", file=sys.stderr)
    return {
        "finite": bool(np.isfinite(energies).all()), "smallest_J": watch.min_jacobian,
        "error": abs(watch.min_jacobian - 1),
        "steps": state.step, "newton_max": max(newton), "newton_mean": float(np.mean(newton)),
        "growth": float(np.max(np.diff(energies)).clip(0) / energies[0]) if energies[0] else 0.0,
        "halved": stepper.failures.steps_failed,
    }  # fmt: skip


if __name__ == "__main__":
    main()
