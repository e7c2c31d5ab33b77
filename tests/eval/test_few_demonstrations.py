"""From a few demonstrations: RL and its controls from the same bases, judged on the same scenes."""

import dataclasses
import shutil
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from hvs_suite.cli.main import run
from hvs_suite.errors import OptionError, OutputError
from hvs_suite.eval.studies import few_demonstrations_report
from hvs_suite.eval.studies.few_demonstrations import (
    BASE,
    FINETUNED,
    IMITATED,
    SCRATCH,
    Budget,
    Curve,
    End,
    Family,
    Point,
    Study,
    run_study,
)

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "align-thesis"
BUDGET = Budget(
    env_steps=120, base_steps=2, imitation_steps=3, imitation_rounds=2, episodes=2
)  # fmt: skip
pytestmark = pytest.mark.timeout(600)


def test_every_way_has_the_same_steps_and_is_not_made_twice(tmp_path):
    so_far = []

    def on_finished(study):
        so_far.append(len(study.families))

    study = run_study(
        SAMPLE, tmp_path / "a", [3], BUDGET, lambda *words: None, seeds=1, on_finished=on_finished
    )
    assert so_far == [1, 2]
    assert study.counts() == [3]
    ways = study.of(3)[0].curves | study.of(0)[0].curves
    assert set(ways) == {FINETUNED, IMITATED, SCRATCH}
    for curve in ways.values():
        assert curve.points[-1].env_steps == BUDGET.env_steps
        steps = [point.env_steps for point in curve.points]
        assert steps == sorted(steps)
    # Both begin with the same base.
    assert ways[FINETUNED].points[0] == ways[IMITATED].points[0]
    for family in study.families:
        for way, curve in family.curves.items():
            assert len(family.ends[way].solved) == BUDGET.episodes
            assert family.ends[way].solved.count("1") == curve.points[-1].n_success
    assert [(row.way, row.other) for row in study.comparisons()] == [
        (FINETUNED, BASE), (IMITATED, BASE), (FINETUNED, IMITATED),
    ]  # fmt: skip
    # Its file is all that it needs to go on elsewhere.
    (tmp_path / "b").mkdir()
    shutil.copy(tmp_path / "a" / "study.json", tmp_path / "b")
    again = []
    for _ in range(2):
        moved = run_study(
            SAMPLE, tmp_path / "b", [3], BUDGET, lambda *w: again.append(w[0]), seeds=1
        )
        assert moved == study
    assert not again
    text = few_demonstrations_report.markdown(study)
    assert "| 3 |" in text
    figure = few_demonstrations_report.draw(study)
    assert [axes.get_title(loc="left") for axes in figure.axes] == ["3 demonstrations"]
    assert len(figure.axes[0].lines) == 3


def _family(count: int, seed: int, *, tuned: int) -> Family:
    """What might have come of a base that solves one scene of two."""

    def curve(solved: int) -> Curve:
        points = [Point(env_steps=at, n=2, n_success=n) for at, n in ((0, 1), (120, solved))]
        return Curve(points=points, minutes=1.0)

    def end(solved: int) -> End:
        return End(solved="1" * solved + "0" * (2 - solved), n_collision=0)

    if not count:
        return Family(
            demonstrations=0, seed=seed, curves={SCRATCH: curve(0)}, ends={SCRATCH: end(0)}
        )
    return Family(
        demonstrations=count,
        seed=seed,
        curves={FINETUNED: curve(tuned), IMITATED: curve(2)},
        ends={BASE: end(1), FINETUNED: end(tuned), IMITATED: end(2)},
    )


@pytest.fixture
def kept(tmp_path):
    """The folder of a study that is finished for two seeds of 3 demonstrations, and one of 4."""
    families = [_family(0, 0, tuned=0), _family(0, 1, tuned=0)]
    families += [_family(3, 0, tuned=1), _family(3, 1, tuned=2), _family(4, 0, tuned=2)]
    study = Study(task="align-thesis", budget=BUDGET, families=families)
    (tmp_path / "study.json").write_text(study.model_dump_json())
    return tmp_path


