"""Sweep: a study run once for each combination of values, each run in a process and a folder of its own."""

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

from .. import __version__
from ..errors import REPEATED_SIGNAL_INTERVAL, STOP_SIGNALS, Exit, InputError, NotConverged, Stopped, one_line
from ..meshes.plain_files import atomic_replacement_of_all, create
from ..output.file_ownership import check_ownership, has_resumable_run, is_fracsim_folder, recorded_file_lines
from ..output.lock import FolderLock, describe_lock_holder
from ..study.check import check_study
from ..study.plugins import collect_physics, physics_lines
from ..study.reader import input_file_lines, load_study, study_text
from .runs import MESSAGE_PREFIX, OUTCOMES, read_last_message, read_log_notes

# characters of a folder name, before a hash
_MAX_NAME_LENGTH = 100


@dataclass(frozen=True)
class SweepCase:
    """One combination of values.

    Attributes:
        values: values as text, by key of the study.
        folder: output folder.
    """

    values: dict[str, str]
    folder: Path

    @property
    def overrides(self) -> list[str]:
        """Texts "key=value" for the option --set."""
        return [f"{key}={value}" for key, value in self.values.items()]


def run_sweep(
    study: str, path: Path, sets: list[str], out: Path, *, ranks: int, only_list: bool, overwrite: bool = False
) -> None:
    """Run all cases that have not reached their end yet, one after the other, or print their commands.

    Args:
        study: name of the study, as the user gave it.
        path: file of the study.
        sets: texts "key=a,b,c" with the values of each key.
        out: folder of the sweep.
        ranks: MPI ranks of each run.
        only_list: print the commands instead, one per line.
        overwrite: unfinished runs of another study may be deleted.

    Raises:
        InputError: a case cannot be run; nothing was run.
        NotConverged: a run failed; the others were run.
        Stopped: the sweep was interrupted.
    """
    if not only_list:
        _refuse_mpirun()
    cases = sweep_cases(sets, out)
    if is_fracsim_folder(out):
        raise InputError(f"--out {out}: the folder is that of a run; give the sweep an empty or a new folder")
    digests: dict[Path, str] = {}  # a file that many cases read is read once
    texts = [_checked_study(path, case, digests) for case in cases]
    _check_distinct(cases, texts)
    for case, text in zip(cases, texts, strict=True):
        _check_folder(case, text, path, overwrite)
    if only_list:
        for case, text in zip(cases, texts, strict=True):
            print(shlex.join(_job_line(study, case, text, ranks, overwrite=overwrite)))
        return
    with FolderLock(out) as lock:
        lock.acquire(make=True)
        outcomes = _run_all(study, list(zip(cases, texts, strict=True)), out, ranks)
    failed = [f"{name} ({outcome})" for name, outcome in outcomes.items() if not outcome.startswith("done")]
    print(f"settings and figures of all runs: {out / 'sweep.csv'}")
    if failed:
        raise NotConverged(f"{len(failed)} of {len(cases)} runs did not end well: {'; '.join(failed)}")


def _run_all(study: str, cases: list[tuple[SweepCase, str]], out: Path, ranks: int) -> dict[str, str]:
    """Outcomes in words, by name of the case.

    Args:
        study: name of the study.
        cases: cases, each with the text of its study.
        out: folder of the sweep.
        ranks: MPI ranks of each run.

    Raises:
        Stopped: the sweep was interrupted.
    """
    outcomes: dict[str, str] = {}
    for number, (case, text) in enumerate(cases, 1):
        print(f"[{number}/{len(cases)}] {case.folder.name}: ", end="", flush=True)
        outcomes[case.folder.name] = outcome = _run(study, case, text, ranks)
        count = len(read_log_notes(case.folder / "log.txt"))
        notes = f" ({count} note{'s' if count > 1 else ''} in {case.folder / 'log.txt'})" if count else ""
        print(one_line(outcome) + notes, flush=True)
        write_sweep_table([entry for entry, _ in cases], outcomes, out)
        if outcome.startswith("interrupted"):
            raise Stopped(f"interrupted after {number - 1} of {len(cases)} runs; the same command goes on")
    return outcomes


