"""Pages of pictures: studies are run, their pictures drawn, and a page written with the commands that make them."""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path

MAX_PICTURE_BYTES = 300_000  # bytes of a picture
MAX_SINGLE_NODE_SHARE = 0.05  # share of pieces: a study whose pieces are single nodes shows its mesh, not a fracture
RUNS, PICTURES = Path("out/gallery"), Path("docs/gallery")


@dataclass(frozen=True)
class PictureEntry:
    """A picture of a page.

    Attributes:
        name: stem of the file.
        text: caption.
        runs: (output folder, arguments of `fracsim run`) of each run shown.
        render: arguments of `fracsim render` without folders and output; without runs, a module that draws the file.
        film: all frames, as a GIF.
        below: `render` of further pictures of the same runs, drawn below one another.
        plot: arguments of `fracsim plot` without folders and output, drawn below the pictures; empty for no plot.
        remark: paragraph below the caption.
    """

    name: str
    text: str
    runs: tuple[tuple[str, str], ...]
    render: str
    film: bool = False
    below: tuple[str, ...] = ()
    plot: str = ""
    remark: str = ""


def packaged_entry(study: str, text: str, render: str) -> PictureEntry:
    """Entry of a packaged study with its own settings."""
    return PictureEntry(study, text, ((study, study),), render)


@dataclass(frozen=True)
class PicturePage:
    """A page of pictures, in Markdown; the pictures are in docs/gallery.

    Attributes:
        path: file of the page.
        head: text above the pictures.
        entries: pictures.
        max_single_nodes: share of pieces that may be single nodes.
    """

    path: Path
    head: str
    entries: Sequence[PictureEntry]
    max_single_nodes: float = MAX_SINGLE_NODE_SHARE

    def make(self, description: str | None) -> None:
        """Run missing studies, draw their pictures, and write the page, as the command line says."""
        parser = argparse.ArgumentParser(description=description, formatter_class=argparse.RawDescriptionHelpFormatter)
        names = [entry.name for entry in self.entries]
        parser.add_argument("names", nargs="*", metavar="NAME", help=", ".join(names))
        parser.add_argument("--again", action="store_true", help="also what has run")
        parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs at a time (as many as cores)")
        asked = parser.parse_args()
        if unknown := set(asked.names) - set(names):
            sys.exit(f"no picture is called {', '.join(sorted(unknown))}")
        wanted = [entry for entry in self.entries if not asked.names or entry.name in asked.names]
        wanted.sort(key=self._seconds, reverse=True)  # no core waits for a long run that another began last
        runs = dict(run for entry in wanted for run in entry.runs)
        with ThreadPoolExecutor(asked.jobs) as pool:
            list(pool.map(lambda run: run_study(*run, again=asked.again), runs.items()))
        # Processes load the library of pictures once, not once a picture.
        with ProcessPoolExecutor(asked.jobs, mp_context=get_context("spawn")) as processes:
            list(processes.map(draw_picture, wanted))
        drawn = [entry for entry in self.entries if picture_path(entry).exists()]
        self.path.write_text(self.head + "".join(self._section(entry) for entry in drawn), encoding="utf-8")
        for folder in runs:
            count, single = count_fragments(RUNS / folder)
            if single > self.max_single_nodes * count:
                share = f"{self.max_single_nodes:.0%}"
                sys.exit(f"{folder}: {single} of {count} pieces are single nodes, more than {share}")

    def _section(self, entry: PictureEntry) -> str:
        """Section of the page for an entry."""
        lines = [f"    ./env fracsim run {arguments} -o {RUNS / folder}" for folder, arguments in entry.runs]
        file = picture_path(entry).name
        lines += [f"    ./env {command}" for command in draw_commands(entry, file)]
        said = f"{entry.text} {self._figures(entry)}".rstrip() + (f"\n\n{entry.remark}" if entry.remark else "")
        return f"## {entry.name}\n\n![{entry.text}](gallery/{file})\n\n{said}\n\n" + "\n".join(lines) + "\n\n"

    def _old_figures(self, entry: PictureEntry) -> str:
        """Processor time and fragments of the entry's runs as the page says; empty if it does not."""
        page = self.path.read_text(encoding="utf-8") if self.path.exists() else ""
        of_it = next((part for part in page.split("\n## ") if part.startswith(f"{entry.name}\n")), "")
        results = re.search(r" (\d+ s[.;].*)$", of_it, re.MULTILINE)
        return results[1] if results else ""

    def _seconds(self, entry: PictureEntry) -> int:
        """Processor time of the entry's runs as the page says, s; 0 if it does not."""
        return int(self._old_figures(entry).partition(" ")[0] or 0)

    def _figures(self, entry: PictureEntry) -> str:
        """Processor time and fragments of the entry's runs; the page's old text if a run is missing."""
        folders = [RUNS / folder for folder, _ in entry.runs]
        if not all(map(has_ended, folders)):
            return self._old_figures(entry)
        seconds = sum(json.loads((folder / "summary.json").read_text(encoding="utf-8"))["cpu"] for folder in folders)
        counts = [count_fragments(folder) for folder in folders]
        parts = ", ".join(
            f"{count} ({single} of one node)" if single else str(count) for count, single in counts if count
        )
        return (f"{seconds:.0f} s" + (f"; pieces: {parts}" if parts else "") + ".") if entry.runs else ""


