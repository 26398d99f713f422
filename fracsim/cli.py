"""Command line. Each command imports only the modules that it needs."""

from __future__ import annotations

import errno
import gc
import math
import os
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

from . import __version__
from .errors import Exit, FracsimError, InputError, NotConverged, Stopped, one_line
from .process import (
    INTERRUPTED,
    check_launcher,
    end_process,
    import_blocked,
    import_dolfinx,
    import_outside,
    is_first_rank,
    start_process,
    start_run,
)

# typer imports rich where it is there, though `rich_markup_mode` is None: two thirds of what this module takes.
with import_blocked("rich"):
    import typer

if TYPE_CHECKING:
    from mpi4py import MPI

    from .study import Study

app = typer.Typer(no_args_is_help=True, pretty_exceptions_enable=False, rich_markup_mode=None)

StudyPath = Annotated[str, typer.Argument(metavar="STUDY.toml", help="a study file, or the name of a packaged one")]
Set = Annotated[list[str], typer.Option("--set", metavar="KEY=VALUE", help="override a value: time.step=1e-3")]
# ClickException, of click or of the click that newer releases of typer bring along: BadParameter is a UsageError of it.
_USAGE_ERROR: Any = typer.BadParameter.__mro__[2]
# Name in the first line of new studies, by which editors find the schema.
_SCHEMA_FILE = "fracsim.schema.json"
_NONE: list[str] = []
_NO_PATHS: list[Path] = []
_BAD_PATH = (errno.ENAMETOOLONG, errno.ELOOP, errno.ENOENT, errno.ENOTDIR, errno.EISDIR, errno.EACCES, errno.EPERM)
_CANNOT_WRITE = (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EFBIG, errno.EIO, errno.ESTALE)


def _print_version(asked: bool) -> None:
    """Print the version and end the command, if it is asked for."""
    if asked:
        if is_first_rank():
            print(f"fracsim {__version__}")
        raise typer.Exit


@app.callback()
def options(
    version: Annotated[
        bool, typer.Option("--version", help="Print the version and exit.", callback=_print_version, is_eager=True)
    ] = False,
) -> None:
    """Fracture on the edges of a finite element mesh."""


@app.command()
def run(
    study: StudyPath,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="output folder (default out/NAME)")] = None,
    set_: Set = _NONE,
    restart: Annotated[bool, typer.Option("--restart", help="go on from the checkpoint in the output folder")] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="begin anew where a run that has not ended left a checkpoint")
    ] = False,
    wall_limit: Annotated[float | None, typer.Option(help="seconds until it stops with a checkpoint")] = None,
) -> None:
    """Run a study. Works under mpirun."""
    if restart and overwrite:
        raise InputError("--restart goes on with the run in the output folder, --overwrite throws it away: give one")
    if wall_limit is not None and not 0 <= wall_limit < math.inf:
        raise InputError(f"--wall-limit {wall_limit:g}: must be a number of seconds, 0 or more: --wall-limit 3600")
    import_outside("mpi4py.MPI")
    from mpi4py import MPI

    from .study.reader import find_study

    comm = MPI.COMM_WORLD
    check_launcher(comm.size)
    path = find_study(study)
    folder = out or Path("out") / path.stem
    loaded = _load(comm, path, set_, folder)
    import_dolfinx()
    from .deformable_run import run_study

    start_run()
    how: dict[str, Any] = {"restart": restart, "overwrite": overwrite, "wall_limit": wall_limit}
    summary = run_study(comm, loaded, folder, **how, source=path)
    if comm.rank == 0:
        ranks, pieces = summary["ranks"], summary["pieces"]
        print(
            f"{one_line(summary['title'])}: {summary['steps']} steps to t = {summary['time']:g} s in "
            f"{summary['wall']:.1f} s on {ranks} rank{'s'[: ranks > 1]}; {summary['broken_edges']} broken edges, "
            f"{pieces} piece{'s'[: pieces != 1]}{_single_node_text(summary)}. Results in {folder}"
        )


def _single_node_text(summary: dict[str, Any]) -> str:
    """Return words on the number of single-node fragments; nothing if there are none."""
    dust = summary.get("dust")
    return f", {dust} of them dust (single nodes; [fracture] crumbs = false leaves none)" if dust else ""


