"""Policies by name: what exists plays, what does not says so in one line."""

import dataclasses
import pickle
from types import SimpleNamespace

import numpy as np
import pytest

from hvs_suite.errors import PolicyError, UnknownTaskError
from hvs_suite.policies import catalogue
from hvs_suite.policies.catalogue import policy_factory
from hvs_suite.policies.checkpoints.loading import CheckpointPolicy
from hvs_suite.registry import TASKS


def playground(split="test", scenario=0):
    return SimpleNamespace(
        info={"split": split, "scenario": scenario},
        action_spec=lambda: SimpleNamespace(shape=(7,)),
        spec=TASKS["align-easy"],
    )


def actions(env, n=4):
    policy = policy_factory("random", "align-easy")(env)
    policy.reset()
    return np.stack([policy.select_action({}) for _ in range(n)])


def test_zero_holds_the_zero_action():
    action = policy_factory("zero", "align-easy")(playground()).select_action({})
    assert action.dtype == np.float32
    np.testing.assert_array_equal(action, np.zeros(7))


def test_random_actions_depend_on_split_and_scenario_alone():
    first = actions(playground())
    assert first.dtype == np.float32
    assert (np.abs(first) <= 1.0).all()
    np.testing.assert_array_equal(first, actions(playground()))
    assert not np.array_equal(first, actions(playground(scenario=1)))
    assert not np.array_equal(first, actions(playground(split="train")))


def test_random_starts_again_with_each_episode():
    env = playground()
    policy = policy_factory("random", "align-easy")(env)
    policy.reset()
    first = [policy.select_action({}) for _ in range(3)]
    policy.reset()
    np.testing.assert_array_equal(first, [policy.select_action({}) for _ in range(3)])


def test_a_run_of_lerobot_train_is_told_where_its_policy_lies(tmp_path):
    policy = tmp_path / "act/checkpoints/last/pretrained_model"
    policy.mkdir(parents=True)
    with pytest.raises(PolicyError, match=f"name its policy, {policy}"):
        policy_factory(str(tmp_path / "act"), "align-easy")


def test_a_type_of_policy_is_told_where_lerobot_train_leaves_one():
    with pytest.raises(PolicyError, match="RUN/checkpoints/last/pretrained_model"):
        policy_factory("act", "align-easy")


@pytest.mark.parametrize("spec", ["expert", "servo", "zero", "random"])
def test_factories_travel_to_workers(spec):
    factory = policy_factory(spec, "align-easy")
    assert pickle.loads(pickle.dumps(factory)) == factory  # noqa: S301 - our own bytes


def test_a_checkpoint_travels_to_workers_and_plays(checkpoint, named):
    factory = policy_factory(str(checkpoint), "align-easy")
    env = named("align-easy")
    policy = pickle.loads(pickle.dumps(factory))(env)  # noqa: S301 - our own bytes
    observation = env.reset(scenario=0).observation
    policy.reset()
    action = policy.select_action(observation)
    assert action.shape == (7,)
    assert action.dtype == np.float32
    env.step(action)


@pytest.mark.parametrize("spec", ["pretrained", "finetuned", "exprt", "no/such/folder"])
def test_what_does_not_exist_says_so_in_one_line(spec, tmp_path, monkeypatch):
    # A folder of policies without any weights: the suite's own grows.
    monkeypatch.setattr(catalogue, "HERE", tmp_path)
    with pytest.raises(PolicyError) as error:
        policy_factory(spec, "align-limit")
    assert "\n" not in str(error.value)


def test_notes_name_shipped_weights_wherever_they_lie(tmp_path):
    shipped = catalogue.checkpoint_folder("pretrained", "align-easy")
    assert catalogue.name_of(shipped) == "pretrained/align-thesis"
    assert catalogue.name_of(tmp_path) == str(tmp_path)


def test_a_name_nearly_right_is_suggested():
    with pytest.raises(PolicyError, match="did you mean expert"):
        policy_factory("exprt", "align-easy")


def test_an_unknown_task_is_refused():
    with pytest.raises(UnknownTaskError, match="align-easy"):
        policy_factory("zero", "align-eazy")


def test_a_folder_that_is_no_checkpoint_is_refused(tmp_path):
    with pytest.raises(PolicyError, match="not a LeRobot checkpoint"):
        policy_factory(str(tmp_path), "align-easy")


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        ({"eth_resolution": 224}, "112 x 112 x 3, the task shows 224 x 224 x 3"),
        ({"eih_channels": 1}, "the task shows 112 x 112 x 1"),
        ({"observations": "eih+joint_positions+joint_velocities"}, "observation.images.eth"),
        ({"observations": "eih+eth+joint_positions"}, "reads 14 joint numbers, the task shows 7"),
        ({"action_mode": "joint_delta"}, "joint positions"),
        ({"normalise_observation": True}, "raw observations"),
    ],
)
def test_a_checkpoint_that_does_not_fit_is_refused(checkpoint, change, reason):
    spec = dataclasses.replace(TASKS["align-easy"], **change)
    with pytest.raises(PolicyError, match=reason):
        CheckpointPolicy(checkpoint, spec)
