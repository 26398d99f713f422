"""Error of the non-local average of a known field against its integral.

    python -m fracsim.studies.evidence.precision.averaging_error --parts 8 -o figures.json

s = (x/R)^2 + y/R on a unit square of unstructured triangles of size R / parts. Over a disk of radius R its average is s
+ <q^2>/2 (closed_forms.kernel_moment). Cells nearer than R to the boundary are excluded.
"""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path
from typing import Any

from ..closed_forms import kernel_moment
from ..trial import Trial
from .case_section import AccuracyCase, ExpectedOrder, Records, measured_errors
from .precision_trials import script_trial

RADIUS = 0.2  # m, of a unit square
CELLS_PER_RADIUS = (2, 3, 4, 6, 8, 12, 16)
KERNELS = ("linear", "constant", "gaussian")


def trials() -> list[Trial]:
    """Trials over h / R, with all kernels."""
    return [
        script_trial(
            "average",
            f"parts-{parts}",
            "averaging_error",
            {"parts": parts},
            {"h": RADIUS / parts},
            full=parts == CELLS_PER_RADIUS[-1],
        )
        for parts in CELLS_PER_RADIUS
    ]


def measure(parts: int) -> dict[str, float]:
    """Relative root mean square error of each kernel, and seconds to build and to apply the average."""
    import numpy as np
    from mpi4py import MPI

    from ....fracture.nonlocal_average import NonlocalAverage
    from ....mesh.domain import distribute
    from ....meshes import BUILDERS

    maker: Any = BUILDERS["box"]
    domain = distribute(MPI.COMM_SELF, maker(size=(1.0, 1.0), h=RADIUS / parts, pattern="unstructured").build())
    centroids = domain.nodes[domain.cell_nodes].mean(axis=1)
    values = (centroids[:, 0] / RADIUS) ** 2 + centroids[:, 1] / RADIUS
    inside = np.all((centroids > RADIUS) & (centroids < 1 - RADIUS), axis=1)
    figures = {}
    for kernel in KERNELS:
        began = time.perf_counter()
        average = NonlocalAverage(domain, RADIUS, kernel)
        built = time.perf_counter()
        results = average(values[:, None])[inside, 0]
        exact = values[inside] + kernel_moment(kernel) / 2
        figures[kernel] = float(np.linalg.norm(results - exact) / np.linalg.norm(exact))
        figures[f"{kernel} to build s"] = built - began
        figures[f"{kernel} to use s"] = time.perf_counter() - built
    return figures | {"seconds": figures["linear to build s"] + figures["linear to use s"], "cells": len(values)}


def _text(records: Records) -> str:
    """Text of the section."""
    return (
        "Root mean square error over the cells that have a whole disk of radius R = 0.2 m. The average is a sum over "
        "centroids weighted with volumes, of second order at least where the kernel is continuous, as the hat (the "
        "default) is; the h^2 term is an integral of the Laplacian of what is summed, and vanishes with the kernel at "
        "R: the order may be 3. The constant kernel ends in a jump, and so, by 1 %, does the Gaussian: cells on the "
        "circle count wholly or not at all, and the scatter of R / h of them, each h^2 off, has order 1.5."
    )


def main() -> None:
    """Measure one mesh and write the figures."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--parts", type=int, required=True, help="R / h")
    parser.add_argument("-o", type=Path, default=Path("figures.json"))
    given = parser.parse_args()
    given.o.write_text(json.dumps(measure(given.parts)) + "\n")


NAMES = tuple(f"parts-{parts}" for parts in CELLS_PER_RADIUS[1:])
CASES = [
    AccuracyCase("average", "Non-local average", _text, ("h",), measured_errors(*KERNELS), KERNELS,
         (ExpectedOrder("linear", "h", 2.0, NAMES, "hat kernel, error of", least=True),
          ExpectedOrder("constant", "h", 1.5, NAMES, "kernel", least=True),
          ExpectedOrder("gaussian", "h", 1.5, NAMES, "kernel", least=True))),
]  # fmt: skip

if __name__ == "__main__":
    main()
