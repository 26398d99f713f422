"""`fracsim report`: from folders to the page."""

from __future__ import annotations

import json
from datetime import date
from pathlib import Path

from ..errors import FalseClaim, InputError
from .compare import read_reference, run_sections
from .content import Section, from_data
from .environment_info import machine_info, program_versions
from .page import write_page
from .runs import RunData, find_runs


def make_report(
    folders: list[Path],
    target: Path | None = None,
    *,
    references: list[Path],
    quantity: str | None = None,
    exact: float | None = None,
) -> Path:
    """Write the page on run folders, sweeps or the folder of evidence; returns its path.

    InputError where that cannot be; FalseClaim, once the page is written, where a claim of the evidence does not hold.
    """
    target = target or folders[0] / "report.html"
    if target.suffix != ".html":
        raise InputError(f"-o {target}: the report is an .html file")
    if any((folder / "evidence.json").is_file() for folder in folders):
        if len(folders) > 1 or references or quantity:
            raise InputError("the report on evidence takes its folder alone, without --reference or --quantity")
        return _of_evidence(folders[0], target)
    if exact is not None and quantity is None:
        raise InputError("--exact is the value of a quantity: name it with --quantity")
    runs = find_runs(folders)
    sections = run_sections(runs, [read_reference(path) for path in references], quantity=quantity, exact=exact)
    title = "fracsim: " + (str(runs[0].settings.get("title", runs[0].name)) if len(runs) == 1 else f"{len(runs)} runs")
    return write_page(target, sections, Path(), title=title, subtitle=_today(), about=_about(runs))


def _of_evidence(folder: Path, target: Path) -> Path:
    try:
        data = json.loads((folder / "evidence.json").read_text(encoding="utf-8"))
        sections = [section for group in data["groups"].values() for section in from_data(group["sections"])]
        about = dict(data["about"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{folder}/evidence.json cannot be read: {type(error).__name__}: {error}") from None
    first, others = [each for each in sections if each.first], [each for each in sections if not each.first]
    page = [*first, *_verdict(sections), *others]
    subtitle = f"{_today()}. Each number comes from a trial recorded beside this page (record.json of each folder)."
    shown = len(page) - len(others) if first else None
    path = write_page(target, page, folder, title="fracsim: evidence", subtitle=subtitle, about=about, shown=shown)
    if false := [claim for section in sections for claim in section.claims if claim.holds is False]:
        what = "; ".join(f"{claim.text} ({claim.measured})" for claim in false)
        raise FalseClaim(f"saved {path}, in which {len(false)} claims do not hold: {what}")
    return path


def _verdict(sections: list[Section]) -> list[Section]:
    """All claims at the top."""
    claims = tuple(claim for section in sections for claim in section.claims)
    if not claims:
        return []
    count = sum(claim.holds is True for claim in claims)
    return [Section("What must hold", f"{count} of {len(claims)} claims hold.", claims)]


def _today() -> str:
    return f"Made on {date.today().isoformat()}"


def _about(runs: list[RunData]) -> dict[str, str]:
    """Versions that ran, where all runs agree; the machine_info is that of the page."""
    ran = [json.dumps({k: v for k, v in run.summary.get("versions", {}).items() if k != "ranks"}) for run in runs]
    found = dict(json.loads(ran[0])) if len(set(ran)) == 1 and ran[0] != "{}" else program_versions()
    return found | {f"page made on: {key}": value for key, value in machine_info().items()}