# --- combinations ---------------------------------------------------------------------------------------------------


def sweep_cases(sets: list[str], out: Path) -> list[SweepCase]:
    """All combinations of the values, the last key changing fastest.

    Args:
        sets: texts "key=a,b,c" with the values of each key.
        out: folder of the sweep.

    Raises:
        InputError: a text has another form, or a key or value is repeated.
    """
    values: dict[str, list[str]] = {}
    for text in sets:
        key, equals, listed = text.partition("=")
        key = key.strip()
        if not equals or not key:
            raise InputError(f"--set {text}: write key=a,b,c, for example --set mesh.h=0.02,0.01")
        if key in values:
            raise InputError(f"--set {text}: {key} is given twice; put all its values in one list")
        values[key] = [part.strip() for part in split_values(listed)]
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
    """Parts of a text between commas that are not inside brackets, braces or quotes."""
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
    """Last part of each key if that is unique, otherwise the whole key."""
    last = [key.rpartition(".")[2] for key in keys]
    return {
        key: end if last.count(end) == 1 and not end.isdigit() else key for key, end in zip(keys, last, strict=True)
    }


def case_folder_name(values: dict[str, str]) -> str:
    """Readable folder name such as h-0.02_scheme-newmark; with digits of a hash if characters were replaced."""
    full = "_".join(f"{key}-{value}" for key, value in values.items())
    safe = "_".join(f"{key}-{_safe_text(value)}" for key, value in values.items())
    if safe == full and len(safe) <= _MAX_NAME_LENGTH:
        return safe
    return f"{safe[:_MAX_NAME_LENGTH]}-{hashlib.sha256(full.encode()).hexdigest()[:6]}"


def _safe_text(value: str) -> str:
    """Value in characters that need no quotes in file systems and shells; a leading minus stays."""
    if re.fullmatch(r"-?[A-Za-z0-9][A-Za-z0-9.+-]*", value):
        return value
    return re.sub(r"[^A-Za-z0-9.+]+", "-", value).strip("-.")


def _checked_study(path: Path, case: SweepCase, digests: dict[Path, str]) -> str:
    """Text of study.toml of a case with lines on its plug-ins and files.

    Raises InputError, with the case, if it cannot be run.

    `digests`: of the files of earlier cases; it is added to.
    """
    try:
        study = load_study(path, case.overrides)
        check_study(study)
        lines = [*collect_physics(study).lines, *input_file_lines(study, digests)]
    except InputError as error:
        raise InputError(f"{case.folder.name}: {str(error).rstrip('.')}. Nothing was run") from None
    return study_text(study, lines)


def _check_distinct(cases: list[SweepCase], texts: list[str]) -> None:
    """Raise InputError if two cases are the same study, as with the values 0.01 and 1e-2."""
    first: dict[str, SweepCase] = {}
    for case, text in zip(cases, texts, strict=True):
        if (earlier := first.setdefault(text, case)) is not case:
            differing = [key for key, value in case.values.items() if earlier.values[key] != value]
            listed = " and ".join(f"{key} = {earlier.values[key]} and {case.values[key]}" for key in differing)
            raise InputError(f"--set: {listed} are the same value; remove one of them. Nothing was run")


def _check_folder(case: SweepCase, study: str, path: Path, overwrite: bool) -> None:
    """Raise InputError if the folder of a case holds foreign files or an unfinished run of another study.

    Args:
        case: the case.
        study: text of its study.toml.
        path: file of the study.
        overwrite: unfinished runs of another study may be deleted.
    """
    check_ownership(case.folder, [path])
    if _case_state(case, study) == "new" and has_resumable_run(case.folder) and not overwrite:
        raise InputError(
            f"--out {case.folder}: a run of another study that has not ended left a checkpoint there; throw it away "
            "with --overwrite, or give another folder. Nothing was run"
        )


