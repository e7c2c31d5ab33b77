"""A result is what its logged actions give; whatever is altered in it, or beside it, is found."""

import dataclasses
import io
import json
import shutil
from collections.abc import Callable, Collection, Mapping
from pathlib import Path
from typing import Any

import dm_env
import numpy as np
import pytest
from dm_env import specs

from hvs_suite.cli import main
from hvs_suite.errors import ResultError
from hvs_suite.eval import protocol
from hvs_suite.eval.board import clips
from hvs_suite.eval.scoring import result_file, verification
from hvs_suite.eval.scoring.result_file import EpisodeRow, Result, Summary
from hvs_suite.eval.scoring.trial import EpisodeLostError, play_trial
from hvs_suite.eval.studies import failures
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


@dataclasses.dataclass
class Script:
    """A stage whose steps end as far outside its bound as is written (mm), whatever is done.

    As a real one, it knows a success, which does not end it, and a slack on its bound.
    """

    excess_mm: list[float]
    collision: bool = False
    hold_steps: int = 2
    goal_ends_episode: bool = True
    slack: Mapping[str, float] = dataclasses.field(default_factory=dict)
    landing_mm: Any = (0.0, 0.0)

    def action_spec(self) -> Any:
        return specs.BoundedArray((7,), np.float32, -1.0, 1.0)

    def reset(self, *, scenario: int | None = None) -> dm_env.TimeStep:
        self.step_count, self.held, self.once, self.done = 0, 0, False, False
        return dm_env.restart({})

    def step(self, action: Any) -> dm_env.TimeStep:
        inside = self.excess_mm[self.step_count] <= self.slack.get("mm", 0.0)
        self.step_count += 1
        self.held = self.held + 1 if inside else 0
        self.once |= inside
        self.done |= self.held >= self.hold_steps
        return dm_env.termination(0.0, {}) if self.is_over else dm_env.transition(0.0, {})

    @property
    def is_over(self) -> bool:
        return self.step_count == len(self.excess_mm)

    @property
    def info(self) -> dict[str, Any]:
        """The error is the number of the step, so that it tells where it was taken."""
        return {
            "is_success": self.done,
            "success_once": self.once,
            "collision": self.is_over and self.collision,
            "truncated": self.is_over and not self.collision,
            "steps_to_goal": self.step_count,
            "errors": {"position_error_mm": float(self.step_count)},
        }


def outcome_of(
    stage: Script, *, failure: str | None = None, action: float = 0.0
) -> tuple[EpisodeRow, Any]:
    """The row of a policy that always does the same; at the end it may fail."""

    def decide(_: Any) -> Any:
        if failure is not None and stage.step_count == len(stage.excess_mm) - 1:
            raise EpisodeLostError(failure)
        return np.full(7, action, np.float32)

    return play_trial(stage, lambda: None, decide, 0)


def replayed(stage: Script, said: EpisodeRow, actions: Any) -> tuple[EpisodeRow, bool]:
    return verification.ReplayTrial({0: actions}, {0: said})(stage, builtin.make_zero(stage), 0)


NEAR = verification.NEAR["mm"]
OUT, IN, JUST_OUT, JUST_IN = 50.0, -50.0, NEAR / 2, -NEAR / 2


@pytest.mark.parametrize(
    ("played", "claimed"),
    [
        ([OUT, IN, JUST_OUT, OUT], [OUT, IN, IN, OUT]),
        ([OUT, IN, JUST_IN, OUT], [OUT, IN, OUT, OUT]),
        # Later than it was, since one step fell out: that step, and none before.
        ([JUST_IN, IN, IN, OUT], [OUT, IN, IN, OUT]),
        ([OUT, JUST_OUT, OUT, OUT], [OUT, IN, OUT, OUT]),
        ([OUT, JUST_IN, OUT, OUT], [OUT, OUT, OUT, OUT]),
        ([JUST_OUT, JUST_OUT, OUT, OUT], [IN, IN, OUT, OUT]),
    ],
)
def test_rounding_excuses_the_outcome_that_it_can_have_made(
    played: list[float], claimed: list[float]
) -> None:
    said, actions = outcome_of(Script(claimed))
    stage = Script(played)
    # Errors and clipped actions are those of the claimed end.
    assert replayed(stage, said, actions) == (said, True)
    assert outcome_of(stage)[0] != said
    assert stage.slack == {}


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
        # Of two steps that rounding may move, neither one alone: both go with their bound.
        ([JUST_OUT, JUST_OUT, JUST_OUT, OUT], [OUT, IN, IN, OUT]),
    ],
)
def test_rounding_excuses_no_other_outcome(played: list[float], claimed: list[float]) -> None:
    said, actions = outcome_of(Script(claimed))
    stage = Script(played)
    own, _ = outcome_of(stage)
    assert replayed(stage, said, actions) == (own, False)
    assert own != said


