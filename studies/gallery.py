"""Pictures of docs/gallery.md and the page itself, which `make gallery` makes.

    python3 -m fracsim.studies.gallery [NAME ...] [--again] [--jobs N]

A run that has ended is not repeated, unless --again is given.
"""

from __future__ import annotations

from pathlib import Path

from .picture_page import PictureEntry, PicturePage, packaged_entry

HEAD = """# Gallery

Each picture is made by the commands below it; `make gallery` makes all of them again. Seconds are processor time on one
rank. Pieces are fragments at the end of the run; single-node fragments are given in parentheses. M22: Mandal et al.
(2022).

"""


CUTS = "--set mesh.h=0.012 --set time.end=0.2 --set output.cut="
NVE36 = (
    "--set 'material.like=steel NVE 36 at 23 C' --set material.energy=corotated --set plasticity.update=implicit"
    " --set fracture.energy=false --set fracture.radius=8e-4 --set time.step=1e-5 --set time.breaking_step=1e-5"
)
THIRD = "--set mesh.h=0.0023 --set mesh.h_notch=0.0007"  # of the cells of a Charpy bar in space
AVERAGED = "doormat --set fracture.radius=0.05 --set fracture.strength=2e5 --set time.step=4e-4"
ENTRIES = (
    packaged_entry("loaf", "A loaf of bread, fixed at one end and pulled at the other until it tears.",
                   "--sheet 0,14,18,-1 --floor"),
    PictureEntry(
        "cuts", "Crack surface with edges cut at midpoints, by nodal forces, and smoothed (M22 fig. 12).",
        tuple((f"cut-{item}", f"loaf {CUTS}{item}") for item in ("middle", "forces", "smooth")),
        "--view 1.1,-1.0,0.5 --size 1400x1100",
    ),
    PictureEntry(
        "loaf-frames", "The loaf while it tears, row by row (M22 fig. 13).", (("loaf", "loaf"),),
        "--sheet 4,12,14,16,18,20,24,29,-1 --floor --size 1200x800",
    ),
    packaged_entry("bread", "Bread that deforms plastically before it tears (M22 fig. 15).",
                   "--sheet 0,36,48,-1 --floor"),
    packaged_entry("bar-2d", "Axial stress in a strip pulled at both ends.",
                   "--field stress:xx --sheet 15,30 --size 1600x700"),
    PictureEntry(
        "bar-2d-stress",
        "Shear stress in the torn strip: degraded energy `chi`, and projected strain `edge` (M22 fig. 9).",
        (("bar-chi", "bar-2d --set time.end=0.11"),
         ("bar-edge", "bar-2d --set time.end=0.096 --set material.energy=linear --set fracture.approach=edge")),
        "--field stress:xy --size 1100x600",
    ),
    packaged_entry("notched-bar", "A notched bar in three-point bending, displacements magnified ten times.",
                   "--magnify 10"),
    packaged_entry("cylinder",
                   "A granite cylinder pulled until it breaks off at a grip, its pieces moved apart.",
                   "--view 0.6,-1.6,0.5 --explode 0.3"),
    PictureEntry(
        "doormat", "A doormat torn with a local strength criterion, and with stress averaged over 5 cm (M22 fig. 6).",
        (("doormat", "doormat"), ("doormat-averaged", AVERAGED)), "--view=-1.2,-0.5,0.35 --size 900x700",
    ),
    packaged_entry("jelly-figure", "A jelly figure pulled by its limbs, at the start and at the end.",
                   "--sheet 0,-1 --view 0.3,-1.6,0.4"),
    packaged_entry("struck-figure", "A jade figure after a pressure pulse on its chest; pieces are moved apart.",
                   "--field piece --explode 0.2"),
    packaged_entry("struck-vase",
                   "A porcelain vase after a pressure pulse on its belly, with at most 150 crack surfaces.", "--floor"),
    PictureEntry(
        "vase-50-150-300", "The same vase with at most 50, 150 and 300 crack surfaces (M22 fig. 16).",
        (("vase-50", "struck-vase --set brittle.surfaces=50"), ("struck-vase", "struck-vase"),
         ("vase-300", "struck-vase --set brittle.surfaces=300")), "--size 700x700",
    ),
    packaged_entry("wall", "An adobe wall after a pressure pulse; it breaks along grain boundaries.",
                   "--view 0.5,-1.6,0.5 --floor"),
    packaged_entry("hammered-vase", "The vase on a table, hit by a ball.", "--view 0.55,-1.2,0.35 --floor"),
    packaged_entry("dropped-vase", "A vase dropped on an inclined table.", "--view 0.4,-1.5,0.3 --floor"),
    packaged_entry("platens", "Brazilian test with the approach `edge`, coloured by piece.", "--field piece"),
    packaged_entry("bent-bar", "A glass bar on two supports, hit in the middle by a cylinder.",
                   "--view 0.3,-1.6,0.25"),
    packaged_entry("hammered-figure", "A jade figure on a table, hit on its belly by a hammer.",
                   "--view 0.75,-1.2,0.35 --floor"),
    PictureEntry(
        "punched-slab", "A metal slab perforated by a ball, seen from below.",
        (("punched-slab", "punched-slab --set mesh.h=0.008"),), "--view=0.5,-1.1,-0.45",
    ),
    packaged_entry("table-loaf", "A loaf torn over a table; pieces of it fall on the table.",
                   "--view 0.35,-1.3,0.45 --floor"),
    packaged_entry("bowl", "Fifty stones in a bowl.", "--view 0.3,-1.0,0.9"),
    packaged_entry(
        "rigid-wall", "An adobe wall of rigid bodies, seen from behind, 40, 120 and 240 ms after the ball starts.",
        "--view 0.6,1.4,0.5 --sheet 1,3,6 --floor",
    ),
    packaged_entry("rigid-slab", "A rigid metal slab perforated by a ball.", "--view 0.5,-1.1,0.6 --sheet 1,3,8"),
    packaged_entry("rigid-rods", "Two steel rods as rigid bodies: one is bent, the other dented.",
                   "--sheet 0,5,-1 --floor --view 0.25,-1.3,0.45"),
    packaged_entry("rigid-vase", "A rigid vase dropped on a floor, after 0, 40, 80 and 200 ms.",
                   "--sheet 0,4,8,-1 --floor --follow"),
    PictureEntry(
        "rigid-vase-film", "The same vase as a film, twenty times slower.", (("rigid-vase", "rigid-vase"),),
        "--floor --size 520x340 --speed 0.05 --follow", film=True,
    ),
    packaged_entry(
        "rigid-figure", "A rigid jade figure thrown at a wall, after 20, 60 and 100 ms.",
        "--sheet 1,3,5 --view=-1,-1.2,0.6 --floor --follow",
    ),
    packaged_entry("rigid-ornament", "A glass shell, dropped on its neck.", "--sheet 0,2,8,-1 --floor"),
    packaged_entry("rigid-ornaments", "Eighteen closed glass shells dropped on a floor.",
                   "--sheet 0,2,-1 --floor --view 0.9,-1.3,0.6"),
    packaged_entry("rigid-boats", "Rowing boats dropped on one another; they do not break.",
                   "--sheet 0,6,-1 --floor --view 0.9,-1.3,0.6"),
    PictureEntry(
        "rigid-beside", "The same vase as a deformable body after 1 ms, and as a rigid body after 32 ms.",
        (("dropped-vase", "dropped-vase"), ("rigid-dropped-vase", "rigid-dropped-vase")),
        "--frame 16 --field piece --view 0.4,-1.5,0.3 --size 1100x800",
    ),
    PictureEntry(
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
    PictureEntry(
        "steels", "Charpy and Izod bars of steel A516 at -40 C, which breaks, and of NVE 36 at 23 C, which bends.",
        (("charpy-A516", "charpy"), ("charpy-NVE36", f"charpy {NVE36}"),
         ("izod-A516", "izod"), ("izod-NVE36", f"izod {NVE36}")), "--size 1400x600",
    ),
    PictureEntry(
        "charpy-3d",
        "Charpy bars in space: A516 at -40 C breaks, NVE 36 at 23 C bends and cracks over a third of its ligament.",
        (("charpy-3d", f"charpy-3d {THIRD}"), ("charpy-3d-ductile", "charpy-3d-ductile")),
        "--view 0.5,-1.1,-0.45 --field crack --size 1400x560",
    ),
    packaged_entry("kalthoff", "A notched steel plate under impact on the side below its notch: vertical stress.",
                   "--field stress:yy"),
    packaged_entry("l-panel", "Degradation `chi` of the elastic energy in a cracked concrete panel.",
                   "--field chi --magnify 40"),
    packaged_entry("branching", "A glass plate whose crack branches, coloured by piece.", "--view top --field piece"),
)  # fmt: skip
PAGE = PicturePage(Path("docs/gallery.md"), HEAD, ENTRIES)

if __name__ == "__main__":
    PAGE.make(__doc__)
