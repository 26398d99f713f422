"""Read a fields.xdmf with VTK's own reader, as ParaView does: python xdmf_reader.py FILE.xdmf FILE.npz

A process of its own: Debian's VTK is built without the reader, PyPI's has it, and the two must not meet in one process.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path
from typing import Any

import numpy as np

# where `make readers` puts it: beside the venvs, made once for all of one Python
_FOLDER = Path(sys.prefix).parent / f"vtk-reader-{sys.implementation.cache_tag}"
READERS = Path(os.environ.get("FRACSIM_READERS", _FOLDER))
NO_READER = 77


def main(source: str, target: str) -> None:
    """Every time, field and warped point of the file as arrays: times, <index>/<centre>/<name>, <index>/warped; of
    symmetric tensors of cells <index>/principal/<name>, too."""
    from vtkmodules.vtkCommonExecutionModel import vtkStreamingDemandDrivenPipeline
    from vtkmodules.vtkIOXdmf2 import vtkXdmfReader

    reader = vtkXdmfReader()
    reader.SetFileName(source)
    reader.UpdateInformation()
    times = reader.GetOutputInformation(0).Get(vtkStreamingDemandDrivenPipeline.TIME_STEPS())
    found = {"times": np.array(times)}
    for index, t in enumerate(times):
        reader.UpdateTimeStep(t)
        found |= {f"{index}/{key}": value for key, value in fields(reader.GetOutputDataObject(0)).items()}
    np.savez(target, **found)  # type: ignore[arg-type]


def fields(grid: Any) -> dict[str, Any]:
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersGeneral import vtkWarpVector

    assert grid.GetClassName() == "vtkUnstructuredGrid"  # one grid, no blocks
    found = {"points": vtk_to_numpy(grid.GetPoints().GetData()), "cells": np.array(grid.GetNumberOfCells())}
    found["kinds"] = np.array([grid.GetCellType(k) for k in range(grid.GetNumberOfCells())])
    for centre, data in (("Node", grid.GetPointData()), ("Cell", grid.GetCellData())):
        for k in range(data.GetNumberOfArrays()):
            found[f"{centre}/{data.GetArrayName(k)}"] = vtk_to_numpy(data.GetArray(k))
    data = grid.GetCellData()
    arrays = [data.GetArray(k) for k in range(data.GetNumberOfArrays())]
    tensors = [array.GetName() for array in arrays if array.GetNumberOfComponents() == 6]
    found |= {f"principal/{name}": principal_values(grid, name) for name in tensors}
    warp = vtkWarpVector()
    warp.SetInputData(grid)
    warp.SetInputArrayToProcess(0, 0, 0, 0, "displacement")  # array 0 of input 0, on points
    warp.Update()
    return found | {"warped": vtk_to_numpy(warp.GetOutput().GetPoints().GetData())}


def principal_values(grid: Any, name: str) -> Any:
    """(cells, 3) principal values of a symmetric tensor of cells, the least first, by VTK's own filter: it takes six
    columns in VTK's order."""
    from vtkmodules.util.numpy_support import vtk_to_numpy
    from vtkmodules.vtkFiltersTensor import vtkTensorPrincipalInvariants

    invariants = vtkTensorPrincipalInvariants()
    invariants.SetInputData(grid)
    invariants.GetCellDataArraySelection().EnableArray(name)
    invariants.Update()
    data = invariants.GetOutput().GetCellData()
    return np.sort(np.column_stack([vtk_to_numpy(data.GetArray(f"{name} - Sigma {k}")) for k in (1, 2, 3)]))


if __name__ == "__main__":
    if READERS.is_dir():
        sys.path.insert(0, str(READERS))
    try:
        import vtkmodules.vtkIOXdmf2  # noqa: F401
    except ImportError:
        sys.exit(NO_READER)
    main(*sys.argv[1:])
