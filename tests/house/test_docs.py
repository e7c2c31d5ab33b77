"""The documentation builds without a warning, no link in it is dead, and its programs run."""

import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
PAGES = sorted(DOCS.rglob("*.md"))


def build(site: Path) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "sphinx", "--quiet", "--fail-on-warning", DOCS, site],
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-3000:]


@pytest.mark.timeout(300)
def test_the_site_builds_without_a_warning_and_results_are_always_new(tmp_path):
    build(tmp_path)
    assert "align-thesis" in (tmp_path / "gallery.html").read_text(encoding="utf-8")
    page = tmp_path / "tasks" / "align-thesis.html"
    page.write_text("of an earlier build", encoding="utf-8")
    build(tmp_path)
    assert "Results of our policies" in page.read_text(encoding="utf-8")


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(DOCS).as_posix())
def test_no_link_is_dead(page):
    text = page.read_text(encoding="utf-8")
    links = re.findall(r"\]\(([^)#\s]+)(?:#[^)]*)?\)", text)
    # The gallery is made when the site is.
    local = [each for each in links if "://" not in each and each != "gallery.md"]
    assert [each for each in local if not (page.parent / each).exists()] == []


@pytest.mark.parametrize("page", ["getting-started.md"])
@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
def test_the_programs_run(page):
    programs = re.findall(r"```python\n(.*?)```", (DOCS / page).read_text("utf-8"), re.DOTALL)
    assert programs
    for program in programs:
        exec(compile(program, page, "exec"), {})
