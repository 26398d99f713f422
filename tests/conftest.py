"""Settings that every test shares, and who runs which: `make test` starts several workers."""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import mpi4py.MPI  # noqa: F401  before dolfinx, whose wheel needs its MPI library
import pytest
from hypothesis import settings

from fracsim.meshes import time_limit
from fracsim.meshes.data import MeshData
from fracsim.study import MeshSettings, check
from fracsim.study.solver_options import PLAIN_VARIABLE
from repeats import REPEATS
from support.forked_readers import ForkedReaders
from support.ranks import Arrays, OnRanks, run_on_ranks, share_starts

OF_DOLFINX = ("dolfinx", "basix", "ffcx", "ufl", "petsc4py")

# The same examples on every machine and in every run: a failure can be repeated, and no deadline depends on the load.
settings.register_profile("fracsim", derandomize=True, deadline=None, max_examples=25, database=None)
settings.load_profile("fracsim")


@pytest.fixture(scope="session")
def on_ranks(tmp_path_factory: pytest.TempPathFactory) -> OnRanks:
    """What support/every.py saves on a rank count, and the folder of its surfaces; run once, when first asked for."""
    folder, begun = tmp_path_factory.mktemp("ranks"), set()

    @cache
    def run(ranks: int) -> tuple[Arrays, Path]:
        assert ranks not in begun, f"the run on {ranks} ranks has failed before"
        begun.add(ranks)
        return run_on_ranks("support.every", ranks, folder), folder / f"every-{ranks}"

    return run


@pytest.fixture(scope="session", autouse=True)
def folder_of_mpi() -> Iterator[None]:
    """Open MPI names a folder by the number of a process, and does not start where a killed run has left one."""
    name = "PRTE_MCA_prte_tmpdir_base"
    with tempfile.TemporaryDirectory(prefix="fracsim-mpi-", ignore_cleanup_errors=True) as folder:
        given = os.environ.setdefault(name, folder)
        yield
        if given == folder:
            del os.environ[name]


@pytest.fixture(scope="session", autouse=True)
def meshes_built_once() -> Iterator[None]:
    """Scenes of one process with the same [mesh] table share its arrays, which no one may write to. What builders build
    is tested by themselves."""
    build, built = check.build_mesh, {}

    def build_once(mesh: MeshSettings, *surface: Any) -> MeshData:
        if mesh.builder is None:
            return build(mesh, *surface)
        key = repr(mesh)
        if key not in built:
            data = built[key] = build(mesh)
            for values in (data.points, data.cells, *data.facet_groups.values(), *data.regions.values()):
                values.flags.writeable = False
        return replace(built[key])

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(check, "build_mesh", build_once)
        yield


@pytest.fixture(scope="session", autouse=True)
def readers_forked() -> Iterator[None]:
    """Calls with a time limit are forked from one process; `python_started` has those of the package."""
    readers = ForkedReaders()
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(time_limit, "subprocess", readers)
        yield
    readers.close()


@pytest.fixture
def python_started(monkeypatch: pytest.MonkeyPatch) -> None:
    """Each call with a time limit starts a Python, as in the package."""
    monkeypatch.setattr(time_limit, "subprocess", subprocess)


@pytest.fixture(autouse=True)
def no_dolfinx(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """What is marked `any_release` cannot import what comes with a release of DOLFINx."""
    if request.node.get_closest_marker("any_release") is not None:
        for name in OF_DOLFINX:
            monkeypatch.setitem(sys.modules, name, None)


@pytest.fixture
def little_built(monkeypatch: pytest.MonkeyPatch) -> None:
    """`check` measures the loads of small meshes alone: it builds those of up to 60,000 cells."""
    monkeypatch.setattr(check, "LIMITS", replace(check.LIMITS, max_built_cells=3000))


# The longest first, so that no worker is left alone with one of them at the end.
FIRST = (
    "test_restart", "test_meshes_builders", "test_studies", "test_obstacles", "test_free_obstacles",
    "test_plasticity", "test_obstacle_pairs", "test_stepping", "test_contact_time_weights", "test_sweep",
    "test_ranks", "test_file_ownership", "test_facets", "test_closing", "test_brittle", "test_fracture",
    "test_contact_checks", "test_bad_input", "test_cannot_write", "test_surface_run", "test_output",
    "test_self_contact", "test_apart",
)  # fmt: skip


LOST_REPEATS = pytest.StashKey[list[str]]()


@pytest.hookimpl(tryfirst=True)
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Tests of a file stay together, for they share what its fixtures made (`--dist loadgroup`); repeats are slow."""
    names = [item.nodeid.removeprefix("tests/") for item in items]
    lost = [each for each in REPEATS if not any(name.startswith(each) for name in names)]
    config.stash[LOST_REPEATS] = lost if config.args == config.getini("testpaths") else []  # a file alone has not all
    for item in items:
        if item.nodeid.removeprefix("tests/").startswith(REPEATS):
            item.add_marker("slow")
        about_fast = item.get_closest_marker("fast_solver_only")
        if about_fast is not None and os.environ.get(PLAIN_VARIABLE) == "1":
            item.add_marker(pytest.mark.skip(f"of the fast solver: {about_fast.args[0]}"))
        if item.get_closest_marker("xdist_group") is None:
            item.add_marker(pytest.mark.xdist_group(item.path.stem))


def pytest_collection_finish(session: pytest.Session) -> None:
    share_starts(item.path.stem for item in session.items if item.get_closest_marker("ranks") is not None)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_make_scheduler(config: pytest.Config, log: Any) -> Any:
    """pytest-xdist starts the groups of the most tests first: here those of `FIRST`."""
    from xdist.scheduler import LoadGroupScheduling

    class Longest(LoadGroupScheduling):  # type: ignore[misc]
        def _assign_work_unit(self, node: Any) -> None:
            place = {group: number for number, group in enumerate(FIRST)}
            self.workqueue.move_to_end(min(self.workqueue, key=lambda group: place.get(group, len(FIRST))), last=False)
            super()._assign_work_unit(node)

    return Longest(config, log) if config.getoption("dist") == "loadgroup" else None


@pytest.fixture(params=["newton", "projections"])
def solver(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    """Few contacts of rigid bodies, and as many as if they were a crowd."""
    if request.param == "projections":
        from fracsim.rigid import contact_solver

        settings = replace(contact_solver.SETTINGS, max_newton_contacts=0)
        monkeypatch.setattr(contact_solver, "SETTINGS", settings)
