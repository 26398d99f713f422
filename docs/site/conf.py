"""Settings of the site: `make site`. Its pages are the Markdown files of the repository, as they are.

Nothing is fetched: MathJax is copied beside the pages, and diagrams are drawn while the site is built.
"""

import base64
import hashlib
import importlib.util
import re
from pathlib import Path
from typing import Any

import mermaidx
from docutils import nodes
from myst_parser.parsers.sphinx_ import MystParser
from sphinx.util.docutils import SphinxDirective

ROOT = Path(__file__).parent.parent.parent
MATHJAX = Path(importlib.util.find_spec("sphinx-mathjax-offline").origin).parent / "static" / "mathjax"
DIAGRAMS = ROOT / "build" / "diagrams"  # a diagram takes seconds to draw

# --- pages ---

project, author = "fracsim", "The fracsim developers"
copyright = "2026, the fracsim developers"
extensions = ["myst_parser", "sphinx.ext.autodoc", "sphinx.ext.napoleon", "sphinx.ext.mathjax"]
root_doc = "README"
include_patterns = ["*.md", "docs/*.md", "docs/site/*.md", "docs/notebooks/*.py"]
# folders that are not searched for pages
exclude_patterns = [".*", "build", "out", "tests", "fracsim", "forms", "meshes", "studies", "**/__pycache__"]
source_suffix = {".md": "markdown", ".py": "percent"}

# The contents, at the side of all pages. A page that is missing here is an error.
CONTENTS = {
    "Start": "docs/install docs/tutorials docs/running docs/faq docs/python docs/batch docs/studies docs/gallery",
    "Notebooks": "docs/notebooks/own_energy docs/notebooks/own_criterion docs/notebooks/temperature",
    "Reference": "docs/study-file docs/meshes docs/output docs/view docs/blender docs/site/reference docs/glossary",
    "Methods": "docs/fracture docs/contact docs/rigid docs/theory docs/accuracy docs/scaling docs/paper-figures",
    "Development": "docs/architecture docs/development CONTRIBUTING CHANGELOG",
}


def add_contents(_app: Any, page: str, text: list[str]) -> None:
    """Add the contents to the start page: the README has them as a table."""
    if page == root_doc:
        for caption, pages in CONTENTS.items():
            names = "\n".join(pages.split())
            text[0] += f"\n```{{toctree}}\n:hidden:\n:caption: {caption}\n\n{names}\n```\n"


# --- Markdown ---

myst_enable_extensions = ["dollarmath"]
myst_heading_anchors = 6  # as GitHub makes them
myst_fence_as_directive = ["mermaid"]


class Mermaid(SphinxDirective):
    """A diagram, drawn as SVG."""

    has_content = True

    def run(self) -> list[nodes.Node]:
        """Return an image that holds the drawing."""
        text = "\n".join(self.content)
        file = DIAGRAMS / f"{hashlib.sha256((mermaidx.__version__ + text).encode()).hexdigest()[:16]}.svg"
        if not file.exists():
            file.parent.mkdir(parents=True, exist_ok=True)
            file.write_text(mermaidx.render(text).svg(), encoding="utf-8")
        drawing = base64.b64encode(file.read_bytes()).decode()
        image = f'<img class="diagram" alt="Diagram" src="data:image/svg+xml;base64,{drawing}">'
        return [nodes.raw("", image, format="html")]


class Percent(MystParser):
    """A notebook as a script: text in cells that begin with `# %% [markdown]`, Python in all others."""

    supported = ("percent",)

    def parse(self, inputstring: str, document: nodes.document) -> None:
        """Read the cells as Markdown."""
        super().parse(as_markdown(inputstring), document)


def as_markdown(script: str) -> str:
    """Return the Markdown of a script in percent format."""
    parts = []
    for kind, cell in re.findall(r"^# %%([^\n]*)\n(.*?)(?=^# %%|\Z)", script, re.MULTILINE | re.DOTALL):
        if "[markdown]" in kind:
            parts.append(re.sub(r"^# ?", "", cell, flags=re.MULTILINE))
        elif cell.strip():
            parts.append(f"```python\n{cell.strip()}\n```\n")
    return "\n".join(parts)


# --- docstrings ---

default_role = "code"
autodoc_typehints = "signature"
autodoc_member_order = "bysource"
python_maximum_signature_line_length = 80
napoleon_use_ivar = True
napoleon_use_rtype = False

# --- look ---

html_theme = "furo"
html_title = "fracsim"
html_static_path = ["style.css", str(MATHJAX / "tex-svg.js")]
html_css_files = ["style.css"]
mathjax_path = "tex-svg.js"
html_show_sphinx = False
html_copy_source = False
html_theme_options = {"navigation_with_keys": True}


def add_start(app: Any, error: Exception | None) -> None:
    """Write index.html, which leads to the start page."""
    if error is None:
        page = f'<!doctype html><meta charset="utf-8"><meta http-equiv="refresh" content="0; url={root_doc}.html">'
        (Path(app.outdir) / "index.html").write_text(page, encoding="utf-8")


def setup(app: Any) -> None:
    """Connect what is defined here with Sphinx."""
    app.add_config_value("CONTENTS", {}, "env", dict)  # other contents: the start page is read again
    app.add_directive("mermaid", Mermaid)
    app.add_source_parser(Percent)
    app.connect("source-read", add_contents)
    app.connect("build-finished", add_start)
