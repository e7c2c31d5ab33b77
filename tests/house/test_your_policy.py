"""Every block of docs/your-policy.md works: programs run, files play, commands end well."""

import json
import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from hvs_suite.cli.main import run

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "your-policy.md").read_text("utf-8")
SECTIONS = dict(re.findall(r"^## ([^\n]*)\n(.*?)(?=^## |\Z)", PAGE, re.MULTILINE | re.DOTALL))
pytestmark = pytest.mark.timeout(600)


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """Where the reader stands: the page's files, and checkpoints where it says that some lie."""
    for name, text in re.findall(r"file `(\w+\.py)`[^`]*```python\n(.*?)```", PAGE, re.DOTALL):
        (tmp_path / name).write_text(text)
    for place in ("act/checkpoints/last/pretrained_model", "policy"):
        shutil.copytree(ROOT / "policies/pretrained/align-thesis", tmp_path / "runs" / place)
    monkeypatch.chdir(tmp_path)
    return tmp_path


def commands(section):
    return [line for block in blocks(section, "sh") for line in block.strip().splitlines()]


def blocks(section, language):
    return re.findall(rf"```{language}\n(.*?)```", SECTIONS[section], re.DOTALL)


def test_the_loops_run(folder, capsys):
    first, second = blocks("In a loop of your own", "python")
    exec(first, {})
    assert capsys.readouterr().out.startswith("False {'position_error_mm'")
    names = {}
    exec(second, names)
    assert names["info"]["split"] == "train"


def test_a_function_is_scored(folder, capsys):
    for line in commands("Scored, in 20 lines"):
        assert run(shlex.split(line)[1:]) == 0, line
    assert "bow.json: as it says; 3 of 3" in capsys.readouterr().out
    assert (folder / "runs/bow.gif").stat().st_size > 10_000


def test_a_model_of_stable_baselines_is_trained_and_scored(folder):
    training, _ = blocks("A model of Stable-Baselines3", "python")
    exec(training, {})
    [line] = commands("A model of Stable-Baselines3")
    assert run(shlex.split(line)[1:]) == 0


def test_a_teacher_is_trained_and_demonstrates(folder, capsys):
    training, _ = blocks("A teacher", "python")
    exec(training, {})
    for line in commands("A teacher"):
        assert run(shlex.split(line)[1:]) == 0, line
    for name, demonstrator in (("taught", "teacher:make"), ("bows", "my_policy:make")):
        origin = json.loads((folder / "runs" / name / "hvs.json").read_text())
        assert origin["demonstrator"] == demonstrator
    notes = json.loads((folder / "runs/pupil/train_config.json").read_text())
    assert notes["demonstrator"] == "teacher:make"
    words = ["pretrain", "--data", "runs/taught", "--steps", "2", "--out", "runs/more"]
    assert run([*words, "--dagger-rounds", "1"]) == 2
    assert "recorded with teacher:make" in capsys.readouterr().err


def test_a_policy_of_lerobot_plays_the_same_from_its_folder_and_by_its_code(folder, capsys):
    for line in commands("A policy of LeRobot"):
        assert run(shlex.split(line)[1:]) == 0, line
    assert run(["compare", "runs/act.json", "runs/any.json"]) == 0
    assert "2 of 2" in capsys.readouterr().out


def test_a_served_policy_is_scored(folder):
    serve, evaluate = (shlex.split(line) for line in commands("Behind a server"))
    serve[serve.index("--port") + 1] = "0"
    # `-c` looks for modules in the current folder, as the command does.
    program = [sys.executable, "-m", "hvs_suite", *serve[1:]]
    with subprocess.Popen(program, stdout=subprocess.PIPE, text=True, cwd=folder) as server:
        try:
            url = next(line for line in server.stdout if line.startswith("ws://")).strip()
            evaluate[evaluate.index("--server") + 1] = url
            assert run(evaluate[1:]) == 0
        finally:
            server.terminate()
