"""Pictures by what is on them: a skin, an inside and a crack where they are, colours, lengths, shadows."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
import numpy.typing as npt
import pytest

from fracsim.errors import InputError
from fracsim.mechanics.term_protocols import SurfaceData
from fracsim.output.fields_file import Field
from fracsim.output.surface.body_surface import BodySurface
from fracsim.output.surface.vtk_files import SurfaceFiles
from fracsim.report.pictures import renderer
from fracsim.report.pictures.annotations import annotate, format_length, format_time, round_length
from fracsim.report.pictures.camera import body_motion
from fracsim.report.pictures.frames import find_frames
from fracsim.report.pictures.picture import SHEET_GAP, FilmOptions, render, tile_pictures, virtual_display
from fracsim.report.pictures.picture_options import (
    DEFAULT_SIZE,
    MATERIAL_LOOKS,
    PictureOptions,
    parse_limits,
    parse_size,
    parse_target,
)
from fracsim.report.pictures.renderer import crack_opening
from fracsim.report.pictures.shadows import SHADOW_STYLE, DepthWindow, lamp_camera, lamp_directions, shadow_shares
from fracsim.report.pictures.surroundings import PLANE_COLOUR
from fracsim.report.plots import readable_unit
from fracsim.study.time_and_output import LOOKS
from support.solids import lattice, patterns, separated

Pixels = npt.NDArray[np.int64]
Values = npt.NDArray[np.float64]
SMALL = (420, 300)
FRONT = PictureOptions(view="front", size=SMALL, material="#ff0000,#00ff00", bare=True)
CUT = 3.5  # m: where the bar of 6 x 1 x 1 m is cut


def shown(path: Path) -> Pixels:
    from imageio.v3 import imread

    return np.asarray(imread(path))[..., :3].astype(int)


def written(
    folder: Path, *gaps: float, cut: bool = True, dim: int = 3, fields: Callable[[Values], Any] | None = None
) -> Path:
    """A bar along x, a frame for each of the gaps (m) of its crack."""
    mesh = lattice(6, 1, 1) if dim == 3 else lattice(6, 2)
    surface, files = BodySurface(mesh, 1.0), SurfaceFiles(folder, dim)
    skeleton = surface.skeleton
    if cut:
        surface.update(patterns(skeleton, separated(skeleton, (mesh.points[:, 0] > CUT).astype(int))))
    for t, gap in enumerate(gaps):
        u = np.zeros_like(mesh.points)
        u[mesh.points[:, 0] > CUT, 0] = gap
        middles = mesh.points[mesh.cells].mean(axis=1)
        more = fields(middles[:, 0]) if fields is not None else []
        files.write_frame(surface.make_frame(float(t), u, np.zeros_like(u), fields=more))
    return folder


def of_hue(pixels: Pixels, channel: int) -> npt.NDArray[np.bool_]:
    """Lit or in the shade, of one of the pure colours of FRONT."""
    rest = np.delete(pixels, channel, axis=2).max(axis=2)
    return (pixels[..., channel] > 40) & (rest < 0.6 * pixels[..., channel])


# --- skin, inside, cracks ---


def test_the_inside_has_its_own_colour_and_is_seen_in_the_gap(tmp_path: Path) -> None:
    """From aslant a wall of the open crack, green, between skins, red; nothing green before it is cut."""
    look = PictureOptions(view="1,-2,0.3", size=SMALL, material=FRONT.material, bare=True)
    whole = shown(render(written(tmp_path / "whole", 0.0, cut=False), options=look))
    torn = shown(render(written(tmp_path / "torn", 1.0), options=look))
    assert of_hue(whole, 0).mean() > 0.05 and not of_hue(whole, 1).any()
    green, red = of_hue(torn, 1), of_hue(torn, 0)
    assert green.mean() > 0.003
    columns = np.flatnonzero(green.any(axis=0))
    assert red[:, : columns.min()].any() and red[:, columns.max() + 1 :].any()


def test_a_crack_that_opens_by_less_than_a_pixel_is_a_line(tmp_path: Path) -> None:
    """Dark pixels where the bar is cut, over its whole height, and nowhere else on it."""
    pixels = shown(render(written(tmp_path, 1e-5), options=FRONT))
    red = of_hue(pixels, 0)
    rows, columns = (np.flatnonzero(red.any(axis=axis)) for axis in (1, 0))
    inside = pixels[rows.min() + 3 : rows.max() - 2, columns.min() + 3 : columns.max() - 2]
    bright = inside.max(axis=2)
    dark = bright < 0.7 * np.median(bright)
    found = np.flatnonzero(dark.any(axis=0)) / (inside.shape[1] - 1) * 6
    assert dark.any(axis=1).mean() > 0.95
    assert found.min() > 2.9 and found.max() < 4.1  # the cut winds between the nodes at 3 and at 4
    whole = shown(render(written(tmp_path / "whole", 0.0, cut=False), options=FRONT))
    bright = whole[rows.min() + 3 : rows.max() - 2, columns.min() + 3 : columns.max() - 2].max(axis=2)
    assert not (bright < 0.7 * np.median(bright)).any()


def test_the_opening_is_the_distance_of_what_was_at_one_place() -> None:
    rest = np.array([[0.0, 0, 0], [1, 0, 0], [1, 0, 0], [1, 0, 0]])
    at = rest + np.array([[0.5, 0, 0], [0, 0, 0], [3e-3, 0, 0], [0, 4e-3, 0]])
    np.testing.assert_allclose(crack_opening(at, rest), [0.0, 5e-3, 5e-3, 5e-3])


def test_magnified_displacements(tmp_path: Path) -> None:
    """A gap of 1 mm, too narrow for a pixel, is 2 m wide at 2000 times: a third of the bar."""
    folder = written(tmp_path, 1e-3)
    pixels = shown(
        render(
            folder, options=PictureOptions(view="front", size=SMALL, material=FRONT.material, bare=True, magnify=2000.0)
        )
    )
    row = of_hue(pixels, 0)[SMALL[1] // 2]
    columns = np.flatnonzero(row)
    gap = np.count_nonzero(~row[columns.min() : columns.max()])
    assert gap / np.ptp(columns) == pytest.approx(2 / 8, abs=0.08)


def test_dust_is_hidden_on_request(tmp_path: Path) -> None:
    """A corner of the bar that flew off to the left is red on the picture, or it is not; the bar is."""
    mesh = lattice(6, 1, 1)
    surface = BodySurface(mesh, 1.0)
    corner = int(np.argmin(mesh.points.sum(axis=1)))
    part = (np.arange(len(mesh.points)) == corner).astype(int)
    surface.update(patterns(surface.skeleton, separated(surface.skeleton, part)))
    u = np.zeros_like(mesh.points)
    u[corner, 0] = -1.0
    SurfaceFiles(tmp_path, 3).write_frame(surface.make_frame(0.0, u, np.zeros_like(u)))
    far = PictureOptions(view="front", size=SMALL, material=FRONT.material, bare=True, zoom=0.6)
    shown_all, without = (shown(render(tmp_path, options=each)) for each in (far, replace(far, dust=False)))
    with_dust, bar = (np.flatnonzero(of_hue(each, 0).any(axis=0)) for each in (shown_all, without))
    assert np.diff(with_dust).max() > 8 and np.diff(bar).max() == 1


@pytest.mark.parametrize("dim", (2, 3))
@pytest.mark.parametrize("view", ("1,-2,0.3", "-1,0.2,3", "top"))
def test_a_body_fills_its_picture_from_every_side(view: str, dim: int, tmp_path: Path) -> None:
    """By what is not paper: between 90 and 98 % of a side, as far from one edge as from the other; one torn and
    moved apart is whole on every picture of a sheet."""
    look = PictureOptions(view=view, size=(2 * SMALL[0], 2 * SMALL[1]), bare=True)
    sheet = shown(render(written(tmp_path, 0.0, 3.0, dim=dim), tmp_path / "sheet.png", look, sheet="0,1"))
    drawn = np.abs(sheet - sheet[0, 0]).max(axis=2) > 12
    torn = drawn[:, -SMALL[0] :]
    assert not drawn[:, [0, SMALL[0] - 1]].any() and not drawn[[0, -1], : SMALL[0]].any()
    there = [np.flatnonzero(torn.any(axis=axis)) for axis in (0, 1)]
    margins, filled = zip(
        *(((of.min(), side - 1 - of.max()), (np.ptp(of) + 1) / side) for of, side in zip(there, SMALL, strict=True)),
        strict=True,
    )
    tight = int(np.argmax(filled))
    assert 0.9 < filled[tight] < 0.98
    assert margins[tight][0] == pytest.approx(margins[tight][1], abs=3) and min(map(min, margins)) > 3


# --- colours and what is to be read ---


@pytest.mark.parametrize(("value", "limits", "colours"), ((0.5, (0.0, 1.0), "viridis"), (0.0, (-1.0, 1.0), "coolwarm")))
def test_colours_in_2d_are_those_of_the_legend(
    value: float, limits: tuple[float, float], colours: str, tmp_path: Path
) -> None:
    """To a unit in 255, light or no light; zero between two signs is grey and the paper white."""
    folder = written(tmp_path, 0.0, cut=False, dim=2, fields=lambda x: [Field("heat", "Cell", np.full(len(x), value))])
    pixels = shown(render(folder, options=PictureOptions("heat", size=SMALL, bare=True, limits=limits)))
    wanted = np.rint(255 * np.array(matplotlib.colormaps[colours](0.5)[:3]))
    inner = pixels[SMALL[1] // 2, SMALL[0] // 2]
    assert np.abs(inner - wanted).max() <= 1 and inner.min() < 240
    assert (pixels[0, 0] == 255).all()
    legend = shown(render(folder, options=PictureOptions("heat", size=DEFAULT_SIZE, limits=limits)))[
        -120:
    ]  # the bar, in its middle
    assert np.abs(legend[:, DEFAULT_SIZE[0] // 2] - wanted).max(axis=1).min() <= 2


def test_one_range_for_all_frames(tmp_path: Path) -> None:
    """What is 1 in every frame has one colour in all, though another part goes from 1 to 5; alone a frame fills it."""
    level = iter((1.0, 5.0))
    folder = written(
        tmp_path, 0.0, 0.0, cut=False, dim=2,
        fields=lambda x: [Field("heat", "Cell", np.where(x < 3, 1.0, next(level)))],
    )  # fmt: skip
    look = PictureOptions("heat", size=(2 * SMALL[0], 2 * SMALL[1]), bare=True)
    sheet = shown(render(folder, tmp_path / "sheet.png", look, sheet="0,1"))
    assert sheet.shape == (SMALL[1], 2 * SMALL[0] + SHEET_GAP, 3)
    quarter, step = SMALL[0] // 3, SMALL[0] + SHEET_GAP
    row = sheet[SMALL[1] // 2]
    assert (row[quarter] == row[quarter + step]).all()
    assert (row[quarter] == row[2 * quarter]).all() and (row[quarter + step] != row[2 * quarter + step]).any()


def test_the_scale_bar_is_as_long_as_it_says(tmp_path: Path) -> None:
    """Beside a bar of 6 m, in a flat picture: 1 m of a width of some 7."""
    pixels = shown(render(written(tmp_path, 0.0, cut=False, dim=2), options=PictureOptions(size=DEFAULT_SIZE)))
    ink = (np.abs(pixels - [34, 38, 44]).max(axis=2) < 4)[-60:, : DEFAULT_SIZE[0] // 3]
    length = ink.sum(axis=1).max()
    body = np.flatnonzero(np.any(pixels[DEFAULT_SIZE[1] // 2] < 250, axis=1))
    assert length == pytest.approx(np.ptp(body) / 6, abs=2.5)


def test_numbers_in_words() -> None:
    assert [round_length(x) for x in (0.0123, 0.7, 49.0)] == pytest.approx([0.01, 0.5, 20.0])
    assert [format_length(x) for x in (0.01, 0.005, 2e-5, 5.0, 0.5)] == ["1 cm", "5 mm", "20 µm", "5 m", "50 cm"]
    assert [format_time(t) for t in (0.0, 1.2e-4, 0.45, 2.0)] == ["t = 0 s", "t = 120 µs", "t = 450 ms", "t = 2 s"]


def test_units_have_the_prefix_of_the_largest_value() -> None:
    assert readable_unit("Pa", 1.34e7) == ("MPa", 1e6) and readable_unit("N", 999.0) == ("N", 1.0)
    assert readable_unit("N", 1000.0) == ("kN", 1e3) and readable_unit("m", 2e-5) == ("µm", pytest.approx(1e-6))
    assert readable_unit("", 1e9) == ("", 1.0) and readable_unit("m", 0.0) == ("m", 1.0)
    assert readable_unit("Pa", 1e15) == ("GPa", 1e9)


@pytest.mark.parametrize("dim", [2, 3])
def test_a_point_in_the_middle_of_the_picture(dim: int, tmp_path: Path) -> None:
    """The right end of a bar of 6 m: half of the picture is beyond it, and zoom shows it larger."""
    folder, last = written(tmp_path, 0.0, cut=False, dim=dim), (6.0, 0.5, 0.5 if dim == 3 else 0.0)
    look = replace(FRONT, size=DEFAULT_SIZE, target=last)
    for zoom in (1.0, 4.0):
        pixels = shown(render(folder, options=replace(look, zoom=zoom)))
        middle = pixels[DEFAULT_SIZE[1] // 2]
        body = np.flatnonzero(np.abs(middle - pixels[0, -1]).max(axis=1) > 20)
        # in perspective the near side of the end is up to half a metre closer to the camera
        assert body.max() == pytest.approx(DEFAULT_SIZE[0] / 2, abs=3 if dim == 2 else 12 * zoom)


def test_the_camera_moves_with_the_larger_part_of_a_broken_body(tmp_path: Path) -> None:
    """The smaller part of the bar, 2.5 m of 6, flies off with the points of its crack face; the larger part stays."""
    frames = find_frames(written(tmp_path / "run", 0.0, 3.0, 300.0))
    motions = [body_motion(frame, FRONT) for frame in frames]
    np.testing.assert_allclose(motions, np.zeros((3, 3)), atol=1e-6)


def test_axes_have_their_directions_on_the_picture(tmp_path: Path) -> None:
    """From the front x is to the right, red, and z upwards, blue; y is along the line of sight."""
    look = replace(FRONT, bare=False, title="", axes=True, size=DEFAULT_SIZE)
    pixels = shown(render(written(tmp_path, 0.0, cut=False), options=look))
    pixels = pixels[: DEFAULT_SIZE[1] // 4, DEFAULT_SIZE[0] // 2 :]
    rows, columns = np.nonzero(np.abs(pixels - [0xC0, 0x39, 0x2B]).max(axis=2) == 0)
    assert np.ptp(columns) == pytest.approx(60, abs=2) and np.ptp(rows) < 4
    upward_rows, upward_columns = np.nonzero(np.abs(pixels - [0x2C, 0x5F, 0xA8]).max(axis=2) == 0)
    assert np.ptp(upward_rows) == pytest.approx(60, abs=4) and np.ptp(upward_columns) < 4
    assert upward_rows.max() == pytest.approx(rows.mean(), abs=4) and columns.min() <= upward_columns.mean() + 4


@pytest.mark.parametrize("ground", (40, 90, 140, 190, 250))
def test_letters_can_be_read_on_any_ground(ground: int) -> None:
    """They differ from their ground, and from their rim, by a contrast of 4.5 and more (WCAG 2.1); where part of the
    ground is dark and part light, in either part; on a light one they are plain ink."""
    even = np.full((300, 420, 3), ground, np.uint8)
    half = even.copy()
    half[:, 40:] = 250
    for paper in (even, half):
        written_on = annotate(paper, title="A title across it all", time="t = 340 µs", pixel=1e-3)
        changed = np.any(written_on != paper, axis=2)
        for rows in (slice(0, 26), slice(26, 60), slice(240, 300)):  # title, time, scale bar
            for columns in (slice(0, 40), slice(40, 420)):
                letters = written_on[rows, columns][changed[rows, columns]]
                seen = luminance(np.concatenate([letters, paper[rows, columns].reshape(-1, 3)[:1]]))
                assert (seen.max() + 0.05) / (seen.min() + 0.05) > 4.5 and len(letters) > 8
    if ground > 200:
        assert written_on.max() == ground


def luminance(pixels: npt.NDArray[np.integer]) -> Values:
    """(n,) relative, of sRGB (n, 3)."""
    share = pixels / 255
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)
    return np.asarray(linear @ [0.2126, 0.7152, 0.0722])


def test_a_look_colours_skin_and_inside(tmp_path: Path) -> None:
    """That of the study, or another that is asked for: its skin has that of the bread and of the jade in hue (the ratio
    of its channels), where the two lie on different sides of red and green; the walls of the crack are paler."""
    folder = written(tmp_path, 1.0)
    (folder / "study.toml").write_text('title = "x"\n[output]\nlook = "bread"\n')
    look = PictureOptions(view="1,-2,0.3", size=SMALL, bare=True)
    for name in ("bread", "jade"):
        pixels = shown(render(folder, options=look if name == "bread" else replace(look, material=name)))
        skin, inside, back = (
            rgb_of(each)
            for each in (
                MATERIAL_LOOKS[name].boundary_colour,
                MATERIAL_LOOKS[name].crack_colour,
                MATERIAL_LOOKS[name].backdrop,
            )
        )
        body = pixels[np.abs(pixels - back).max(axis=2) > 12]
        for part, least in ((skin, 0.3), (inside, 0.01)):
            apart = np.linalg.norm(body / body.sum(axis=1, keepdims=True) - part / part.sum(), axis=1)
            assert np.mean(apart < 0.03) > least


def test_runs_side_by_side_have_the_look_of_their_own_study(tmp_path: Path) -> None:
    folders = []
    for skin in ("#ff0000", "#00ff00"):
        folders.append(written(tmp_path / skin[1:], 0.0, cut=False))
        (folders[-1] / "study.toml").write_text(f'[output]\nlook = {{ skin = "{skin}", inside = "#0000ff" }}\n')
    both = shown(render(folders, tmp_path / "both.png", replace(FRONT, material="")))
    left, right = both[:, : SMALL[0] // 2], both[:, -(SMALL[0] // 2) :]
    assert of_hue(left, 0).mean() > 0.1 and not of_hue(left, 1).any()
    assert of_hue(right, 1).mean() > 0.1 and not of_hue(right, 0).any()


def rgb_of(colour: str) -> Values:
    return np.array([int(colour[k : k + 2], 16) for k in (1, 3, 5)], float)


def test_a_sheet_is_read_from_left_to_right_and_down() -> None:
    """Five pictures: three and two, and paper where there is no sixth; up to three stand in one row."""
    pictures = [np.full((4, 6, 3), 10 * k, np.uint8) for k in range(1, 6)]
    sheet = tile_pictures(pictures)
    assert sheet.shape == (2 * 4 + SHEET_GAP, 3 * 6 + 2 * SHEET_GAP, 3)
    down, along = 4 + SHEET_GAP, 6 + SHEET_GAP
    assert [sheet[0, 0, 0], sheet[0, along, 0], sheet[0, 2 * along, 0]] == [10, 20, 30]
    assert [sheet[down, 0, 0], sheet[down, along, 0], sheet[down, 2 * along, 0]] == [40, 50, 255]
    assert tile_pictures(pictures[:3]).shape == (4, 3 * 6 + 2 * SHEET_GAP, 3)


# --- floor ---


def test_a_floor_has_the_shadow_of_what_stands_on_it(tmp_path: Path) -> None:
    """Darker than the floor, beside the body; without one there is none."""
    folder = written(tmp_path, 0.0, cut=False)
    look = PictureOptions(view="0.3,-1.5,1.2", size=SMALL, material=FRONT.material, bare=True)
    plain, floor = (
        shown(render(folder, options=each)) for each in (look, PictureOptions(**{**vars(look), "floor": True}))
    )
    backdrop = floor[0, 0]

    def grey(pixels: Pixels) -> float:
        """Share that is the backdrop's colour, but darker than it."""
        share = pixels / backdrop
        return float(((np.ptp(share, axis=2) < 0.02) & (share.max(axis=2) < 0.93)).mean())

    assert grey(plain) == 0 and grey(floor) > 0.005


