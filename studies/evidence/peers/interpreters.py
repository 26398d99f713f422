"""Where other programs are: each has a Python of its own, which an environment variable names."""

from __future__ import annotations

import os
import subprocess


def working_python(variable: str, asked: str) -> str | None:
    """The Python that a variable names, where it gets through what is `asked` of it; None where there is none."""
    given = os.environ.get(variable)
    if not given:
        return None
    try:
        done = subprocess.run([given, "-I", "-c", asked], capture_output=True, timeout=120)
    except (OSError, subprocess.TimeoutExpired):
        return None
    return given if done.returncode == 0 else None
