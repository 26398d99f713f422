"""Damaged checkpoints: --restart ends with exit 2 and the name of the file, and the folder stays as it is.

Every fourth is given the digest of what it says now: it is refused in the same way, or runs, and is no traceback.
"""

from __future__ import annotations

import hashlib
import os
import random
import shutil
import signal
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from fracsim.errors import Exit

from .corpus import RUNS, contents, history, write
from .trial import Wrong, call, expect

MARK = b"\nfracsim checkpoint, SHA-256 "
KINDS = ("gone", "link", "short", "long", "type", "number", "number", "order", "swapped", "group", "other")
STATE = Path("checkpoint") / "state.h5"
_STOPPED: dict[str, Path] = {}


def prepare(folder: Path) -> None:
    """Runs that were stopped on their way, after edges broke where they do."""
    for name in RUNS:
        _STOPPED[name] = stopped(name, folder)


def stopped(name: str, folder: Path) -> Path:
    """The folder of a run that was stopped on its way, whatever the speed of the machine."""
    place = folder / "stopped" / name
    place.mkdir(parents=True, exist_ok=True)
    study = write(place / "study.toml", RUNS[name])
    for limit in (0.1, 0.15, 0.2, 0.3, 0.45, 0.6, 0.9, 1.3, 2.0, 3.0, 5.0):
        if (place / "out" / STATE).exists() and len(history(place / "out")["step"]) > 1:
            return place
        call("run", study, "-o", place / "out", "--overwrite", "--wall-limit", limit)
    expect((place / "out" / STATE).exists(), f"{name} could not be stopped on its way")
    return place


def attack(number: int, chance: random.Random, place: Path) -> str:
    """One checkpoint."""
    os.chdir(place)
    forged = number % 4 == 3
    name = chance.choice(sorted(_STOPPED))
    study, out = _STOPPED[name] / "study.toml", place / "out"
    good = content_of(_STOPPED[name] / "out" / STATE)
    expect(good != "cannot be read", "a good one cannot be read")
    for _ in range(100):
        shutil.rmtree(out, ignore_errors=True)
        shutil.copytree(_STOPPED[name] / "out", out)
        how = _content(out / STATE, chance, _STOPPED) if forged else damaged(out / STATE, chance, _STOPPED)
        if content_of(out / STATE) != good:  # else nothing that counts has changed
            break
    if forged:
        _seal(out / STATE)
    before = contents(out)
    done = call("run", study, "-o", out, "--restart", "--wall-limit", 30)
    try:
        if forged and "link" not in how:
            done.expect(Exit.DONE, Exit.BAD_INPUT, Exit.NOT_CONVERGED, Exit.STOPPED)
            if done.code != Exit.BAD_INPUT:
                return "forged, and runs"
        done.expect(Exit.BAD_INPUT)
        expect("state.h5" in done.said, f"the file is not named: {done.said[-500:]}")
        expect(contents(out) == before, f"the folder was changed: {done.said[-300:]}")
    except Wrong as wrong:
        raise Wrong(f"{name}, {'forged, ' * forged}{how}: {wrong}") from None
    return f"{'forged' if forged else how.split()[0]} refused"


def _seal(path: Path) -> None:
    """Put the digest of a file at its end, as a program would that knows how."""
    data = path.read_bytes()
    begin = data.rfind(MARK)
    if begin >= 0 and len(data) - begin <= len(MARK) + 65:
        data = data[:begin]
    path.write_bytes(data + MARK + hashlib.sha256(data).hexdigest().encode() + b"\n")


def content_of(path: Path) -> Any:
    """All that an HDF5 file says, read by h5py alone; HDF5 hangs on some damage, and crashes on other."""
    reader, writer = os.pipe()
    if (child := os.fork()) == 0:
        signal.alarm(5)
        os.write(writer, hashlib.sha256(repr(_content_of(path)).encode()).hexdigest().encode())
        os._exit(0)
    os.close(writer)
    with os.fdopen(reader) as file:
        said = file.read()
    _, status = os.waitpid(child, 0)
    return said if status == 0 else "cannot be read"


def _content_of(path: Path) -> Any:
    """Kinds, types, shapes, numbers and attributes by name."""
    try:
        with h5py.File(path) as file:
            found: dict[str, Any] = {}

            def note(name: str) -> None:
                if name != "/" and not isinstance(link := file.get(name, getlink=True), h5py.HardLink):
                    found[name] = repr(type(link))
                    return
                item = file[name]
                attributes = {key: repr(value) for key, value in item.attrs.items()}
                if isinstance(item, h5py.Group):
                    found[name] = attributes
                    for key in item:
                        note(f"{name.rstrip('/')}/{key}")
                else:
                    value = np.asarray(item[()])
                    raw = repr(value.tolist()) if value.dtype == object else value.tobytes()
                    digest = hashlib.sha256(raw if isinstance(raw, bytes) else raw.encode()).hexdigest()
                    found[name] = attributes, str(item.dtype), item.shape, digest

            note("/")
            return found
    except Exception as error:
        return f"cannot be read: {type(error).__name__}"