def test_a_floor_is_where_the_obstacle_plane_is(tmp_path: Path) -> None:
    """In place of its slab, not of a wall, and the shadow lies where the plane is, below the bar."""
    folder = written(tmp_path, 0.0, cut=False)
    frame = BodySurface(lattice(6, 1, 1), 1.0)
    x = np.array([[-9.0, -9, -2], [9, -9, -2], [0, 9, -2]])
    none = np.zeros_like(frame.skeleton.points)
    behind = np.array([[-1.0, 3, 0], [1, 3, 0], [0, 3, 1]])
    drawn = {
        name: SurfaceData(each, np.array([[0, 1, 2]]), np.empty((0, 2), int))
        for name, each in (("wall", behind), ("table", x))
    }
    SurfaceFiles(folder, 3).write_frame(frame.make_frame(0.0, none, none), drawn)
    wall = '[[obstacle]]\nname = "wall"\nshape = "plane"\nnormal = [0.0, -1.0, 0.0]\n'
    table = '[[obstacle]]\nname = "table"\nshape = "plane"\nnormal = [0.0, 0.0, 1.0]\n'
    (folder / "study.toml").write_text(wall + table)
    look = PictureOptions(view="0.3,-1.5,1.2", size=SMALL, material=FRONT.material, bare=True)
    slab, floor = (
        shown(render(folder, options=each)) for each in (look, PictureOptions(**{**vars(look), "floor": True}))
    )
    warm = [(pixels[..., 0] > pixels[..., 2] + 10).mean() for pixels in (slab, floor)]
    assert rgb_of(PLANE_COLOUR)[0] > rgb_of(PLANE_COLOUR)[2] + 15 and floor[0, 0, 0] < floor[0, 0, 2]
    assert warm[0] > warm[1] + 0.02
    shadow = (floor.max(axis=2) < 0.93 * floor[0, 0].max()) & ~of_hue(floor, 0)
    body = of_hue(floor, 0)
    assert np.nonzero(shadow)[0].mean() > np.nonzero(body)[0].mean() + 20


