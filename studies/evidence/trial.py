"""One trial: a study with its settings, how it is measured, and what it may take."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

Setting = str | float | int | bool


@dataclass(frozen=True)
class Trial:
    """A run of `fracsim run` on a study, or of a script that writes figures.json, in a folder of its own.

    Attributes:
        group, case, name: place in the report, and the folder OUT/group/case/name.
        study: the whole study as TOML data; None for a script.
        script: arguments after `python -m`, to which `-o FOLDER/figures.json` is added; empty for a study.
        settings: what this trial varies (h, dt, scheme ...): columns of the report's tables.
        measure: "module:function" in fracsim.studies.evidence, called with the output folder of the run and returning
            name -> figure; "" for none. Only called where the run ended well, unless `always`.
        always: the run may end in any way (stability), and is measured all the same.
        ranks: MPI ranks.    repeats: timed runs, of which medians are taken.    limit: s of wall time for each.
        full: left to `make report-full`.
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
