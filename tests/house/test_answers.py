"""The tables of docs/answers.md are those of the studies that stand in eval/answers."""

import re
import shlex
from pathlib import Path

import pytest

from hvs_suite.cli.main import parse
from hvs_suite.eval.studies import grid_report, search_report
from hvs_suite.eval.studies.grid import Study
from hvs_suite.eval.studies.search import Search

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "answers.md").read_text(encoding="utf-8")
ANSWERS = sorted((ROOT / "eval" / "answers").glob("*.json"))


def tables_and_commands(path):
    """What docs/answers.md has to show of a study, and what makes its policies."""
    said = path.read_text(encoding="utf-8")
    if path.stem == "search":
        found = Search.model_validate_json(said)
        tables = [search_report.trial_table(found), search_report.importance_table(found)]
        return tables, [line for trial in found.trials for line in trial.commands]
    study = Study.model_validate_json(said)
    assert study.name == path.stem
    tables = [grid_report.table(study.rows(group)) for group in study.groups()]
    return tables, [line for cell in study.finished for line in cell.commands]


@pytest.mark.parametrize("path", ANSWERS, ids=[path.stem for path in ANSWERS])
def test_tables_are_those_of_the_studies(path):
    tables, _ = tables_and_commands(path)
    assert f"hvs study {path.stem} " in TEXT
    for table in tables:
        assert "\n".join(table) in TEXT


@pytest.mark.parametrize("path", ANSWERS, ids=[path.stem for path in ANSWERS])
def test_every_command_is_one(path):
    _, commands = tables_and_commands(path)
    for line in commands:
        parse(shlex.split(line)[1:])


def test_every_picture_is_of_a_study():
    shown = set(re.findall(r"pictures/answers-([a-z-]+)\.png", TEXT))
    assert shown == {path.stem for path in ANSWERS}