# --- obstacles and shadows ---


def with_obstacle(folder: Path, lower: tuple[float, ...], upper: tuple[float, ...]) -> Path:
    """The bar without a crack and an obstacle, a box between two corners in m."""
    import pyvista

    box = pyvista.Box([side for pair in zip(lower, upper, strict=True) for side in pair]).triangulate()
    box = box.compute_normals(auto_orient_normals=True)
    surface = BodySurface(lattice(6, 1, 1), 1.0)
    none = np.zeros_like(surface.skeleton.points)
    drawn = SurfaceData(np.asarray(box.points, float), box.regular_faces, np.empty((0, 2), int))
    SurfaceFiles(folder, 3).write_frame(surface.make_frame(0.0, none, none), {"block": drawn})
    return folder


def test_an_obstacle_in_front_is_opaque_and_hides_its_part_of_the_body(tmp_path: Path) -> None:
    """A box in front of a third of the bar: no red of the bar there, all of it beside the box."""
    folder = with_obstacle(tmp_path, (2.0, -2.0, -0.2), (4.0, -1.0, 1.2))
    red = of_hue(shown(render(folder, options=FRONT)), 0)
    columns = np.flatnonzero(red.any(axis=0))
    middle = columns.min() + np.ptp(columns) // 2
    assert not red[:, middle - 20 : middle + 20].any()
    assert red[:, columns.min() + 5 : columns.min() + 60].any(axis=0).all()


