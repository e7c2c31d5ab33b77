"""``docs/thesis.md`` names only tests, options, tasks and commands that exist."""

import ast
import dataclasses
import importlib
import inspect
import re
from pathlib import Path

import pytest

import hvs_suite
from hvs_suite.cli.main import COMMANDS
from hvs_suite.errors import OptionError

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "thesis.md"
FIELDS = {field.name for field in dataclasses.fields(hvs_suite.TASKS["align-thesis"])}
KEYWORDS = set(inspect.signature(hvs_suite.load).parameters)


def rows():
    """Cells of every row of every table: (what the thesis has, what gives it, test)."""
    lines = PAGE.read_text(encoding="utf-8").splitlines()
    split = [line.strip()[1:-1].split("|") for line in lines if line.startswith("|")]
    cells = [[cell.strip() for cell in row] for row in split]
    return [row for row in cells if not row[0].startswith(("the thesis", "defect", "---"))]


def quoted(text):
    return re.findall(r"`([^`]+)`", text)


def names_of_tests():
    """Every ``path::name`` below tests/, read and not imported."""
    found = set()
    for path in (ROOT / "tests").rglob("test_*.py"):
        for node in ast.parse(path.read_text(encoding="utf-8")).body:
            if isinstance(node, ast.FunctionDef) and node.name.startswith("test_"):
                found.add(f"{path.relative_to(ROOT / 'tests').as_posix()}::{node.name}")
    return found


def complaint(word, commands):
    """What is wrong with a quoted word of the middle column; empty if nothing is."""
    if word in hvs_suite.TASKS:
        return ""
    if word.startswith("hvs "):
        return "" if word.split()[1] in COMMANDS else "no such command"
    if word.startswith("--"):
        places = [COMMANDS[name].split(":") for name in commands]
        options = {
            field.name
            for module, name in places
            for field in dataclasses.fields(getattr(importlib.import_module(module), name))
        }
        return "" if word[2:].replace("-", "_") in options else "no such option of that command"
    if "." in word.partition("=")[0]:
        module, _, name = word.partition("(")[0].rpartition(".")
        return "" if hasattr(importlib.import_module(module), name) else "no such function"
    name, given, value = word.partition("=")
    if name in KEYWORDS - FIELDS:
        return ""
    if name not in FIELDS:
        return "no such option"
    if given:
        try:
            hvs_suite.TASKS["align-thesis"].with_options({name: ast.literal_eval(value)})
        except OptionError as error:
            return str(error)
    return ""


def test_the_page_has_all_its_tables():
    text = PAGE.read_text(encoding="utf-8")
    assert len(re.findall(r"^## ", text, re.MULTILINE)) == 6
    assert len(rows()) > 80
    assert {len(row) for row in rows()} == {3}


def test_every_row_names_a_test_or_says_later():
    assert [row[0] for row in rows() if not quoted(row[2]) and row[2] != "later"] == []


def test_every_test_that_is_named_exists():
    known = names_of_tests()
    assert [name for row in rows() for name in quoted(row[2]) if name not in known] == []


def test_every_option_and_command_that_is_named_exists():
    wrong = {}
    for row in rows():
        words = quoted(row[1])
        commands = [word.split()[1] for word in words if word.startswith("hvs ")]
        wrong |= {word: reason for word in words if (reason := complaint(word, commands))}
    assert wrong == {}


@pytest.mark.parametrize(
    "word",
    ["hvs dance", "eih_colour", 'start="sitting"', "--nonsense", "gymnasium.no_such", "align-x"],
)
def test_a_word_that_means_nothing_would_be_noticed(word):
    assert complaint(word, ["record"])


def test_every_option_of_the_task_has_its_place():
    words = {word.partition("=")[0] for row in rows() for word in quoted(row[1])}
    # Not the thesis's, but the suite's own: how a task is called, drawn and marked.
    assert sorted(FIELDS - words) == ["marker", "multisampling", "name", "version"]