@app.command()
def check(study: StudyPath, set_: Set = _NONE) -> None:
    """Validate everything that can be known without solving; print what the scene will build."""
    if not is_first_rank():
        return
    from .study.check import check_study
    from .study.reader import load_study

    loaded = load_study(study, set_)
    print(one_line(loaded.title))
    for line in check_study(loaded):
        print("  " + one_line(line))


@app.command()
def mesh(
    study: StudyPath,
    out: Annotated[Path, typer.Option("-o", "--out", help="mesh file: .vtkhdf, .msh, .vtu, ...")],
    set_: Set = _NONE,
) -> None:
    """Build and save the mesh of a study, print its quality."""
    if not is_first_rank():
        return
    from .meshes.directions import preferred_directions
    from .meshes.quality import mesh_quality
    from .study.mesh_source import build_mesh, save_mesh
    from .study.reader import load_study

    data = build_mesh(load_study(study, set_).mesh)
    for note in data.notes:
        print(f"note: {one_line(note)}")
    for name, value in (mesh_quality(data) | preferred_directions(data)).items():
        print(f"{name:24} {value:.6g}" if isinstance(value, float) else f"{name:24} {one_line(str(value))}")
    for note in save_mesh(data, out):
        print(f"note: {one_line(note)}")
    print(f"saved in {out}")


@app.command()
def render(
    outs: Annotated[list[Path], typer.Argument(metavar="OUT...", help="output folders of runs, side by side")],
    png: Annotated[
        Path | None,
        typer.Option("-o", "--out", help=".png, .gif or .mp4 of all frames, a folder for PNGs of them (OUT/last.png)"),
    ] = None,
    colour: Annotated[
        str, typer.Option("--colour", "--field", help="crack, piece, age, or a field of the run: strain, stress:xx")
    ] = "crack",
    explode: Annotated[float, typer.Option(min=0, help="move pieces apart by this share of their distance")] = 0.0,
    view: Annotated[str, typer.Option(help="iso, front, back, left, right, top, or x,y,z to look from")] = "iso",
    zoom: Annotated[float, typer.Option(min=0.01, help="above 1 is nearer")] = 1.0,
    frame: Annotated[int, typer.Option(help="which frame, from 0; -1 is the last")] = -1,
    look: Annotated[
        str,
        typer.Option(
            help="bread, porcelain, glass, jade, granite, steel, wood, plain; or two colours: #b9712c,#f0deb6"
        ),
    ] = "",
    floor: Annotated[bool, typer.Option("--floor", help="where an obstacle plane is, else below the body")] = False,
    size: Annotated[str, typer.Option(help="of a picture in pixels; half of it each on a sheet")] = "1400x900",
    limits: Annotated[str, typer.Option("--range", help="LOW,HIGH of the colours; default: of what is shown")] = "",
    magnify: Annotated[float, typer.Option(min=0, help="displacements so many times as large")] = 1.0,
    sheet: Annotated[str, typer.Option(help="so many frames on one picture, or which: 0,18,-1")] = "",
    fps: Annotated[int, typer.Option(min=1, max=120, help="pictures a second of a film")] = 12,
    speed: Annotated[
        float, typer.Option(min=0, help="simulated seconds a second of a film, in place of --fps: 0.05")
    ] = 0.0,
    frames: Annotated[str, typer.Option(metavar="FIRST:END", help="of a film or folder of pictures: 0:30")] = "",
    follow: Annotated[bool, typer.Option("--follow", help="the camera moves with the body")] = False,
    target: Annotated[str, typer.Option(metavar="X,Y,Z", help="point at the centre of the picture, m")] = "",
    axes: Annotated[bool, typer.Option("--axes", help="show the directions of x, y and z")] = False,
    title: Annotated[str | None, typer.Option(help="in place of the study's")] = None,
    dust: Annotated[bool, typer.Option("--dust/--no-dust", help="draw pieces of a single node")] = True,
    bare: Annotated[bool, typer.Option("--bare", help="no title, time, scale bar or legend")] = False,
) -> None:
    """Draw the split surface of runs off-screen: a picture, a sheet of several, or a film of all frames."""
    if not is_first_rank():
        return
    import_outside("pyvista")
    from .report.pictures.picture import FilmOptions, render
    from .report.pictures.picture_options import PictureOptions, parse_limits, parse_size, parse_target

    _note_active_runs(outs)
    how = PictureOptions(
        colour, explode, view, zoom, material=look, size=parse_size(size),
        limits=parse_limits(limits) if limits else None, magnify=magnify, floor=floor, title=title, bare=bare,
        dust=dust, axes=axes, follow=follow, target=parse_target(target) if target else None,
    )  # fmt: skip
    film = FilmOptions(fps, frames, speed)
    print(f"saved {render(outs, png, how, frame=frame, sheet=sheet, film=film)}")


