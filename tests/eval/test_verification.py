"""A result is what its logged actions give; whatever is altered in it, or beside it, is found."""

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hvs_suite.cli import main
from hvs_suite.errors import ResultError
from hvs_suite.eval import protocol, result_file, verification
from hvs_suite.eval.result_file import EpisodeRow, Summary
from hvs_suite.eval.trial import Course

TASK = "align-thesis"


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("made")
    protocol.evaluate("expert", TASK, folder / "expert.json", episodes=3)
    protocol.evaluate("random", TASK, folder / "random.json", episodes=3, workers=2)
    return folder


@pytest.fixture
def copy(made: Path, tmp_path: Path) -> Path:
    shutil.copytree(made, tmp_path / "copy")
    return tmp_path / "copy" / "expert.json"


@pytest.mark.parametrize("name", ["expert", "random"])
def test_an_honest_result_is_verified(name: str, made: Path) -> None:
    verdict = verification.verify(made / f"{name}.json")
    assert (verdict.n_episodes, verdict.n_played, verdict.n_near) == (3, 3, 0)
    # Pictures or none, one process or two: the physics is the same to the last bit.
    assert verdict.largest_mm == verdict.largest_deg == 0.0


def test_verifying_draws_no_picture(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from hvs_suite.tasks.shared.environment import Environment

    def draw(self: Environment) -> None:
        pytest.fail("it drew a picture")

    monkeypatch.setattr(Environment, "renderer", property(draw))
    verification.verify(made / "expert.json")


def test_a_sample_is_drawn_with_what_the_files_maker_cannot_know(
    made: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = made / "expert.json"
    one, other = (verification.verify(path, sample=1).nonce for _ in range(2))
    assert one is not None
    assert one != other
    assert verification.drawn(1000, 20, one) != verification.drawn(1000, 20, str(other))
    # What was printed repeats the draw.
    assert main.run(["verify", str(path), "--sample", "1", "--nonce", one]) == 0
    assert f"1 of 3 scenarios played again (nonce {one})" in capsys.readouterr().out
    assert verification.drawn(1000, 20, one) == verification.drawn(1000, 20, one)
    assert verification.verify(path, sample=3).nonce is None


def test_lost_episodes_are_verified_up_to_where_they_were_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(Path(__file__).parent)
    path = tmp_path / "nan.json"
    protocol.evaluate("broken_policies:nan", TASK, path, episodes=1)
    assert verification.verify(path).n_played == 1


# --- what rounding may excuse ---------------------------------------------------------------------


def course(excess: list[float], hold_steps: int = 2, **changes: Any) -> Course:
    """A course whose errors tell the step they were taken at."""
    n = len(excess)
    values: dict[str, Any] = {
        "scenario": 0,
        "hold_steps": hold_steps,
        "actions": np.zeros((n, 7), np.float32),
        "inside": np.array(excess) <= 0.0,
        "excess": np.array(excess),
        "clipped": np.ones(n, np.bool_),
        "errors": [dict.fromkeys(result_file.ERRORS, float(step)) for step in range(n + 1)],
        "collision": False,
        "truncated": True,
        "failure": None,
        "landing_mm": np.zeros(2),
    }
    return Course(**(values | changes))


OUT, IN, JUST_OUT, JUST_IN = 50.0, -50.0, 0.5, -0.5


@pytest.mark.parametrize(
    ("played", "claimed"),
    [
        ([OUT, IN, JUST_OUT, OUT], [OUT, IN, IN, OUT]),
        ([OUT, IN, JUST_IN, OUT], [OUT, IN, OUT, OUT]),
        # Later than it was, since one step fell out: that step, and none before.
        ([JUST_IN, IN, IN, OUT], [OUT, IN, IN, OUT]),
        ([OUT, JUST_OUT, OUT, OUT], [OUT, IN, OUT, OUT]),
        ([OUT, JUST_IN, OUT, OUT], [OUT, OUT, OUT, OUT]),
        ([JUST_OUT, JUST_OUT, JUST_OUT, OUT], [OUT, IN, IN, OUT]),
    ],
)
def test_rounding_excuses_the_outcome_that_it_can_have_made(
    played: list[float], claimed: list[float]
) -> None:
    said = course(claimed).row()
    found = course(played).could_be(said)
    # Errors and clipped actions are those of the claimed end.
    assert found == said
    assert found != course(played).row()


@pytest.mark.parametrize(
    ("played", "claimed"),
    [
        # Near a bound in another step than those that would have to be inside.
        ([JUST_OUT, OUT, OUT, OUT], [IN, IN, OUT, OUT]),
        ([OUT, IN, OUT, JUST_OUT], [OUT, IN, IN, OUT]),
        # After the goal.
        ([OUT, IN, IN, JUST_OUT], [IN, IN, OUT, OUT]),
        ([OUT, IN, IN, JUST_IN], [OUT, OUT, IN, IN]),
        # Surely inside before, so that the goal was held earlier than claimed.
        ([IN, IN, JUST_OUT, OUT], [OUT, IN, IN, OUT]),
        ([OUT, OUT, OUT, OUT], [OUT, IN, OUT, OUT]),
        ([OUT, IN, OUT, JUST_IN], [OUT, OUT, OUT, OUT]),
        ([np.inf, JUST_OUT, OUT, OUT], [IN, IN, OUT, OUT]),
    ],
)
def test_rounding_excuses_no_other_outcome(played: list[float], claimed: list[float]) -> None:
    said = course(claimed).row()
    assert course(played).could_be(said) == course(played).row() != said


@pytest.mark.parametrize(
    "change",
    [
        {"collision": True, "truncated": False},
        {"failure": "too slow", "truncated": False},
        {"clipped": np.zeros(4, np.bool_)},
    ],
)
def test_rounding_excuses_no_collision_failure_or_clipping(change: dict[str, Any]) -> None:
    excess = [OUT, JUST_OUT, OUT, OUT]
    said = course(excess, **change).row()
    assert course(excess).could_be(said) != said


def test_only_a_handful_of_outcomes_is_left_to_rounding(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def always(self: Course, claimed: EpisodeRow) -> EpisodeRow:
        return claimed

    other = result_file.load(made / "expert.json").episodes[0].model_copy(update={"steps": 99})
    monkeypatch.setattr(Course, "could_be", always)
    monkeypatch.setattr(Course, "row", lambda self: other)
    with pytest.raises(ResultError, match="decided 3 of 3 outcomes as the file says"):
        verification.verify(made / "expert.json")


# --- tampering ----------------------------------------------------------------------------------

Content = dict[str, Any]


def reseal(content: Content) -> None:
    """What a careful cheat does: summary and seal agree with the altered rows again."""
    rows = [EpisodeRow.model_validate(row) for row in content["episodes"]]
    summary, metadata = content["summary"], content["metadata"]
    content["summary"] = Summary.of(
        summary["task"],
        summary["policy"],
        summary["split"],
        rows,
        tolerances=metadata["tolerances"],
        time_limit_steps=metadata["time_limit_steps"],
    ).model_dump(mode="json")
    content["sha256"] = result_file.seal(content)


def swap_log(content: Content, path: Path, change: Callable[[Any, Any], tuple[Any, Any]]) -> None:
    """Alters the action log and lets the result vouch for it."""
    log_path = result_file.actions_path(path)
    with np.load(log_path) as log:
        steps, actions = change(log["steps"], log["actions"].copy())
    buffer = io.BytesIO()
    np.savez_compressed(buffer, steps=steps, actions=actions)
    log_path.write_bytes(buffer.getvalue())
    content["metadata"]["actions_sha256"] = verification.action_log.digest(log_path)


def edit(name: str, value: Any) -> Callable[[Content, Path], None]:
    def tamper(content: Content, path: Path) -> None:
        block, _, key = name.partition(".")
        content[block][key] = value

    return tamper


def better_error(content: Content, path: Path) -> None:
    content["episodes"][1]["position_error_mm"] /= 2
    reseal(content)


def better_settled_error(content: Content, path: Path) -> None:
    content["episodes"][1]["settled_tilt_error_deg"] += 3e-5
    reseal(content)


def faster(content: Content, path: Path) -> None:
    row = content["episodes"][0]
    row["steps"] -= 1
    row["steps_to_goal"] -= 1
    reseal(content)


def other_action(content: Content, path: Path) -> None:
    def change(steps: Any, actions: Any) -> tuple[Any, Any]:
        actions[19, 1] += 0.02
        return steps, actions

    swap_log(content, path, change)
    reseal(content)


def action_without_hash(content: Content, path: Path) -> None:
    before = content["metadata"]["actions_sha256"]
    swap_log(content, path, lambda steps, actions: (steps, -actions))
    content["metadata"]["actions_sha256"] = before


def other_episodes_actions(content: Content, path: Path) -> None:
    swap_log(content, path, lambda steps, actions: (steps[::-1], actions[::-1]))
    reseal(content)


def shorter_log(content: Content, path: Path) -> None:
    def change(steps: Any, actions: Any) -> tuple[Any, Any]:
        steps = steps.copy()
        steps[-1] -= 1
        return steps, actions[:-1]

    swap_log(content, path, change)
    reseal(content)


def no_log(content: Content, path: Path) -> None:
    result_file.actions_path(path).unlink()


def pickled_log(content: Content, path: Path) -> None:
    def change(steps: Any, actions: Any) -> tuple[Any, Any]:
        return steps, np.array([print], dtype=object)

    swap_log(content, path, change)
    reseal(content)


def fewer_rows(content: Content, path: Path) -> None:
    content["episodes"].pop()
    reseal(content)


def wider_tolerance(content: Content, path: Path) -> None:
    content["metadata"]["tolerances"]["position_error_mm"] = 50.0
    reseal(content)


def resealed(name: str, value: Any) -> Callable[[Content, Path], None]:
    def tamper(content: Content, path: Path) -> None:
        edit(name, value)(content, path)
        reseal(content)

    return tamper


TAMPERING: dict[str, tuple[Callable[[Content, Path], None], str]] = {
    "a better error, summary and seal made to fit": (better_error, "scenario 1: position_error"),
    "a settled error, a hair too far": (better_settled_error, "scenario 1: settled_tilt_error"),
    "a faster success": (faster, "scenario 0: steps is"),
    "a flattered summary": (edit("summary.pc_success", 99.0), "summary.pc_success is not"),
    "another policy's name": (edit("summary.policy", "mine"), "was changed after it was written"),
    "another action, its hash made to fit": (other_action, "scenario 0: "),
    "another action, its hash as it was": (action_without_hash, "is not the action log"),
    "the actions of other episodes": (other_episodes_actions, "scenario 0: "),
    "an action left out": (shorter_log, "settled_steps is 20, but 19 actions are logged"),
    "no action log": (no_log, "cannot be read"),
    "an action log with code in it": (pickled_log, "holds object"),
    "an episode left out": (fewer_rows, "holds 3 scenarios, the result 2"),
    "a wider tolerance": (wider_tolerance, "tolerances is"),
    "another version of the task": (resealed("metadata.task_version", 2), "task_version is 2"),
    "another digest of the task": (resealed("metadata.task_digest", "abc"), "task_digest is abc"),
    "an easier task": (resealed("summary.task", "align-easy"), "task_digest is"),
    "another split": (resealed("summary.split", "train"), "scenario 0: "),
    "another version of MuJoCo": (edit("metadata.packages", {}), "was changed after it was"),
    "an option": (resealed("metadata.options", {"hold_steps": 1}), "the task was changed"),
    "another schema": (lambda content, path: content.update(schema_version=1), "schema_version"),
}


@pytest.mark.parametrize("how", TAMPERING)
def test_tampering_is_found_and_named(
    how: str, copy: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    content = json.loads(copy.read_text())
    tamper, reason = TAMPERING[how]
    tamper(content, copy)
    copy.write_text(json.dumps(content))
    assert main.run(["verify", str(copy)]) == 1
    complaint = capsys.readouterr().err.splitlines()[-1]
    assert reason in complaint


def test_the_command_verifies_a_folder(made: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main.run(["verify", str(made), "--json"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert [Path(entry["file"]).name for entry in found] == ["expert.json", "random.json"]


@pytest.mark.parametrize("words", ["nowhere.json", ".", "", "--sample 0 ."])
def test_nothing_to_verify_is_the_users_mistake(
    words: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main.run(["verify", *words.split()]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1
