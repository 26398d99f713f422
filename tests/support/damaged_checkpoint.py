"""Ways to damage a checkpoint: bytes of the file, and what it holds.

`RAW` are of bytes. `EDITS` change what HDF5 reads: with the digest of before (`edit`), as another program would, or
with one that fits (`resealed`), as a program with a fault would have written it.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from fracsim.output.checkpoint_file import DIGEST_LINE_BYTES, append_digest

Damage = Callable[[Path], None]
Edit = Callable[[h5py.File], None]


def _cut(share: float) -> Damage:
    return lambda path: path.write_bytes((whole := path.read_bytes())[: int(share * len(whole))])


def _flipped(share: float) -> Damage:
    def flip(path: Path) -> None:
        whole = bytearray(path.read_bytes())
        whole[int(share * (len(whole) - 1))] ^= 4
        path.write_bytes(whole)

    return flip


def _to(change: Callable[[bytes], bytes]) -> Damage:
    return lambda path: path.write_bytes(change(path.read_bytes()))  # type: ignore[func-returns-value]


RAW: dict[str, Damage] = {
    "empty": _to(lambda whole: b""),
    "junk": _to(lambda whole: b"junk"),
    "zeros": _to(lambda whole: bytes(len(whole))),
    "text": _to(lambda whole: b"t = 1.0\n" * 100),
    **{f"cut to {share:g}": _cut(share) for share in (0.01, 0.3, 0.9, 0.999)},
    **{f"a bit at {share:g}": _flipped(share) for share in (0.0, 0.05, 0.2, 0.5, 0.8, 0.97, 0.995, 1.0)},
    "longer": _to(lambda whole: whole + b"more"),
    "without its digest": _to(lambda whole: whole[:-DIGEST_LINE_BYTES]),
    "twice": _to(lambda whole: whole + whole),
    "begun later": _to(lambda whole: whole[512:]),
}


def array(name: str, change: Callable[[Any], Any]) -> Edit:
    def edit(file: h5py.File) -> None:
        values = change(file[name][()])
        del file[name]
        file[name] = values

    return edit


def at(name: str, value: float) -> Edit:
    """The first number of an array is another."""

    def change(values: Any) -> Any:
        values.reshape(-1)[0] = value
        return values

    return array(name, change)


def number(name: str, value: Any) -> Edit:
    return lambda file: file.attrs.__setitem__(name, value)


def without(name: str) -> Edit:
    def edit(file: h5py.File) -> None:
        if name in file.attrs:
            del file.attrs[name]
        else:
            del file[name]

    return edit


def linked(name: str, link: Any) -> Edit:
    def edit(file: h5py.File) -> None:
        del file[name]
        file[name] = link

    return edit


def _elsewhere(file: h5py.File) -> None:
    """The numbers of u are in another file."""
    values = file["u"][()]
    beside = Path(file.filename).with_name("u.bin")
    values.tofile(beside)
    del file["u"]
    file.create_dataset("u", values.shape, values.dtype, external=[(str(beside), 0, values.nbytes)])
    beside.unlink()


def _virtual(file: h5py.File) -> None:
    source = h5py.VirtualSource(file.filename, "v", shape=file["v"].shape)
    layout = h5py.VirtualLayout(shape=file["u"].shape, dtype=float)
    layout[:] = source
    del file["u"]
    file.create_virtual_dataset("u", layout)


def _huge(file: h5py.File) -> None:
    """Claims to be of a terabyte, and has not a byte of it."""
    del file["u"]
    file.create_dataset("u", (1 << 36, 2), chunks=(1024, 2))


EDITS: dict[str, Edit] = {
    **{f"no {name}": without(name) for name in (
        "u", "v", "a", "forces", "chi", "plastic", "weakened", "integrity", "broken", "breaks",
        "t", "step", "dt", "dissipated", "work", "easy", "elastic", "mesh", "notes", "notes/study", "notes/monitors",
    )},
    **{f"{name} nan": at(name, np.nan) for name in ("u", "v", "a", "forces", "chi", "plastic", "integrity")},
    "u infinite": at("u", np.inf), "u of 1e300": at("u", 1e300), "u short": array("u", lambda u: u[:-1]),
    "u long": array("u", lambda u: np.concatenate([u, u[:1]])), "u flat": array("u", lambda u: u.reshape(-1)),
    "u of whole numbers in words": array("u", lambda u: np.array([b"1.0"] * len(u))),
    "u one number": array("u", lambda u: 1.0), "u a group": linked("u", h5py.SoftLink("/notes")),
    "u elsewhere": linked("u", h5py.ExternalLink("other.h5", "/u")),
    "u by another name": linked("u", h5py.SoftLink("/v")),
    "u in another file": _elsewhere, "u put together": _virtual, "u huge": _huge,
    "notes elsewhere": linked("notes", h5py.ExternalLink("other.h5", "/notes")),
    "chi above 1": at("chi", 1.5), "chi below 0": at("chi", -0.5), "chi short": array("chi", lambda chi: chi[1:]),
    "plastic short": array("plastic", lambda rows: rows[:, :-1]),
    "weakened out of range": at("weakened", 10**6), "weakened negative": at("weakened", -3),
    "weakened permuted": array("weakened", lambda keys: keys[::-1]),
    "weakened twice": array("weakened", lambda keys: np.concatenate([keys[:1], keys[:-1]])),
    "weakened no edges": array("weakened", lambda keys: np.column_stack([keys[:, 0] * 0, 8 + np.arange(len(keys))])),
    "weakened short": array("weakened", lambda keys: keys[:-1]),
    "weakened of real numbers": array("weakened", lambda keys: keys.astype(float)),
    "integrity negative": at("integrity", -1.0), "integrity whole": at("integrity", 1.0),
    "integrity short": array("integrity", lambda values: values[:-1]), "breaks infinite": at("breaks", np.inf),
    "broken short": array("broken", lambda keys: keys[1:]),
    "t nan": number("t", np.nan), "t infinite": number("t", np.inf), "t before the start": number("t", -1.0),
    "t in words": number("t", "late"), "t many": number("t", [1.0, 2.0]), "step -5": number("step", -5),
    "step of a half": number("step", 1.5), "step 0 later": number("step", 0), "dt nan": number("dt", np.nan),
    "dt 0": number("dt", 0.0), "dt backwards": number("dt", -0.1),
    "dissipated infinite": number("dissipated", np.inf),
    "work nan": number("work", np.nan), "easy -1": number("easy", -1), "a step before": number("dt_before", 0.1),
    "another mesh": number("mesh", "0123456789abcdef"),
    "an array more": lambda file: file.__setitem__("more", [1.0]),
    "a number more": number("more", 1.0), "study no TOML": linked("notes/study", "title = ["),
    "monitors no JSON": linked("notes/monitors", "{"), "monitors a list": linked("notes/monitors", "[1]"),
    "monitors of another run": linked("notes/monitors", '{"wall": 1.0}'),
    "step of 1e9": number("step", 1e9), "step of 2^40": number("step", 2**40), "dt of 1e-300": number("dt", 1e-300),
}  # fmt: skip


def edit(path: Path, change: Edit) -> None:
    """Change what a checkpoint holds; its digest stays at its end."""
    last = path.read_bytes()[-DIGEST_LINE_BYTES:]
    path.write_bytes(path.read_bytes()[:-DIGEST_LINE_BYTES])
    with h5py.File(path, "r+") as file:
        change(file)
    path.write_bytes(path.read_bytes() + last)


def resealed(path: Path, change: Edit) -> None:
    """Change what a checkpoint holds, and give it the digest of that."""
    edit(path, change)
    path.write_bytes(path.read_bytes()[:-DIGEST_LINE_BYTES])
    append_digest(path)