def test_all_that_is_finished_is_reported(kept):
    def refuse(*words):
        raise AssertionError(f"nothing is left to do, but {words}")

    study = run_study(SAMPLE, kept, [3], BUDGET, refuse, seeds=2)
    # Of 4 scenes 2 by the bases, 3 by the fine-tuned, 4 by DAgger; then the same of 2 scenes.
    assert [(row.n_only_way, row.n_only_other) for row in study.comparisons()] == [
        (1, 0), (2, 0), (0, 1), (1, 0), (1, 0), (0, 0),
    ]  # fmt: skip
    text = few_demonstrations_report.markdown(study)
    assert "| 3 | 2 | 50.0 %" in text
    assert "| 4 | 1 | 50.0 %" in text
    assert len(few_demonstrations_report.draw(study).axes) == 2


def test_a_study_that_is_finished_is_reported_at_once(kept, capsys):
    words = ["study", "few-demonstrations", "--data", str(SAMPLE), "--out", str(kept)]
    budget = [
        word
        for name, number in dataclasses.asdict(BUDGET).items()
        for word in (f"--{name.replace('_', '-')}", str(number))
    ]
    before = (kept / "study.json").read_text()
    assert run([*words, "--demonstrations", "3", "--seeds", "2", *budget]) == 0
    assert (kept / "study.json").read_text() == before
    text = (kept / "study.md").read_text()
    assert "| 4 | 1 | 50.0 %" in text
    assert capsys.readouterr().out.startswith(text)
    assert (kept / "study.png").read_bytes().startswith(b"\x89PNG")


def test_what_is_finished_is_reported_before_its_control_is():
    study = Study(task="align-thesis", budget=BUDGET, families=[_family(3, 0, tuned=1)])
    text = few_demonstrations_report.markdown(study)
    assert text.count("| 3 | 1 | 50.0 %") == 1
    assert text.splitlines()[4].endswith("|  |")
    assert len(few_demonstrations_report.draw(study).axes[0].lines) == 2


def test_another_study_in_the_folder_is_left_alone(kept):
    before = (kept / "study.json").read_text()
    other = dataclasses.replace(BUDGET, episodes=3)
    with pytest.raises(OutputError, match="budget"):
        run_study(SAMPLE, kept, [3], other, lambda *words: None)
    assert (kept / "study.json").read_text() == before
    (kept / "study.json").write_text("{}")
    with pytest.raises(OutputError, match="another folder"):
        run_study(SAMPLE, kept, [3], BUDGET, lambda *words: None)


def test_its_processes_end_with_a_study_that_is_killed(tmp_path):
    endless = dataclasses.replace(BUDGET, base_steps=10**6)
    script = (
        "import os, signal\n"
        "from pathlib import Path\n"
        "from hvs_suite.eval.studies.few_demonstrations import Budget, run_study\n"
        "def stop(*words): os.kill(os.getpid(), signal.SIGKILL)\n"
        f"run_study(Path({str(SAMPLE)!r}), Path({str(tmp_path)!r}), [3], {endless}, stop)\n"
    )
    # What it prints has an end only once all that could print have ended.
    killed = subprocess.run(
        [sys.executable, "-c", script], check=False, stdout=subprocess.PIPE, timeout=300
    )
    assert killed.returncode == -signal.SIGKILL


@pytest.mark.parametrize("change", [{"episodes": 0}, {"env_steps": 1}])
def test_a_budget_that_makes_no_sense_is_refused(change):
    with pytest.raises(OptionError):
        dataclasses.replace(BUDGET, **change)


@pytest.mark.parametrize("count", [1, 6])
def test_more_demonstrations_than_there_are_are_refused(count, tmp_path):
    with pytest.raises(OptionError, match="dataset's 5"):
        run_study(SAMPLE, tmp_path, [count], BUDGET, lambda *words: None)


@pytest.mark.parametrize("none", [{"seeds": 0}, {"workers": 0}])
def test_a_study_of_nothing_is_refused(none, tmp_path):
    with pytest.raises(OptionError, match=r"at least 1, not 0"):
        run_study(SAMPLE, tmp_path, [3], BUDGET, lambda *words: None, **none)
