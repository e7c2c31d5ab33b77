"""The tables of docs/answers.md are those of the studies that stand in eval/answers."""

import re
import shlex
from pathlib import Path

import pytest

from hvs_suite.cli.main import parse
from hvs_suite.eval.studies import grid_report
from hvs_suite.eval.studies.grid import Study

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "docs" / "answers.md").read_text(encoding="utf-8")
STUDIES = sorted((ROOT / "eval" / "answers").glob("*.json"))


@pytest.mark.parametrize("path", STUDIES, ids=[path.stem for path in STUDIES])
def test_tables_are_those_of_the_studies(path):
    study = Study.model_validate_json(path.read_text(encoding="utf-8"))
    assert study.name == path.stem
    assert f"hvs study {study.name} " in TEXT
    for group in study.groups():
        assert "\n".join(grid_report.table(study.rows(group))) in TEXT


@pytest.mark.parametrize("path", STUDIES, ids=[path.stem for path in STUDIES])
def test_every_command_of_a_cell_is_one(path):
    study = Study.model_validate_json(path.read_text(encoding="utf-8"))
    for cell in study.finished:
        for line in cell.commands:
            parse(shlex.split(line)[1:])


def test_every_picture_is_of_a_study():
    shown = set(re.findall(r"pictures/answers-([a-z-]+)\.png", TEXT))
    assert shown == {path.stem for path in STUDIES}
