"""Runs that go on after they were ended, and what they are compared with."""

from __future__ import annotations

import json
from pathlib import Path

from .corpus import RUNS, differences, write
from .trial import expect, run, words

_WHOLE: dict[str, Path] = {}


def prepare(folder: Path) -> None:
    """All runs without interruption, on one rank and on two."""
    for name, data in RUNS.items():
        for ranks in (1, 2):
            place = folder / "whole" / f"{name}-{ranks}"
            _WHOLE[place.name] = place / "out"
            if not (place / "out" / "summary.json").exists():
                place.mkdir(parents=True, exist_ok=True)
                study = write(place / "study.toml", data)
                run(words("run", study, "-o", place / "out", "--overwrite", ranks=ranks), place, "said").expect(0)


def whole(name: str, ranks: int) -> Path:
    """The folder of a run that was not interrupted."""
    return _WHOLE[f"{name}-{ranks}"]


def outcome(out: Path) -> str:
    """What summary.json says of a run; "" where there is none, which is so while a run is on its way."""
    path = out / "summary.json"
    return str(json.loads(path.read_text())["outcome"]) if path.exists() else ""


def go_on(study: Path, out: Path, ranks: int, place: Path) -> str:
    """Go on from the last checkpoint, or begin where there is none; returns which of them."""
    from_there = (out / "checkpoint" / "state.h5").exists()
    how = ["--restart"] if from_there else []
    run(words("run", study, "-o", out, *how, ranks=ranks), place, "resumed").expect(0)
    return "went on" if from_there else "began again"


def expect_whole(name: str, ranks: int, out: Path) -> None:
    """Wrong where a run is not what it would have been without interruption, or left what it did not finish."""
    wrong = differences(out, whole(name, ranks))
    expect(not wrong, f"{name} on {ranks} ranks is another run: {'; '.join(wrong[:8])}")
    left = [path.name for path in out.rglob("*") if path.name.endswith((".new", ".tmp"))]
    expect(not left, f"left behind: {left}")
    expect(outcome(out) == "done", f"outcome {outcome(out)!r}")
