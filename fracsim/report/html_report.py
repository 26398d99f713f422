"""Report of runs or of the evidence as one HTML page (`fracsim report`)."""

from __future__ import annotations

import json
import os
import platform
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from urllib.parse import quote

from ..errors import FalseClaim, InputError
from .compare import read_reference, run_sections
from .content import Section, from_data
from .page import write_page
from .runs import RunData, find_runs

# dolfinx-solver-real is the wheel of DOLFINx, with PETSc and petsc4py
_PROGRAM_PACKAGES = ("fenics-dolfinx", "dolfinx-solver-real", "petsc4py", "mpi4py", "numpy", "scipy")


def make_report(
    folders: list[Path],
    target: Path | None = None,
    *,
    references: list[Path],
    quantity: str | None = None,
    exact: float | None = None,
    view: bool = False,
) -> Path:
    """Write a report and return its path.

    Args:
        folders: output folders of runs or sweeps, or the folder of the evidence.
        target: the .html file; None: report.html in the first folder.
        references: CSV files of curves to compare with.
        quantity: quantity whose error is compared, see `RunData.quantity`.
        exact: exact value of the quantity.
        view: write the page of `fracsim view` of each run beside the tables, with links to them.

    Raises:
        InputError: the folders or options do not fit.
        FalseClaim: a claim of the evidence does not hold; the page has been written.
    """
    target = target or folders[0] / "report.html"
    if target.suffix != ".html":
        raise InputError(f"-o {target}: the report is an .html file")
    if any((folder / "evidence.json").is_file() for folder in folders):
        if len(folders) > 1 or references or quantity or view:
            raise InputError("the report on evidence takes its folder alone, without --reference, --quantity or --view")
        return _evidence_report(folders[0], target)
    if exact is not None and quantity is None:
        raise InputError("--exact is the value of a quantity: name it with --quantity")
    runs = find_runs(folders)
    sections = run_sections(runs, [read_reference(path) for path in references], quantity=quantity, exact=exact)
    title = "fracsim: " + (str(runs[0].settings.get("title", runs[0].name)) if len(runs) == 1 else f"{len(runs)} runs")
    links = _write_views(runs, target) if view else None
    about = _about_runs(runs)
    return write_page(target, sections, Path(), title=title, subtitle=_date_line(), about=about, links=links)


def _write_views(runs: list[RunData], target: Path) -> dict[str, str]:
    """Write the page of `fracsim view` of each run; returns their addresses by name, relative to the report."""
    from .view_page import write_view

    links = {}
    for run in runs:
        page = target.with_suffix("") / f"view-{run.name.replace('/', '-')}.html"
        page.parent.mkdir(parents=True, exist_ok=True)
        write_view(run.folder, page)
        links[run.name] = quote(f"{page.parent.name}/{page.name}")
    return links


def _evidence_report(folder: Path, target: Path) -> Path:
    """Write the report of the evidence; see `make_report`."""
    try:
        data = json.loads((folder / "evidence.json").read_text(encoding="utf-8"))
        sections = [section for group in data["groups"].values() for section in from_data(group["sections"])]
        about = dict(data["about"])
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise InputError(f"{folder}/evidence.json cannot be read: {type(error).__name__}: {error}") from None
    first = [section for section in sections if section.first]
    folded = [section for section in sections if not section.first]
    page = [*first, *_claim_sections(sections), *folded]
    subtitle = f"{_date_line()}. Each number comes from a trial recorded beside this page (record.json of each folder)."
    shown = len(page) - len(folded) if first else None
    path = write_page(target, page, folder, title="fracsim: evidence", subtitle=subtitle, about=about, shown=shown)
    if false := [claim for section in sections for claim in section.claims if claim.holds is False]:
        claims = "; ".join(f"{claim.text} ({claim.measured})" for claim in false)
        raise FalseClaim(f"saved {path}, in which {len(false)} claims do not hold: {claims}")
    return path


def _claim_sections(sections: list[Section]) -> list[Section]:
    """Section with all claims, if there are any."""
    claims = tuple(claim for section in sections for claim in section.claims)
    if not claims:
        return []
    count = sum(claim.holds is True for claim in claims)
    return [Section("What must hold", f"{count} of {len(claims)} claims hold.", claims)]


def _date_line() -> str:
    return f"Made on {date.today().isoformat()}"


def _about_runs(runs: list[RunData]) -> dict[str, str]:
    """Versions of the programs that ran, if all runs agree, and the machine on which the page is made."""
    ran = [json.dumps({k: v for k, v in run.summary.get("versions", {}).items() if k != "ranks"}) for run in runs]
    versions = dict(json.loads(ran[0])) if len(set(ran)) == 1 and ran[0] != "{}" else program_versions()
    return versions | {f"page made on: {key}": value for key, value in machine_info().items()}


def machine_info() -> dict[str, str]:
    """Processor, available cores, memory and operating system of this machine, without its name."""
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    try:
        system = platform.freedesktop_os_release()["PRETTY_NAME"]
    except (OSError, KeyError):
        system = platform.system()
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count()
    return {"processor": _processor(), "cores": str(cores), "memory": f"{memory:.0f} GiB", "system": system}


def program_versions() -> dict[str, str]:
    """Versions of the installed programs, from their metadata: they are not imported."""
    from .. import __version__

    versions = {"fracsim": __version__, "python": platform.python_version()}
    for name in _PROGRAM_PACKAGES:
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions


def _processor() -> str:
    """Model of the processor."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        return platform.machine()
    models = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return models[0] if models else platform.machine()