@app.command()
def export(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="output folder of a run")],
    kind: Annotated[str, typer.Option("--format", help="usd (all frames in a file), glb (so too if rigid), obj, ply")],
    target: Annotated[Path | None, typer.Option("-o", "--out", help="folder for the files (OUT/export)")] = None,
    frame: Annotated[int | None, typer.Option(help="this one alone, from 0; -1 is the last")] = None,
    dust: Annotated[bool, typer.Option("--dust/--no-dust", help="with pieces of a single node")] = True,
    look: Annotated[str, typer.Option(help="colours, as of render")] = "",
) -> None:
    """Write the surfaces of a run, with obstacles and materials, for Blender, Houdini and others."""
    if not is_first_rank():
        return
    import_outside("pyvista")
    from .report.export import export_surfaces

    _note_active_runs([out])
    result = export_surfaces(out, kind, target, frame=frame, dust=dust, look=look)
    print(f"saved {result[0]}" + (f" and {len(result) - 1} more" if len(result) > 1 else ""))


@app.command()
def view(
    out: Annotated[Path, typer.Argument(metavar="OUT", help="output folder of a run, which may go on")],
    html: Annotated[Path | None, typer.Option("-o", "--out", help="write the page as one .html file instead")] = None,
) -> None:
    """Show a run in the browser: the body in time, in 3D, with its fields, fragments and curves."""
    if not is_first_rank():
        return
    import_outside("pyvista")
    from .output.lock import describe_lock_holder
    from .report.view_page import LARGE_PAGE, serve_view, write_view

    if html is None:
        serve_view(out, lambda: bool(describe_lock_holder(out)))
        return
    _note_active_runs([out])
    size = write_view(out, html).stat().st_size
    advice = "; a longer output.interval or fewer output.fields make it smaller" if size > LARGE_PAGE else ""
    print(f"saved {html} ({size / 1e6:.1f} MB{advice})")


@app.command()
def report(
    outs: Annotated[list[Path], typer.Argument(metavar="OUT...", help="folders of runs, sweeps, or of evidence")],
    html: Annotated[Path | None, typer.Option("-o", "--out", help="the page (OUT/report.html)")] = None,
    reference: Annotated[list[Path], typer.Option(help="CSV of a curve, columns as in history.csv")] = _NO_PATHS,
    quantity: Annotated[
        str | None, typer.Option(help="error against run time of peak_COLUMN, final_COLUMN, ...")
    ] = None,
    exact: Annotated[float | None, typer.Option(help="what the quantity should be (that of the finest run)")] = None,
    view: Annotated[bool, typer.Option("--view", help="a page of each run in 3D, as of `fracsim view`, too")] = False,
) -> None:
    """Tables and plots of runs in one HTML file that needs nothing else, and CSVs beside it."""
    if not is_first_rank():
        return
    import_outside("matplotlib")
    from .report.html_report import make_report

    _note_active_runs(outs)
    print(f"saved {make_report(outs, html, references=reference, quantity=quantity, exact=exact, view=view)}")


@app.command()
def plot(
    outs: Annotated[list[Path], typer.Argument(metavar="OUT...", help="output folders of runs or sweeps")],
    y: Annotated[str, typer.Option(help="column of history.csv: reaction_grip_x")],
    x: Annotated[str, typer.Option(help="column of history.csv: motion_grip_x")] = "time",
    target: Annotated[Path | None, typer.Option("-o", "--out", help=".svg, .png or .pdf (OUT/curve.svg)")] = None,
    reference: Annotated[list[Path], typer.Option(help="CSV of a curve with a line of names; x first")] = _NO_PATHS,
    scale: Annotated[
        str, typer.Option(metavar="X,Y", help="factors from the units of references to SI; mm and kN: 1e-3,1e3")
    ] = "1,1",
) -> None:
    """Draw a column of history.csv over another one, for several runs, beside curves of experiments."""
    if not is_first_rank():
        return
    import_outside("matplotlib")
    from .report.curve_plot import draw_curves, parse_scale

    _note_active_runs(outs)
    path = draw_curves(outs, target, x=x, y=y, references=reference, scale=parse_scale(scale))
    print(f"saved {path}")