def _refuse_mpirun() -> None:
    """Raise InputError if this process is one of several MPI ranks."""
    # a single process may have the variables of a launcher as well, as in a shell started by srun
    sizes = ["OMPI_COMM_WORLD_SIZE", "PMI_SIZE", *(["SLURM_STEP_NUM_TASKS"] if "PMIX_RANK" in os.environ else [])]
    if any(os.environ.get(name, "1") != "1" for name in sizes) or os.environ.get("PMIX_RANK", "0") != "0":
        raise InputError("a sweep starts its runs itself: call it without mpirun and say how many ranks with --ranks")


# --- one run --------------------------------------------------------------------------------------------------------


def run_command(study: str, case: SweepCase, ranks: int, mode: str = "") -> list[str]:
    """Command that runs a case; `mode` is "restart", "overwrite" or ""."""
    command = ["fracsim", "run", study]
    for override in case.overrides:
        command += ["--set", override]
    command += ["-o", str(case.folder), *([f"--{mode}"] if mode else [])]
    return command if ranks == 1 else ["mpirun", "-n", str(ranks), *command]


def _job_line(study: str, case: SweepCase, text: str, ranks: int, *, overwrite: bool) -> list[str]:
    """Command of a case for a job array. A finished case has a command without effect, so that line numbers stay."""
    state = _case_state(case, text)
    if state == "done":
        return ["true", f"{case.folder}: done before"]
    return run_command(study, case, ranks, "restart" if state == "begun" else "overwrite" if overwrite else "")


def _run_environment() -> dict[str, str]:
    """Environment of a run, without the variables by which a launcher gives a process its rank."""
    prefixes = ("PMI_", "PMIX_", "OMPI_COMM_WORLD_")
    return {name: value for name, value in os.environ.items() if not name.startswith(prefixes)}


def _case_state(case: SweepCase, study: str) -> str:
    """State of a case: "done", "begun" (with a checkpoint) or "new".

    Files of another study, or of one with another content of a mesh or obstacle file or another version of a plug-in,
    do not count.
    """
    try:
        earlier = (case.folder / "study.toml").read_text(encoding="utf-8")
        if tomllib.loads(earlier) != tomllib.loads(study):
            return "new"
        if any(lines(earlier) != lines(study) for lines in (recorded_file_lines, physics_lines)):
            return "new"
    except (OSError, ValueError):
        return "new"
    if _read_summary(case).get("outcome") == "done":
        return "done"
    return "begun" if (case.folder / "checkpoint" / "state.h5").is_file() else "new"


def _describe_finished(case: SweepCase) -> str:
    """Outcome of a case that is not run again; it names the version of the program if that was another one."""
    version = (_read_summary(case).get("versions") or {}).get("fracsim", __version__)
    if version == __version__:
        return "done before"
    return f"done before, by fracsim {version}; this is {__version__}: delete its folder to run it again"


def _read_summary(case: SweepCase) -> dict[str, Any]:
    """Values of summary.json of a case; empty if it cannot be read."""
    try:
        return dict(json.loads((case.folder / "summary.json").read_text(encoding="utf-8")))
    except (OSError, ValueError):
        return {}


def _run(study: str, case: SweepCase, text: str, ranks: int) -> str:
    """Run a case and return the outcome in words, with the reason of a failure."""
    state = _case_state(case, text)
    if state == "done":
        return _describe_finished(case)
    # a run of a job array, or of a sweep that was killed
    if (holder := describe_lock_holder(case.folder)) is not None:
        return f"refused: a run is going on there ({holder})"
    try:
        case.folder.mkdir(parents=True, exist_ok=True)
        # otherwise an earlier one could be taken for this run's
        (case.folder / "summary.json").unlink(missing_ok=True)
    except OSError as error:
        raise InputError(f"--out {case.folder.parent}: cannot write there: {error.strerror}") from None
    # _check_folder has allowed to overwrite what is in the folder
    mode = "restart" if state == "begun" else "overwrite"
    log, command = case.folder / "log.txt", run_command(study, case, ranks, mode)
    create(log).close()
    with log.open("w", encoding="utf-8") as file, _SignalForwarder() as forwarder:
        # A session of its own: otherwise Ctrl-C would reach the run beside the forwarded signal, and mpirun would kill
        # its ranks at once.
        process = subprocess.Popen(command, stdout=file, stderr=file, start_new_session=True, env=_run_environment())
        code = forwarder.wait_for(process)
    if forwarder.first_signal is not None:
        return "interrupted"
    outcome = OUTCOMES.get(code, f"failed with exit code {code}")
    if code == Exit.DONE:
        return outcome
    return f"{outcome}: {read_last_message(log).removeprefix(MESSAGE_PREFIX) or 'it said nothing'}"


