"""Pictures of docs/gallery.md and the page itself, which `make gallery` makes.

    python3 -m fracsim.studies.gallery [NAME ...] [--again] [--jobs N]

A run that has ended is not repeated, unless --again is given.
"""

from __future__ import annotations

import argparse
import csv
import json
import os
import re
import shlex
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from pathlib import Path

MAX_PICTURE_BYTES = 300_000  # bytes of a picture
MAX_SINGLE_NODE_SHARE = 0.05  # share of pieces: a study whose pieces are single nodes shows its mesh, not a fracture
PAGE = Path("docs/gallery.md")
RUNS = Path("out/gallery")
HEAD = """# Gallery

Each picture is made by the commands below it; `make gallery` makes all of them again. Seconds are processor time on one
rank. Pieces are fragments at the end of the run; single-node fragments are given in parentheses. M22: Mandal et al.
(2022).

"""


@dataclass(frozen=True)
class GalleryEntry:
    """A picture of the gallery.

    Attributes:
        name: stem of the file.
        text: caption.
        runs: (output folder, arguments of `fracsim run`) of each run shown.
        render: arguments of `fracsim render` without folders and output; without runs, a module that draws the file.
        film: all frames, as a GIF.
    """

    name: str
    text: str
    runs: tuple[tuple[str, str], ...]
    render: str
    film: bool = False


def packaged_entry(study: str, text: str, render: str) -> GalleryEntry:
    """Entry of a packaged study with its own settings."""
    return GalleryEntry(study, text, ((study, study),), render)