@app.command()
def sweep(
    study: StudyPath,
    set_: Annotated[list[str], typer.Option("--set", metavar="KEY=A,B,C", help="mesh.h=0.02,0.01")] = _NONE,
    out: Annotated[Path | None, typer.Option("-o", "--out", help="output folder (default out/NAME-sweep)")] = None,
    ranks: Annotated[int, typer.Option(min=1, help="MPI ranks of each run")] = 1,
    list_: Annotated[bool, typer.Option("--list", help="print one complete command a line for a job array")] = False,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="begin anew where a run of another study left a checkpoint")
    ] = False,
) -> None:
    """Run a study once for each combination of values; goes on where it was left."""
    if list_ and not is_first_rank():
        return
    from .report.sweep import run_sweep
    from .study.reader import find_study

    path = find_study(study)
    folder = out or Path("out") / f"{path.stem}-sweep"
    run_sweep(study, path, set_, folder, ranks=ranks, only_list=list_, overwrite=overwrite)


@app.command()
def show(study: Annotated[str, typer.Argument(metavar="NAME", help="a packaged study (`fracsim list`)")]) -> None:
    """Print a packaged study, with its comments."""
    if not is_first_rank():
        return
    from .study.reader import packaged_study_text

    print(packaged_study_text(study), end="")


@app.command()
def new(
    path: Annotated[Path, typer.Argument(metavar="STUDY.toml", help="file to write")],
    study: Annotated[str, typer.Option("--from", metavar="NAME", help="a packaged study (`fracsim list`)")],
) -> None:
    """Write a study file of your own: a copy of a packaged study, with its comments."""
    if not is_first_rank():
        return
    from .study.reader import packaged_study_text

    target = path if path.suffix else path.with_suffix(".toml")
    if target.exists() or target.is_symlink():
        raise InputError(f"{target} exists: give another name, or delete it")
    target.write_text(f"#:schema {_SCHEMA_FILE}\n{packaged_study_text(study)}", encoding="utf-8")
    print(f"wrote {target}; next: fracsim check {target}; for editors: fracsim schema > {_SCHEMA_FILE}")


@app.command()
def schema() -> None:
    """Print the JSON schema of study files, for editors that complete and check keys."""
    if not is_first_rank():
        return
    import json

    from .study.documentation import study_schema

    print(json.dumps(study_schema(), indent=1))


@app.command()
def doctor() -> None:
    """Say which DOLFINx, PETSc, MPI, compiler and optional packages there are, and what to type for what lacks."""
    if not is_first_rank():
        return
    from .doctor import print_parts

    if not print_parts():
        raise typer.Exit(Exit.BAD_INPUT)


@app.command(name="list")
def list_(
    what: Annotated[str | None, typer.Argument(help="materials: those that [material] like may name")] = None,
) -> None:
    """Show the studies, builders, energies and schemes that exist, or a table of materials."""
    if not is_first_rank():
        return
    from .study.catalogue import catalogue, material_table

    if what is not None:
        if what != "materials":
            raise InputError(f'list {what}: there is "fracsim list" and "fracsim list materials"')
        print("\n".join(material_table()))
        return
    from .studies import folder as packaged_studies

    for heading, entries in catalogue().items():
        print(heading + (f" in {packaged_studies()}" if heading == "studies" else ""))
        for name, words in entries.items():
            print(f"  {name:18} {words}")


def _note_active_runs(folders: list[Path]) -> None:
    """Print a note on folders in which a run continues, whose results are incomplete."""
    from .output.lock import describe_lock_holder

    for folder in folders:
        if words := describe_lock_holder(folder):
            print(
                f"fracsim: note: a run goes on in {folder} ({one_line(words)}); shown is what it has written",
                file=sys.stderr,
            )


def _load(comm: MPI.Comm, path: Path, overrides: list[str], folder: Path) -> Study:
    """Return the study, which rank 0 reads (collective): the file may be edited meanwhile."""
    from .mesh.parallel import from_root
    from .study import Study
    from .study.reader import load_study

    def work() -> object:
        loaded = load_study(path, overrides)
        check_folder(folder)
        return loaded.model_dump(exclude_none=True)

    # as plain data: pydantic's generic tables cannot be pickled
    return Study.model_validate(from_root(comm, work))


