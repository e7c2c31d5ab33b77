"""What RL learns of the way: chooses otherwise far from the goal, and nothing near it."""

import dataclasses

import numpy as np
import pytest
import torch
from safetensors.torch import load_file
from test_finetune import CALL, SMALL, Killed, state_of
from test_hvs_policy import new_policy, observations, one

import hvs_suite
from hvs_suite.policies.belief.acting import CompiledBelief, CompiledParts, act
from hvs_suite.policies.belief.choice import MOST, Choice
from hvs_suite.policies.checkpoints.loading import CheckpointPolicy, load_network
from hvs_suite.policies.residual.folding import load_base, with_residual, write_folded
from hvs_suite.policies.residual.stage import MakeStage
from hvs_suite.policies.residual.td3 import finetune

pytestmark = pytest.mark.timeout(600)

TASK = "track-curve"
WAY = dataclasses.replace(SMALL, learns="way", reach_m=0.001)
WIDE = {"position_tolerance_mm": 5000.0, "tilt_tolerance_deg": 180.0}


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """A policy that nobody has trained."""
    from hvs_suite.policies.hvs.modeling_hvs import save_checkpoint

    folder = tmp_path_factory.mktemp("base")
    save_checkpoint(new_policy(TASK), folder)
    return folder


@pytest.fixture(scope="module")
def chosen(base, tmp_path_factory):
    """The same with a choice that has learned something."""
    network = with_residual(load_base(base), WAY)
    torch.manual_seed(1)
    with torch.no_grad():
        network.choice.layers[-2].weight.normal_()
    folder = tmp_path_factory.mktemp("chosen")
    write_folded(base, network.choice, WAY, folder, hvs_suite.TASKS[TASK])
    return folder


def played(network, n=3):
    """Actions on some observations: step by step, compiled, and in parts, as learning plays."""
    spec, memory, fast, apart = hvs_suite.TASKS[TASK], network.start(1), None, network.start(1)
    compiled, parts = CompiledBelief(network), network.choice and CompiledParts(network)
    actions = []
    for observation in observations(spec, n):
        batch = one(spec, observation)
        images = {name: batch[f"observation.images.{name}"] for name in ("eih", "eth")}
        state = batch["observation.state"]
        with torch.no_grad():
            action, memory = act(network, images, state, memory)
            same, fast = compiled(images, state, fast)
            torch.testing.assert_close(same, action, atol=1e-5, rtol=0.0)
            if parts:
                apart, sightings, read = parts.perceive(images, state, apart, None, None)
                share = network.choice(read)
                same, apart = parts.respond(apart, sightings, state, share, None)
                torch.testing.assert_close(same, action, atol=1e-5, rtol=0.0)
        actions.append(action)
    return torch.cat(actions)


def test_it_leaves_the_actions_as_they_are_at_first_and_then_changes_them(base, chosen):
    plain = load_base(base)
    before = played(plain)
    torch.testing.assert_close(played(with_residual(plain, WAY)), before, rtol=0.0, atol=0.0)
    assert (played(load_network(chosen)) - before).abs().max() > 1e-6


def test_near_the_goal_it_changes_nothing():
    choice = Choice(3, 8, 2, 0.02)
    way = torch.tensor([[0.019], [0.021]])
    change = choice.change(torch.tensor([[0.5, -2.0]]).expand(2, 2), way)
    torch.testing.assert_close(change, torch.tensor([[0.0, 0.0], [0.5 * MOST, -MOST]]))


def test_its_checkpoint_is_played_alike_with_and_without_lerobot(chosen):
    from hvs_suite.policies.hvs.modeling_hvs import HvsPolicy

    spec = hvs_suite.TASKS[TASK]
    policy, alone = (
        HvsPolicy.from_pretrained(chosen, local_files_only=True),
        CheckpointPolicy(chosen, spec),
    )
    for player in (policy, alone):
        player.reset()
    for observation in observations(spec, 3):
        np.testing.assert_allclose(
            policy.select_action(one(spec, observation))[0].numpy(),
            alone.select_action(observation),
            atol=1e-5,
        )


@pytest.mark.parametrize(("wide", "expected"), [({}, [-0.01] * 8), (WIDE, [0.0] * 4 + [1.0])])
def test_an_episode_ends_where_the_tip_has_arrived(base, wide, expected):
    options = {"time_limit_steps": 8, "hold_steps": 8}
    settings = dataclasses.replace(WAY, shaping=0.0)
    stage = MakeStage(TASK, options | wide, "train", str(base), settings, 0)()
    for scene in range(2):
        stage.reset()
        over, rewards = False, []
        while not over:
            action = np.zeros(stage.action_space.shape, np.float32)
            _, reward, over, _, info = stage.step(action)
            rewards.append(reward)
        assert rewards == expected
        assert info["success"] == bool(wide)
        # The next scene, not the rest of this one.
        assert info["episode"] == scene + 1
    stage.close()


def test_a_killed_run_ends_like_one_that_was_left_alone(base, tmp_path):
    call = {**CALL, "settings": WAY, "options": {"time_limit_steps": 3, "hold_steps": 3}}

    def kill(progress):
        if (progress.stage, progress.env_steps) == ("training", 8):
            raise Killed

    finetune(base, TASK, tmp_path / "whole", steps=13, **call)
    with pytest.raises(Killed):
        finetune(base, TASK, tmp_path / "cut", steps=13, on_progress=kill, **call)
    finetune(base, TASK, tmp_path / "cut", steps=13, **call)
    (tensors, counts), (expected, expected_counts) = (
        state_of(tmp_path / name) for name in ("cut", "whole")
    )
    assert counts == expected_counts
    for name, value in expected.items():
        torch.testing.assert_close(tensors[name], value, rtol=0.0, atol=0.0, msg=name)
    # All but the choice is as it was, and that has learned.
    before, after = (load_file(path / "model.safetensors") for path in (base, tmp_path / "whole"))
    assert all(torch.equal(after[name], value) for name, value in before.items())
    added = after.keys() - before.keys()
    assert all(name.startswith("network.choice.") for name in added)
    assert any(after[name].any() for name in added if ".4." in name)
