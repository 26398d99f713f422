"""What all attacks share: trials, their failures, running them two at a time, and commands with a time limit."""

from __future__ import annotations

import os
import random
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import traceback
from collections.abc import Callable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

PATIENCE = 90.0  # s, after which a command is taken to hang: a busy machine, and kernels to compile
MEMORY = 8 << 30  # bytes of address space of a process of a trial
AT_ONCE = 2
TEMPORARY = "tmp"  # of a trial: a killed mpirun leaves its session there, on which one of the same process id fails


class Wrong(Exception):
    """What an attack brought to light."""


def expect(holds: object, said: str) -> None:
    """Wrong where it does not hold."""
    if not holds:
        raise Wrong(said)


@dataclass
class Tally:
    """Of one kind of attack.

    Attributes:
        ends: how often trials ended in which way.    failures: (number, what was wrong).
    """

    kind: str
    trials: int = 0
    seconds: float = 0.0
    ends: dict[str, int] = field(default_factory=dict)
    failures: list[tuple[int, str]] = field(default_factory=list)

    def note(self, number: int, end: str, wrong: str | None) -> None:
        self.trials += 1
        self.ends[end] = self.ends.get(end, 0) + 1
        if wrong is not None:
            self.failures.append((number, wrong))
            print(f"FAILED {self.kind}:{number}: {wrong}", flush=True)


Trial = Callable[[int, random.Random, Path], str]  # number, chance, empty folder -> how it ended; raises Wrong


def run_trials(kind: str, trial: Trial, numbers: Sequence[int], seed: int, folder: Path) -> Tally:
    """Run trials in processes of their own that are forked from this one, AT_ONCE at a time. Folders of those that
    failed stay."""
    tally, waiting, going = Tally(kind), list(reversed(numbers)), dict[int, tuple[int, Path, float]]()
    began = time.monotonic()
    while waiting or going:
        while waiting and len(going) < AT_ONCE:
            number = waiting.pop()
            place = folder / f"{kind}-{number}"
            shutil.rmtree(place, ignore_errors=True)
            place.mkdir(parents=True)
            sys.stdout.flush()
            if (child := os.fork()) == 0:
                _work(trial, number, random.Random(f"{seed} {kind} {number}"), place)
            going[child] = number, place, time.monotonic()
        for child, (number, place, since) in list(going.items()):
            done, status = os.waitpid(child, os.WNOHANG)
            late = time.monotonic() - since > 8 * PATIENCE
            if late:
                os.killpg(child, signal.SIGKILL)
                _, status = os.waitpid(child, 0)
            if not done and not late:
                continue
            del going[child]
            end, wrong = _verdict(place, status, late)
            shutil.rmtree(place / TEMPORARY, ignore_errors=True)
            tally.note(number, end, wrong)
            if wrong is None:
                shutil.rmtree(place, ignore_errors=True)
            if tally.trials % max(len(numbers) // 10, 1) == 0:
                print(f"  {kind}: {tally.trials} of {len(numbers)}, {len(tally.failures)} failed, "
                      f"{time.monotonic() - began:.0f} s", flush=True)  # fmt: skip
        time.sleep(0.005)
    tally.seconds = time.monotonic() - began
    return tally


def _work(trial: Trial, number: int, chance: random.Random, place: Path) -> None:
    """Of the child: what it comes to stands in the folder."""
    code = 1
    try:
        os.setpgid(0, 0)
        (place / TEMPORARY).mkdir()
        os.environ["TMPDIR"], tempfile.tempdir = str(place / TEMPORARY), None
        resource.setrlimit(resource.RLIMIT_AS, (MEMORY, MEMORY))
        with (place / "said").open("w") as said:
            os.dup2(said.fileno(), 1)
            os.dup2(said.fileno(), 2)
        sys.stdout, sys.stderr = (os.fdopen(os.dup(each), "w", buffering=1) for each in (1, 2))
        (place / "end").write_text(trial(number, chance, place))
        code = 0
    except Wrong as wrong:
        (place / "wrong").write_text(str(wrong))
    except BaseException:
        (place / "wrong").write_text(traceback.format_exc())
    finally:
        os._exit(code)


def _verdict(place: Path, status: int, late: bool) -> tuple[str, str | None]:
    if late:
        return "hangs", "did not end in time"
    if os.WIFSIGNALED(status):
        return "crashed", f"ended by signal {os.WTERMSIG(status)}; see {place / 'said'}"
    if os.WEXITSTATUS(status):
        wrong = (place / "wrong").read_text() if (place / "wrong").exists() else f"exit {os.WEXITSTATUS(status)}"
        return "wrong", f"{wrong.strip()}  [{place}]"
    return (place / "end").read_text(), None


# --- commands -------------------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Ended:
    """A command that has ended: its exit code, and what it said."""

    code: int
    said: str

    def expect(self, *codes: int) -> Ended:
        """This; Wrong where it ended in another way, or with a traceback."""
        expect(self.code in codes, f"exit {self.code}, not {' or '.join(map(str, codes))}: {self.said[-1500:]}")
        expect("Traceback (most recent call last)" not in self.said, f"a traceback: {self.said[-1500:]}")
        return self


def call(*arguments: str | Path) -> Ended:
    """The command line in this process, which has imported what it needs, with a time limit: it ends by SIGALRM."""
    from fracsim import cli

    at = Path(f"call-{time.monotonic_ns()}").absolute()
    before, streams = sys.argv, (sys.stdout, sys.stderr)
    signal.signal(signal.SIGALRM, signal.SIG_DFL)
    signal.alarm(int(PATIENCE))
    sys.argv = ["fracsim", *map(str, arguments)]
    code: Any = 0
    with at.open("w", buffering=1) as said:
        sys.stdout = sys.stderr = said
        try:
            cli.main()
        except SystemExit as end:
            code = end.code or 0
        except BaseException:
            said.write(traceback.format_exc())
            code = 99
        finally:
            signal.alarm(0)
            sys.argv, (sys.stdout, sys.stderr) = before, streams
    text = at.read_text(errors="replace")
    at.unlink()
    return Ended(int(code), text)


def words(*arguments: str | Path, ranks: int = 1) -> list[str]:
    """The command line for processes of their own."""
    mpirun = ["mpirun", "-n", str(ranks)] if ranks > 1 else []
    return [*mpirun, shutil.which("fracsim") or "fracsim", *map(str, arguments)]


def started(command: list[str], said: Path) -> subprocess.Popen[bytes]:
    """A command on its way, in a session of its own; what it says goes into a file."""
    with said.open("ab") as file:
        return subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=file, stderr=file, start_new_session=True, env=dict(os.environ)
        )


