"""Sweeps: a study run once for each combination of values, each run in processes and a folder of its own."""

from __future__ import annotations

import csv
import hashlib
import itertools
import json
import os
import re
import shlex
import signal
import subprocess
import time
import tomllib
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ..errors import REPEATED_SIGNAL_INTERVAL, STOP_SIGNALS, Exit, InputError, NotConverged, Stopped, one_line
from ..meshes.plain_files import create, replacing_all
from ..output.file_ownership import check_ownership, has_resumable_run
from ..output.lock import FolderLock, describe_lock_holder
from ..study.check import check_study
from ..study.reader import load_study, study_text
from .exit_status import MESSAGE_PREFIX, OUTCOMES, read_last_message

MAX_FOLDER_NAME = 100


@dataclass(frozen=True)
class SweepCase:
    """One combination: its values as texts by key, and its folder."""

    values: dict[str, str]
    folder: Path

    @property
    def overrides(self) -> list[str]:
        return [f"{key}={value}" for key, value in self.values.items()]


def run_sweep(
    study: str, path: Path, sets: list[str], out: Path, *, ranks: int, only_list: bool, overwrite: bool = False
) -> None:
    """Run what has not ended well yet, one run after the other; or print the commands. Raises NotConverged at the end
    where a run failed. `study` is what the user called it, `path` where it is; `overwrite`: runs of another study that
    have not ended may be thrown away."""
    if not only_list:
        _refuse_mpirun()
    cases = sweep_cases(sets, out)
    studies = [_validated(path, case) for case in cases]
    for case, text in zip(cases, studies, strict=True):
        _check_folder(case, text, path, overwrite)
    if only_list:
        for case, text in zip(cases, studies, strict=True):
            print(shlex.join(_listed(study, case, text, ranks, overwrite=overwrite)))
        return
    with FolderLock(out) as lock:
        lock.acquire(make=True)
        outcomes = _run_all(study, list(zip(cases, studies, strict=True)), out, ranks)
    failed = [f"{name} ({outcome})" for name, outcome in outcomes.items() if not outcome.startswith("done")]
    print(f"settings and figures of all runs: {out / 'sweep.csv'}")
    if failed:
        raise NotConverged(f"{len(failed)} of {len(cases)} runs did not end well: {'; '.join(failed)}")


def _run_all(study: str, cases: list[tuple[SweepCase, str]], out: Path, ranks: int) -> dict[str, str]:
    """Outcomes in words of all cases, each with its study as text, by their names. Raises Stopped."""
    outcomes: dict[str, str] = {}
    for number, (case, text) in enumerate(cases, 1):
        print(f"[{number}/{len(cases)}] {case.folder.name}: ", end="", flush=True)
        outcomes[case.folder.name] = outcome = _run(study, case, text, ranks)
        print(one_line(outcome), flush=True)
        write_sweep_table([each for each, _ in cases], outcomes, out)
        if outcome.startswith("interrupted"):
            raise Stopped(f"interrupted after {number - 1} of {len(cases)} runs; the same command goes on")
    return outcomes


# --- combinations ---------------------------------------------------------------------------------------------------


def sweep_cases(sets: list[str], out: Path) -> list[SweepCase]:
    """All combinations of the values given, the last key changing fastest. InputError where one comes up twice."""
    values: dict[str, list[str]] = {}
    for text in sets:
        key, equals, rest = text.partition("=")
        key = key.strip()
        if not equals or not key:
            raise InputError(f"--set {text}: write key=a,b,c, for example --set mesh.h=0.02,0.01")
        if key in values:
            raise InputError(f"--set {text}: {key} is given twice; put all its values in one list")
        values[key] = [part.strip() for part in split_values(rest)]
        if "" in values[key]:
            raise InputError(f"--set {text}: there is an empty value in the list")
        if repeated := {value for value in values[key] if values[key].count(value) > 1}:
            raise InputError(f"--set {text}: {min(repeated)} comes up twice")
    if not values:
        raise InputError("a sweep needs values to vary: --set mesh.h=0.02,0.01 --set time.step=1e-3,5e-4")
    short = short_keys(list(values))
    chosen = [dict(zip(values, combination, strict=True)) for combination in itertools.product(*values.values())]
    return [
        SweepCase(case, out / case_folder_name({short[key]: value for key, value in case.items()})) for case in chosen
    ]


