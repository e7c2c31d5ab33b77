"""DAgger: the policy plays, a teacher labels, and training goes on with those frames."""

import json
from pathlib import Path

import miniature
import numpy as np
import pytest
from safetensors.torch import load_file

import hvs_suite
from hvs_suite.datasets.expert import Expert
from hvs_suite.datasets.features import ACTION_EXECUTED
from hvs_suite.errors import OptionError
from hvs_suite.policies.imitation.dagger import Correct, play_round, read_round, round_shares
from hvs_suite.policies.imitation.demonstrations import Demonstrations
from hvs_suite.policies.imitation.pretrain import pretrain
from hvs_suite.policies.servo import make_servo
from hvs_suite.policies.training.dataset import read_manifest
from hvs_suite.rollout import overrule

SIDE = 28
OPTIONS = {"eih_resolution": SIDE, "eth_resolution": SIDE}
FRAMES = 30


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of align-easy with tiny images."""
    root = tmp_path_factory.mktemp("data") / "tiny"
    columns = miniature.scene(40, side=SIDE)
    miniature.write_dataset(root, columns, miniature.episodes(40), options=OPTIONS)
    return root


@pytest.fixture(scope="module")
def novice(data: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A policy that has hardly learned anything."""
    out = tmp_path_factory.mktemp("novice")
    pretrain(data, out, steps=2, batch_size=4)
    return out


def play(data: Path, novice: Path, folder: Path, workers: int = 1, **more):
    return play_round(
        read_manifest(data),
        novice,
        folder,
        frames=FRAMES,
        first_scenario=10,
        workers=workers,
        **more,
    )


def test_a_round_holds_the_policys_states_and_the_experts_answers(data, novice, tmp_path):
    assert read_round(tmp_path / "round") is None
    summary = play(data, novice, tmp_path / "round")
    found = read_round(tmp_path / "round")
    assert found is not None
    assert found[0] == summary
    columns, images = found[1].columns, found[1].images
    assert summary.frames == len(columns["action"]) == FRAMES
    assert summary.next_scenario == 10 + summary.episodes
    with hvs_suite.load("align-easy", split="train", **OPTIONS) as env:
        time_step = env.reset(scenario=10)
        np.testing.assert_array_equal(
            images["observation.images.eth"][0], time_step.observation["eth"]
        )
        np.testing.assert_array_equal(columns["action"][0], Expert(env).label())
        # A novice does not go where the expert goes, so its second state is another one.
        env.step(columns["action"][0])
        assert np.abs(columns["observation.state"][1, :7] - env.joint_positions).max() > 0.01


def test_servo_labels_what_it_would_do_where_the_policy_has_led_the_arm():
    servo_alone = Correct("servo")
    with hvs_suite.load("align-easy", split="train") as env:
        # Where servo itself plays, it agrees with itself.
        own = servo_alone(env, make_servo(env), 3)
        assert own.success
        for frame in own.frames:
            np.testing.assert_array_equal(frame["action"], frame[ACTION_EXECUTED])
        # Where the arm was led astray for some steps, it still arrives: it knows where the arm is.
        led = LedAstray(make_servo(env))
        led_home = servo_alone(env, led, 3)
        assert led_home.success
        assert len(led_home.frames) > len(own.frames)
        for frame in led_home.frames[LedAstray.steps :]:
            np.testing.assert_array_equal(frame["action"], frame[ACTION_EXECUTED])


class LedAstray:
    """A policy that stands still at first, and tells the other that it has."""

    steps = 5

    def __init__(self, policy):
        self._policy = policy

    def reset(self):
        self._policy.reset()
        self._count = 0

    def select_action(self, observation):
        action = self._policy.select_action(observation)
        self._count += 1
        if self._count <= self.steps:
            action = np.zeros(7, np.float32)
            overrule(self._policy, action)
        return action