def ended(process: subprocess.Popen[bytes], said: Path, patience: float = PATIENCE) -> Ended:
    """What a command came to; Wrong where it does not end in time."""
    try:
        code = process.wait(patience)
    except subprocess.TimeoutExpired:
        end_all(process.pid)
        raise Wrong(
            f"{process.args} did not end in {patience:g} s: {said.read_text(errors='replace')[-800:]}"
        ) from None
    return Ended(code, said.read_text(errors="replace"))


def run(command: list[str], place: Path, name: str) -> Ended:
    """A command to its end."""
    said = place / name
    return ended(started(command, said), said)


def members(session: int) -> list[int]:
    """Processes of a session that have not ended, mpirun's ranks among them."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdigit():
            continue
        with suppress(OSError, ValueError):
            state, _, _, own = (entry / "stat").read_text().rpartition(")")[2].split()[:4]
            if int(own) == session and state != "Z":
                found.append(int(entry.name))
    return found


def descendants(pid: int) -> list[int]:
    """Processes that came of one, also those in sessions of their own."""
    children: dict[int, list[int]] = {}
    for entry in Path("/proc").iterdir():
        with suppress(OSError, ValueError):
            if entry.name.isdigit():
                parent = (entry / "stat").read_text().rpartition(")")[2].split()[1]
                children.setdefault(int(parent), []).append(int(entry.name))
    found, look = [], [pid]
    while look:
        look = [child for each in look for child in children.get(each, [])]
        found += look
    return found


def alive(pids: Sequence[int]) -> list[int]:
    """Those of some processes that have not ended."""
    left = []
    for pid in pids:
        with suppress(OSError):
            if Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] not in "ZX":
                left.append(pid)
    return left


def end_all(session: int) -> None:
    """Kill what is left of a session and came of it: processes of this suite alone."""
    for pid in {*descendants(session), *members(session), session}:
        with suppress(ProcessLookupError):
            os.kill(pid, signal.SIGKILL)


def files(folder: Path) -> Iterator[Path]:
    """All files below a folder."""
    return (path for path in sorted(folder.rglob("*")) if path.is_file() and not path.is_symlink())