class _SignalForwarder:
    """Forwarder of stop signals to the run, which then ends with a checkpoint before the sweep ends.

    The run receives SIGUSR1 in place of any signal: mpirun forwards that one, but kills its ranks at a SIGTERM. A
    second signal, `REPEATED_SIGNAL_INTERVAL` seconds later or more, ends the run without a checkpoint; some senders
    send a signal twice.

    Attributes:
        first_signal: time of the first signal (s, monotonic clock); None: there was none.
    """

    def __init__(self) -> None:
        self.first_signal: float | None = None
        self._process: subprocess.Popen[bytes] | None = None
        self._previous_handlers: dict[int, Any] = {}

    def __enter__(self) -> _SignalForwarder:
        caught = [number for number in STOP_SIGNALS if signal.getsignal(number) is not signal.SIG_IGN]
        self._previous_handlers = {number: signal.signal(number, self._forward) for number in caught}
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._previous_handlers.items():
            signal.signal(number, handler)

    def wait_for(self, process: subprocess.Popen[bytes]) -> int:
        """Exit code of a run, after it has ended."""
        self._process = process
        # it came before the run was started
        if self.first_signal is not None:
            process.send_signal(signal.SIGUSR1)
        return process.wait()

    def _forward(self, number: int, _: Any) -> None:
        clock, is_first = time.monotonic(), self.first_signal is None
        if self.first_signal is not None and clock < self.first_signal + REPEATED_SIGNAL_INTERVAL:
            return
        self.first_signal = clock if self.first_signal is None else self.first_signal
        if self._process is not None and self._process.poll() is None:
            self._process.send_signal(signal.SIGUSR1 if is_first else signal.SIGTERM)


# --- the table ------------------------------------------------------------------------------------------------------


def write_sweep_table(cases: list[SweepCase], outcomes: dict[str, str], out: Path) -> None:
    """Write sweep.csv with settings, outcome, notes and numbers of summary.json of each case.

    Args:
        cases: all cases.
        outcomes: outcomes so far, by name of the case.
        out: folder of the sweep.
    """
    rows = []
    for case in cases:
        name = case.folder.name
        notes = read_log_notes(case.folder / "log.txt") if name in outcomes else []
        row = {"case": name, **case.values, "outcome": outcomes.get(name, "not run yet"), "notes": "; ".join(notes)}
        rows.append(row | (_summary_numbers(case) if name in outcomes else {}))
    columns = list(dict.fromkeys(key for row in rows for key in row))
    with (
        atomic_replacement_of_all(out / "sweep.csv") as temporary,
        temporary.open("w", newline="", encoding="utf-8") as file,
    ):
        writer = csv.DictWriter(file, columns, restval="")
        writer.writeheader()
        writer.writerows(rows)


def _summary_numbers(case: SweepCase) -> dict[str, Any]:
    """Numbers of summary.json, with peak_NAME of the reactions and seconds_PHASE."""
    summary = _read_summary(case)
    plain = {key: value for key, value in summary.items() if isinstance(value, int | float)}
    peaks = {f"peak_{key}": value for key, value in summary.get("peak_reactions", {}).items()}
    return plain | peaks | {f"seconds_{key}": value for key, value in summary.get("seconds", {}).items()}
