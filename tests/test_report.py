"""fracsim report: one page that needs nothing else, with the numbers of the runs."""

from __future__ import annotations

import csv
import json
import re
import shutil
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from urllib.parse import unquote
from xml.etree import ElementTree

import imageio.v3
import numpy as np
import pytest

from cases import BAR, DUCTILE_TABLES, STRIP, fracsim, swept_here, write_study
from fracsim.errors import FalseClaim, InputError
from fracsim.report.content import Claim, Picture, Plot, PlotGrid, ReportTable, Section, Series, from_data, to_data
from fracsim.report.curve_plot import curve_plot
from fracsim.report.html_report import make_report
from fracsim.report.page import write_page
from fracsim.report.plots import SERIES_COLOURS, draw_plot
from fracsim.report.runs import find_runs, flatten_tables


@pytest.fixture(scope="module")
def runs(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A sweep of the bar over two cell sizes, and one run of a strip that breaks."""
    folder = tmp_path_factory.mktemp("report")
    bar = write_study(folder / "bar.toml", BAR)
    assert swept_here(bar, "--set", "mesh.h=0.25,0.125", "-o", folder / "sweep").returncode == 0
    strip = write_study(folder / "strip.toml", STRIP)
    assert fracsim("run", strip, "-o", folder / "strip").returncode == 0
    return folder


@pytest.fixture
def undrawn(monkeypatch: pytest.MonkeyPatch) -> None:
    """Plots are left blank, where only tables are looked at."""
    monkeypatch.setattr("fracsim.report.page.draw_plot", lambda plot, name: "<svg/>")


class Page(HTMLParser):
    """Tags that are open, and everything that would be fetched from elsewhere."""

    VOID = ("meta", "link", "img", "br")

    def __init__(self) -> None:
        super().__init__()
        self.open: list[str] = []
        self.fetched: list[str] = []
        self.ids: list[str] = []

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        if tag not in self.VOID:
            self.open.append(tag)
        for key, value in attributes:
            if tag == "a" and (value or "").endswith(".csv"):
                continue  # a link, which nothing follows by itself
            if key in ("src", "href", "xlink:href", "data", "poster") and not (value or "").startswith(("#", "data:")):
                self.fetched.append(f"{tag} {key}={value}")
            if key == "id" and value:
                self.ids.append(value)

    def handle_startendtag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        self.handle_starttag(tag, attributes)
        if tag not in self.VOID:
            self.open.pop()

    def handle_endtag(self, tag: str) -> None:
        assert self.open.pop() == tag


def parsed(path: Path) -> Page:
    page = Page()
    page.feed(path.read_text())
    assert not page.open, "every tag is closed"
    return page


def table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def whole(runs: Path) -> Path:
    """The report of all of them."""
    return make_report([runs / "sweep", runs / "strip"], runs / "whole" / "page.html", references=[])


def test_the_page_needs_nothing_else(whole: Path) -> None:
    text, page = whole.read_text(), parsed(whole)
    assert page.fetched == [] and "http" not in text and "<script" not in text and "@import" not in text
    assert "url(" not in re.sub(r"url\(#\w+\)", "", text)
    assert text.count("<svg") >= 8
    # markers and clips that plots refer to: each must be in the page once, or plots would draw those of others
    referred = set(re.findall(r'(?:url\(|xlink:href=")#(\w+)', text))
    assert referred and all(page.ids.count(name) == 1 for name in referred)


def test_the_numbers_are_those_of_the_runs(runs: Path, whole: Path) -> None:
    found = {row["run"]: row for row in table(whole.parent / "page" / "runs.csv")}
    assert len(found) == 3
    for name, folder in (("h-0.125", runs / "sweep" / "h-0.125"), ("strip", runs / "strip")):
        summary, row = json.loads((folder / "summary.json").read_text()), found[name]
        assert float(row["wall s"]) == summary["wall"] and int(row["cells"]) == summary["cells"]
        assert float(row["peak reaction_grip_x N"]) == summary["peak_reactions"]["reaction_grip_x"]
        assert int(row["broken edges"]) == summary["broken_edges"]
        assert float(row["solve s"]) == summary["seconds"]["solve"]
    assert int(found["strip"]["broken edges"]) > 0
    assert {found[name]["mesh.h"] for name in found} == {"0.25", "0.125"}


@pytest.mark.usefixtures("undrawn")
def test_every_phase_that_a_run_times_is_in_the_table(tmp_path: Path) -> None:
    """A strip that yields and breaks goes through all of them."""
    tables = {**DUCTILE_TABLES, "time": {"end": 0.02}}
    assert fracsim("run", write_study(tmp_path / "strip.toml", STRIP, **tables), "-o", tmp_path / "run").returncode == 0
    seconds = json.loads((tmp_path / "run" / "summary.json").read_text())["seconds"]
    assert {"plasticity", "fracture"} < set(seconds)
    make_report([tmp_path / "run"], tmp_path / "page.html", references=[])
    (row,) = table(tmp_path / "page" / "runs.csv")
    assert {phase: float(row.get(f"{phase} s") or "nan") for phase in seconds} == seconds


@pytest.mark.usefixtures("undrawn")
def test_error_against_run_time(runs: Path, tmp_path: Path) -> None:
    """The error of the coarse run is that of its peak beside that of the fine one; the fine one has none."""
    quantity = "peak_reaction_grip_x"
    make_report([runs / "sweep"], tmp_path / "page.html", references=[], quantity=quantity)
    coarse, fine = table(tmp_path / "page" / "precision.csv")
    peaks = [
        np.abs(np.genfromtxt(runs / "sweep" / name / "history.csv", delimiter=",", names=True)["reaction_grip_x"]).max()
        for name in ("h-0.25", "h-0.125")
    ]
    assert float(coarse["error, relative"]) == pytest.approx(abs(peaks[0] / peaks[1] - 1), rel=1e-12)
    assert fine["error, relative"] == ""
    make_report([runs / "sweep"], tmp_path / "page.html", references=[], quantity=quantity, exact=2 * peaks[0])
    assert [float(row["error, relative"]) for row in table(tmp_path / "page" / "precision.csv")] == pytest.approx(
        [0.5, 1 - peaks[1] / (2 * peaks[0])]
    )


@pytest.mark.usefixtures("undrawn")
def test_the_peak_of_a_reaction_is_that_at_which_edges_break(tmp_path: Path) -> None:
    """Quasi-static: the load falls within the step that breaks. Its peak is that of summary.json in every table."""
    quasi = {"scheme": "quasi-static", "step": 0.008, "end": 0.024}
    assert (
        fracsim("run", write_study(tmp_path / "strip.toml", STRIP, time=quasi), "-o", tmp_path / "run").returncode == 0
    )
    summary, (run,) = json.loads((tmp_path / "run" / "summary.json").read_text()), find_runs([tmp_path / "run"])
    peak = summary["peak_reactions"]["reaction_grip_x"]
    assert peak > 1.2 * run.history["reaction_grip_x"].max(), "it is reached within a step"
    assert run.quantity("peak_reaction_grip_x") == pytest.approx(peak, rel=1e-9)
    (tmp_path / "curve.csv").write_text(f"motion_grip_x,reaction_grip_x\n0,0\n0.02,{peak:.17g}\n")
    make_report([tmp_path / "run"], tmp_path / "page.html", references=[tmp_path / "curve.csv"])
    (row,) = table(tmp_path / "page" / "references.csv")
    assert float(row["peak, relative"]) == pytest.approx(0, abs=1e-9)


@pytest.mark.usefixtures("undrawn")
def test_a_reference_that_is_the_run_is_no_distance_away(runs: Path, tmp_path: Path) -> None:
    (run,) = find_runs([runs / "strip"])
    x, y = run.history["motion_grip_x"], run.history["reaction_grip_x"]
    np.testing.assert_allclose(x, run.history["time"] * 1.0, rtol=1e-12)  # drawn at 1 m/s
    lines = "\n".join(f"{a:.17g},{b:.17g}" for a, b in zip(x, y, strict=True))
    curve = tmp_path / "curve.csv"
    curve.write_text(f"motion_grip_x,reaction_grip_x\n{lines}\n")
    make_report([runs / "strip"], tmp_path / "page.html", references=[curve])
    (row,) = table(tmp_path / "page" / "references.csv")
    assert float(row["rms, relative"]) < 1e-12 and abs(float(row["peak, relative"])) < 1e-12
    curve.write_text("motion_grip_x,reaction_grip_x\n" + "\n".join(f"{a},{2 * b}" for a, b in zip(x, y, strict=True)))
    make_report([runs / "strip"], tmp_path / "page.html", references=[curve])
    (row,) = table(tmp_path / "page" / "references.csv")
    assert float(row["peak, relative"]) == pytest.approx(-0.5)


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("nothing",), "there is no such folder"),
        (("empty",), "is not the output folder of a run, a sweep or of evidence: it has no study.toml"),
        (("strip", "-o", "page.pdf"), "the report is an .html file"),
        (("strip", "--quantity", "peak_reaction_hand_x"), "has no such figure. Give peak_COLUMN"),
        (("strip", "--exact", "3"), "name it with --quantity"),
        (("strip", "strip"), "the same folder is given twice"),
        (("strip", "--reference", "bad.csv"), "Give a CSV whose first line names columns of history.csv"),
        (("strip", "--reference", "other.csv"), "has no column load"),
    ],
)
def test_what_cannot_be_reported(runs: Path, arguments: tuple[str, ...], words: str) -> None:
    (runs / "empty").mkdir(exist_ok=True)
    (runs / "bad.csv").write_text("time,elastic\n1,two\n")
    (runs / "other.csv").write_text("time,load\n0,1\n")
    names = ("nothing", "empty", "strip", "bad.csv", "other.csv", "page.pdf")
    done = fracsim("report", *(runs / name if name in names else name for name in arguments))
    assert done.returncode == 2 and words in done.stderr and "Traceback" not in done.stderr


def test_the_folder_of_a_job_array_is_that_of_a_sweep(runs: Path, tmp_path: Path) -> None:
    """A job array leaves no sweep.csv: cases go by their names, numbers by value; what is no run is left out."""
    order = ["h-0.5_step-1e-3", "h-0.5_step-0.01", "h-2_step-0.01", "h-10_step-0.01"]
    for name in sorted(order):
        shutil.copytree(runs / "strip", tmp_path / "array" / name)
    (tmp_path / "array" / "logs").mkdir()
    assert [run.folder.name for run in find_runs([tmp_path / "array"])] == order
    swept = {run.folder: run.name for run in find_runs([runs / "sweep"])}
    (runs / "sweep" / "sweep.csv").rename(tmp_path / "sweep.csv")
    try:
        assert {run.folder: run.name for run in find_runs([runs / "sweep"])} == swept
    finally:
        (tmp_path / "sweep.csv").rename(runs / "sweep" / "sweep.csv")


@pytest.mark.usefixtures("undrawn")
def test_an_unfinished_run_is_shown_as_such(runs: Path, tmp_path: Path) -> None:
    folder = tmp_path / "killed"
    folder.mkdir()
    for name in ("study.toml", "history.csv"):
        text = (runs / "strip" / name).read_text()
        (folder / name).write_text(text[:-20] if name == "history.csv" else text)
    make_report([folder], tmp_path / "page.html", references=[])
    (row,) = table(tmp_path / "page" / "runs.csv")
    assert row["outcome"] == "unfinished" and row["steps"] == "9" and float(row["wall s"]) > 0


def test_text_of_a_study_cannot_become_markup(tmp_path: Path) -> None:
    """Titles, names and labels are shown as they are, formulas included."""
    nasty = "<b>$x_1$ & co</b>"
    plot = Plot(nasty, nasty, nasty, (Series(nasty, (1.0, 2.0), (1.0, None), names=(nasty, "")),))
    section = Section(
        nasty, nasty, (Claim(nasty, nasty, False),), (ReportTable("t", nasty, (nasty,), ((nasty,),)),), (plot,)
    )
    target = write_page(tmp_path / "page.html", [section], tmp_path, title=nasty, subtitle=nasty, about={nasty: nasty})
    parsed(target)
    text = target.read_text()
    assert "<b>$x" not in text and "&lt;b&gt;$x_1$ &amp; co&lt;/b&gt;" in text


def test_sections_survive_json() -> None:
    plot = Plot(
        "c", "x", "y", (Series("l", (1.0, None), (2.0, 3.0), "points", ("a", "b"), (0.1, 0.2)),), "loglog", True, (1.0,)
    )
    table_ = ReportTable("t", "c", ("a", "b"), ((1, 2.5), ("x", None)), "run it", (1,))
    grid = PlotGrid("several", (plot, plot), 2)
    sections = [Section("s", "t", (Claim("c", "m", None),), (table_,), (plot, grid), (Picture("p", "a/b.png"),))]
    assert from_data(json.loads(json.dumps(to_data(sections)))) == sections


def test_evidence_is_shown_without_importing_a_study(tmp_path: Path) -> None:
    """From its JSON alone: claims at the top, a picture inside the page, one that does not exist with a remark."""
    from PIL import Image

    Image.new("RGB", (4, 4), "red").save(tmp_path / "there.png")
    pictures = (Picture("there", "there.png"), Picture("gone", "gone.png"))
    sections = [Section("A", claims=(Claim("all is well", "3", True), Claim("more", "4", False)), pictures=pictures)]
    data = {"about": {"cores": "2"}, "groups": {"precision": {"sections": to_data(sections)}}}
    (tmp_path / "evidence.json").write_text(json.dumps(data))
    code = f"""
import sys
from pathlib import Path
from fracsim.errors import FalseClaim
from fracsim.report.curve_plot import curve_plot
from fracsim.report.html_report import make_report
try:
    make_report([Path({str(tmp_path)!r})], references=[])
except FalseClaim:
    print('told', end=' ')
print([name for name in ("dolfinx", "fracsim.studies", "mpi4py", "petsc4py") if name in sys.modules])
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "told []"
    text = (tmp_path / "report.html").read_text()
    assert "1 of 2 claims hold" in text and text.count("data:image/png;base64,") == 1 and "no picture" in text
    (tmp_path / "evidence.json").write_text("{}")
    with pytest.raises(InputError, match="cannot be read"):
        make_report([tmp_path], references=[])


def test_what_is_first_lies_open_and_the_rest_is_folded(tmp_path: Path) -> None:
    """A section of the first screen goes before the claims, those that fail before those that hold, which are folded
    away, as are all other sections; a page without a first screen lies open."""
    some = (Claim("it is well", "3", True), Claim("it is bad", "4", False), Claim("it is open", "not run", None))
    sections = [Section("Far down", "deep text", some), Section("Up front", "short text", first=True)]
    for name, part in (("short", sections), ("long", sections[:1])):
        data = {"about": {}, "groups": {"precision": {"sections": to_data(part)}}}
        (tmp_path / name).mkdir()
        (tmp_path / name / "evidence.json").write_text(json.dumps(data))
        with pytest.raises(FalseClaim):
            make_report([tmp_path / name], references=[])
    text = (tmp_path / "short" / "report.html").read_text()
    order = ["short text", "What must hold", "it is bad", "<details>", "it is open", "<details>", "it is well"]
    places = [text.index(order[0])]
    for words in order[1:]:
        places.append(text.index(words, places[-1]))
    folded = text.index('<details class="part">')
    assert places[-1] < folded < text.index("Far down", folded)
    assert text.index("deep text") > folded and "1 of 3 claims do not hold" in text
    assert '<details class="part">' not in (tmp_path / "long" / "report.html").read_text()


def test_small_multiples_have_a_panel_for_each_plot_and_one_legend() -> None:
    """A label that two panels share is in the legend once, in one colour; titles are captions; numbers have scales of
    their own."""
    ours, theirs = Series("we", (1.0, 2.0), (3.0, 4.0)), Series("they", (10.0, 20.0), (0.1, 0.2))
    panels = (Plot("First", "s", "error", (ours,)), Plot("Second", "s", "error", (theirs, ours)))
    text = draw_plot(PlotGrid("both", panels, columns=2), "grid")
    assert [text.count(f">{words}</text>") for words in ("First", "Second", "we", "they")] == [1, 1, 1, 1]
    assert text.count(">error</text>") == 1 and text.count(">s</text>") == 2
    first, second = SERIES_COLOURS[:2]
    # lines and markers of both panels and of the legend
    assert text.count(f"stroke: {first}") > text.count(f"stroke: {second}") > 0


def test_names_in_a_plot_are_clear_of_one_another() -> None:
    """Twelve points in a heap and two apart, by the size that the names are really drawn at; most of them are there."""
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    from fracsim.report.plots import label_points

    random = np.random.default_rng(5)
    points = [*random.normal(0.0, 0.1, (12, 2)).tolist(), [-1.0, 1.0], [1.0, -1.0]]
    figure = Figure(figsize=(6.4, 3.8))
    canvas = FigureCanvasAgg(figure)
    axes = figure.add_subplot()
    axes.plot(*np.transpose(points), "o")
    label_points(axes, [(x, y, f"trial-{at}-mm") for at, (x, y) in enumerate(points)], [tuple(p) for p in points])
    boxes = [text.get_window_extent(canvas.get_renderer()) for text in axes.texts]
    assert len(boxes) >= 8
    assert not any(one.overlaps(other) for at, one in enumerate(boxes) for other in boxes[:at])
    assert all(axes.bbox.x0 <= box.x0 and box.x1 <= axes.bbox.x1 for box in boxes)


@pytest.mark.parametrize(("holds", "code"), ((True, 0), (None, 0), (False, 1)))
def test_a_false_claim_ends_the_command_with_1(tmp_path: Path, holds: bool | None, code: int) -> None:
    """The page is written all the same, and the message names the claim."""
    sections = [Section("A", claims=(Claim("the sky is green", "blue", holds),))]
    data = {"about": {}, "groups": {"precision": {"sections": to_data(sections)}}}
    (tmp_path / "evidence.json").write_text(json.dumps(data))
    done = fracsim("report", tmp_path)
    assert done.returncode == code and (tmp_path / "report.html").exists()
    assert ("1 claims do not hold: the sky is green (blue)" in done.stderr) == (code == 1)


def test_tables_inside_tables_are_named_by_their_path() -> None:
    data = {"a": {"b": 1, "c": [{"d": 2}, {"d": 3}]}, "e": [1, 2]}
    assert flatten_tables(data) == {"a.b": 1, "a.c.0.d": 2, "a.c.1.d": 3, "e": [1, 2]}


# --- fracsim plot ---


def test_a_curve_beside_an_experiment_in_its_own_units(runs: Path, tmp_path: Path) -> None:
    """A test's CSV in mm and kN, written from the run itself, lies on the curve of the run."""
    folder = runs / "strip"
    (run,) = find_runs([folder])
    x, y = (next(name for name in run.history if name.startswith(kind)) for kind in ("motion_", "reaction_"))
    measured = tmp_path / "measured.csv"
    rows = zip(run.history[x] / 1e-3, run.history[y] / 1e3, strict=True)
    measured.write_text("u (mm),F (kN)\n" + "".join(f"{u:.17g},{f:.17g}\n" for u, f in rows))
    plot = curve_plot([folder], x, y, [measured], (1e-3, 1e3))
    ours, theirs = plot.series
    assert np.allclose(ours.x, theirs.x) and np.allclose(ours.y, theirs.y)
    size = {"": 1.0, "m": 1e-3, "µ": 1e-6, "k": 1e3, "M": 1e6}[plot.y.partition(", ")[2].removesuffix("N")]
    assert np.allclose(np.array(ours.y) * size, run.history[y])
    assert 1 <= max(map(abs, ours.y)) < 1000


@pytest.mark.parametrize("suffix", [".svg", ".png", ".pdf"])
def test_a_curve_is_drawn_as_what_other_programs_open(runs: Path, tmp_path: Path, suffix: str) -> None:
    target = tmp_path / f"curve{suffix}"
    result = fracsim("plot", runs / "sweep", runs / "strip", "--y", "elastic", "-o", target)
    assert result.returncode == 0, result.stderr
    if suffix == ".svg":
        text = " ".join(ElementTree.parse(target).getroot().itertext())
        assert "strip" in text and "time, " in text and "elastic, " in text
    elif suffix == ".png":
        pixels = imageio.v3.imread(target)
        assert pixels.shape[:2] == (608, 1024) and pixels[0, 0].min() == 255 and pixels.min() < 50
    else:
        assert target.read_bytes().startswith(b"%PDF")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("--y", "strength"), "no column strength; it has: step, time"),
        (("--y", "elastic", "-o", "curve.jpeg"), "a curve is drawn as .svg, .png, .pdf"),
        (("--y", "elastic", "--scale", "1e-3"), "must be two factors other than 0"),
        (("--y", "elastic", "--reference", "three.csv"), "it has the columns a, b, c, but not time and elastic"),
        (("--y", "elastic", "--reference", "bare.csv"), "where the names of the columns belong"),
        (("--y", "elastic", "--reference", "ragged.csv"), "the first line has 2 columns, the line '1,2,3' 3"),
    ],
)
def test_what_cannot_be_drawn_is_refused(runs: Path, tmp_path: Path, arguments: tuple[str, ...], message: str) -> None:
    (tmp_path / "three.csv").write_text("a,b,c\n1,2,3\n2,3,4\n")
    (tmp_path / "ragged.csv").write_text("a,b\n1,2,3\n")
    (tmp_path / "bare.csv").write_text("1,2\n2,3\n")
    given = [tmp_path / each if each.endswith(".csv") else each for each in arguments]
    result = fracsim("plot", runs / "strip", *given)
    assert result.returncode == 2 and message in result.stderr and "Traceback" not in result.stderr