CUTS = "--set mesh.h=0.012 --set time.end=0.2 --set output.cut="
NVE36 = (
    "--set 'material.like=steel NVE 36 at 23 C' --set material.energy=corotated --set plasticity.update=implicit"
    " --set fracture.energy=false --set fracture.radius=8e-4 --set time.step=1e-5 --set time.breaking_step=1e-5"
)
AVERAGED = "doormat --set fracture.radius=0.05 --set fracture.strength=2e5 --set time.step=4e-4"
ENTRIES = (
    packaged_entry("loaf", "A loaf of bread, fixed at one end and pulled at the other until it tears.",
                   "--sheet 0,14,18,-1 --floor"),
    GalleryEntry(
        "cuts", "Crack surface with edges cut at midpoints, by nodal forces, and smoothed (M22 fig. 12).",
        tuple((f"cut-{item}", f"loaf {CUTS}{item}") for item in ("middle", "forces", "smooth")),
        "--view 1.1,-1.0,0.5 --size 1400x1100",
    ),
    GalleryEntry(
        "loaf-frames", "The loaf while it tears, row by row (M22 fig. 13).", (("loaf", "loaf"),),
        "--sheet 4,12,14,16,18,20,24,29,-1 --floor --size 1200x800",
    ),
    packaged_entry("bread", "Bread that deforms plastically before it tears (M22 fig. 15).",
                   "--sheet 0,36,48,-1 --floor"),
    packaged_entry("bar-2d", "Axial stress in a strip pulled at both ends.",
                   "--field stress:xx --sheet 15,30 --size 1600x700"),
    GalleryEntry(
        "bar-2d-stress",
        "Shear stress in the torn strip: degraded energy `chi`, and projected strain `edge` (M22 fig. 9).",
        (("bar-chi", "bar-2d --set time.end=0.11"),
         ("bar-edge", "bar-2d --set time.end=0.096 --set material.energy=linear --set fracture.approach=edge")),
        "--field stress:xy --size 1100x600",
    ),
    packaged_entry("notched-bar", "A notched bar in three-point bending, displacements magnified ten times.",
                   "--magnify 10"),
    packaged_entry("cylinder",
                   "A granite cylinder that breaks near its grips; cracks that hardly open are drawn as lines.",
                   "--view 0.6,-1.6,0.5"),
    GalleryEntry(
        "doormat", "A doormat torn with a local strength criterion, and with stress averaged over 5 cm (M22 fig. 6).",
        (("doormat", "doormat"), ("doormat-averaged", AVERAGED)), "--view=-1.2,-0.5,0.35 --size 900x700",
    ),
    packaged_entry("jelly-figure", "A jelly figure pulled by its limbs, at the start and at the end.",
                   "--sheet 0,-1 --view 0.3,-1.6,0.4"),
    packaged_entry("struck-figure", "A jade figure after a pressure pulse on its chest; pieces are moved apart.",
                   "--field piece --explode 0.2"),
    packaged_entry("struck-vase",
                   "A porcelain vase after a pressure pulse on its belly, with at most 150 crack surfaces.", "--floor"),
    GalleryEntry(
        "vase-50-150-300", "The same vase with at most 50, 150 and 300 crack surfaces (M22 fig. 16).",
        (("vase-50", "struck-vase --set brittle.surfaces=50"), ("struck-vase", "struck-vase"),
         ("vase-300", "struck-vase --set brittle.surfaces=300")), "--size 700x700",
    ),
    packaged_entry("wall", "An adobe wall after a pressure pulse; it breaks along grain boundaries.",
                   "--view 0.5,-1.6,0.5 --floor"),
    packaged_entry("hammered-vase", "The vase on a table, hit by a ball.", "--view 0.55,-1.2,0.35 --floor"),
    packaged_entry("dropped-vase", "A vase dropped on an inclined table.", "--view 0.4,-1.5,0.3"),
    packaged_entry("platens", "Brazilian test with the approach `edge`, coloured by piece.", "--field piece"),
    packaged_entry("bent-bar", "A glass bar on two supports, hit in the middle by a cylinder.", "--view 0.3,-1.6,0.25"),
    packaged_entry("hammered-figure", "A jade figure on a table, hit on its belly by a hammer.",
                   "--view 0.75,-1.2,0.35"),
    GalleryEntry(
        "punched-slab", "A metal slab perforated by a ball, seen from below.",
        (("punched-slab", "punched-slab --set mesh.h=0.008"),), "--view=0.5,-1.1,-0.45",
    ),
    packaged_entry("table-loaf", "A loaf torn over a table; pieces of it fall on the table.", "--view 0.35,-1.3,0.45"),
    packaged_entry("bowl", "Fifty stones in a bowl.", "--view 0.3,-1.0,0.9"),
    packaged_entry(
        "rigid-wall", "An adobe wall of rigid bodies, seen from behind, 40, 120 and 240 ms after the ball starts.",
        "--view 0.6,1.4,0.5 --sheet 1,3,6 --floor",
    ),
    packaged_entry("rigid-slab", "A rigid metal slab perforated by a ball.", "--view 0.5,-1.1,0.6 --sheet 1,3,8"),
    packaged_entry("rigid-rods", "Two steel rods as rigid bodies: one is bent, the other dented.",
                   "--sheet 0,5,-1 --floor --view 0.25,-1.3,0.45"),
    packaged_entry("rigid-vase", "A rigid vase dropped on a floor, after 0, 40, 100 and 200 ms.",
                   "--sheet 0,4,10,-1 --floor"),
    GalleryEntry(
        "rigid-vase-film", "The same vase as a film, twenty times slower.", (("rigid-vase", "rigid-vase"),),
        "--floor --size 520x340 --fps 5", film=True,
    ),
    packaged_entry(
        "rigid-figure", "A rigid jade figure thrown at a wall, after 20, 60 and 100 ms.",
        "--sheet 1,3,5 --view=-1,-1.2,0.6 --floor",
    ),
    packaged_entry("rigid-ornament", "A glass shell, dropped on its neck.", "--sheet 0,2,8,-1 --floor"),
    packaged_entry("rigid-ornaments", "Eighteen closed glass shells dropped on a floor.",
                   "--sheet 0,2,-1 --floor --view 0.9,-1.3,0.6"),
    packaged_entry("rigid-boats", "Rowing boats dropped on one another; they do not break.",
                   "--sheet 0,6,-1 --floor --view 0.9,-1.3,0.6"),
    GalleryEntry(
        "rigid-beside", "The same vase as a deformable body after 1 ms, and as a rigid body after 32 ms.",
        (("dropped-vase", "dropped-vase"), ("rigid-dropped-vase", "rigid-dropped-vase")),
        "--frame 16 --field piece --view 0.4,-1.5,0.3 --size 1100x800",
    ),
    GalleryEntry(
        "rigid-trials", "Cracks of a bar by penalty forces; its stress with pinned nodes; strain of finite rotations.",
        (),
        "fracsim.studies.rigid_trials",
    ),
    packaged_entry("brazilian",
                   "A granite disk that cracks along its loaded diameter between platens: horizontal stress.",
                   "--field stress:xx"),
    packaged_entry("granite-cylinder",
                   "A granite cylinder that splits between platens, while its load falls and at the end.",
        "--sheet=-13,-1 --view top --magnify 5 --size 1400x700"),
    GalleryEntry(
        "steels", "Charpy and Izod bars of steel A516 at -40 C, which breaks, and of NVE 36 at 23 C, which bends.",
        (("charpy-A516", "charpy"), ("charpy-NVE36", f"charpy {NVE36}"),
         ("izod-A516", "izod"), ("izod-NVE36", f"izod {NVE36}")), "--size 1400x600",
    ),
    GalleryEntry(
        "charpy-3d",
        "Charpy bars in space: A516 at -40 C breaks, NVE 36 at 23 C bends and cracks over a third of its ligament.",
        (("charpy-3d", "charpy-3d"), ("charpy-3d-ductile", "charpy-3d-ductile")),
        "--view 0.5,-1.1,-0.45 --field crack --size 1400x560",
    ),
    packaged_entry("kalthoff", "A notched steel plate under impact on the side below its notch: vertical stress.",
                   "--field stress:yy"),
    packaged_entry("l-panel", "Degradation `chi` of the elastic energy in a cracked concrete panel.",
                   "--field chi --magnify 40"),
    packaged_entry("branching", "A glass plate whose crack branches, coloured by piece.", "--view top --field piece"),
)  # fmt: skip


