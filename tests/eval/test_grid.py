"""A grid of trainings: nothing is made twice, a killed study goes on, a command makes a cell."""

import dataclasses
import shlex
from collections.abc import Callable

import pytest
from safetensors.torch import load_file

from hvs_suite.cli.main import parse, run
from hvs_suite.errors import OptionError, OutputError
from hvs_suite.eval.scoring import result_file
from hvs_suite.eval.studies import (
    ablation,
    curriculum,
    few_demonstrations,
    grid_report,
    inputs,
    randomisation,
    resolution,
    rewards,
    start_goal,
    thesis_runs,
)
from hvs_suite.eval.studies.grid import Cell, Finished, Judged, Maker, Plan, Study, run_grid
from hvs_suite.eval.studies.training import Scenes
from hvs_suite.eval.studies.ways import Imitation, Recording
from hvs_suite.registry import TASKS, find
from hvs_suite.rollout import one_torch_thread

STUDIES: dict[str, Callable[..., Plan]] = {
    module.__name__.rpartition(".")[2]: module.plan
    for module in (
        ablation,
        inputs,
        resolution,
        randomisation,
        rewards,
        start_goal,
        curriculum,
        thesis_runs,
    )
}
PLANS = {
    f"{name}{' quick' if quick else ''}": make(quick=quick)
    for name, make in STUDIES.items()
    for quick in (False, True)
} | {
    "few_demonstrations": few_demonstrations.plan(
        "align-thesis", demonstrations=[3, 5], teachers=["expert", "servo"], env_steps=120,
        base_steps=2, imitation_steps=3, imitation_rounds=2, episodes=2, eyes="align-hard",
    ),
}  # fmt: skip
DATA = Recording(task="align-thesis", episodes=3, options={"start": "mixed"})
pytestmark = pytest.mark.timeout(600)


def small(**settings: int) -> Imitation:
    return Imitation(data=DATA, steps=2, settings={"batch_size": 4, **settings})


ON = [Scenes(task="align-thesis")]
PLAN = Plan(
    name="small",
    question="Which?",
    cells=[
        Cell(group="align-thesis", name="whole", way=small(), on=ON),
        Cell(group="align-thesis", name="short", way=small(window_steps=4), on=ON, against="whole"),
    ],
    seeds=1,
    episodes=2,
)


class Killed(BaseException):
    """What a kill looks like to the runner."""


def silent(*words: object) -> None:
    """Say nothing."""


def test_a_killed_study_goes_on_and_nothing_is_made_twice(tmp_path):
    def kill(stage, share, _words):
        if "short" in stage and "training" in stage:
            raise Killed

    with pytest.raises(Killed):
        run_grid(PLAN, tmp_path, kill, workers=1)
    [first] = tmp_path.glob("cells/*.json")
    written = first.stat().st_mtime_ns
    study = run_grid(PLAN, tmp_path, silent, workers=1)
    assert [each.name for each in study.finished] == ["whole", "short"]
    assert first.stat().st_mtime_ns == written
    assert len(list((tmp_path / "data").iterdir())) == 1
    reports: list[str] = []
    again = run_grid(PLAN, tmp_path, lambda *words: reports.append(words[0]), workers=1)
    assert again == study
    assert not reports
    # Its commands make the same policy, and the same result, on as many threads.
    maker = Maker(tmp_path / "again", tmp_path / "again", PLAN.episodes)
    with one_torch_thread():
        for line in maker.commands(PLAN.cells[1], 0):
            assert run(shlex.split(line)[1:]) == 0
    runs = [PLAN.cells[1].way.folder(out, 0) for out in (tmp_path, tmp_path / "again")]
    ours, theirs = (load_file(each / "policy/model.safetensors") for each in runs)
    assert all(ours[name].equal(theirs[name]) for name in ours)
    ours, theirs = (result_file.load(each / "dev-2.json") for each in runs)
    assert ours.episodes == theirs.episodes


@pytest.mark.parametrize("plan", PLANS.values(), ids=PLANS)
def test_plans_are_whole(plan, tmp_path):
    before: set[tuple[str, str]] = set()
    maker = Maker(tmp_path, tmp_path, plan.episodes)
    for cell in plan.cells:
        assert cell.against is None or (cell.group, cell.against) in before
        before.add((cell.group, cell.name))
        for line in maker.commands(cell, 0):
            command = parse(shlex.split(line)[1:])
            tasks = getattr(command, "task", ())
            for task in (tasks,) if isinstance(tasks, str) else tasks:
                find(task).options_from_text(command.option)
    # Two cells that train in one folder would be in each other's way.
    folders = {cell.way.folder(tmp_path, seed) for cell, seed in plan.jobs()}
    assert len(folders) == len(plan.jobs())


