"""Figures of Mandal et al. (2022) and Bao et al. (2007), and docs/paper-figures.md, which `make figures` makes.

    python3 -m fracsim.studies.paper_figures [NAME ...] [--again] [--jobs N]

A run that has ended is not repeated, unless --again is given.
"""

from __future__ import annotations

import shlex
from pathlib import Path

from .paper_table import SCENES, overrides
from .picture_page import PictureEntry, PicturePage

HEAD = """# Figures of the papers

M22 is Mandal et al. (2022), M22s its supplement, B07 Bao et al. (2007). Their bodies are not public: a figure takes the
place of the armadillo, a vase that of the bunny. Each picture is made by the commands below it; `make figures` makes
all of them again. Seconds are processor time on one rank; single-node fragments are given in parentheses.

Figures that have their picture elsewhere:

| figure | picture |
|---|---|
| M22 1, 13 | [loaf](gallery.md#loaf), [loaf-frames](gallery.md#loaf-frames) |
| M22 5, 7, 10, 11 | drawings, no results |
| M22 12 | [cuts](gallery.md#cuts) |
| M22 16 | [vase-50-150-300](gallery.md#vase-50-150-300) |
| M22 18 | [charpy-3d](gallery.md#charpy-3d), [steels](gallery.md#steels) |
| M22 22 | [granite-cylinder](gallery.md#granite-cylinder), [brazilian](gallery.md#brazilian) |
| M22 23 to 25 | XFEM beside the paper's method: [the report](accuracy.md) has virtual nodes in place of XFEM |
| B07 2, 13 | [rigid-slab](gallery.md#rigid-slab), [rigid-rods](gallery.md#rigid-rods) |
| B07 5 | no picture: contact is solved by impulses, so no body is deformed and set back to a rigid state |
| B07 6, upper rows | [rigid-wall](gallery.md#rigid-wall) |
| B07 7, 9, 10 | [rigid-trials](gallery.md#rigid-trials) |

"""


def table_run(row: str) -> str:
    """Arguments of `fracsim run` for a row of table 2 of M22."""
    sets = [item for item in overrides(SCENES[row], small=False) if not item.startswith("output.picture=")]
    return " ".join([SCENES[row].study, *(f"--set {shlex.quote(item)}" for item in sets)])


SHORT_LOAF = "loaf --set time.end=0.18"
STRIP = "bar-2d --set time.end="
STRIP_FIELDS = ("stress:xx", "stress:xy", "stress:yy")
DEBRIS = (
    "bread --set mesh.h=0.012 --set time.end=0.4 --set brittle.surfaces=60 --set brittle.per_pass=6"
    """ --set brittle.spacing=0.008 --set 'brittle.grains={count=900,seed=4,spread=0.3,mode="bias"}'"""
)
PLANES = (
    'obstacle=[{name="floor",shape="plane",at=[0.0,0.0,0.0],normal=[0.0,0.0,1.0],friction=0.5},'
    '{name="wall",shape="plane",at=[0.6,0.0,0.0],normal=[-1.0,0.0,0.0],friction=0.5},'
)
SHOT_FIGURE = (
    "rigid-figure --set mesh.h=0.009 --set brittle.surfaces=100 --set 'body.0.velocity=[4.0,0.0,1.5]'"
    f' --set \'{PLANES}{{name="projectile",shape="sphere",radius=0.025,at=[-0.1,0.0,0.45],velocity=[40.0,0.0,0.0],'
    "density=7800.0}]' --set time.step=5e-4 --set time.end=0.2 --set output.interval=4e-3"
)
SHOT_VIEW = "--sheet 0,2,4,6,10,20 --size 1200x800 --zoom 1.7 --view=-0.6,-1.5,0.4 --floor"
SHOT_VASE = (
    "rigid-vase --set mesh.wall=0.0 --set mesh.h=0.011 --set brittle.surfaces=60 --set brittle.spacing=0.012"
    " --set 'body=[{position=[0.0,0.0,0.3],spin=[0.0,2.0,0.0]}]'"
    f' --set \'{PLANES}{{name="projectile",shape="sphere",radius=0.02,at=[-0.15,0.0,0.48],velocity=[60.0,0.0,0.0],'
    "density=7800.0}]' --set time.step=5e-4 --set time.end=0.1 --set output.interval=2e-3"
)
CROSSED_BOATS = (
    "rigid-boats --set 'body=[{position=[0.0,0.0,0.6]},{position=[0.0,0.0,1.2],rotation=[2.2214,2.2214,0.0]}]'"
    " --set output.interval=0.05"
)
ORNAMENTS = "rigid-ornaments --set 'body.0.copies=[5,5,4]' --set brittle.surfaces=23 --set time.step=0.005"
IZOD_CELLS = "--set mesh.h=0.0018 --set mesh.h_notch=0.00052"
GRAINS = """rigid-ornament --set 'brittle.grains={ count = 40, seed = 2, spread = 0.15, mode = "replace" }'"""


