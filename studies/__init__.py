"""Packaged studies, one TOML file each, and the programs that measure them."""

from pathlib import Path


def folder() -> Path:
    """Folder of the packaged study files, in a checkout and in an installed package."""
    return Path(__file__).parent
