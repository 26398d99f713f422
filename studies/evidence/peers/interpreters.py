"""Pythons of other programs, each named by an environment variable."""

from __future__ import annotations

import os
import subprocess


def working_python(variable: str, asked: str) -> str | None:
    """Python that a variable names, if it runs the code `asked` without error; else None."""
    given = os.environ.get(variable)
    if not given:
        return None
    try:
        done = subprocess.run([given, "-I", "-c", asked], capture_output=True, timeout=120)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return given if done.returncode == 0 else None
