"""A trial of the evidence: a study or script, its settings, how it is measured, and its limits."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

Setting = str | float | int | bool


@dataclass(frozen=True)
class Trial:
    """A run of `fracsim run` on a study, or of a script that writes figures.json, in its own folder.

    Attributes:
        group, case, name: place in the report, and the folder OUT/group/case/name.
        study: the whole study as TOML data; None for a script.
        script: arguments after `python -m`, to which `-o FOLDER/figures.json` is added; empty for a study.
        settings: what this trial varies (h, dt, scheme ...): columns of the report's tables.
        measure: "module:function" in fracsim.studies.evidence; "" for none. The function is called with the output
            folder of the run and returns name -> figure. It is called only if the run ended well, or with `always`.
        always: measure the run whatever its outcome (stability).
        ranks: MPI ranks.
        repeats: timed runs, of which medians are taken.
        limit: wall time of each run, s.
        full: run by `make report-full` only.
    """

    group: str
    case: str
    name: str
    study: dict[str, Any] | None = None
    script: tuple[str, ...] = ()
    settings: dict[str, Setting] = field(default_factory=dict)
    measure: str = ""
    always: bool = False
    ranks: int = 1
    repeats: int = 1
    limit: float = 120.0
    full: bool = False