def strip(name: str, number: int, text: str, options: str, frames: str) -> PictureEntry:
    """Crack and three stresses of the strip of M22, figs. 8 and 9, below one another."""
    sheet = f"--sheet {frames} --size 1000x400"
    below = tuple(f"--field {field} {sheet}" for field in STRIP_FIELDS)
    return PictureEntry(name, f"{text} (M22 fig. {number}).", ((name, f"{STRIP}{options}"),), sheet, below=below)


ENTRIES = (
    PictureEntry(
        "jelly-strain", "Strain of a jelly figure before and after its limbs tear (M22 fig. 2).",
        (("jelly-figure", "jelly-figure"),), "--field strain --sheet 8,12,16,24 --view 0.3,-1.6,0.4",
        remark="As in the paper, the strain is largest where limbs are about to tear, and falls once they have torn.",
    ),
    PictureEntry(
        "struck-figures", "A figure of solid jade and one of porcelain, 5 mm thick, struck by a hammer (M22 fig. 3).",
        (("jade", table_run("jade-figure")), ("porcelain", table_run("porcelain-figure"))),
        "--view 0.75,-1.2,0.35",
        remark="The hammer is our own: the paper states neither its mass nor its speed.",
    ),
    PictureEntry(
        "struck-vases", "A vase of solid glass and one of porcelain, struck by a ball (M22 fig. 4).",
        (("glass", table_run("glass-vase")), ("porcelain-vase", table_run("porcelain-vase"))),
        "--view 0.55,-1.2,0.35 --floor",
        remark="The ball is our own: the paper states neither mass nor speed of its hammer.",
    ),
    PictureEntry(
        "doormat-radius", "A doormat with averaging radii of 0, 5 and 50 mm and the paper's strength (M22 fig. 6).",
        (("doormat", "doormat"), ("doormat-5", "doormat --set fracture.radius=0.005 --set mesh.h=0.006"),
         ("doormat-50", "doormat --set fracture.radius=0.05")),
        "--view=-1.2,-0.5,0.35 --size 900x700",
        remark="An average of stresses is below their peak: with the same strength cracks start later, and fewer edges"
        " break, the larger the radius (868 for 0, 265 for 50 mm; 1,780 for 5 mm in cells half as large). More and"
        " wider cracks, as in the paper, do not follow from its equations with its strength."
        " [The gallery](gallery.md#doormat) has 50 mm with 0.2 MPa.",
    ),
    strip("strip-edge", 8, "Crack and stresses xx, xy, yy of a strip, its strain projected on the intact edges",
          "0.1 --set material.energy=linear --set fracture.approach=edge", "42,46,-1"),
    strip("strip-chi", 9, "Crack and stresses xx, xy, yy of a strip, its energy degraded",
          "0.12 --set material.energy=stvk", "42,46,52"),
    PictureEntry(
        "resolutions", "A loaf of 1,500, 37,000 and 616,000 tetrahedra (M22 fig. 14).",
        (("loaf-coarse", f"{SHORT_LOAF} --set mesh.h=0.0245"), ("loaf-medium", f"{SHORT_LOAF} --set mesh.h=0.0084"),
         ("loaf-fine", f"{SHORT_LOAF} --set mesh.h=0.0033")), "--floor",
        remark="As in the paper, smaller cells show finer details. The place of the crack depends on the mesh:"
        " there is no fracture energy.",
    ),
    PictureEntry(
        "debris", "Bread with yield stress 2.5 MPa and strength 3 MPa, and with 1 MPa and 4 MPa (M22 fig. 15).",
        (("debris-more", f"{DEBRIS} --set plasticity.yield_stress=2.5e6 --set fracture.strength=3e6"),
         ("debris-less", DEBRIS)), "--floor",
        remark="Cracks follow grains, so that pieces have 7 nodes and more. Unlike in the paper the amount of debris"
        " does not differ: 9 pieces each. Without grains ([bread](gallery.md#bread)) debris consists of single nodes.",
    ),
    PictureEntry(
        "izod", "Izod bars: A516 at -40 C breaks, NVE 36 at 23 C bends and cracks in part (M22 figs. 19, 20).",
        (("izod-3d", f"izod-3d {IZOD_CELLS}"),
         ("izod-3d-ductile", f"izod-3d-ductile {IZOD_CELLS} --set time.end=2e-3")),
        "--view 0.5,-1.1,-0.45 --field crack --size 1400x560", plot="--x motion_striker_z --y contact_striker_z",
        remark="The bars have 25,394 cells, the paper's 27,800. The peaks at 0.1 mm are inertia of the struck end. The"
        " paper's text has no values of its curves. [Fracture](fracture.md#charpy-bars-in-space) has the figures.",
    ),
    PictureEntry(
        "snapped-bars", "Bars of brittle steel that snap along a crack surface: Charpy and Izod (M22 figs. 17, 19).",
        (("brittle-charpy", table_run("brittle-charpy")), ("brittle-izod", table_run("brittle-izod"))),
        "--view 0.5,-1.1,-0.45 --size 1400x560",
        remark="Strength alone, as in the paper. [Izod](#izod) has the same bar with its fracture energy.",
    ),
    PictureEntry(
        "split-granite", "A granite cylinder that splits between platens along a crack surface (M22 fig. 21).",
        (("split-granite", table_run("granite-cylinder")),), "--sheet 0,-1 --view top --magnify 5 --size 1400x700",
        remark="Strength alone, as in the paper, of the stress averaged over 3 cm. The load reaches 1.05 times"
        " pi D t f_t / 2. [The gallery](gallery.md#granite-cylinder) has the cylinder with its fracture energy.",
    ),
    PictureEntry(
        "rejected", "The two approaches that M22 rejects, and degraded energy, on a strip (M22s figs. 1, 2).", (),
        "fracsim.studies.rejected_figures",
    ),
    PictureEntry(
        "hundred-ornaments", "A hundred glass shells dropped on a floor (B07 fig. 1).",
        (("hundred-ornaments", ORNAMENTS),), "--sheet 0,2,-1 --floor --view 0.9,-1.3,0.6",
    ),
    PictureEntry(
        "crossed-boats", "An overturned boat dropped across another: gunwales meet (B07 fig. 3).",
        (("crossed-boats", CROSSED_BOATS),), "--field piece --sheet 0,5,7,10,20,-1 --floor --view 0.9,-1.3,0.5",
    ),
    PictureEntry(
        "thousand-boats", "A thousand boats (B07 fig. 4).",
        (("thousand-boats", "rigid-boats --set mesh.h=0.5 --set 'body.0.copies=[10,10,10]'"),),
        "--sheet 0,10,-1 --floor --view 0.9,-1.3,0.6",
    ),
    PictureEntry(
        "twenty-walls", "Twenty walls and a ball (B07 fig. 6, last row).",
        (("twenty-walls", "rigid-wall --set 'body.0.copies=[1,20,1]' --set brittle.surfaces=60"
          " --set 'obstacle.1.velocity=[0.0,12.0,0.0]' --set time.end=3.0 --set output.interval=0.1"),),
        "--sheet 6,14,-1 --floor --size 1600x800 --view 1.2,0.7,0.5",
    ),
    PictureEntry(
        "shot-figure", "A flying figure, struck by a projectile, meets a wall (B07 fig. 8).",
        (("shot-figure", SHOT_FIGURE),), SHOT_VIEW,
    ),
    PictureEntry(
        "shot-vase", "A solid vase struck at high speed (B07 fig. 11).",
        (("shot-vase", SHOT_VASE),), SHOT_VIEW,
    ),
    PictureEntry(
        "ornament-grains", "A glass shell that breaks along grain boundaries (B07 fig. 12).",
        (("ornament-grains", GRAINS),), "--sheet 0,2,8,-1 --floor",
    ),
)  # fmt: skip
PAGE = PicturePage(Path("docs/paper-figures.md"), HEAD, ENTRIES, max_single_nodes=1.0)

if __name__ == "__main__":
    PAGE.make(__doc__)
