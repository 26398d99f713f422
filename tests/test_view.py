"""The page of `fracsim view`: what it holds, its server, and the page in a real browser."""

from __future__ import annotations

import base64
import csv
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import threading
import urllib.error
import urllib.request
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import pyvista
from mpi4py import MPI

from fracsim.deformable_run import run_study
from fracsim.errors import InputError
from fracsim.report.view_page import PackedRun, ViewServer, page_text, write_view
from fracsim.study.reader import load_study
from programs import Chromium
from support.exported import dropped_bar

pytest.importorskip("trimesh", reason="an environment made without a network")


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> Path:
    pytest.importorskip("mujoco", reason="an environment made without a network")
    return dropped_bar(tmp_path_factory.mktemp("view") / "out")


def beginning(run: Path, folder: Path, frames: int) -> Path:
    """The files of a run as they were after some frames."""
    shutil.copytree(run, folder)
    pvd = run.joinpath("surface.pvd").read_text().splitlines()
    head, entries, tail = pvd[:3], pvd[3:-2], pvd[-2:]
    (folder / "surface.pvd").write_text("\n".join([*head, *entries[: 2 * frames], *tail]) + "\n")
    rows = run.joinpath("history.csv").read_text().splitlines()
    (folder / "history.csv").write_text("\n".join(rows[: 1 + 5 * (frames - 1)]) + "\n")
    (folder / "summary.json").unlink()
    return folder


def integers(text: str) -> Any:
    """As the page reads them: differences in four sequences of bytes, signs in the lowest bit."""
    parts = np.frombuffer(zlib.decompress(base64.b64decode(text)), np.uint8).reshape(4, -1).astype(np.uint32)
    zigzag = sum(part << np.uint32(8 * number) for number, part in enumerate(parts))
    steps = (zigzag >> np.uint32(1)).astype(np.int64) * np.where(zigzag & 1, -1, 1) - (zigzag & 1)
    return np.cumsum(steps)


def test_positions_are_those_of_the_surface_to_half_a_step(run: Path) -> None:
    """In all frames, from differences to the frame before where triangles are the same."""
    data = PackedRun(run).to_json()
    files = sorted((run / "surface").glob("surface_*.vtu"))
    assert len(data["frames"]) == len(files) > 3
    points: dict[str, Any] = {}
    differences = 0
    for frame, file in zip(data["frames"], files, strict=True):
        for name in ("skin", "inside"):
            if name not in frame["parts"]:
                continue
            part = frame["parts"][name]
            stored = integers(part["points"])
            points[name] = stored if "topology" in part else points[name] + stored
            differences += "topology" not in part
        found = np.concatenate([each.reshape(3, -1).T for each in points.values()]) * data["step"] + data["origin"]
        wanted = np.asarray(pyvista.read(file).points)
        least, largest = found.min(axis=0), found.max(axis=0)
        np.testing.assert_allclose([least, largest], [wanted.min(axis=0), wanted.max(axis=0)], atol=data["step"])
        gaps = np.linalg.norm(found[:, None] - wanted[None], axis=2).min(axis=1)
        assert gaps.max() <= data["step"]
    assert differences > 2 and data["step"] < 1e-4


def test_fragments_and_history_are_those_of_the_tables(run: Path) -> None:
    data = PackedRun(run).to_json()
    with (run / "pieces.csv").open() as file:
        rows = [row for row in csv.DictReader(file)]
    last = [row for row in rows if row["time"] == rows[-1]["time"]]
    table = data["frames"][-1]["pieces"]
    assert table["piece"] == [int(row["piece"]) for row in last]
    assert table["mass"] == pytest.approx([float(row["mass"]) for row in last], rel=1e-5)
    speed = [np.hypot.reduce([float(row[f"velocity_{axis}"]) for axis in "xyz"]) for row in last]
    assert table["speed"] == pytest.approx(speed, rel=1e-5, abs=1e-12)
    assert len(data["history"]["time"]) == 30 and data["outcome"] == "done"