def check_folder(folder: Path) -> None:
    """Raise InputError if results cannot be written to a folder; nothing is created."""
    try:
        os.lstat(folder)
    except (FileNotFoundError, NotADirectoryError):
        pass
    except OSError as error:
        raise InputError(f"--out {folder}: {error.strerror}; give another one") from None
    present = next(path for path in (folder.absolute(), *folder.absolute().parents) if os.path.lexists(path))
    if not present.is_dir():
        raise InputError(f"--out {folder}: {present} is not a folder; give another one")
    if not os.access(present, os.W_OK | os.X_OK):
        raise InputError(f"--out {folder}: no permission to write in {present}; give another one")


def program() -> NoReturn:
    """Run the command line in a process of its own; the entry point of the console script."""
    if sys.argv[1:2] in (["list"], ["check"], ["run"]):
        # garbage collection among imports takes a twentieth of list and check; start_run enables it again
        gc.disable()
    try:
        main(start_process)
    except SystemExit as end:
        end_process(end.code)


def main(begin: Callable[[], None] | None = None) -> NoReturn:
    """Run the command line; an error of the user ends it with one message and an exit code, on any number of ranks.

    `begin`: called first.
    """
    # without arguments the help is printed, and the usage is wrong all the same
    bare = len(sys.argv) == 1
    if not is_first_rank() and (bare or "--help" in sys.argv):
        sys.exit(Exit.DONE)

    def work() -> object:
        if begin is not None:
            begin()
        code = app(["--help"] if bare else None, prog_name="fracsim", standalone_mode=False)
        sys.stdout.flush()  # here what cannot be written is told
        return code

    code = _exit_code(work)
    if not is_first_rank() and "mpi4py.MPI" not in sys.modules:
        sys.exit(Exit.DONE)  # mpirun kills all ranks at the first that fails, and rank 0 may still have to say why
    sys.exit(Exit.BAD_INPUT if bare else code)


def _exit_code(work: Callable[[], object]) -> int:
    """Return the exit code of `work`, and print the message of an error."""
    try:
        code = work()
        if code == INTERRUPTED and is_first_rank():
            print("fracsim: interrupted before the first step; nothing was written", file=sys.stderr, flush=True)
        return code if isinstance(code, int) else Exit.DONE
    except (SystemExit, Exception) as error:
        code, message = _error_code_and_message(error)
        # what ends a run by rule may come late from rank 0, which first writes a summary and draws the last frame
        _end_other_ranks(message, code, late=isinstance(error, NotConverged | Stopped))
    if message and is_first_rank():
        print(message, file=sys.stderr, flush=True)
    return code


def _error_code_and_message(error: BaseException) -> tuple[int, str]:
    """Return exit code and message: one sentence for an error of the user, a traceback for one of the program."""
    if isinstance(error, FracsimError):
        return int(error.exit_code), f"fracsim: {error}"
    if isinstance(error, _USAGE_ERROR):
        return int(Exit.BAD_INPUT), f"fracsim: {error.format_message().rstrip('.')}; see fracsim --help"
    if isinstance(error, typer.Exit):
        return error.exit_code, ""
    if isinstance(error, SystemExit):
        return (error.code or 0, "") if isinstance(error.code, int | None) else (1, str(error.code))
    if isinstance(error, OSError) and error.errno in _CANNOT_WRITE:
        where = f" {error.filename}" if error.filename else ""
        words = f"cannot write{where}: {error.strerror}; make room or give another --out"
        return int(Exit.CANNOT_WRITE), f"fracsim: {FracsimError(words)}"
    if isinstance(error, OSError) and error.errno in _BAD_PATH and _is_user_file(error.filename):
        return int(Exit.BAD_INPUT), f"fracsim: {FracsimError(f'{error.filename}: {error.strerror}; give another path')}"
    return 1, "".join(traceback.format_exception(error)).rstrip()


def _is_user_file(path: object) -> bool:
    """Return whether a path is outside of the program itself."""
    return bool(path) and not str(path).startswith((sys.prefix, str(Path(__file__).parent)))


def _end_other_ranks(message: str, code: int, *, late: bool) -> None:
    """Return if every rank has failed; otherwise end the ranks that wait for this one."""
    if "mpi4py.MPI" not in sys.modules:
        return
    from mpi4py import MPI

    if MPI.COMM_WORLD.size > 1:
        from .mesh.parallel import abort_unless_all_failed

        abort_unless_all_failed(MPI.COMM_WORLD, message, code, late=late)


__all__ = ["app", "main", "program"]
