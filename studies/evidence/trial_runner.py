"""Running trials: each in processes of its own with a time limit, recorded in record.json, and not run twice."""

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
    """The record of a trial; taken from OUT/group/case/name/record.json where the same trial has been run before."""
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
    """Run a trial that is recorded once more and add its times, whatever they are, to the record."""
    folder = trial_folder(out, trial)
    again = _merge_runs([_run_once(_command(trial, folder), folder, trial.limit)])
    for key in TIMES:
        record[key] += again[key]
    if again["outcome"] != "done":
        record["outcome"], record["message"] = again["outcome"], again["message"]
    _save(record, folder)


def trial_folder(out: Path, trial: Trial) -> Path:
    """Where a trial is run and recorded."""
    return out / trial.group / trial.case / trial.name


def _save(record: dict[str, Any], folder: Path) -> None:
    (folder / RECORD).write_text(json.dumps(record, indent=1) + "\n")


def fingerprint(trial: Trial) -> str:
    """Name of a run: it changes with any part of the trial and with the program (and the script) that is run."""
    code = program_digest() + (evidence_digest() if trial.script else "")
    return hashlib.sha256((json.dumps(asdict(trial), sort_keys=True) + code).encode()).hexdigest()[:16]


@cache
def program_digest() -> str:
    """Name of the code that a study runs through: the page that is made of it afterwards is not part of it."""
    package = Path(root.__file__).parent
    sources = (path for kind in ("*.py", "*.c") for path in package.rglob(kind))
    modules = [path for path in sources if not {"report", "studies"} & set(path.parts[-3:])]
    for part in (forms, meshes):
        modules += Path(str(part.__file__)).parent.rglob("*.py")
    return _digest_of(modules)


@cache
def evidence_digest() -> str:
    """Name of the code of the evidence: what was measured by an older one is measured again, from the same run."""
    return _digest_of(list(Path(__file__).parent.rglob("*.py")))


def _digest_of(modules: list[Path]) -> str:
    digest = hashlib.sha256()
    for path in sorted(modules):
        digest.update(path.read_bytes())
    return digest.hexdigest()[:16]


def _trial_data(trial: Trial, command: list[str]) -> dict[str, Any]:
    keys = ("group", "case", "name", "settings", "ranks", "repeats", "limit")
    return {key: getattr(trial, key) for key in keys} | {"command": shlex.join(command)}


def _command(trial: Trial, folder: Path) -> list[str]:
    """What is run, inside `folder`; also what a reader of the report runs again."""
    if trial.study is not None:
        (folder / "trial.toml").write_text(tomli_w.dumps(trial.study))
        work = ["fracsim", "run", "trial.toml", "-o", "run", "--overwrite"]  # a trial cut short begins anew
    else:
        work = ["python3", "-m", *trial.script, "-o", "figures.json"]
    if trial.ranks == 1:
        return work
    return ["mpirun", "--oversubscribe", "--timeout", str(int(trial.limit) + 5), "-n", str(trial.ranks), *work]


def _run_once(command: list[str], folder: Path, limit: float) -> dict[str, Any]:
    """One run: outcome, wall time in s, the last thing it said, and summary.json where there is one."""
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
    """Worst outcome, last summary, and the times of all runs, s: `wall` of the process; inside it `stepping`, and `cpu`
    of all ranks there."""
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
    """Figures of the run into the record; a measurement that fails makes the trial a failed one, not a hole."""
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
