"""Recipes of containers and packages agree with one another and with pyproject.toml; nothing is built."""

from __future__ import annotations

import re
import subprocess
import tomllib
from pathlib import Path

import pytest

pytestmark = pytest.mark.any_release

ROOT = Path(__file__).parent.parent
PYPROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())
DOCKERFILE, APPTAINER = (ROOT / "Dockerfile").read_text(), (ROOT / "apptainer.def").read_text()
# names that conda-forge gives packages of PyPI
CONDA_NAMES = {
    "gmsh": "python-gmsh", "matplotlib": "matplotlib-base", "dolfinx-solver-real": "fenics-dolfinx",
    "isal": "python-isal", "mujoco-core": "mujoco-python", "usd-core": "openusd",
}  # fmt: skip


def requirements(name: str) -> list[str]:
    """Lines of a requirements file."""
    lines = (ROOT / name).read_text().splitlines()
    return [line for line in (line.split("#")[0].strip() for line in lines) if line]


def extras() -> dict[str, list[str]]:
    """Extras of pyproject.toml and what they need."""
    files = PYPROJECT["tool"]["setuptools"]["dynamic"]["optional-dependencies"]
    return {extra: [line for name in entry["file"] for line in requirements(name)] for extra, entry in files.items()}


def conda(requirement: str) -> str:
    """A requirement of pip as conda writes it: `fenics-dolfinx >=0.11,<0.12`."""
    name, limits = re.fullmatch(r"([\w.-]+)(.*)", requirement).groups()  # type: ignore[union-attr]
    return f"{CONDA_NAMES.get(name, name)} {limits}".strip()


# --- Apptainer ---


def sections() -> dict[str, str]:
    """Sections of the definition, by name; "" is its head."""
    names = ["", *re.findall(r"^%(\w+)$", APPTAINER, re.MULTILINE)]
    assert len(names) == len(set(names))
    return dict(zip(names, re.split(r"^%\w+$", APPTAINER, flags=re.MULTILINE), strict=True))


def test_the_definition_has_a_head_and_the_sections_of_apptainer() -> None:
    parts = sections()
    head = dict(re.findall(r"^(\w+): (.*)$", parts[""], re.MULTILINE))
    base = re.findall(r"^FROM ([\w.:-]+) AS system$", DOCKERFILE, re.MULTILINE)
    assert (head["Bootstrap"], [head["From"]]) == ("docker", base)
    assert set(parts) == {"", "files", "post", "environment", "runscript", "test", "labels"}


@pytest.mark.parametrize("name", ["post", "environment", "runscript", "test"])
def test_shell_sections_can_be_read_by_sh(name: str) -> None:
    done = subprocess.run(["sh", "-n"], input=sections()[name], text=True, capture_output=True, timeout=10, check=False)
    assert done.returncode == 0, done.stderr


def test_settings_are_those_of_the_dockerfile() -> None:
    """Those for root apart, which nobody is in Apptainer; a value of the job's own is kept."""
    set_ = dict(re.findall(r"^ *(?:ENV )?((?:OMP|OMPI|LANG)\w*)=([\w.,-]+)", DOCKERFILE, re.MULTILINE))
    exported = dict(re.findall(r"export (\w+)=(?:\$\{\w+:-)?([^}\s]*)", sections()["environment"]))
    assert len(set_) == 6
    assert exported == {k: v for k, v in set_.items() if "ROOT" not in k} | {"PATH": "/opt/fracsim/bin:$PATH"}


def test_both_containers_install_the_same() -> None:
    def installed(text: str) -> list[set[str]]:
        return [set(re.findall(r"/src/?[\w.]*|--no-\S+", line)) for line in re.findall(r"pip --python .*", text)]

    assert installed(sections()["post"]) == installed(DOCKERFILE) and len(installed(DOCKERFILE)) == 2


def test_containers_have_the_files_that_an_installation_reads() -> None:
    """Those of pyproject.toml too: without one the extras would be silently empty."""
    copied = dict(line.split() for line in sections()["files"].strip().splitlines())
    let_in = set(re.findall(r"^!([\w.]+)$", (ROOT / ".dockerignore").read_text(), re.MULTILINE))
    assert all(target == f"/src/{name}" and (ROOT / name).exists() for name, target in copied.items())
    files = PYPROJECT["tool"]["setuptools"]["dynamic"]["optional-dependencies"].values()
    needed = {"packages.txt", "pyproject.toml", PYPROJECT["project"]["readme"], "LICENSE", "fracsim", "forms", "meshes"}
    assert set(copied) == let_in == needed | {"studies"} | {name for entry in files for name in entry["file"]}


# --- conda ---


def test_the_conda_recipe_needs_what_pyproject_needs() -> None:
    """Dependencies and the extra `dolfinx` to run, the other extras as constraints; the same version and command."""
    yaml = pytest.importorskip("yaml")
    recipe = yaml.safe_load((ROOT / "conda-recipe.yaml").read_text())
    assert set(recipe) == {"schema_version", "package", "source", "build", "requirements", "tests", "about"}
    assert set(recipe["requirements"]) == {"host", "run", "run_constraints"}
    project, needed = PYPROJECT["project"], recipe["requirements"]
    assert recipe["package"] == {"name": project["name"], "version": project["version"]}
    assert recipe["build"]["python"]["entry_points"] == [f"{k} = {v}" for k, v in project["scripts"].items()]
    assert recipe["about"]["license"] == project["license"] and (ROOT / recipe["about"]["license_file"]).exists()
    python = f"python {project['requires-python']}"
    run = [python, *map(conda, project["dependencies"] + extras()["dolfinx"])]
    assert sorted(needed["run"]) == sorted([*run, "petsc * real_*", "c-compiler"])
    optional = [line for extra, lines in extras().items() if extra != "dolfinx" for line in lines]
    assert sorted(needed["run_constraints"]) == sorted(map(conda, optional))
    assert needed["host"] == [python, "pip", *map(conda, PYPROJECT["build-system"]["requires"])]


# --- citation ---


def test_the_citation_has_the_version_and_both_papers() -> None:
    """Keys that the Citation File Format 1.2 requires; titles and identifiers as in the theory."""
    yaml = pytest.importorskip("yaml")
    citation = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert {"cff-version", "message", "title", "authors"} <= set(citation)
    project, theory = PYPROJECT["project"], " ".join((ROOT / "docs" / "theory.md").read_text().split())
    assert (citation["version"], citation["license"]) == (project["version"], project["license"])
    assert len(citation["references"]) == 2
    for paper in citation["references"]:
        assert paper["title"] in theory and f"[doi:{paper['doi']}]" in theory and f"({paper['year']})" in theory
        assert all(author["family-names"] in theory for author in paper["authors"])
