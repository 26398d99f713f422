"""Studies that come with fracsim: one TOML each."""

from pathlib import Path


def folder() -> Path:
    """Where the study files are, in a checkout and in an installed package."""
    return Path(__file__).parent
