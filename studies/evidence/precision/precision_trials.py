"""Trials and settings that the cases of the group share."""

from __future__ import annotations

from typing import Any

from ..peers.akantu import akantu_python
from ..trial import Setting, Trial

GROUP = "precision"
MINIMAL_OUTPUT: dict[str, Any] = {
    "every": 1_000_000,
    "fields": [],
    "picture": False,
    "precision": "double",
}  # only the first and the last frame, with all digits
SCRIPTS = "fracsim.studies.evidence.precision"
TIGHT_TOLERANCES: dict[str, Any] = {"snes_rtol": 1e-10, "ksp_rtol": 1e-8}  # leaves the error of h and dt alone

Study = dict[str, Any]
Settings = dict[str, Setting]


def study_trial(case: str, name: str, study: Study, measure: str, settings: Settings, **more: Any) -> Trial:
    """Trial of a study; `measure` is a function of this group as "module:function"."""
    return Trial(GROUP, case, name, study=study, settings=settings, measure=f"precision.{measure}", **more)


def script_trial(
    case: str, name: str, module: str, arguments: dict[str, Any], settings: Settings, **more: Any
) -> Trial:
    """Trial of a script of this group that writes figures.json; `arguments` as --key value."""
    words = [str(word) for key, value in arguments.items() for word in (f"--{key}", value)]
    return Trial(GROUP, case, name, script=(f"{SCRIPTS}.{module}", *words), settings=settings, **more)


def akantu_trials(case: str, h: float, order: int, full: bool = False) -> list[Trial]:
    """Trial of a static case solved by Akantu on the same mesh; empty if Akantu is not installed."""
    if akantu_python() is None:
        return []
    words = ("fracsim.studies.evidence.peers.akantu_statics", "--case", case, "--h", str(h), "--order", str(order))
    settings: Settings = {"h": h, "order": order, "elements": "Akantu"}
    return [Trial(GROUP, case, f"akantu-order-{order}-h-{h:g}", script=words, settings=settings, full=full)]