def split_values(text: str) -> list[str]:
    """Parts between the commas that are not inside brackets, braces or quotes."""
    parts, depth, quote = [""], 0, ""
    for character in text:
        if quote:
            quote = "" if character == quote else quote
        elif character in "\"'":
            quote = character
        else:
            depth += (character in "[{(") - (character in "]})")
        if character == "," and not depth and not quote:
            parts.append("")
        else:
            parts[-1] += character
    return parts


def short_keys(keys: list[str]) -> dict[str, str]:
    """The last part of each key where that tells them apart, else the whole key."""
    last = [key.rpartition(".")[2] for key in keys]
    return {
        key: end if last.count(end) == 1 and not end.isdigit() else key for key, end in zip(keys, last, strict=True)
    }


def case_folder_name(values: dict[str, str]) -> str:
    """A folder name that can be read: h-0.02_scheme-newmark. A few digits of a hash where characters had to go."""
    whole = "_".join(f"{key}-{value}" for key, value in values.items())
    safe = "_".join(f"{key}-{_plain(value)}" for key, value in values.items())
    if safe == whole and len(safe) <= MAX_FOLDER_NAME:
        return safe
    return f"{safe[:MAX_FOLDER_NAME]}-{hashlib.sha256(whole.encode()).hexdigest()[:6]}"


def _plain(value: str) -> str:
    """A value in characters that no file system or shell minds; a leading minus stays."""
    if re.fullmatch(r"-?[A-Za-z0-9][A-Za-z0-9.+-]*", value):
        return value
    return re.sub(r"[^A-Za-z0-9.+]+", "-", value).strip("-.")


def _validated(path: Path, case: SweepCase) -> str:
    """The study of a case as its run would write it. InputError, with the combination, where it cannot be run."""
    try:
        study = load_study(path, case.overrides)
        check_study(study)
    except InputError as error:
        raise InputError(f"{case.folder.name}: {error}. Nothing was run") from None
    return study_text(study)


def _check_folder(case: SweepCase, study: str, path: Path, overwrite: bool) -> None:
    """InputError where a run would meet, or its log replace, what a sweep of this study has not written."""
    check_ownership(case.folder, [path])
    if _state(case, study) == "new" and has_resumable_run(case.folder) and not overwrite:
        raise InputError(
            f"--out {case.folder}: a run of another study that has not ended left a checkpoint there; throw it away "
            "with --overwrite, or give another folder. Nothing was run"
        )


def _refuse_mpirun() -> None:
    """InputError where this process is one of several; one alone may have the variables of a launcher, as in a shell
    that srun has started."""
    sizes = ["OMPI_COMM_WORLD_SIZE", "PMI_SIZE", *(["SLURM_STEP_NUM_TASKS"] if "PMIX_RANK" in os.environ else [])]
    if any(os.environ.get(name, "1") != "1" for name in sizes) or os.environ.get("PMIX_RANK", "0") != "0":
        raise InputError("a sweep starts its runs itself: call it without mpirun and say how many ranks with --ranks")


# --- one run --------------------------------------------------------------------------------------------------------


def run_command(study: str, case: SweepCase, ranks: int, how: str = "") -> list[str]:
    """What runs one case; `how`: "restart", "overwrite" or ""."""
    work = ["fracsim", "run", study]
    for override in case.overrides:
        work += ["--set", override]
    work += ["-o", str(case.folder), *([f"--{how}"] if how else [])]
    return work if ranks == 1 else ["mpirun", "-n", str(ranks), *work]


def _listed(study: str, case: SweepCase, text: str, ranks: int, *, overwrite: bool) -> list[str]:
    """The line of a case for a job array. A case that is done has one that does nothing: numbers of lines stay."""
    state = _state(case, text)
    if state == "done":
        return ["true", f"{case.folder}: done before"]
    return run_command(study, case, ranks, "restart" if state == "begun" else "overwrite" if overwrite else "")


def _environment() -> dict[str, str]:
    """The environment of a run, without the variables by which a launcher tells this process which rank it is."""
    heads = ("PMI_", "PMIX_", "OMPI_COMM_WORLD_")
    return {name: value for name, value in os.environ.items() if not name.startswith(heads)}


