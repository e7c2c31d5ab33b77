"""A result is what its logged actions give; whatever is altered in it, or beside it, is found."""

import io
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import dm_env
import numpy as np
import pytest
from columns import put_rows, rows_of
from dm_env import specs

from hvs_suite.cli import main
from hvs_suite.errors import ResultError
from hvs_suite.eval import protocol, result_file, verification
from hvs_suite.eval.result_file import EpisodeRow, Summary
from hvs_suite.eval.trial import play_trial, same_outcome
from hvs_suite.policies import builtin

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
    assert set(verdict.largest.values()) == {0.0}


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


class Bench:
    """A task of one bounded length whose errors are given (mm), held for two steps."""

    goal_ends_episode = True
    landing_mm = np.zeros(2)

    def __init__(self, errors_mm: list[float], collides: bool = False) -> None:
        self._errors_mm, self._collides = errors_mm, collides
        self.slack: dict[str, float] = {}

    def action_spec(self) -> Any:
        return specs.BoundedArray((7,), np.float32, -1.0, 1.0)

    def reset(self, *, scenario: int | None = None) -> Any:
        self._step, self._held, self._once, self._goal = 0, 0, False, None
        return dm_env.restart({})

    def step(self, action: Any) -> Any:
        self._step += 1
        is_inside = self._errors_mm[self._step - 1] <= 1.0 + self.slack.get("mm", 0.0)
        self._held = self._held + 1 if is_inside else 0
        self._once = self._once or is_inside
        if self._held == 2 and self._goal is None:
            self._goal = self._step
        over = self._step == len(self._errors_mm)
        return dm_env.truncation(0.0, {}) if over else dm_env.transition(0.0, {})

    @property
    def info(self) -> dict[str, Any]:
        over = self._step == len(self._errors_mm)
        return {
            "is_success": self._goal == self._step and self._step > 0,
            "success_once": self._once,
            "steps_to_goal": self._goal,
            "collision": over and self._collides,
            "truncated": over and not self._collides,
            "errors": {"position_error_mm": self._errors_mm[max(self._step - 1, 0)]},
        }


def played(errors_mm: list[float], claimed: EpisodeRow | None = None, **changes: Any) -> Any:
    """The row of a bench, or what its replay says to a claimed row."""
    n = len(errors_mm)
    bench = Bench(errors_mm, **changes)
    actions = np.zeros((n, 7), np.float32)
    if claimed is None:
        remaining = iter(actions)
        return play_trial(bench, lambda: None, lambda _: next(remaining), 0)[0]
    replay = verification.ReplayTrial({0: actions}, {0: claimed})
    found, by_rounding = replay(bench, builtin.make_zero(bench), 0)
    assert not bench.slack
    return found, by_rounding


OUT, IN, JUST_OUT, JUST_IN = 50.0, 0.0, 1.0005, 0.9995


@pytest.mark.parametrize(
    ("errors_mm", "claimed"),
    [
        ([OUT, IN, JUST_OUT, OUT], [OUT, IN, JUST_IN, OUT]),
        ([OUT, IN, JUST_IN, OUT], [OUT, IN, JUST_OUT, OUT]),
        ([JUST_IN, IN, IN, OUT], [JUST_OUT, IN, IN, OUT]),
        ([OUT, JUST_OUT, OUT, OUT], [OUT, JUST_IN, OUT, OUT]),
        ([OUT, JUST_IN, OUT, OUT], [OUT, JUST_OUT, OUT, OUT]),
        ([JUST_OUT, JUST_OUT, OUT, OUT], [JUST_IN, JUST_IN, OUT, OUT]),
    ],
)
def test_rounding_excuses_the_outcome_that_it_can_have_made(
    errors_mm: list[float], claimed: list[float]
) -> None:
    said = played(claimed)
    assert said != played(errors_mm)
    found, by_rounding = played(errors_mm, said)
    assert by_rounding
    assert same_outcome(found, said)


