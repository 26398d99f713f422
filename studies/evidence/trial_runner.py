"""Run trials in separate processes with a time limit, and record each in record.json."""

from __future__ import annotations

import hashlib
import importlib
import json
import os
import shlex
import signal
import subprocess
import sys
import time
from dataclasses import asdict
from functools import cache
from pathlib import Path
from typing import Any

import tomli_w

import fracsim as root
from fracsim import forms, meshes
from fracsim.report.runs import OUTCOMES, read_last_message, read_log_messages

from .trial import Trial

RECORD = "record.json"
TIMES = ("wall", "stepping", "cpu")  # of a record: lists of s, one of each run
PHASES = ("solve", "fracture", "energies", "plasticity")


def run_trial(trial: Trial, out: Path) -> dict[str, Any]:
    """Record of a trial; read from OUT/group/case/name/record.json if the same trial has run before."""
    folder = trial_folder(out, trial)
    path = folder / RECORD
    digest = fingerprint(trial)
    record: dict[str, Any] = json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}
    if record.get("digest") != digest:
        folder.mkdir(parents=True, exist_ok=True)
        command = _command(trial, folder)
        runs = [_run_once(command, folder, trial.limit) for _ in range(trial.repeats)]
        record = {**_trial_data(trial, command), "digest": digest, **_merge_runs(runs)}
    if record.get("measured by") != evidence_digest():
        _measure(trial, folder, record)
        _save(record, folder)
    return record


def repeat_timing(trial: Trial, out: Path, record: dict[str, Any]) -> None:
    """Run a recorded trial again and append its times to the record."""
    folder = trial_folder(out, trial)
    again = _merge_runs([_run_once(_command(trial, folder), folder, trial.limit)])
    for key in TIMES:
        record[key] += again[key]
    if again["outcome"] != "done":
        record["outcome"], record["message"] = again["outcome"], again["message"]
    _save(record, folder)


def trial_folder(out: Path, trial: Trial) -> Path:
    """Folder in which a trial is run and recorded."""
    return out / trial.group / trial.case / trial.name


def _save(record: dict[str, Any], folder: Path) -> None:
    """Write the record to its folder."""
    (folder / RECORD).write_text(json.dumps(record, indent=1) + "\n")


def fingerprint(trial: Trial) -> str:
    """Digest of a run; it changes with the trial, with the program and with the script."""
    code = program_digest() + (evidence_digest() if trial.script else "")
    return hashlib.sha256((json.dumps(asdict(trial), sort_keys=True) + code).encode()).hexdigest()[:16]


@cache
def program_digest() -> str:
    """Digest of the code that a study runs through, without the report and the studies."""
    package = Path(root.__file__).parent
    sources = (path for kind in ("*.py", "*.c") for path in package.rglob(kind))
    modules = [path for path in sources if not {"report", "studies"} & set(path.parts[-3:])]
    for part in (forms, meshes):
        modules += Path(str(part.__file__)).parent.rglob("*.py")
    return _digest_of(modules)


@cache
def evidence_digest() -> str:
    """Digest of the evidence's code. A run that older code measured is measured again."""
    return _digest_of(list(Path(__file__).parent.rglob("*.py")))


def _digest_of(modules: list[Path]) -> str:
    """Digest of the text of modules."""
    digest = hashlib.sha256()
    for path in sorted(modules):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _trial_data(trial: Trial, command: list[str]) -> dict[str, Any]:
    """Description of the trial in its record."""
    keys = ("group", "case", "name", "settings", "ranks", "repeats", "limit")
    return {key: getattr(trial, key) for key in keys} | {"command": shlex.join(command)}


def _command(trial: Trial, folder: Path) -> list[str]:
    """Command that runs the trial inside `folder`; the report shows it to readers."""
    if trial.study is not None:
        (folder / "trial.toml").write_text(tomli_w.dumps(trial.study))
        work = ["fracsim", "run", "trial.toml", "-o", "run", "--overwrite"]  # a trial cut short begins anew
    else:
        work = ["python3", "-m", *trial.script, "-o", "figures.json"]
    if trial.ranks == 1:
        return work
    return ["env", f"MPIEXEC_TIMEOUT={int(trial.limit) + 5}", "mpirun", "-n", str(trial.ranks), *work]


def _run_once(command: list[str], folder: Path, limit: float) -> dict[str, Any]:
    """Run once: outcome, wall time in s, last message, and summary.json if it exists."""
    for name in ("figures.json", "run/summary.json"):  # those of an earlier run would be taken for this one's
        (folder / name).unlink(missing_ok=True)
    began = time.perf_counter()
    with (folder / "log.txt").open("w") as log:
        process = subprocess.Popen(command, cwd=folder, stdout=log, stderr=log, start_new_session=True)
        try:
            code = process.wait(limit + 10)
            outcome = OUTCOMES.get(code, f"failed ({code})")
        except subprocess.TimeoutExpired:
            os.killpg(process.pid, signal.SIGKILL)
            process.wait()
            outcome = "out of time"
    summary = folder / "run" / "summary.json"
    return {
        "outcome": outcome,
        "wall": time.perf_counter() - began,
        "message": (read_log_messages if outcome == "done" else read_last_message)(folder / "log.txt"),
        "summary": json.loads(summary.read_text(encoding="utf-8")) if summary.exists() else None,
    }


def _merge_runs(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Worst outcome, last summary and the times of all runs, s.

    `wall`: of the process. `stepping`: of the time steps. `cpu`: processor time of all ranks in the time steps.
    """
    summaries = [run["summary"] for run in runs if run["summary"] is not None]
    return {
        "outcome": next((run["outcome"] for run in runs if run["outcome"] != "done"), "done"),
        "message": runs[-1]["message"],
        "wall": [run["wall"] for run in runs],
        "stepping": [sum(summary["seconds"].get(key, 0.0) for key in PHASES) for summary in summaries],
        "cpu": [summary["cpu"] for summary in summaries],
        "summary": runs[-1]["summary"],
    }


def _measure(trial: Trial, folder: Path, record: dict[str, Any]) -> None:
    """Add the figures of the run to its record. An error of the measurement makes the outcome "not measured"."""
    record["figures"], record["measured by"] = {}, evidence_digest()
    if record["outcome"] == "not measured":
        record["outcome"] = "done"
    if record["outcome"] != "done" and not trial.always:
        return
    try:
        if (script := folder / "figures.json").exists():
            record["figures"] = json.loads(script.read_text(encoding="utf-8"))
        if trial.measure:
            module, _, function = trial.measure.partition(":")
            measured = getattr(importlib.import_module(f".{module}", __package__), function)(folder / "run")
            record["figures"] |= measured
    except Exception as error:
        record["outcome"] = "not measured"
        record["message"] = f"{type(error).__name__}: {error}"
        print(f"{trial.group}/{trial.case}/{trial.name}: {record['message']}", file=sys.stderr)