def test_ablations_lack_what_they_say():
    settings = {(cell.group, cell.name): cell.way.settings for cell in PLANS["ablation"].cells}
    tilted = {name: each for (task, name), each in settings.items() if task == "surface-tilted"}
    assert "eih" not in tilted["no eye in hand"]["inputs"]
    assert "joint_positions" in tilted["no eye in hand"]["inputs"]
    assert "slopes" not in tilted["no eye in hand"]
    assert tilted["no eye to hand"]["slopes"] == ("eih",)
    assert tilted["no DAgger"]["dagger_rounds"] == 0
    assert tilted["everything"]["dagger_rounds"] == 2
    assert {TASKS[task].family for task, _ in settings} == {spec.family for spec in TASKS.values()}
    [only] = {cell.group for cell in ablation.plan(["track-line"]).cells}
    assert only == "track-line"
    with pytest.raises(OptionError, match="no ablation of 'track-hard'; choose from align-thesis"):
        ablation.plan(["track-hard"])


def judged(solved: str, scenes: str = "dev") -> Judged:
    return Judged(
        scenes=scenes, solved=solved, n_collision=1, steps_to_goal=9.0, settled=0.5, metric="e, mm"
    )


def finished(name: str, *solved: str, against: str | None = "whole", seed: int = 0) -> Finished:
    return Finished(
        group="g", name=name, against=against, seed=seed, commands=["hvs"], minutes=2.0,
        judged=[judged(each, f"test {i}") for i, each in enumerate(solved)],
    )  # fmt: skip


def test_tables_say_what_was_found():
    study = Study(
        name="s",
        question="Which?",
        finished=[
            *(finished("whole", "1" * 20, against=None, seed=seed) for seed in (0, 1)),
            *(finished("worse", "1" * 10 + "0" * 10, seed=seed) for seed in (0, 1)),
            finished("alike", "1" * 19 + "0"),
        ],
    )
    whole, worse, alike = study.rows("g")
    assert (whole.p, whole.rate) == (None, 100.0)
    assert (worse.only_other, worse.only_this) == (20, 0)
    # Of two tests the smaller p is doubled; the seed that the other lacks does not count.
    assert worse.p == pytest.approx(2 * 2 * 0.5**20)
    assert (alike.only_other, alike.only_this, alike.p) == (1, 0, 1.0)
    text = grid_report.markdown(study)
    assert "| worse | 50.0 % |" in text
    assert "fewer scenes: worse." in text
    assert "as far as these scenes tell: alike." in text
    [axes] = grid_report.draw(study).axes
    assert [label.get_text() for label in axes.get_yticklabels()] == ["alike", "worse", "whole"]


def test_of_three_groups_and_more_two_stand_abreast():
    whole = finished("whole", "11", against=None)
    groups = ["a", "b", "c"]
    study = Study(
        name="s", question="?", finished=[whole.model_copy(update={"group": g}) for g in groups]
    )
    drawn = grid_report.draw(study).axes
    assert [axes.get_title(loc="left") for axes in drawn] == [*groups, ""]
    assert [axes.get_subplotspec().colspan.start for axes in drawn] == [0, 1, 0, 1]
    assert [axes.axison for axes in drawn] == [True, True, True, False]


def test_cells_that_play_several_scenes_make_a_map():
    cells = [finished("whole", "11", "10", against=None), finished("other", "00", "11")]
    study = Study(name="s", question="?", finished=cells)
    text = grid_report.markdown(study)
    assert "| other | test 1 | 100.0 % |" in text
    assert "tell: other (played test 0 and test 1)." in text
    # There is one seed, and all are compared with the same.
    assert "each seed" not in text
    assert "compared with" not in text
    assert "| collisions |" in text
    [axes] = grid_report.draw(study).axes
    assert [text.get_text() for text in axes.texts] == ["100", "50", "0", "100"]


def test_a_study_that_is_finished_is_reported_at_once(tmp_path, capsys):
    plan = inputs.plan(quick=True)
    maker = Maker(tmp_path, tmp_path, plan.episodes)
    (tmp_path / "cells").mkdir()
    for cell in plan.chosen([inputs.WHOLE]):
        done = finished(cell.name, "10", against=None).model_copy(update={"group": cell.group})
        maker.path(cell, 0).write_text(done.model_dump_json())
    words = ["study", "inputs", "--quick", "--out", str(tmp_path), "--cell", inputs.WHOLE]
    assert run(words) == 0
    text = (tmp_path / "study.md").read_text()
    assert text in capsys.readouterr().out
    assert "## track-line" in text
    study = Study.model_validate_json((tmp_path / "study.json").read_bytes())
    assert len(study.finished) == 2
    assert (tmp_path / "study.png").stat().st_size > 10_000


def test_nonsense_is_refused(tmp_path, capsys):
    words = ["study", "inputs", "--quick", "--out", str(tmp_path), "--cell", "no thanks"]
    assert run(words) == 2
    assert "no thanks" in capsys.readouterr().err
    with pytest.raises(OptionError, match="seeds"):
        dataclasses.replace(PLAN, seeds=0)
    (tmp_path / "cells").mkdir()
    Maker(tmp_path, tmp_path, PLAN.episodes).path(PLAN.cells[0], 0).write_text("{}")
    with pytest.raises(OutputError, match="Field required"):
        run_grid(PLAN, tmp_path, silent)
