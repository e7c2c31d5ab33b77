"""Robustness: cells are paired, nothing is played twice, and the file is what the scenes give."""

import json
from pathlib import Path

import pytest

from hvs_suite.cli.main import run
from hvs_suite.errors import OptionError, OutputError, ResultError
from hvs_suite.eval import protocol
from hvs_suite.eval.scoring import result_file, robustness_file
from hvs_suite.eval.scoring.robustness_file import Robustness
from hvs_suite.eval.studies import robustness, robustness_report
from hvs_suite.eval.studies.robustness import Plan, chosen_axes, run_study

# The expert sees no picture, knows all, and fails where there is no time left.
PLAN = Plan(policy="expert", task="align-thesis", axes=("latency", "all"), episodes=4)
N_CELLS = 7


def silent(_stage: str, _share: float, _words: str) -> None:
    """Takes reports and says nothing."""


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Robustness]:
    """A study of two axes, its folder first."""
    out = tmp_path_factory.mktemp("study")
    return out, run_study(PLAN, out, silent)


def test_every_cell_plays_the_same_scenes_and_is_compared_with_them(
    studied: tuple[Path, Robustness],
) -> None:
    out, study = studied
    assert [(cell.axis, cell.strength) for cell in study.cells] == [
        (axis, strength) for axis in PLAN.axes for strength in ("mild", "medium", "strong")
    ]
    assert study.undisturbed.solved == "1111"
    for cell in study.cells:
        result = result_file.load(out / "cells" / f"{cell.axis}-{cell.strength}.json")
        assert [row.scenario for row in result.episodes] == [0, 1, 2, 3]
        assert result.metadata.options == cell.options
        assert cell.options["unannounced"] is True
        assert cell.n_lost == 4 - cell.n_success
        assert cell.n_won == 0
    mild, *_ = study.cells
    steps = [
        result_file.load(out / "cells" / f"{name}.json").summary.steps_to_goal_mean
        for name in ("undisturbed", "latency-mild")
    ]
    assert mild.n_success == 4
    assert steps[1] == pytest.approx(steps[0] + 1.0)


def test_what_is_finished_is_not_played_again(
    studied: tuple[Path, Robustness], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_arguments: object, **_options: object) -> None:
        raise AssertionError("played again")

    monkeypatch.setattr(protocol, "evaluate", refuse)
    assert run_study(PLAN, studied[0], silent) == studied[1]


def test_a_killed_study_goes_on_in_the_middle_of_a_cell(
    studied: tuple[Path, Robustness], tmp_path: Path
) -> None:
    played: list[str] = []

    def interrupt(stage: str, _share: float, _words: str) -> None:
        played.append(stage)
        if len(played) == 6:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run_study(PLAN, tmp_path, interrupt)
    assert (tmp_path / "cells" / "latency-mild.json.partial").exists()
    finished = (tmp_path / "cells" / "undisturbed.json").stat().st_mtime_ns
    assert run_study(PLAN, tmp_path, silent) == studied[1]
    assert (tmp_path / "cells" / "undisturbed.json").stat().st_mtime_ns == finished
    assert not list(tmp_path.glob("**/*.partial"))


def test_another_study_s_folder_is_left_alone(studied: tuple[Path, Robustness]) -> None:
    other = Plan(policy="expert", task="align-thesis", axes=("latency",), episodes=5)
    with pytest.raises(OutputError, match="episodes differs"):
        run_study(other, studied[0], silent)


def test_the_file_holds_what_the_scenes_give(
    studied: tuple[Path, Robustness], tmp_path: Path
) -> None:
    path = tmp_path / "expert" / "align-thesis.json"
    path.parent.mkdir()
    path.write_text(studied[1].model_dump_json(), encoding="utf-8")
    assert robustness_file.load_all(tmp_path) == [studied[1]]
    assert robustness_file.load_all(tmp_path / "none") == []
    content = json.loads(path.read_text(encoding="utf-8"))
    content["cells"][0]["n_success"] = 3
    path.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(ResultError, match="n_success is not what the scenes give"):
        robustness_file.load(path)


def test_what_came_with_the_suite_is_whole() -> None:
    for study in robustness_file.load_all():
        path = robustness_file.COMMITTED / study.policy / f"{study.task}.json"
        assert path.is_file()
        axes = {axis.name: axis for axis in chosen_axes(study.task)}
        for name, cells in study.axes().items():
            assert tuple(cell.level for cell in cells) == axes[name].levels


def test_the_picture_has_a_panel_an_axis_and_a_line_a_policy(
    studied: tuple[Path, Robustness],
) -> None:
    study = studied[1]
    figure = robustness_report.draw([study, study.model_copy(update={"policy": "another"})])
    drawn = [axes for axes in figure.axes if axes.get_title(loc="left")]
    assert [axes.get_title(loc="left") for axes in drawn] == ["latency", "all together"]
    assert all(len(axes.containers) == 2 for axes in drawn)


def test_the_command_writes_table_picture_and_figures(
    studied: tuple[Path, Robustness], capsys: pytest.CaptureFixture[str]
) -> None:
    out, study = studied
    words = ["study", "robustness", "--policy", "expert", "--task", "align-thesis", "--episodes"]
    axes = [word for axis in PLAN.axes for word in ("--axis", axis)]
    assert run([*words, "4", *axes, "--out", str(out)]) == 0
    assert "all together" in capsys.readouterr().out
    assert robustness_file.load(out / "study.json") == study
    assert (out / "study.png").stat().st_size > 10_000
    assert "| latency | " in (out / "study.md").read_text(encoding="utf-8")


def test_an_axis_is_found_by_its_name_or_refused() -> None:
    assert [axis.name for axis in chosen_axes("align-thesis", ["blur"])] == ["blur"]
    with pytest.raises(OptionError, match="did you mean light"):
        chosen_axes("align-thesis", ["lihgt"])


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--policy", "servo", "--task", "align-thesis", "--axis", "taste"], "no axis 'taste'"),
        (["--policy", "servant", "--task", "align-thesis"], "did you mean servo"),
        (["--policy", "servo", "--task", "align-thesys"], "align-thesis"),
        (["--policy", "servo", "--task", "clutter-choice", "--axis", "marker"], "no axis marker"),
        (["--policy", "finetuned", "--task", "align-easy"], "no finetuned weights"),
        (["--policy", "zero", "--task", "align-thesis", "--episodes", "0"], "at least 1"),
        (["--policy", "zero", "--task", "align-easy", "--beside", "{folder}/x.json"], "x.json"),
    ],
)
def test_bad_input_is_one_line(
    words: list[str], reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = [word.format(folder=tmp_path) for word in words]
    assert run(["study", "robustness", *words, "--out", str(tmp_path / "out")]) == 2
    complaint = capsys.readouterr().err.strip()
    assert reason in complaint
    assert "\n" not in complaint
    assert not (tmp_path / "out" / "study.json").exists()


def test_the_name_of_the_axis_of_all_is_the_file_s() -> None:
    assert chosen_axes("align-thesis")[-1].name == robustness.ALL