def test_fields_are_components_of_tensors_and_magnitudes_of_vectors(tmp_path: Path) -> None:
    """In the frame of a clamped bar that is pulled: sigma_xx is the largest component."""
    over = ["mesh.h=0.05", "time.end=0.02", "output.surface=false", "output.picture=false",
            'output.fields=["velocity", "stress", "von_mises"]']  # fmt: skip
    run_study(MPI.COMM_SELF, load_study("bar-2d", over), tmp_path / "bar")
    data = PackedRun(tmp_path / "bar").to_json()
    ranges = {name: field["range"] for name, field in data["frames"][-1]["parts"]["skin"]["fields"].items()}
    components = {f"stress:{component}" for component in ("xx", "yy", "zz", "xy", "yz", "xz")}
    assert components | {"velocity", "von_mises"} <= set(ranges) and "stress" not in ranges
    assert ranges["stress:xx"][1] == max(ranges[name][1] for name in components) > 0
    assert data["units"]["stress"] == "Pa" and ranges["velocity"][0] >= 0


def test_the_page_needs_nothing_else(run: Path, tmp_path: Path) -> None:
    page = write_view(run, tmp_path / "run.html").read_text()
    markup = re.sub(r"<script>.*?</script>", "", page, count=1, flags=re.DOTALL)  # three.js names addresses in comments
    assert not re.findall(r"""(?:src|href)=["'](?!data:)|https?://|@import|url\(""", markup)
    assert "THREE_JS" not in page and "DATA_OF_THE_RUN" not in page


def test_what_cannot_be_viewed(run: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with pytest.raises(InputError, match="is not the output folder of a run"):
        write_view(tmp_path, tmp_path / "a.html")
    with pytest.raises(InputError, match=r"-o a.pdf: the page is an .html file: -o out.html"):
        write_view(run, Path("a.pdf"))
    monkeypatch.setattr("fracsim.report.view_page._TEMPLATE", "resources/missing.zip")
    with pytest.raises(InputError, match=r"needs three.js, which trimesh brings: pip install fracsim\[files\]"):
        write_view(run, tmp_path / "a.html")


# --- server ---


@contextmanager
def served(folder: Path, running: threading.Event) -> Iterator[ViewServer]:
    with ViewServer(folder, running.is_set, port=0) as server:
        thread = threading.Thread(target=server.serve_forever, args=(0.05,))
        thread.start()
        yield server
        server.shutdown()
        thread.join()


def answer(server: ViewServer, path: str, host: str = "localhost") -> tuple[int, bytes]:
    request = urllib.request.Request(server.address.rstrip("/") + path, headers={"Host": host})
    try:
        with urllib.request.urlopen(request, timeout=30) as reply:
            return reply.status, reply.read()
    except urllib.error.HTTPError as error:
        return error.code, b""


def test_the_server_gives_the_page_and_its_data_and_no_file(run: Path) -> None:
    with served(run, threading.Event()) as server:
        assert server.address.startswith("http://127.0.0.1:") and server.server_address[0] == "127.0.0.1"
        assert answer(server, "/")[0] == 200
        for path in ("/study.toml", "/surface.pvd", "/../out/study.toml", "/%2e%2e/out/study.toml", "/data.json/../x"):
            assert answer(server, path)[0] == 404, path
        assert answer(server, "/", host="elsewhere.example")[0] == 403
        assert answer(server, "/data.json?first=x")[0] == 400
        other = socket.create_connection(("127.0.0.1", server.server_port))
        other.sendall(b"POST /data.json HTTP/1.1\r\nHost: localhost\r\nContent-Length: 0\r\n\r\n")
        assert b" 501 " in other.recv(100)
        other.close()


def test_the_server_gives_new_frames_alone(run: Path, tmp_path: Path) -> None:
    """And all frames when the run began again."""
    folder, running = beginning(run, tmp_path / "out", 3), threading.Event()
    running.set()
    with served(folder, running) as server:

        def data(query: str = "") -> Any:
            return json.loads(answer(server, "/data.json" + query)[1])

        first = data()
        assert len(first["frames"]) == 3 and first["outcome"] == "running" and len(first["history"]["time"]) == 10
        for name in ("surface.pvd", "history.csv"):
            shutil.copy(run / name, folder / name)
        more = data("?first=3&generation=0")
        assert (more["first"], len(more["frames"]), len(more["history"]["time"])) == (3, 4, 30)
        pvd = (folder / "surface.pvd").read_text()
        (folder / "surface.pvd").write_text(pvd.replace('timestep="0"', 'timestep="0.001"'))
        again = data("?first=7&generation=0")
        assert (again["first"], again["generation"], len(again["frames"])) == (0, 1, 7)


def test_the_command_serves_until_it_is_interrupted(run: Path) -> None:
    env = os.environ | {"BROWSER": "true"}  # the program of that name opens nothing
    command = [sys.executable, "-m", "fracsim", "view", run]
    # a shell that starts the tests in the background lets them ignore the signal
    heeds = partial(signal.signal, signal.SIGINT, signal.SIG_DFL)
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=env, preexec_fn=heeds
    ) as process:
        assert process.stdout is not None
        found = re.search(r"is shown at (http://127.0.0.1:\d+/) until you press Ctrl-C", process.stdout.readline())
        assert found is not None
        with urllib.request.urlopen(found.group(1), timeout=30) as reply:
            assert b"<title>fracsim view</title>" in reply.read()
        process.send_signal(signal.SIGINT)
        try:
            _, errors = process.communicate(timeout=30)
        finally:
            process.kill()  # or the block would wait for it
    assert process.returncode == 0 and not errors.strip()


