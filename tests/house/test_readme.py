"""What the README and the pages that it leads to show is true: programs, tables, commands."""

import json
import re
from pathlib import Path

import gymnasium
import pytest

import hvs_suite
from hvs_suite.cli.main import COMMANDS

ROOT = Path(__file__).parents[2]
TEXT = (ROOT / "README.md").read_text(encoding="utf-8")
COMMANDS_PAGE = (ROOT / "docs" / "commands.md").read_text(encoding="utf-8")
TASKS_PAGE = (ROOT / "docs" / "tasks" / "README.md").read_text(encoding="utf-8")


def table(text, first):
    """Rows of the table whose head begins with a word, marks removed."""
    lines = text[text.index(f"| {first} |") :].split("\n\n")[0].splitlines()
    return [[cell.strip(" `") for cell in line.strip()[1:-1].split("|")] for line in lines[2:]]


@pytest.mark.timeout(300)
@pytest.mark.filterwarnings("ignore:.*multi-threaded:DeprecationWarning")
def test_the_programs_run(capsys):
    first, second = re.findall(r"```python\n(.*?)```", TEXT, re.DOTALL)
    exec(first, {})
    assert "'scenario': 7" in capsys.readouterr().out
    names = {}
    exec(second, names)
    assert isinstance(names["envs"], gymnasium.vector.AsyncVectorEnv)
    assert names["env"].reset(seed=0)[1]["split"] == "train"
    for env in (names["env"], names["envs"]):
        env.close()


def test_the_table_of_tasks_is_true():
    rows = {row[0]: row for row in table(TASKS_PAGE, "task")}
    assert list(rows) == list(hvs_suite.TASKS)
    for task, spec in hvs_suite.TASKS.items():
        _, start, target, tolerance, held, steps, _ = rows[task]
        words = spec.describe()
        assert start == spec.start
        assert numbers(target) == numbers(words.target)
        assert (int(held), int(steps)) == (spec.hold_steps, spec.time_limit_steps)
        assert numbers(tolerance) == numbers(words.tolerance)


def numbers(text):
    """The numbers in a text."""
    return {float(number) for number in re.findall(r"[\d.]+", text)}


def test_every_command_that_is_named_exists():
    # Where code begins with it: prose that only mentions the suite does not count.
    named = set(re.findall(r"(?:`|^|/)hvs ([a-z-]+)", TEXT, re.MULTILINE))
    assert len(named) > 4
    assert sorted(named - set(COMMANDS)) == []


def test_the_page_of_commands_has_them_all():
    assert set(re.findall(r"^\| `hvs ([a-z-]+)", COMMANDS_PAGE, re.MULTILINE)) == set(COMMANDS)


def test_the_figures_are_the_board_s():
    rows = table(TEXT, "hardest task")
    assert {hvs_suite.TASKS[row[0]].family for row in rows} == {
        spec.family for spec in hvs_suite.TASKS.values()
    }
    columns = ("expert", "servo", "pretrained", "finetuned")
    for task, _, *shares in rows:
        for policy, share in zip(columns, shares, strict=True):
            path = ROOT / "eval" / "results" / policy / f"{task}.json"
            if not path.exists():
                assert share == "-"
                continue
            summary = json.loads(path.read_text(encoding="utf-8"))["summary"]
            assert share == f"{summary['pc_success']:.1f} %"


def test_every_target_of_make_that_is_named_exists():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE))
    named = set(re.findall(r"(?:`|^)make ([a-z-]+)", TEXT, re.MULTILINE))
    assert {"demo", "test"} <= named <= targets


def test_every_file_that_is_linked_exists():
    links = re.findall(r"\]\(([^)#]+)\)", TEXT)
    local = [link for link in links if not link.startswith("http")]
    assert local
    assert [link for link in local if not (ROOT / link).exists()] == []