def damaged(path: Path, chance: random.Random, others: dict[str, Path]) -> str:
    """Damage a checkpoint; says how."""
    return _bytes(path, chance) if chance.random() < 0.4 else _content(path, chance, others)


def _bytes(path: Path, chance: random.Random) -> str:
    data = bytearray(path.read_bytes())
    at = chance.randrange(len(data))
    kind = chance.choice(("cut", "flipped", "zeroed", "inserted", "empty", "garbage", "bits"))
    match kind:
        case "cut":
            del data[at:]
        case "flipped":
            data[at] ^= 0xFF
        case "zeroed":
            size = min(chance.choice((16, 512, 4096)), len(data) - at)
            data[at : at + size] = bytes(size)
        case "inserted":
            data[at:at] = chance.randbytes(chance.randint(1, 64))
        case "empty":
            data = bytearray()
        case "garbage":
            data = bytearray(chance.randbytes(len(data)))
        case _:
            for _ in range(20):
                data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    path.write_bytes(data)
    return f"bytes {kind} at {at}"


def _content(path: Path, chance: random.Random, others: dict[str, Path]) -> str:
    with h5py.File(path, "r+") as file:
        names: list[str] = []
        file.visit(names.append)
        attributes = [(name, key) for name in ["/", *names] for key in file[name].attrs]
        if attributes and chance.random() < 0.3:
            return _attribute(file, *chance.choice(attributes), chance)
        arrays = [name for name in names if isinstance(file[name], h5py.Dataset)]
        name = chance.choice(arrays)
        value = file[name][()]
        kind = chance.choice(
            ("gone", "link", "short", "long", "type", "number", "number", "order", "swapped", "group", "other")
        )
        if kind == "group":
            del file[name]
            file.create_group(name)
        elif kind == "link":
            del file[name]
            file[name] = h5py.ExternalLink(str(path.with_name("elsewhere.h5")), name)
            with h5py.File(path.with_name("elsewhere.h5"), "w") as other:
                other[name] = value
        elif kind == "swapped":
            other = chance.choice(arrays)
            there = file[other][()]
            del file[name]
            file[name] = there
        elif kind == "other":
            whose = chance.choice(sorted(others))
            with h5py.File(others[whose] / "out" / STATE) as theirs:
                del file[name]
                if name in theirs:
                    file[name] = theirs[name][()]
        elif kind == "gone" or not isinstance(value, np.ndarray) or value.size == 0 or value.dtype == object:
            kind = "gone"
            del file[name]
        else:
            del file[name]
            file[name] = _array(value, kind, chance)
    return f"content {kind} of {name}"


def _array(value: Any, kind: str, chance: random.Random) -> Any:
    """Other numbers, or another shape."""
    if kind == "short":
        return value[:-1] if value.ndim else value
    if kind == "long":
        return np.concatenate([value, value[-1:]])
    if kind == "type":
        return value.astype(chance.choice((np.float32, np.int64, np.uint8, np.complex128, "S8")))
    if kind == "order":
        return value[::-1].copy()
    value = value.copy()
    flat = value.reshape(-1)
    at = chance.randrange(value.size)
    if value.dtype.kind == "f":
        flat[at] = chance.choice((np.nan, np.inf, -np.inf, 1e300, -1.0, 0.0, 2.0, np.nextafter(flat[at], np.inf)))
    elif value.dtype.kind == "b":
        flat[at] = ~flat[at]
    elif value.dtype.kind in "iu":
        flat[at] = chance.choice((0, np.iinfo(value.dtype).max, np.iinfo(value.dtype).min, int(flat[at]) ^ 1))
    return value


def _attribute(file: Any, name: str, key: str, chance: random.Random) -> str:
    value = file[name].attrs[key]
    new = chance.choice((float("nan"), float("inf"), -5, 1e9, 0, 1e-300, -1.0, "x", None, b"", [1.0, 2.0], 2**40))
    if new is None:
        del file[name].attrs[key]
    else:
        del file[name].attrs[key]
        file[name].attrs[key] = new
    return f"clock {key} of {name} from {value!r} to {new!r}"