def _state(case: SweepCase, study: str) -> str:
    """ "done", "begun" (there is a checkpoint) or "new"; what is there of another study counts for nothing."""
    try:
        if tomllib.loads((case.folder / "study.toml").read_text(encoding="utf-8")) != tomllib.loads(study):
            return "new"
    except (OSError, ValueError):
        return "new"
    if _summary(case).get("outcome") == "done":
        return "done"
    return "begun" if (case.folder / "checkpoint" / "state.h5").is_file() else "new"


def _summary(case: SweepCase) -> dict[str, Any]:
    """summary.json of a case, empty where there is none."""
    try:
        return dict(json.loads((case.folder / "summary.json").read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}


def _run(study: str, case: SweepCase, text: str, ranks: int) -> str:
    """The outcome in words, with the reason where it failed."""
    state = _state(case, text)
    if state == "done":
        return "done before"
    if (words := describe_lock_holder(case.folder)) is not None:  # of a job array, or of a sweep that was killed
        return f"refused: a run is going on there ({words})"
    try:
        case.folder.mkdir(parents=True, exist_ok=True)
        (case.folder / "summary.json").unlink(missing_ok=True)  # of an earlier run: it would be taken for this one's
    except OSError as error:
        raise InputError(f"--out {case.folder.parent}: cannot write there: {error.strerror}") from None
    # what is there may be overwritten: _check_folder has looked
    log, work = case.folder / "log.txt", run_command(study, case, ranks, "restart" if state == "begun" else "overwrite")
    create(log).close()
    with log.open("w", encoding="utf-8") as file, _Forwarding() as forwarding:
        # in a session of its own: Ctrl-C would reach it beside the signal passed on, and mpirun kills its ranks at once
        process = subprocess.Popen(work, stdout=file, stderr=file, start_new_session=True, env=_environment())
        code = forwarding.wait_for(process)
    if forwarding.asked is not None:
        return "interrupted"
    outcome = OUTCOMES.get(code, f"failed with exit code {code}")
    if code == Exit.DONE:
        return outcome
    return f"{outcome}: {read_last_message(log).removeprefix(MESSAGE_PREFIX) or 'it said nothing'}"


class _Forwarding:
    """Passes on a signal that would end the sweep to the run, which ends first, with a checkpoint.

    SIGUSR1 is passed on in place of the others: mpirun passes it on, too, while it kills ranks at a SIGTERM. Who does
    not want to wait for the checkpoint sends a second signal (SAME_REQUEST s later, for some senders send it twice).

    Attributes:
        asked: when the first signal came (s, monotonic); None: none came.
    """

    def __init__(self) -> None:
        self.asked: float | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._before: dict[int, Any] = {}

    def __enter__(self) -> _Forwarding:
        wanted = [number for number in STOP_SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
        self._before = {number: signal.signal(number, self._pass_on) for number in wanted}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, handler)

    def wait_for(self, process: subprocess.Popen[bytes]) -> int:
        """The exit code of a run, once it has ended."""
        self._process = process
        if self.asked is not None:  # before the run was started
            process.send_signal(signal.SIGUSR1)
        return process.wait()

    def _pass_on(self, number: int, _: Any) -> None:
        now, first = time.monotonic(), self.asked is None
        if self.asked is not None and now < self.asked + REPEATED_SIGNAL_INTERVAL:
            return
        self.asked = now if self.asked is None else self.asked
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGUSR1 if first else signal.SIGTERM)


# --- the table ------------------------------------------------------------------------------------------------------


def write_sweep_table(cases: list[SweepCase], outcomes: dict[str, str], out: Path) -> None:
    """sweep.csv: settings, outcome and the figures of summary.json of every run so far; replaced in one go."""
    rows = []
    for case in cases:
        figures = _figures(case) if case.folder.name in outcomes else {}
        rows.append({"case": case.folder.name, **case.values, "outcome": outcomes.get(case.folder.name, "not run yet")})
        rows[-1] |= figures
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with replacing_all(out / "sweep.csv") as new, new.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)


def _figures(case: SweepCase) -> dict[str, Any]:
    summary = _summary(case)
    plain = {key: value for key, value in summary.items() if isinstance(value, int | float)}
    peaks = {f"peak_{key}": value for key, value in summary.get("peak_reactions", {}).items()}
    return plain | peaks | {f"seconds_{key}": value for key, value in summary.get("seconds", {}).items()}