def test_tables_are_links_to_their_files_and_the_end_is_in_the_contents(runs: Path, tmp_path: Path) -> None:
    page = make_report([runs / "sweep"], tmp_path / "two words.html", references=[])
    text = page.read_text(encoding="utf-8")
    links = re.findall(r'<p class="caption"[^>]*>.*?<a href="([^"]+)">', text)
    assert links and all((tmp_path / unquote(link)).is_file() for link in links)
    targets = set(re.findall(r'id="([^"]+)"', text))
    assert {"about"} <= set(re.findall(r'<a href="#([^"]+)"', text)) <= targets


def test_a_report_links_to_its_runs_in_3d(runs: Path, tmp_path: Path) -> None:
    """A page of each run, with its frames; the address has the name of the folder as it is."""
    page = make_report([runs / "sweep", runs / "strip"], tmp_path / "two words.html", references=[], view=True)
    line = re.findall(r"<p>In 3D: (.*)</p>", page.read_text(encoding="utf-8"))
    links = re.findall(r'<a href="([^"]+)">([^<]+)</a>', line[0])
    assert len(links) == len({address for address, _ in links}) == 1 + len(list((runs / "sweep").glob("*/study.toml")))
    for address, _ in links:
        text = (tmp_path / unquote(address)).read_text(encoding="utf-8")
        data = json.loads(re.findall(r'<script type="application/json" id="data">(.*?)</script>', text, re.DOTALL)[0])
        assert data["frames"] and data["outcome"] == "done"
