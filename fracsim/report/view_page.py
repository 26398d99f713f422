"""Page with a run in 3D (`fracsim view`): one HTML file, or served on this machine while the run goes on."""

from __future__ import annotations

import json
import sys
import webbrowser
import zipfile
from collections.abc import Callable
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from importlib.resources import files
from pathlib import Path
from threading import Lock
from urllib.parse import parse_qs, urlsplit

from ..errors import InputError
from ..meshes.plain_files import atomic_replacement
from .view_data import PackedRun

HOST, PORT = "127.0.0.1", 8750
# bytes of a page that a browser takes seconds to open
LARGE_PAGE = 50_000_000
# trimesh brings three.js (MIT licence) in the template of its own viewer, in front of that viewer's code
_TEMPLATE, _BEGIN, _END = "resources/templates/viewer.zip", "<script>", "var camera,controls"


def write_view(folder: Path, target: Path) -> Path:
    """Write a run as one HTML file, which needs nothing else, and return its path.

    Raises:
        InputError: the folder is not the output of a run, or a package is missing.
    """
    if target.suffix != ".html":
        raise InputError(f"-o {target}: the page is an .html file: -o {folder.name}.html")
    page = page_text(json.dumps(PackedRun(folder).to_json()))
    with atomic_replacement(target) as temporary:
        temporary.write_text(page, encoding="utf-8")
    return target


def page_text(data: str) -> str:
    """Page with the data of a run as JSON; "null" if it is to ask the server for them."""
    page = files(__package__).joinpath("view.html").read_text(encoding="utf-8")
    # "<" could end the element that holds the data, or begin a comment in it
    return page.replace("THREE_JS", _three_js()).replace("DATA_OF_THE_RUN", data.replace("<", "\\u003c"))


def _three_js() -> str:
    """Source of three.js. Raises InputError if trimesh is missing or has it no more."""
    try:
        with zipfile.ZipFile(str(files("trimesh").joinpath(_TEMPLATE))) as archive:
            text = archive.read(archive.namelist()[0]).decode()
        return text[text.index(_BEGIN) + len(_BEGIN) : text.index(_END)]
    except (ImportError, OSError, ValueError, zipfile.BadZipFile):
        raise InputError("view: this one needs three.js, which trimesh brings: pip install fracsim[files]") from None


class ViewServer(ThreadingHTTPServer):
    """Server of the page of one run, for this machine alone. It has the page and its data, and no file."""

    daemon_threads = True

    def __init__(self, folder: Path, is_running: Callable[[], bool], port: int = PORT) -> None:
        """Open a port: this one, or any if it is in use.

        Args:
            folder: output folder of the run.
            is_running: returns whether the run goes on.
            port: number of the port.

        Raises:
            InputError: the folder is not the output of a run, or a package is missing.
        """
        self._run, self._is_running, self._lock = PackedRun(folder), is_running, Lock()
        self.page = page_text("null").encode()
        try:
            super().__init__((HOST, port), _Handler)
        except OSError:
            super().__init__((HOST, 0), _Handler)

    @property
    def address(self) -> str:
        """Address of the page."""
        return f"http://{HOST}:{self.server_port}/"

    def data(self, first: int, generation: int) -> bytes:
        """Data from frame `first` on, of the frames of a generation; all data if the run began again since."""
        running = self._is_running()
        with self._lock:
            data = self._run.to_json(first, running=running)
            if data["generation"] != generation:
                data = self._run.to_json(running=running)
        return json.dumps(data).encode()


class _Handler(BaseHTTPRequestHandler):
    """Answers to a browser on this machine."""

    server: ViewServer

    def do_GET(self) -> None:
        """Answer with the page or its data."""
        path, query = urlsplit(self.path).path, parse_qs(urlsplit(self.path).query)
        # another host name would be a page of the network that was led here
        if self.headers.get("Host", "").partition(":")[0] not in (HOST, "localhost"):
            self.send_error(403)
        elif path == "/":
            self._answer("text/html; charset=utf-8", self.server.page)
        elif path == "/data.json":
            numbers = [query.get(name, ["0"])[0] for name in ("first", "generation")]
            if not all(number.isdecimal() for number in numbers):
                self.send_error(400)
                return
            try:
                self._answer("application/json", self.server.data(*map(int, numbers)))
            except (InputError, OSError, KeyError) as error:  # a frame may be half written
                self.send_error(503, explain=str(error))
        else:
            self.send_error(404)

    def _answer(self, kind: str, body: bytes) -> None:
        self.send_response(200)
        self.send_header("Content-Type", kind)
        self.send_header("Content-Length", str(len(body)))
        self.send_header("Cache-Control", "no-store")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Print nothing."""


def serve_view(folder: Path, is_running: Callable[[], bool]) -> None:
    """Serve the page until the user interrupts it, and open it in the browser; see `ViewServer`."""
    with ViewServer(folder, is_running) as server:
        try:
            print(f"{folder} is shown at {server.address} until you press Ctrl-C", flush=True)
            webbrowser.open(server.address)
            server.serve_forever()
        except KeyboardInterrupt:
            print(file=sys.stderr)