# --- in Chromium ---

SHOWN = "typeof drawn !== 'undefined' && drawn >= 0"


@pytest.mark.slow
@pytest.mark.parametrize("size", [(1280, 800), (390, 844)])
def test_the_page_plays_and_answers_a_click(run: Path, tmp_path: Path, size: tuple[int, int]) -> None:
    page = write_view(run, tmp_path / "run.html")
    with Chromium(tmp_path / "profile", *size) as browser:
        browser.open(page.as_uri())
        browser.wait_for(SHOWN)
        assert browser.evaluate("document.documentElement.scrollWidth") <= size[0]
        browser.evaluate("document.getElementById('play').click()")
        browser.wait_for("drawn >= 2")
        assert browser.evaluate("document.getElementById('time').textContent").startswith("t = 0.0")
        browser.evaluate("document.getElementById('play').click()")
        for colour in ("velocity", "age", "piece"):
            browser.evaluate(f"document.getElementById('colour').value = '{colour}'; show(frames.length - 1)")
        # where a vertex of the first fragment is on the window, in front of all others
        point = browser.evaluate("""(() => {
            const part = parts.get("skin"), x = part.geometry.attributes.position, index = part.geometry.index;
            const box = renderer.domElement.getBoundingClientRect(), ray = new THREE.Raycaster();
            for (let k = 0; k < index.count; k += 3) {
                const middle = new THREE.Vector3();
                for (let i = 0; i < 3; i++)
                    middle.add(new THREE.Vector3().fromBufferAttribute(x, index.getX(k + i)).divideScalar(3));
                const seen = middle.clone().project(camera);
                ray.setFromCamera(new THREE.Vector2(seen.x, seen.y), camera);
                const hit = ray.intersectObject(part.object)[0];
                if (hit && hit.point.distanceTo(middle) < 1e-6) {
                    const piece = part.topology.piece[part.topology.split[index.getX(k)]];
                    return [box.left + (seen.x + 1) / 2 * box.width, box.top + (1 - seen.y) / 2 * box.height, piece];
                }
            }
        })()""")
        browser.click(*point[:2])
        browser.wait_for("!document.getElementById('info').hidden", 10)
        table = PackedRun(run).to_json()["frames"][-1]["pieces"]
        row = table["piece"].index(point[2])
        assert browser.evaluate("document.getElementById('info').textContent") == (
            f"piece {point[2]}: mass {float(f'{table["mass"][row]:.4g}'):g} kg, "
            f"speed {float(f'{table["speed"][row]:.4g}'):g} m/s"
        )
        before = browser.evaluate(
            "[...parts.get('skin').geometry.attributes.position.array].map(Math.abs).reduce((a, b) => a + b)"
        )
        browser.evaluate("document.getElementById('explode').value = 1; show(drawn)")
        after = browser.evaluate(
            "[...parts.get('skin').geometry.attributes.position.array].map(Math.abs).reduce((a, b) => a + b)"
        )
        assert after > 1.2 * before
        browser.screenshot(tmp_path / "page.png")
        assert browser.errors == []
    assert np.ptp(pyvista.read(tmp_path / "page.png").point_data.active_scalars) > 100