@pytest.mark.parametrize(
    ("collision", "how"), [(True, {}), (False, {"failure": "too slow"}), (False, {"action": 2.0})]
)
def test_rounding_excuses_no_collision_failure_or_clipping(
    collision: bool, how: dict[str, Any]
) -> None:
    excess = [OUT, JUST_OUT, OUT, OUT]
    said, _ = outcome_of(Script(excess, collision=collision), **how)
    stage = Script(excess)
    own, actions = outcome_of(stage)
    found, by_rounding = replayed(stage, said, actions)
    assert not by_rounding
    assert found == own != said


def test_only_a_handful_of_outcomes_is_left_to_rounding(
    made: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def always(
        self: verification.ReplayTrial, env: Any, policy: Any, scenario: int
    ) -> tuple[EpisodeRow, bool]:
        return self.claimed[scenario], True

    monkeypatch.setattr(verification.ReplayTrial, "__call__", always)
    with pytest.raises(ResultError, match="decided 3 of 3 outcomes as the file says"):
        verification.verify(made / "expert.json")


# --- what the log does not hold -------------------------------------------------------------------


@pytest.fixture(scope="module", params=["expert", "zero"])
def partly_logged(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Four scenarios, the actions of the last two of which are not kept."""
    path = tmp_path_factory.mktemp("partly") / "result.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(protocol, "LOGGED_OF_BUILTIN", 2)
        protocol.evaluate(request.param, TASK, path, episodes=4)
    return path


def altered(path: Path, folder: Path, scenario: int, policy: str | None = None) -> Path:
    """A copy in which a scenario ended a tenth elsewhere, and all else agrees."""
    copied = Path(shutil.copytree(path.parent, folder / "copy")) / path.name
    result = result_file.load(copied)
    rows = list(result.episodes)
    otherwise = {name: value + 0.1 for name, value in rows[scenario].settled.errors.items()}
    changed: dict[str, Any] = {
        "settled": rows[scenario].settled.model_copy(update={"errors": otherwise})
    }
    if not rows[scenario].success:
        changed["errors"] = otherwise
    rows[scenario] = rows[scenario].model_copy(update=changed)
    return rewritten(copied, result, rows, policy)


def with_lost(path: Path, folder: Path, scenarios: Collection[int]) -> Path:
    """A copy that says of some scenarios that the time limit came before the goal."""
    copied = Path(shutil.copytree(path.parent, folder / "copy")) / path.name
    result = result_file.load(copied)
    rows = list(result.episodes)
    for scenario in scenarios:
        end = rows[scenario].settled
        lost = {"success": False, "steps_to_goal": None, "truncated": True}
        lost |= {"steps": end.steps, "errors": end.errors}
        rows[scenario] = rows[scenario].model_copy(update=lost)
    return rewritten(copied, result, rows)


def rewritten(
    path: Path, result: Result, rows: list[EpisodeRow], policy: str | None = None
) -> Path:
    """The file with other rows, and the summary that they have."""
    said = result.summary
    summary = Summary.of(
        said.task,
        policy or said.policy,
        said.split,
        rows,
        tolerances=result.metadata.tolerances,
        time_limit_steps=result.metadata.time_limit_steps,
    )
    result_file.write(result.model_copy(update={"episodes": rows, "summary": summary}), path)
    return path


def test_a_built_in_policy_plays_again_what_is_not_logged(partly_logged: Path) -> None:
    result = result_file.load(partly_logged)
    assert (result.metadata.n_logged, result.summary.n_episodes) == (2, 4)
    assert len(verification.load_actions(partly_logged, result)) == 2
    verdict = verification.verify(partly_logged)
    assert (verdict.n_episodes, verdict.n_played, verdict.n_near) == (4, 4, 0)
    assert set(verdict.largest.values()) == {0.0}
    # So do those who look for the reasons of failures, and those who draw clips.
    lost = sum(not row.success for row in result.episodes)
    assert len(failures.sort_failures(partly_logged).failures) == lost
    assert all(row.scenario < 2 for _, row in clips.choose(result))


@pytest.mark.parametrize("scenario", [1, 3])
def test_an_altered_row_is_found_whether_it_is_logged_or_not(
    scenario: int, partly_logged: Path, tmp_path: Path
) -> None:
    path = altered(partly_logged, tmp_path, scenario)
    with pytest.raises(ResultError, match=f"scenario {scenario}: .*error"):
        verification.verify(path)


def test_a_policy_that_looks_may_go_another_way_if_it_solves_as_many(tmp_path: Path) -> None:
    path = tmp_path / "results" / "servo.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(protocol, "LOGGED_OF_BUILTIN", 2)
        protocol.evaluate("servo", "align-fixed", path, episodes=10)
    assert verification.verify(path).n_other == 0
    verdict = verification.verify(altered(path, tmp_path / "elsewhere", 3))
    assert (verdict.n_played, verdict.n_near, verdict.n_other) == (10, 0, 1)
    # It solves all eight that are not logged.
    assert verification.verify(with_lost(path, tmp_path / "seven", range(3, 10))).n_other == 7
    with pytest.raises(ResultError, match="0 of 8 scenarios that are not logged are claimed"):
        verification.verify(with_lost(path, tmp_path / "eight", range(2, 10)))


def test_shipped_weights_play_again_what_is_not_logged_and_no_others(tmp_path: Path) -> None:
    path = tmp_path / "pretrained.json"
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(protocol, "LOGGED_OF_SHIPPED", 2)
        protocol.evaluate("pretrained", TASK, path, episodes=4)
    result = result_file.load(path)
    assert len(verification.load_actions(path, result)) == 2
    verdict = verification.verify(path)
    assert (verdict.n_played, verdict.n_other, verdict.largest["mm"]) == (4, 0, 0.0)
    other = result.metadata.model_copy(update={"policy_hash": "0" * 64})
    result_file.write(result.model_copy(update={"metadata": other}), path)
    with pytest.raises(ResultError, match="other pretrained weights than this version ships"):
        verification.verify(path)


@pytest.mark.parametrize("policy", ["trapped:make", "hvs_suite_none", "./expert", "finetuned"])
def test_no_file_names_the_code_that_verifying_runs(
    policy: str, partly_logged: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "trapped.py").write_text("raise SystemExit('it ran')")
    monkeypatch.chdir(tmp_path)
    path = altered(partly_logged, tmp_path, 3, policy)
    for look in (verification.verify, failures.sort_failures):
        with pytest.raises(
            ResultError, match=r"n_logged must be the number of rows|no finetuned weights"
        ):
            look(path)


# --- tampering ----------------------------------------------------------------------------------

Content = dict[str, Any]


def reseal(content: Content) -> None:
    """What a careful cheat does: summary and seal agree with the altered rows again."""
    summary, metadata = content["summary"], content["metadata"]
    columns = result_file._rows(content["episodes"], summary["n_episodes"])
    rows = [EpisodeRow(**{"scenario": k} | row) for k, row in enumerate(columns)]
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
    content["episodes"]["errors"]["position_error_mm"][1] /= 2
    reseal(content)


def worse_settled_error(content: Content, path: Path) -> None:
    errors = content["episodes"]["settled"]["errors"]
    errors["tilt_error_deg"] = spread(errors["tilt_error_deg"])
    errors["tilt_error_deg"][1] += 0.011
    reseal(content)


def spread(column: Any) -> list[Any]:
    """A column of three as a list, be all of it one value or not."""
    return column if isinstance(column, list) else 3 * [column]


def faster(content: Content, path: Path) -> None:
    for name in ("steps", "steps_to_goal"):
        content["episodes"][name] = spread(content["episodes"][name])
        content["episodes"][name][0] -= 1
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
    content["summary"]["n_episodes"] = 2
    content["metadata"]["n_logged"] = 2
    content["episodes"] = first_two(content["episodes"])
    reseal(content)


def first_two(columns: Any) -> Any:
    if isinstance(columns, dict):
        return {name: first_two(column) for name, column in columns.items()}
    return columns[:2] if isinstance(columns, list) else columns


def without_a_metric(content: Content, path: Path) -> None:
    """The figure that a board shows first."""
    for block in (content["episodes"], content["episodes"]["settled"]):
        del block["errors"]["lateral_error_mm"]
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
    "a settled error, a hair too far": (worse_settled_error, "scenario 1: settled.tilt_error"),
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
    "a metric left out": (without_a_metric, "metrics is"),
    "a wider tolerance": (wider_tolerance, "tolerances is"),
    "another version of the task": (resealed("metadata.task_version", 2), "task_version is 2"),
    "another digest of the task": (resealed("metadata.task_digest", "abc"), "task_digest is abc"),
    "an easier task": (resealed("summary.task", "align-easy"), "task_digest is"),
    "another split": (resealed("summary.split", "train"), "scenario 0: "),
    "another version of MuJoCo": (edit("metadata.packages", {}), "was changed after it was"),
    "an option": (resealed("metadata.options", {"hold_steps": 1}), "not what differs"),
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
