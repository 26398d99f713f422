"""Notebooks run as scripts, and their numbers are those of the closed forms that they name."""

from __future__ import annotations

import re
import runpy
from pathlib import Path
from typing import Any

import matplotlib as mpl
import numpy as np
import pytest

FOLDER = Path(__file__).parent.parent / "docs" / "notebooks"


def run(name: str, folder: Path, monkeypatch: pytest.MonkeyPatch) -> dict[str, Any]:
    """Names that a notebook leaves; it runs in `folder`, and its figures are drawn nowhere."""
    monkeypatch.chdir(folder)
    mpl.use("Agg")
    import matplotlib.pyplot as plt

    try:
        return runpy.run_path(str(FOLDER / name))
    finally:
        plt.close("all")


def test_an_energy_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("own_energy.py", tmp_path, monkeypatch)
    assert len(names["force"]) == 10 and names["stretch"][-1] == pytest.approx(2)
    np.testing.assert_allclose(names["force"], names["exact"], rtol=1e-6)


def test_a_criterion_of_ones_own(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    names = run("own_criterion.py", tmp_path, monkeypatch)
    for name, factor in (("along edges", 1), ("Tresca", 2)):
        before, at = names["stresses"][name]
        assert before < factor * names["strength"] <= at < before + 0.06 * names["strength"], name
    np.testing.assert_allclose(names["masses"], names["exact_mass"], rtol=1e-9)
    assert names["broken"][-1] > 100 and (np.diff(names["broken"]) >= 0).all()


def test_coupling_with_another_form(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Within the error of linear cells: it is a third on half the cell size, 0.6 % here."""
    names = run("temperature.py", tmp_path, monkeypatch)
    assert names["error"] < 0.01
    assert names["row"]["elastic"] == pytest.approx(names["exact_energy"], rel=5e-3)


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_notebooks_have_the_percent_format(path: Path) -> None:
    """A head for jupytext, then cells; a cell of text has comments alone."""
    head, *cells = re.split(r"^(?=# %%)", path.read_text(), flags=re.MULTILINE)
    assert "formats: py:percent" in head and cells[0].startswith("# %% [markdown]\n# # ")
    for cell in cells:
        lines = cell.splitlines()
        assert lines[0] in ("# %%", "# %% [markdown]")
        assert "[markdown]" not in lines[0] or all(line.startswith("#") for line in lines if line)