def test_the_expert_as_a_teacher_knows_what_the_demonstrator_does_not_show():
    with hvs_suite.load("insert-feel", split="train") as env:
        labels = {}
        for name in ("expert", "demonstrator"):
            played = Correct(name)(env, make_servo(env), 0)
            labels[name] = np.array([frame["action"] for frame in played.frames])
    # Of the same states: one goes where the hole is, the other where the paint says.
    assert np.abs(labels["expert"] - labels["demonstrator"])[-5:].max() > 1e-4


def test_any_number_of_workers_plays_the_same_round(data, novice, tmp_path):
    play(data, novice, tmp_path / "one")
    play(data, novice, tmp_path / "two", workers=2)
    one, two = read_round(tmp_path / "one"), read_round(tmp_path / "two")
    assert one is not None
    assert two is not None
    assert one[0] == two[0]
    for key, column in one[1].columns.items():
        np.testing.assert_array_equal(column, two[1].columns[key], err_msg=key)
    for key, frames in one[1].images.items():
        np.testing.assert_array_equal(frames, two[1].images[key], err_msg=key)


def test_added_frames_are_learned_from_and_never_held_out(data, novice, tmp_path):
    demonstrations = Demonstrations(read_manifest(data), tmp_path / "cache", 0)
    before, held_out = len(demonstrations.training), demonstrations.held_out.copy()
    play(data, novice, tmp_path / "round")
    found = read_round(tmp_path / "round")
    assert found is not None
    demonstrations.add(found[1])
    assert len(demonstrations.training) == before + FRAMES
    np.testing.assert_array_equal(demonstrations.held_out, held_out)
    weights = demonstrations.weights()
    begins, _ = demonstrations.episodes()
    assert weights[begins >= len(miniature.scene(40)["action"])].sum() == pytest.approx(0.5)
    assert not weights[np.isin(begins, held_out)].any()
    batch = demonstrations.batch(np.array([3, 40, 69]))
    np.testing.assert_array_equal(batch["action"][1:], found[1].columns["action"][[0, 29]])
    np.testing.assert_array_equal(batch["action"][0], miniature.scene(40)["action"][3])


class Killed(BaseException):
    """What a kill looks like to the loop."""


@pytest.mark.parametrize("without", [(), ("keypoints",)], ids=str)
def test_a_run_killed_after_a_round_ends_like_one_that_was_left_alone(data, tmp_path, without):
    options = {
        "steps": 8,
        "batch_size": 16,
        "window_steps": 2,
        "without": without,
        "checkpoint_period_s": 0.0,
        "dagger_rounds": 2,
        "dagger_frames": 20,
        "workers": 1,
    }
    whole = pretrain(data, tmp_path / "whole", **options)
    assert [played.frames for played in whole.rounds] == [20, 20]
    assert whole.rounds[1].first_scenario == whole.rounds[0].next_scenario

    def kill(progress):
        if progress.stage == "training" and progress.step == 5:
            raise Killed

    with pytest.raises(Killed):
        pretrain(data, tmp_path / "cut", on_progress=kill, **options)
    outcome = pretrain(data, tmp_path / "cut", **options)
    assert outcome.rounds == whole.rounds
    a, b = (load_file(tmp_path / name / "model.safetensors") for name in ("whole", "cut"))
    for name, value in a.items():
        np.testing.assert_array_equal(value, b[name], err_msg=name)
    written = json.loads((tmp_path / "cut/training/outcome.json").read_text())
    assert len(written["rounds"]) == 2


def test_rounds_come_before_the_end_and_leave_time_to_learn():
    for rounds in (1, 2, 5):
        shares = round_shares(rounds)
        assert len(shares) == rounds
        assert shares == sorted(shares)
        assert shares[0] > 0.0
        assert shares[-1] < 0.9
    assert round_shares(0) == []


@pytest.mark.parametrize(
    "options", [{"dagger_rounds": -1}, {"dagger_frames": 0}, {"workers": 0}], ids=str
)
def test_rounds_that_make_no_sense_are_refused(data, tmp_path, options):
    with pytest.raises(OptionError):
        pretrain(data, tmp_path / "out", steps=1, **options)