@pytest.mark.parametrize(
    ("errors_mm", "claimed"),
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
    ],
)
def test_rounding_excuses_no_other_outcome(errors_mm: list[float], claimed: list[float]) -> None:
    said = played(claimed)
    found, by_rounding = played(errors_mm, said)
    assert not by_rounding
    assert found == played(errors_mm) != said


def test_rounding_excuses_no_collision() -> None:
    errors_mm = [OUT, JUST_OUT, OUT, OUT]
    said = played(errors_mm, collides=True)
    found, by_rounding = played(errors_mm, said)
    assert not by_rounding
    assert not same_outcome(found, said)


def test_only_a_handful_of_outcomes_is_left_to_rounding(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def always(self: Any, env: Any, policy: Any, scenario: int) -> tuple[EpisodeRow, bool]:
        return self.claimed[scenario], True

    monkeypatch.setattr(verification.ReplayTrial, "__call__", always)
    with pytest.raises(ResultError, match="decided 3 of 3 outcomes as the file says"):
        verification.verify(made / "expert.json")


# --- what a log need not hold ----------------------------------------------------------------


@pytest.fixture(scope="module")
def short_log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A result of a built-in policy whose log holds one scenario of three."""
    path = tmp_path_factory.mktemp("short") / "expert.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(protocol, "LOGGED_OF_BUILTIN", 1)
        protocol.evaluate("expert", TASK, path, episodes=3)
    return path


def test_what_is_not_logged_is_played_by_the_policy_itself(short_log: Path) -> None:
    assert result_file.load(short_log).metadata.n_logged == 1
    verdict = verification.verify(short_log)
    assert (verdict.n_played, set(verdict.largest.values())) == (3, {0.0})


def test_an_altered_row_beyond_the_log_is_found(short_log: Path, tmp_path: Path) -> None:
    path = Path(shutil.copytree(short_log.parent, tmp_path / "copy")) / short_log.name
    content = json.loads(path.read_text())
    rows = rows_of(content)
    rows[2]["settled"]["errors"]["tilt_error_deg"] += 1e-3
    put_rows(content, rows)
    reseal(content)
    path.write_text(json.dumps(content))
    with pytest.raises(ResultError, match=r"scenario 2: settled\.tilt_error_deg"):
        verification.verify(path)


# --- tampering ----------------------------------------------------------------------------------

Content = dict[str, Any]


def reseal(content: Content) -> None:
    """What a careful cheat does: summary and seal agree with the altered rows again."""
    rows = [EpisodeRow.model_validate(row) for row in rows_of(content)]
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
    rows = rows_of(content)
    rows[1]["errors"]["position_error_mm"] /= 2
    put_rows(content, rows)
    reseal(content)


def better_settled_error(content: Content, path: Path) -> None:
    rows = rows_of(content)
    rows[1]["settled"]["errors"]["tilt_error_deg"] += 3e-5
    put_rows(content, rows)
    reseal(content)


def faster(content: Content, path: Path) -> None:
    rows = rows_of(content)
    rows[0]["steps"] -= 1
    rows[0]["steps_to_goal"] -= 1
    put_rows(content, rows)
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
    put_rows(content, rows_of(content)[:-1])
    content["metadata"]["n_logged"] = 2
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
    "a settled error, a hair too far": (better_settled_error, "scenario 1: settled.tilt_error"),
    "a faster success": (faster, "scenario 0: steps is"),
    "a flattered summary": (edit("summary.pc_success", 99.0), "summary.pc_success is not"),
    "another policy's name": (edit("summary.policy", "mine"), "was changed after it was written"),
    "another action, its hash made to fit": (other_action, "scenario 0: "),
    "another action, its hash as it was": (action_without_hash, "is not the action log"),
    "the actions of other episodes": (other_episodes_actions, "scenario 0: "),
    "an action left out": (shorter_log, "settled.steps is 20, but 19 actions are logged"),
    "no action log": (no_log, "cannot be read"),
    "an action log with code in it": (pickled_log, "holds object"),
    "an episode left out": (fewer_rows, "holds 3 scenarios, the result says 2"),
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