def test_an_obstacle_that_hides_most_of_the_body_is_translucent(tmp_path: Path) -> None:
    """A plate in front of the whole bar: the bar is seen through it, redder than the plate beside it."""
    pixels = shown(render(with_obstacle(tmp_path, (-1.0, -2.0, -2.0), (7.0, -1.9, 3.0)), options=FRONT))
    height, width = SMALL[1], SMALL[0]
    redness = pixels[..., 0] - pixels[..., 1:].max(axis=2)
    assert redness[height // 2, width // 2] > redness[height // 2 - 70, width // 2] + 30


def test_an_obstacle_casts_its_shadow_on_the_body(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A box above the bar darkens its top, by what the main light gives; one below it on the far side does not."""
    look = replace(FRONT, view="0,-1.2,1.0")
    above = with_obstacle(tmp_path / "above", (2.0, 0.3, 1.6), (3.0, 1.2, 1.8))
    below = with_obstacle(tmp_path / "below", (2.0, 0.3, -0.8), (3.0, 1.2, -0.6))
    shadowed = [shown(render(folder, options=look)) for folder in (above, below)]
    monkeypatch.setattr(renderer, "SCENE_STYLE", replace(renderer.SCENE_STYLE, shadow_light=1.0))
    lit = [shown(render(folder, options=look)) for folder in (above, below)]
    darker = [(full - dim)[of_hue(full, 0), 0] for full, dim in zip(lit, shadowed, strict=True)]
    assert min(map(np.min, darker)) >= 0
    assert np.count_nonzero(darker[0] > 40) > 300 and np.count_nonzero(darker[1] > 40) < 30


def test_the_shadow_of_a_sphere_on_a_plane_has_its_radius() -> None:
    """Light from straight above: hidden within the radius of the sphere, lit beyond, over a half-shadow as wide as the
    lamp is seen from there; its area is that of the sphere's disc."""
    import pyvista

    direction, height, radius = np.array([0.0, 0.0, 1.0]), 1.0, 0.5
    sphere = pyvista.Sphere(radius=radius, center=(0.0, 0.0, height), theta_resolution=90, phi_resolution=90)
    plane = pyvista.Plane(i_size=4.0, j_size=4.0, i_resolution=1, j_resolution=1)
    with virtual_display(), DepthWindow(200, 200) as window, DepthWindow(512, 512) as maps:
        window.set_surfaces([plane])
        seen = window.depth_from(lamp_camera(direction, np.zeros(3), 2.0))
        maps.set_surfaces([sphere])
        cameras = [lamp_camera(ray, np.zeros(3), 2.0) for ray in lamp_directions(direction)]
        share = shadow_shares(seen, maps, cameras, np.ones(seen.depth.shape, bool))
        rows, columns = np.indices(share.shape).reshape(2, -1)
        points = seen.points_at(rows, columns)
    np.testing.assert_allclose(points[2], 0.0, atol=1e-5)
    distance = np.hypot(*points[:2]).reshape(share.shape)
    half = SHADOW_STYLE.lamp_radius * height + 0.02
    assert (share[distance < radius - half] == 1).all() and (share[distance > radius + half] == 0).all()
    assert 0 < share[np.abs(distance - radius) < 0.01].mean() < 1
    assert share.sum() * (4.0 / 200) ** 2 == pytest.approx(np.pi * radius**2, rel=0.03)


# --- what is written, and what cannot be ---


def test_a_folder_of_pictures_and_runs_side_by_side(tmp_path: Path) -> None:
    first, second = written(tmp_path / "first", 0.0, 0.5), written(tmp_path / "second", 1.0)
    look = PictureOptions(size=SMALL)
    made = render(first, tmp_path / "frames", look)
    assert [path.name for path in sorted(made.iterdir())] == ["frame_000000.png", "frame_000001.png"]
    both = shown(render([first, second], tmp_path / "both.png", look))
    assert both.shape == (SMALL[1] // 2, SMALL[0] + SHEET_GAP, 3)
    assert np.any(both[:, : SMALL[0] // 2] != both[:, -(SMALL[0] // 2) :])


def test_a_film_in_mp4_has_every_frame(tmp_path: Path) -> None:
    pytest.importorskip("imageio_ffmpeg")
    import imageio.v2

    folder, film_options = written(tmp_path, 0.0, 0.5, 1.0), FilmOptions(5)
    made = render(folder, tmp_path / "film.mp4", PictureOptions(size=(161, 121)), film=film_options)
    with imageio.v2.get_reader(made) as film:
        assert film.count_frames() == 3 and film.get_meta_data()["fps"] == pytest.approx(5)


@pytest.mark.parametrize(
    ("call", "message"),
    (
        (lambda folder: render(folder, sheet="0,9"), "--sheet 0,9: .* has 2 frames, counted from 0, and no 9"),
        (lambda folder: render(folder, sheet="some"), "--sheet some: must be how many frames, or which"),
        (lambda folder: render([folder, folder], sheet="2"), "--sheet: frames of one run"),
        (lambda folder: render([folder, folder], folder / "a.gif"), "pictures of several runs, is a .png"),
        (lambda folder: parse_size("big"), "--size big: must be WIDTHxHEIGHT"),
        (lambda folder: parse_size("4x90000"), "--size 4x90000"),
        (lambda folder: parse_limits("2,1"), "--range 2,1: must be two numbers, the lower first"),
        (lambda folder: parse_limits("0,nan"), "--range 0,nan"),
        (lambda folder: parse_target("0,1"), "--target 0,1: must be a point in m"),
    ),
)
def test_what_cannot_be_drawn_is_said(call: Callable[[Path], Any], message: str, tmp_path: Path) -> None:
    with pytest.raises(InputError, match=message):
        call(written(tmp_path, 0.0, 0.1))


def test_a_flat_body_has_no_floor(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="--floor: a body in 2D has none"):
        render(written(tmp_path, 0.0, dim=2), options=PictureOptions(floor=True, size=SMALL))


def test_a_study_names_the_looks_that_there_are() -> None:
    assert set(LOOKS) == set(MATERIAL_LOOKS)