@pytest.mark.slow
def test_a_served_page_follows_a_run(run: Path, tmp_path: Path) -> None:
    folder, running = beginning(run, tmp_path / "out", 2), threading.Event()
    running.set()
    with served(folder, running) as server, Chromium(tmp_path / "profile", 1280, 800) as browser:
        browser.open(server.address)
        browser.wait_for(SHOWN)
        assert browser.evaluate("[frames.length, run.outcome]") == [2, "running"]
        browser.evaluate("show(1)")
        for name in ("surface.pvd", "history.csv", "summary.json"):
            shutil.copy(run / name, folder / name)
        running.clear()
        browser.wait_for("frames.length === 7 && drawn === 6 && run.outcome === 'done'", 30)
        assert browser.evaluate("run.history.time.length") == 30
        assert browser.errors == []


@pytest.mark.slow
@pytest.mark.parametrize("surface", ["true", "false"])
def test_a_body_in_2d_is_seen_from_the_front(surface: str, tmp_path: Path) -> None:
    """Its split surface, or its mesh."""
    over = ["mesh.h=0.02", f"output.surface={surface}", "output.picture=false", "output.interval=0.1"]
    run_study(MPI.COMM_SELF, load_study("bar-2d", over), tmp_path / "bar")
    with Chromium(tmp_path / "profile", 1280, 800) as browser:
        browser.open(write_view(tmp_path / "bar", tmp_path / "bar.html").as_uri())
        browser.wait_for(SHOWN)
        view = browser.evaluate("camera.getWorldDirection(new THREE.Vector3()).toArray()")
        assert view == pytest.approx([0.0, 0.0, -1.0], abs=1e-6)
        assert browser.evaluate("[...parts.keys()]") == (["skin", "outline"] if surface == "true" else ["skin"])
        assert browser.errors == []


@pytest.mark.slow
def test_the_page_of_the_demo_has_at_most_ten_megabytes(tmp_path: Path) -> None:
    run_study(MPI.COMM_SELF, load_study("loaf", ["output.picture=false"]), tmp_path / "loaf")
    page = write_view(tmp_path / "loaf", tmp_path / "loaf.html")
    assert page.stat().st_size < 10e6
    with Chromium(tmp_path / "profile", 1280, 800) as browser:
        browser.open(page.as_uri())
        browser.wait_for(SHOWN)
        browser.evaluate("show(frames.length - 1)")
        assert browser.errors == []


def test_text_of_a_run_stays_text(run: Path) -> None:
    """No element and no comment begins within the data of the page."""
    title = "</script><!--<script>"
    page, plain = (page_text(json.dumps({"title": each})) for each in (title, "plain"))
    assert page.count("<") == plain.count("<") and json.loads(
        page[page.index('{"title') :].split("\n")[0].split("<")[0]
    )


def test_a_run_that_is_repeated_is_packed_anew(run: Path, tmp_path: Path) -> None:
    """Its frames have the same times and names, but were written later."""
    folder = beginning(run, tmp_path / "again", 3)
    packed = PackedRun(folder)
    packed.to_json()
    assert packed.to_json()["generation"] == 0
    first = min((folder / "surface").glob("surface_*.vtu"))
    os.utime(first, ns=(0, first.stat().st_mtime_ns + 10**9))
    assert packed.to_json()["generation"] == 1 and len(packed.frames) == 3
