"""Ways to damage a file, as lost power, full disks and failing ones do."""

from __future__ import annotations

import os
from pathlib import Path

DAMAGES = ("empty", "one byte", "header", "half", "last byte", "garbage", "flipped")


def damage(path: Path, kind: str) -> None:
    """Put a damaged file in the place of a whole one, which stays as it is for those that have it open."""
    whole = path.read_bytes()
    middle = len(whole) // 2
    damaged = {
        "empty": b"",
        "one byte": whole[:1],
        "header": whole[:64],
        "half": whole[:middle],
        "last byte": whole[:-1],
        "garbage": bytes(range(256)) * (len(whole) // 256 + 1),
        "flipped": whole[:middle] + bytes([whole[middle] ^ 0xFF]) + whole[middle + 1 :],
    }[kind]
    fresh = path.with_name(path.name + ".fresh")
    fresh.write_bytes(damaged)
    fresh.chmod(path.stat().st_mode & 0o777)
    os.replace(fresh, path)
