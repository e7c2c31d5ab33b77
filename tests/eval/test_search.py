"""A Bayesian search: it learns from its trials, and a killed one goes on as if it had not been."""

import math

import pytest

from hvs_suite.cli.main import run
from hvs_suite.errors import OptionError, OutputError, TrainingError
from hvs_suite.eval.studies import search, search_report
from hvs_suite.eval.studies.grid import Finished, Judged
from hvs_suite.eval.studies.ways import Imitation, Recording

SCENES = 200


class Killed(BaseException):
    """What a kill looks like to the search."""


def pretend(monkeypatch, kill_at=None):
    """Let policies with a learning rate near 1e-3 solve most scenes, whatever else is set."""
    made = []

    def make_all(make, jobs, workers, report):
        for cell, seed in jobs:
            if cell.name == kill_at:
                raise Killed
            made.append(cell.name)
            rate = cell.way.settings["learning_rate"]
            n = round(SCENES * math.exp(-abs(math.log(rate / 1e-3))))
            judged = Judged(
                scenes="dev", solved="1" * n + "0" * (SCENES - n), n_collision=0,
                steps_to_goal=9.0, settled=1.0, metric="e, mm",
            )  # fmt: skip
            finished = Finished(
                group=cell.group, name=cell.name, against=None, seed=seed,
                commands=make.commands(cell, seed), minutes=1.0, judged=[judged],
            )  # fmt: skip
            path = make.path(cell, seed)
            path.parent.mkdir(exist_ok=True)
            path.write_text(finished.model_dump_json())
            yield finished

    monkeypatch.setattr(search, "make_all", make_all)
    return made


def silent(*words: object) -> None:
    """Say nothing."""


def test_a_killed_search_goes_on_as_if_it_had_not_been(tmp_path, monkeypatch):
    made = pretend(monkeypatch)
    whole = search.run_search("imitation", tmp_path / "a", silent, trials=16, workers=2)
    assert len(made) == 16
    made = pretend(monkeypatch, kill_at="trial 7")
    with pytest.raises(Killed):
        search.run_search("imitation", tmp_path / "b", silent, trials=16, workers=2)
    assert len(made) == 7
    made = pretend(monkeypatch)
    again = search.run_search("imitation", tmp_path / "b", silent, trials=16, workers=2)
    # Trial 6 was finished, and trial 7 begun.
    assert made[0] == "trial 7"
    assert len(made) == 9
    for one, other in zip(whole.trials, again.trials, strict=True):
        assert (one.settings, one.n_success) == (other.settings, other.n_success)
    assert again.importances == whole.importances
    assert next(iter(whole.importances)) == "learning_rate"
    assert sum(whole.importances.values()) == pytest.approx(1.0)
    best = max(whole.trials, key=lambda each: each.n_success)
    text = search_report.markdown(whole)
    assert f"The best is trial {best.number}" in text
    assert "| learning_rate |" in text
    assert len(search_report.draw(whole).axes) == 2
    with pytest.raises(OutputError, match="another search"):
        search.run_search("rl", tmp_path / "a", silent, trials=16)


def test_a_trial_is_made_with_what_was_proposed(tmp_path, monkeypatch):
    pretend(monkeypatch)
    [trial] = search.run_search("imitation", tmp_path, silent, trials=1).trials
    [line] = [line for line in trial.commands if line.startswith("hvs pretrain")]
    for name, value in trial.settings.items():
        assert f"--{name.replace('_', '-')} {value}" in line


def test_a_trial_that_comes_apart_solves_nothing_and_the_search_goes_on(tmp_path, monkeypatch):
    def come_apart(*words: object) -> None:
        raise TrainingError("training came apart")

    monkeypatch.setattr(Recording, "make", silent)
    monkeypatch.setattr(Imitation, "train", come_apart)
    found = search.run_search("imitation", tmp_path, silent, trials=2, workers=1)
    assert [trial.n_success for trial in found.trials] == [0, 0]
    assert found.trials[0].settings != found.trials[1].settings


def test_nonsense_is_refused(tmp_path, capsys):
    with pytest.raises(OptionError, match="trials"):
        search.run_search("rl", tmp_path, silent, trials=0)
    (tmp_path / "search.journal").write_text("no journal\n")
    assert run(["study", "search", "--quick", "--out", str(tmp_path)]) == 2
    assert "search.journal" in capsys.readouterr().err
