"""Each named task has a page, which says what the task says of itself."""

from pathlib import Path

import pytest

import hvs_suite
from hvs_suite.tasks.shared.certificate import load_certificate
from hvs_suite.tasks.shared.page import page

FOLDER = Path(__file__).parents[2] / "docs" / "tasks"


@pytest.mark.each_task
def test_the_page_is_what_hvs_show_writes(named, task):
    written = (FOLDER / f"{task}.md").read_text(encoding="utf-8")
    assert written == page(named(task), load_certificate(task), f"{task}.webp"), (
        f"make it anew: hvs show {task} --out docs/tasks/{task}.md"
    )


def test_there_is_a_page_and_a_picture_of_each_named_task_and_of_no_other():
    for suffix in (".md", ".webp"):
        found = {path.stem for path in FOLDER.glob(f"*{suffix}")} - {"README"}
        assert found == set(hvs_suite.TASKS)
