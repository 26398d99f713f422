"""Run trials and collect the page's sections: python -m fracsim.studies.evidence OUT [--full] [--only GROUP ...]."""

from __future__ import annotations

import argparse
import importlib
import itertools
import json
import os
import sys
import time
from concurrent.futures import ThreadPoolExecutor
from datetime import date
from pathlib import Path
from typing import Any

from ...report.content import Section, to_data
from ...report.html_report import machine_info, program_versions
from .trial import Trial
from .trial_runner import RECORD, fingerprint, repeat_timing, run_trial, trial_folder

UNTIMED = ("stability", "dependence", "experiments")  # what counts there is not time: runs of one rank go two at a time
# group -> its module; also the order of the report
GROUPS = {
    "precision": "precision",
    "peers": "peers",
    "stability": "stability",
    "ladder": "feature_cost",
    "growth": "crack_count_cost",
    "rows": "paper_table_rows",
    "dependence": "mesh_dependence",
    "experiments": "experiments",
}
Records = list[dict[str, Any]]


def main() -> None:
    """Run the trials of the groups and write evidence.json."""
    parser = argparse.ArgumentParser(prog="python -m fracsim.studies.evidence", description=__doc__)
    parser.add_argument("out", type=Path, metavar="OUT", help="folder of the evidence; what is there is not run again")
    parser.add_argument("--full", action="store_true", help="the long trials too")
    parser.add_argument(
        "--only", nargs="+", choices=GROUPS, default=list(GROUPS), metavar="GROUP", help=", ".join(GROUPS)
    )
    given = parser.parse_args()
    modules = {name: importlib.import_module(f".{GROUPS[name]}", __package__) for name in given.only}
    records = {name: _run(name, module, given.out, given.full) for name, module in modules.items()}
    path = write_evidence(given.out, records, {name: module.sections for name, module in modules.items()})
    failed = [record for group in records.values() for record in group if record["outcome"] != "done"]
    print(
        f"{sum(map(len, records.values()))} trials, {len(failed)} of them not done; now: fracsim report {path.parent}"
    )


def _run(group: str, module: Any, out: Path, full: bool) -> Records:
    """Records of a group. Without `full`, long trials are included only if they have been recorded before."""
    chosen = [trial for trial in module.trials() if full or not trial.full or is_recorded(trial, out)]
    began, number = time.monotonic(), itertools.count(1)

    def run(trial: Trial) -> dict[str, Any]:
        record, done = run_trial(trial, out), next(number)
        left = (time.monotonic() - began) / done * (len(chosen) - done)
        line = f"{group} {done}/{len(chosen)} {trial.case}/{trial.name}: {record['outcome']}"
        print(f"{line}, {record['wall'][-1]:.1f} s, about {left:.0f} s left in the group", flush=True)
        return record

    with ThreadPoolExecutor(2 if group in UNTIMED and (os.cpu_count() or 1) > 1 else 1) as pool:
        alone = [pool.submit(run, trial) if trial.ranks == 1 else None for trial in chosen]
    records = [one.result() if one is not None else run(trial) for one, trial in zip(alone, chosen, strict=True)]
    if doubtful := getattr(module, "trials_to_repeat", None):
        _repeat_timings(doubtful, list(zip(chosen, records, strict=True)), out)
    print(f"{group}: {time.monotonic() - began:.0f} s", flush=True)
    return records


def _repeat_timings(doubtful: Any, runs: list[tuple[Trial, dict[str, Any]]], out: Path) -> None:
    """Repeat the trials whose timing the group doubts, until it doubts none; the set may change each time."""
    while wanted := doubtful([record for _, record in runs]):
        for trial, record in runs:
            if (trial.case, trial.name) in wanted:
                repeat_timing(trial, out, record)
                print(f"{trial.group} {trial.case}/{trial.name}: once more, {record['wall'][-1]:.1f} s", flush=True)


def is_recorded(trial: Trial, out: Path) -> bool:
    """Return whether a record of this trial, with the same program, exists."""
    path = trial_folder(out, trial) / RECORD
    return path.exists() and json.loads(path.read_text(encoding="utf-8"))["digest"] == fingerprint(trial)


def write_evidence(out: Path, records: dict[str, Records], makers: dict[str, Any]) -> Path:
    """Write OUT/evidence.json: sections of each group as data, with the origin of each number.

    Groups that were not run keep their sections. If a section cannot be made, a section with the error takes its place.
    """
    path = out / "evidence.json"
    groups = json.loads(path.read_text(encoding="utf-8"))["groups"] if path.exists() else {}
    groups |= {name: {"sections": _sections(makers[name], group)} for name, group in records.items()}
    ordered = {name: groups[name] for name in GROUPS if name in groups}
    out.mkdir(parents=True, exist_ok=True)
    about = program_versions() | machine_info() | {"trials run on": date.today().isoformat()}
    path.write_text(json.dumps({"about": about, "groups": ordered}, indent=1) + "\n")
    return path


def _sections(make: Any, records: Records) -> list[dict[str, Any]]:
    """Sections of a group as data; a section with the error if they cannot be made."""
    try:
        return to_data(make(records))
    except Exception as error:
        text = f"This section could not be made from the records: {type(error).__name__}: {error}"
        print(text, file=sys.stderr)
        return to_data([Section(f"{records[0]['group'] if records else 'an empty group'}: failed", text)])


if __name__ == "__main__":
    main()
