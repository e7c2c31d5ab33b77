"""Recipes: one for each named task, of its present meaning, and such that ``hvs`` takes it."""

import json
import shlex
from pathlib import Path

import pytest

import hvs_suite
from hvs_suite.cli.main import parse
from hvs_suite.datasets.features import dataset_features
from hvs_suite.datasets.metadata import read_metadata
from hvs_suite.tasks.shared.lock import digest

ROOM = Path(__file__).parents[2] / "datasets"


def test_every_named_task_has_a_recipe():
    assert {path.stem for path in (ROOM / "recipes").iterdir()} == set(hvs_suite.TASKS)


@pytest.mark.parametrize("task", sorted(hvs_suite.TASKS))
def test_recipe_is_of_the_tasks_present_meaning(task):
    recipe = json.loads((ROOM / "recipes" / f"{task}.json").read_text())
    assert recipe["task"] == task
    assert recipe["task_version"] == hvs_suite.TASKS[task].version
    assert recipe["task_digest"] == digest(task)


@pytest.mark.parametrize("task", sorted(hvs_suite.TASKS))
def test_recipe_is_a_command_that_hvs_takes(task):
    program, *words = shlex.split(
        json.loads((ROOM / "recipes" / f"{task}.json").read_text())["command"]
    )
    assert program == "hvs"
    command = parse(words)
    assert command.task == task
    # Policies are scored on the test split, so none is trained on it.
    assert command.split == "train"
    start = {} if command.start is None else {"start": command.start}
    dataset_features(hvs_suite.TASKS[task].with_options(start))


def test_the_sample_is_of_its_tasks_present_meaning():
    metadata = read_metadata(ROOM / "samples" / "align-thesis")
    assert metadata.task_digest == digest("align-thesis")
    assert "hvs record" in metadata.command
