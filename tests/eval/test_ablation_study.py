"""What each choice contributes: each row is trained without one, and scored on the same scenes."""

import json
from pathlib import Path

import pytest

from hvs_suite.errors import OptionError
from hvs_suite.eval.studies import ablation
from hvs_suite.eval.studies.ablation import ABLATIONS, NO_DAGGER, WHOLE, Budget, run_study

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "align-thesis"
BUDGET = Budget(steps=2, dagger_rounds=1, dagger_frames=8, seed=0, episodes=2, workers=1)


def test_rows_lack_what_they_say_and_are_not_made_twice(tmp_path):
    names = ["no eye in hand", "no DAgger, 1/4 of the data"]
    reports: list[str] = []
    study = run_study(SAMPLE, tmp_path, names, BUDGET, lambda *words: reports.append(words[0]))
    assert [row.name for row in study.rows] == [WHOLE, NO_DAGGER, *names]
    assert [row.against for row in study.rows] == [None, WHOLE, WHOLE, NO_DAGGER]
    assert [row.demonstrations for row in study.rows] == [5, 5, 5, 2]
    configs = sorted(tmp_path.glob("*/*/policy/train_config.json"))
    settings = {
        path.parent.parent.name: json.loads(path.read_text())["settings"] for path in configs
    }
    assert settings["no-eye-in-hand"]["inputs"] == ["eth"]
    assert settings["no-dagger"]["dagger_rounds"] == 0
    assert settings["everything"]["dagger_rounds"] == 1
    again: list[str] = []
    assert run_study(SAMPLE, tmp_path, names, BUDGET, lambda *w: again.append(w[0])) == study
    assert reports
    assert not again
    text = ablation.markdown(study)
    assert all(row.name in text for row in study.rows[1:])
    axes = ablation.draw(study).axes[0]
    assert [label.get_text() for label in axes.get_yticklabels()] == [
        row.name for row in study.rows[::-1]
    ]


def test_every_row_comes_after_the_one_it_is_compared_with():
    names = list(ABLATIONS)
    assert all(names.index(a.against) <= names.index(name) for name, a in ABLATIONS.items())


def test_an_unknown_row_is_refused(tmp_path):
    with pytest.raises(OptionError, match="no thanks"):
        run_study(SAMPLE, tmp_path, ["no thanks"], BUDGET, lambda *words: None)
