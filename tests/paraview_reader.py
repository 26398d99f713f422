"""What ParaView shows of a file: pvpython paraview_reader.py FILE READER TIME FILTERS TARGET.json

READER is the name of a reader in paraview.simple, "OpenDataFile" for the one that ParaView takes by itself. FILTERS is
JSON: a list of filters by their names, and their properties, from the reader on. The target has the times, the blocks,
the number of cells, and of every array its components by the names that ParaView's menus show, with their ranges.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

# where `make paraview` puts it: beside the venvs, made once for all of them
HOME = Path(os.environ.get("FRACSIM_PARAVIEW", Path(sys.prefix).parent / "paraview"))


def pvpython(*arguments: str | Path) -> subprocess.CompletedProcess[str]:
    """Run ParaView's Python off-screen: of `make paraview`, or the one in PATH. FileNotFoundError: none."""
    program, env = "pvpython", dict(os.environ)
    if (HOME / "ready").exists():
        program = str(HOME / "usr/bin/pvpython")
        libraries = [*sorted(map(str, (HOME / "usr/lib").glob("*-linux-gnu"))), str(HOME / "usr/lib")]
        env |= {"LD_LIBRARY_PATH": ":".join(libraries), "PYTHONPATH": str(HOME / "usr/lib/python3/dist-packages")}
    command = [program, "--force-offscreen-rendering", *map(str, arguments)]
    return subprocess.run(command, env=env, capture_output=True, text=True, timeout=120, check=False)


def arrays(source: Any) -> dict[str, dict[str, dict[str, tuple[float, float]]]]:
    """Of points and cells: name -> component as shown -> range; "" of an array of one component."""
    found: dict[str, dict[str, dict[str, tuple[float, float]]]] = {}
    for centre, data in (("Node", source.PointData), ("Cell", source.CellData)):
        found[centre] = {}
        for array in data.values():
            count = array.GetNumberOfComponents()
            ranges = {array.GetComponentName(i): array.GetRange(i) for i in range(count)}
            found[centre][array.Name] = ranges if count > 1 else {"": array.GetRange(0)}
    return found


def blocks(source: Any) -> list[str]:
    """Names of the blocks of a data set that has some."""
    if (hierarchy := source.GetDataInformation().GetHierarchy()) is None:
        return []
    root = hierarchy.GetRootNode()
    return [hierarchy.GetNodeName(child) for child in hierarchy.GetChildNodes(root, False)]


def main(file: str, reader: str, time: str, filters: str, target: str) -> None:
    """Read `file` at one of its times (s; -1: its last) and apply `filters`."""
    from paraview import simple

    if reader == "OpenDataFile":
        source = simple.OpenDataFile(file)
    else:
        key = "FileNames" if reader == "XDMFReader" else "FileName"
        source = getattr(simple, reader)(**{key: [file]})
    source.UpdatePipelineInformation()
    given = source.TimestepValues
    times = [given] if isinstance(given, float) else list(given)  # of one time ParaView makes a number
    t, last = times[-1] if float(time) < 0 else float(time), source
    for name, properties in json.loads(filters):
        last = getattr(simple, name)(Input=last)
        for key, value in properties.items():
            setattr(last, key, value)
    last.UpdatePipeline(t)
    about = last.GetDataInformation()
    found = {"times": times, "kind": about.GetDataSetTypeAsString(), "cells": about.GetNumberOfCells()}
    Path(target).write_text(json.dumps(found | {"blocks": blocks(source), "arrays": arrays(last)}))


if __name__ == "__main__":
    main(*sys.argv[1:])