def main() -> None:
    """Run missing studies, draw their pictures, and write the page."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", help=f"{', '.join(entry.name for entry in ENTRIES)}")
    parser.add_argument("--again", action="store_true", help="also what has run")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="runs at a time (as many as cores)")
    asked = parser.parse_args()
    if unknown := set(asked.names) - {entry.name for entry in ENTRIES}:
        sys.exit(f"no picture is called {', '.join(sorted(unknown))}")
    wanted = [entry for entry in ENTRIES if not asked.names or entry.name in asked.names]
    runs = dict(run for entry in wanted for run in entry.runs)
    with ThreadPoolExecutor(asked.jobs) as pool:
        list(pool.map(lambda run: run_study(*run, again=asked.again), runs.items()))
        list(pool.map(draw_picture, wanted))
    PAGE.write_text(
        HEAD + "".join(page_section(entry) for entry in ENTRIES if picture_path(entry).exists()), encoding="utf-8"
    )
    for folder in runs:
        count, single = count_fragments(RUNS / folder)
        if single > MAX_SINGLE_NODE_SHARE * count:
            sys.exit(f"{folder}: {single} of {count} pieces are single nodes, more than {MAX_SINGLE_NODE_SHARE:.0%}")


def run_study(folder: str, arguments: str, *, again: bool) -> None:
    """Run a study, unless its output folder holds a run that has ended."""
    if again or not has_ended(RUNS / folder):
        command = ["fracsim", "run", *shlex.split(arguments), "-o", str(RUNS / folder), "--overwrite"]
        subprocess.run([*command, "--set", "output.picture=false"], check=True)


def draw_picture(entry: GalleryEntry) -> None:
    """Draw the picture of an entry."""
    target = picture_path(entry)
    if entry.runs:
        folders = [str(RUNS / folder) for folder, _ in entry.runs]
        subprocess.run(["fracsim", "render", *folders, "-o", str(target), *shlex.split(entry.render)], check=True)
    else:
        subprocess.run([sys.executable, "-m", entry.render, str(target)], check=True)
    if not entry.film:
        reduce_colours(target)


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


def picture_path(entry: GalleryEntry) -> Path:
    """File of the picture, in the folder beside the page."""
    return PAGE.parent / "gallery" / f"{entry.name}.{'gif' if entry.film else 'png'}"


def page_section(entry: GalleryEntry) -> str:
    """Section of the page for an entry, in Markdown."""
    lines = [f"    ./env fracsim run {arguments} -o {RUNS / folder}" for folder, arguments in entry.runs]
    folders = " ".join(str(RUNS / folder) for folder, _ in entry.runs)
    file = picture_path(entry).name
    last = f"python3 -m {entry.render} {file}"
    if entry.runs:
        last = f"fracsim render {folders} {entry.render}" + (f" -o {file}" if entry.film else "")
    body = "\n".join([*lines, f"    ./env {last}"])
    said = f"{entry.text} {run_figures(entry)}".rstrip()
    return f"## {entry.name}\n\n![{entry.text}](gallery/{file})\n\n{said}\n\n{body}\n\n"


def run_figures(entry: GalleryEntry) -> str:
    """Processor time and fragments of the entry's runs; the page's old text if a run is missing."""
    folders = [RUNS / folder for folder, _ in entry.runs]
    if not all(map(has_ended, folders)):
        page = PAGE.read_text(encoding="utf-8") if PAGE.exists() else ""
        of_it = next((part for part in page.split("\n## ") if part.startswith(f"{entry.name}\n")), "")
        results = re.search(r" (\d+ s[.;].*)$", of_it, re.MULTILINE)
        return results[1] if results else ""
    seconds = sum(json.loads((folder / "summary.json").read_text(encoding="utf-8"))["cpu"] for folder in folders)
    counts = [count_fragments(folder) for folder in folders]
    parts = ", ".join(f"{count} ({single} of one node)" if single else str(count) for count, single in counts if count)
    return (f"{seconds:.0f} s" + (f"; pieces: {parts}" if parts else "") + ".") if entry.runs else ""


def count_fragments(folder: Path) -> tuple[int, int]:
    """(fragments, single-node fragments) at the end of a run; (0, 0) if nothing broke."""
    path = folder / "pieces.csv"
    rows = list(csv.DictReader(path.open(encoding="utf-8"))) if path.exists() else []
    last = [row for row in rows if row["time"] == rows[-1]["time"]]
    return len(last), sum(float(row["dust"]) > 0 for row in last)


if __name__ == "__main__":
    main()
