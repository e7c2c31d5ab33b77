"""From a few demonstrations: RL and its controls from the same bases, judged on the same scenes."""

import dataclasses
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hvs_suite.errors import OptionError
from hvs_suite.eval import few_demonstrations_report
from hvs_suite.eval.few_demonstrations import FINETUNED, IMITATED, SCRATCH, Budget, run_study

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "align-thesis"
BUDGET = Budget(
    env_steps=120, base_steps=2, imitation_steps=3, imitation_rounds=2, eye_frames=40, eye_steps=2,
    seeds=1, episodes=2, processes=2,
)  # fmt: skip
pytestmark = pytest.mark.timeout(600)


def test_every_way_has_the_same_steps_and_is_not_made_twice(tmp_path):
    study = run_study(SAMPLE, tmp_path, [3], BUDGET, lambda *words: None)
    ways = {curve.way: curve for curve in study.curves}
    assert set(ways) == {FINETUNED, IMITATED, SCRATCH}
    for curve in study.curves:
        assert curve.points[-1].env_steps == BUDGET.env_steps
        steps = [point.env_steps for point in curve.points]
        assert steps == sorted(steps)
    # Both begin with the same base; what trained the eyes counts as played.
    assert ways[FINETUNED].points[0] == ways[IMITATED].points[0]
    assert ways[FINETUNED].points[1].env_steps == BUDGET.eye_frames
    assert [(row.way, row.other) for row in study.comparisons] == [
        (FINETUNED, "base"), (IMITATED, "base"), (FINETUNED, IMITATED),
    ]  # fmt: skip
    again = []
    assert run_study(SAMPLE, tmp_path, [3], BUDGET, lambda *w: again.append(w[0])) == study
    assert not again
    text = few_demonstrations_report.markdown(study)
    assert "| 3 |" in text
    figure = few_demonstrations_report.draw(study)
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["3 demonstrations"]
    assert len(figure.axes[0].lines) == 3


def test_its_processes_end_with_a_study_that_is_killed(tmp_path):
    endless = dataclasses.replace(BUDGET, base_steps=10**6)
    script = (
        "import os, signal\n"
        "from pathlib import Path\n"
        "from hvs_suite.eval.few_demonstrations import Budget, run_study\n"
        "def stop(*words): os.kill(os.getpid(), signal.SIGKILL)\n"
        f"run_study(Path({str(SAMPLE)!r}), Path({str(tmp_path)!r}), [3], {endless}, stop)\n"
    )
    # What it prints has an end only once all that could print have ended.
    killed = subprocess.run(
        [sys.executable, "-c", script], check=False, stdout=subprocess.PIPE, timeout=300
    )
    assert killed.returncode == -signal.SIGKILL


@pytest.mark.parametrize("change", [{"seeds": 0}, {"env_steps": 40}, {"processes": 0}])
def test_a_budget_that_makes_no_sense_is_refused(change):
    with pytest.raises(OptionError):
        dataclasses.replace(BUDGET, **change)


@pytest.mark.parametrize("count", [1, 6])
def test_more_demonstrations_than_there_are_are_refused(count, tmp_path):
    with pytest.raises(OptionError, match="dataset's 5"):
        run_study(SAMPLE, tmp_path, [count], BUDGET, lambda *words: None)
