"""From a few demonstrations: RL and its controls from the same bases, judged on the same scenes."""

import signal
import subprocess
import sys

import pytest

from hvs_suite.cli.main import run
from hvs_suite.eval.studies import grid_report
from hvs_suite.eval.studies.few_demonstrations import BASE, FINETUNED, SCRATCH
from hvs_suite.eval.studies.grid import Finished, Judged, Study
from hvs_suite.eval.studies.training import Point

WORDS = ["study", "few-demonstrations", "--task", "align-thesis", "--seeds", "1"]
TEACHERS = ["--teacher", "demonstrator", "--teacher", "servo"]
pytestmark = pytest.mark.timeout(600)


def test_every_way_has_the_same_steps_and_is_not_made_twice(tmp_path, capsys):
    words = [*WORDS, *TEACHERS, "--processes", "1", "--curriculum", "start"]
    words += ["--quick", "--out", str(tmp_path)]
    assert run(words) == 0
    study = Study.model_validate_json((tmp_path / "study.json").read_text())
    cells = {cell.name: cell for cell in study.finished}
    ways = [FINETUNED, "DAgger, demonstrator", "DAgger, servo"]
    assert list(cells) == [BASE, *ways, SCRATCH]
    assert not cells[BASE].curve
    for name in (*ways, SCRATCH):
        steps = [point.env_steps for point in cells[name].curve]
        assert steps[-1] == 40
        assert steps == sorted({*steps})
        assert cells[name].curve[-1].n_success == cells[name].judged[0].solved.count("1")
    assert "--curriculum start" in cells[FINETUNED].commands[-2]
    # RL and DAgger begin with the same demonstrations; the labels are another teacher's.
    demonstrator, servo = (cells[name].commands[-2] for name in ways[1:])
    assert demonstrator.replace("demonstrator", "servo").split("--out")[0] in servo
    text = (tmp_path / "study.md").read_text()
    assert "## align-thesis, 3 demonstrations" in text
    assert text in capsys.readouterr().out
    written = {path: path.stat().st_mtime_ns for path in tmp_path.glob("cells/*.json")}
    assert run(words) == 0
    assert {path: path.stat().st_mtime_ns for path in tmp_path.glob("cells/*.json")} == written


def test_success_is_drawn_over_environment_steps_as_far_as_every_seed_came():
    def cell(name, seed, *solved):
        points = [
            Point(env_steps=100 * i, n=2, n_success=n_success) for i, n_success in enumerate(solved)
        ]
        end = Judged(
            scenes="dev", solved="10", n_collision=0, steps_to_goal=9.0, settled=1.0, metric="e, mm"
        )
        return Finished(
            group="g",
            name=name,
            against=None,
            seed=seed,
            commands=[],
            minutes=1.0,
            curve=points,
            judged=[end],
        )

    cells = [cell("base", 0), cell("base", 1), cell("RL", 0, 0, 1, 2), cell("RL", 1, 0, 0, 1, 2)]
    bars, curves = grid_report.draw(Study(name="s", question="?", finished=cells)).axes
    assert [each.get_text() for each in bars.get_yticklabels()] == ["RL", "base"]
    [line] = curves.lines
    assert line.get_xdata().tolist() == [0.0, 0.1, 0.2]
    assert line.get_ydata().tolist() == [0.0, 25.0, 75.0]


def test_its_processes_end_with_a_study_that_is_killed(tmp_path):
    script = (
        "import os, signal\n"
        "from pathlib import Path\n"
        "from hvs_suite.eval.studies.few_demonstrations import plan\n"
        "from hvs_suite.eval.studies.grid import run_grid\n"
        "def stop(*words): os.kill(os.getpid(), signal.SIGKILL)\n"
        "made = plan('align-thesis', demonstrations=[3], teachers=[], env_steps=40,\n"
        "    base_steps=10**6, imitation_steps=3, imitation_rounds=2, episodes=2)\n"
        f"run_grid(made, Path({str(tmp_path)!r}), stop, workers=2)\n"
    )
    # What it prints has an end only once all that could print have ended.
    killed = subprocess.run(
        [sys.executable, "-c", script], check=False, stdout=subprocess.PIPE, timeout=300
    )
    assert killed.returncode == -signal.SIGKILL


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--demonstrations", "1"], "at least 2"),
        (["--env-steps", "3", "--demonstrations", "3"], "at least imitation_rounds"),
        (["--base-steps", "0", "--demonstrations", "3"], "base_steps must be at least 1"),
        (["--episodes", "0", "--demonstrations", "3"], "episodes must be at least 1"),
    ],
)
def test_nonsense_is_refused(words, reason, tmp_path, capsys):
    assert run([*WORDS, *words, "--out", str(tmp_path)]) == 2
    assert reason in capsys.readouterr().err
