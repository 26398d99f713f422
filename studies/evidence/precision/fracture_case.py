"""Cases of fracture, contact and impact: a problem, its settings, and what is measured against an outside reference.

A case with random meshes is run on several of them: its error is the largest, its time the median.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from statistics import median
from time import process_time
from typing import Any

from ..trial import Setting, Trial
from .case_section import AccuracyCase, measured_errors
from .precision_trials import GROUP, SCRIPTS, Settings, Study

Figures = dict[str, float]
SEEDS = (1, 2, 3)  # of random meshes


@dataclass(frozen=True)
class FractureCase:
    """A problem with an outside reference.

    Attributes:
        name: of the case, in its records and as argument of the script.
        title: title of the section.
        text: problem, reference and its source.
        measure: settings, folder -> figures, among them the errors and `seconds`, the processor time of the steps.
        errors: names of the errors; the first one is the target.
        short: settings that the short report runs.
        full: settings that the full report adds.
        peers: () -> trials of other programs on the same problem.
        split: setting whose values are series of the plots.
        excluded: values of settings that cannot be defaults.
        limit: wall time of a trial, s.
        figures: names of figures that the table shows beside the errors.
    """

    name: str
    title: str
    text: str
    measure: Callable[[Settings, Path], Figures]
    errors: tuple[str, ...]
    short: tuple[Settings, ...]
    full: tuple[Settings, ...] = ()
    peers: Callable[[], list[Trial]] = list
    split: str = "order"
    excluded: tuple[Setting, ...] = ()
    limit: float = 120.0
    figures: tuple[str, ...] = ()

    def trials(self) -> list[Trial]:
        """Trials of all settings, and those of other programs."""
        own = [self._trial(settings, full=False) for settings in self.short]
        return [*own, *(self._trial(settings, full=True) for settings in self.full), *self.peers()]

    def _trial(self, settings: Settings, *, full: bool) -> Trial:
        """Trial of one setting."""
        words = [f"{key}={value}" for key, value in settings.items()]
        script = (f"{SCRIPTS}.fracture_script", self.name, *words)
        name = "-".join(words).replace("=", "-")
        return Trial(GROUP, self.name, name, script=script, settings=settings, limit=self.limit, full=full)

    def accuracy_case(self) -> AccuracyCase:
        """The case as the report shows it."""
        columns = tuple(dict.fromkeys(key for settings in (*self.short, *self.full) for key in settings))
        return AccuracyCase(
            self.name, self.title, lambda records: self.text, columns, measured_errors(*self.errors), self.errors,
            split=self.split, excluded=self.excluded, figures=self.figures,
        )  # fmt: skip


def parse_settings(words: list[str]) -> Settings:
    """Settings from words "key=value"; numbers are read as such."""

    def value(text: str) -> Setting:
        for kind in (int, float):
            try:
                return kind(text)
            except ValueError:
                continue
        return text

    return {key: value(text) for key, _, text in (word.partition("=") for word in words)}


def steps_of(scene: Any, seconds: list[float]) -> Iterator[tuple[Any, Any]]:
    """(state, report) of each step to the end of a scene; the processor time of each is appended to `seconds`."""
    state = scene.start()
    while not scene.ended(state):
        began = process_time()
        state, report = scene.stepper.advance(state)
        seconds.append(process_time() - began)
        yield state, report


def run_in(study: Study, folder: Path) -> tuple[Path, float]:
    """Run a study in a folder; returns that of its output, and the processor time of its steps, s."""
    from mpi4py import MPI

    from ....deformable_run import run_study
    from ....study.reader import validate

    out = folder / "run"
    summary = run_study(MPI.COMM_SELF, validate(study, "trial"), out, overwrite=True)
    return out, float(summary["cpu"])


def worst_of(runs: list[Figures], errors: tuple[str, ...]) -> Figures:
    """Largest errors and medians of all other figures of several runs."""
    return {key: (max if key in errors else median)([figures[key] for figures in runs]) for key in runs[0]}
