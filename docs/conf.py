"""How the documentation is built: ``make docs``, offline, warnings as errors."""

import re
import sys
from pathlib import Path

import hvs_suite.cell  # noqa: F401 - chooses the OpenGL backend before MuJoCo is imported

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE))

import gallery  # noqa: E402 - lies beside this file

project = "hvs_suite"
copyright = "the maintainers of hvs_suite, Apache License 2.0"
html_title = "hvs_suite"
html_theme = "furo"
html_static_path = ["pictures"]
html_theme_options = {"sidebar_hide_name": False}
extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "sphinx.ext.viewcode",
    "sphinx_copybutton",
    "sphinx_design",
]
# The gallery stands for the table of tasks.
exclude_patterns = ["test-full.txt", "tasks/README.md"]
myst_enable_extensions = ["colon_fence"]
myst_heading_anchors = 3
autodoc_member_order = "bysource"
autodoc_typehints = "description"
autodoc_typehints_description_target = "documented"
# Our docstrings quote names with single backticks.
default_role = "literal"
napoleon_use_ivar = True
# Environment is a class and, where nothing may know the rooms, a protocol.
suppress_warnings = ["ref.python"]

_OUTSIDE = re.compile(
    r"\[([^\]]+)\]\((?:\.\./)+((?:(?:tasks|datasets|policies|eval|tests|hvs_suite)/|README)[^)]*)\)"
)


def read(_app: object, name: str, source: list[str]) -> None:
    """Prepare a page: what lies outside docs/ is named, and tasks get their films and figures."""
    text = _OUTSIDE.sub(lambda link: f"{link[1]} (`{link[2]}`)", source[0])
    source[0] = gallery.extended(name, text)


def outdated(*_: object) -> list[str]:
    """Pages to read anew although they have not changed: the results in them may have."""
    return gallery.pages()


def setup(app: "object") -> None:
    """Connect what is ours to Sphinx."""
    gallery.write(HERE / "gallery.md")
    app.connect("source-read", read)  # type: ignore[attr-defined]
    app.connect("env-get-outdated", outdated)  # type: ignore[attr-defined]