def run_study(folder: str, arguments: str, *, again: bool) -> None:
    """Run a study, unless its output folder holds a run that has ended."""
    if again or not has_ended(RUNS / folder):
        command = ["fracsim", "run", *shlex.split(arguments), "-o", str(RUNS / folder), "--overwrite"]
        subprocess.run([*command, "--set", "output.picture=false"], check=True)


def draw_commands(entry: PictureEntry, file: str) -> list[str]:
    """Commands that draw an entry's pictures: one file, or one for each that is drawn below another."""
    if not entry.runs:
        return [f"python3 -m {entry.render} {file}"]
    folders = " ".join(str(RUNS / folder) for folder, _ in entry.runs)
    commands = drawings(entry)
    stem, suffix = file.rsplit(".", 1)
    rows = [f" -o {stem}-{row}.{suffix}" for row in range(1, len(commands) + 1)]
    if len(commands) == 1:
        rows = [f" -o {file}" if entry.film else ""]
    return [f"fracsim {name} {folders} {options}{row}" for (name, options), row in zip(commands, rows, strict=True)]


def drawings(entry: PictureEntry) -> list[tuple[str, str]]:
    """Commands of fracsim that draw an entry's pictures, and their arguments without folders and output."""
    commands = [("render", render) for render in (entry.render, *entry.below)]
    return [*commands, ("plot", entry.plot)] if entry.plot else commands


def draw_picture(entry: PictureEntry) -> None:
    """Draw the picture of an entry."""
    from ..cli import app

    target = picture_path(entry)
    if not entry.runs:
        subprocess.run([sys.executable, "-m", entry.render, str(target)], check=True)
        return
    folders = [str(RUNS / folder) for folder, _ in entry.runs]
    commands = drawings(entry)
    rows = [RUNS / f"{entry.name}-{row}{target.suffix}" for row in range(len(commands))]
    for (name, options), row in zip(commands, rows, strict=True):
        app([name, *folders, "-o", str(row), *shlex.split(options)], standalone_mode=False)
    if len(rows) == 1:
        shutil.move(rows[0], target)
    else:
        stack_pictures(rows, target)
    if not entry.film:
        reduce_colours(target)


def stack_pictures(rows: Sequence[Path], target: Path) -> None:
    """Write one picture with those of `rows` below one another."""
    from PIL import Image

    images = [Image.open(row).convert("RGB") for row in rows]
    whole = Image.new("RGB", (max(image.width for image in images), sum(image.height for image in images)), "white")
    top = 0
    for image in images:
        whole.paste(image, (0, top))
        top += image.height
    whole.save(target)


def has_ended(folder: Path) -> bool:
    """Return whether the folder holds a run that has ended."""
    try:
        return bool(json.loads((folder / "summary.json").read_text(encoding="utf-8"))["outcome"] == "done")
    except (OSError, ValueError, KeyError):
        return False


def reduce_colours(path: Path) -> None:
    """Reduce a picture larger than MAX_PICTURE_BYTES to 256 colours."""
    from PIL import Image

    if path.stat().st_size > MAX_PICTURE_BYTES:
        with Image.open(path) as image:
            small = image.convert("RGB").quantize(256, dither=Image.Dither.NONE)
        small.save(path, optimize=True)


def picture_path(entry: PictureEntry) -> Path:
    """File of the picture."""
    return PICTURES / f"{entry.name}.{'gif' if entry.film else 'png'}"


def count_fragments(folder: Path) -> tuple[int, int]:
    """(fragments, single-node fragments) at the end of a run; (0, 0) if nothing broke."""
    path = folder / "pieces.csv"
    rows = list(csv.DictReader(path.open(encoding="utf-8"))) if path.exists() else []
    last = [row for row in rows if row["time"] == rows[-1]["time"]]
    return len(last), sum(float(row["dust"]) > 0 for row in last)
