"""The LeRobot side of the `hvs` policy: checkpoints, processors, discovery."""

import subprocess
import sys

import miniature
import pytest
import torch

from hvs_suite.policies.checkpoints.loading import CheckpointPolicy
from hvs_suite.registry import TASKS


@pytest.fixture(scope="module")
def policy(checkpoint):
    from hvs_suite.policies.hvs import HvsPolicy

    return HvsPolicy.from_pretrained(checkpoint)


@pytest.fixture(scope="module")
def batch():
    columns = miniature.scene(4, side=112)
    tensors = {}
    for key, values in columns.items():
        tensor = torch.from_numpy(values)
        tensors[key] = tensor.permute(0, 3, 1, 2) / 255.0 if ".images." in key else tensor
    return tensors


def test_importing_the_package_registers_the_type():
    ask = (
        "import hvs_suite.policies.hvs\n"
        "from lerobot.configs import PreTrainedConfig\n"
        "print(PreTrainedConfig.get_choice_class('hvs').__name__)"
    )
    done = subprocess.run([sys.executable, "-c", ask], capture_output=True, text=True, check=True)
    assert done.stdout == "HvsConfig\n"


def test_lerobot_finds_policy_and_processors_by_type(checkpoint):
    from lerobot.configs import PreTrainedConfig
    from lerobot.policies.factory import get_policy_class, make_pre_post_processors

    import hvs_suite.policies.hvs  # noqa: F401 - registers the type

    config = PreTrainedConfig.from_pretrained(checkpoint)
    assert config.type == "hvs"
    assert get_policy_class("hvs").name == "hvs"
    for pretrained_path in (None, str(checkpoint)):
        before, after = make_pre_post_processors(config, pretrained_path=pretrained_path)
        assert before({"observation.state": torch.zeros(14)})["observation.state"].shape == (1, 14)
        assert after(torch.ones(1, 7)).shape == (1, 7)


def test_a_saved_policy_decides_as_before(policy, batch, tmp_path):
    from hvs_suite.policies.hvs import HvsPolicy
    from hvs_suite.policies.hvs.modeling_hvs import save_checkpoint

    save_checkpoint(policy, tmp_path)
    again = HvsPolicy.from_pretrained(tmp_path)
    torch.testing.assert_close(
        again.select_action(batch), policy.select_action(batch), atol=0, rtol=0
    )
    assert policy.predict_action_chunk(batch).shape == (4, 1, 7)


def test_actions_do_not_depend_on_privileged_keys(policy, batch):
    public = {k: v for k, v in batch.items() if k.startswith("observation.")}
    disturbed = {k: v if k in public else torch.full_like(v, 99.0) for k, v in batch.items()}
    actions = []
    for seen in (public, batch, disturbed):
        # It remembers where it has sent the arm.
        policy.reset()
        actions.append(policy.select_action(seen))
    assert torch.equal(actions[0], actions[1])
    assert torch.equal(actions[0], actions[2])


def test_the_loss_uses_privileged_keys_where_they_are_and_warns_where_not(policy, batch, caplog):
    loss, parts = policy.forward(batch)
    assert set(parts) == {"action_loss", "eih_loss", "eth_loss", "target_loss", "flange_loss"}
    assert all(isinstance(value, float) for value in parts.values())
    policy.train()
    public = {k: v for k, v in batch.items() if not k.startswith("privileged.")}
    alone, parts = policy.forward(public)
    policy.eval()
    assert set(parts) == {"action_loss"}
    assert alone < loss
    assert "without keypoint supervision" in caplog.text


def test_the_new_pipeline_delivers_privileged_keys_to_the_loss(policy, batch):
    from hvs_suite.policies.hvs import make_hvs_pre_post_processors

    before, _ = make_hvs_pre_post_processors(policy.config)
    delivered = before(dict(batch))
    for key, value in batch.items():
        assert torch.equal(delivered[key], value), key


def test_the_worker_without_lerobot_decides_like_lerobot(policy, checkpoint):
    from lerobot.policies.factory import make_pre_post_processors

    columns = miniature.scene(2, side=112)
    player = CheckpointPolicy(checkpoint, TASKS["align-easy"])
    before, after = make_pre_post_processors(policy.config, pretrained_path=str(checkpoint))
    for row in range(2):
        state = columns["observation.state"][row]
        observation = {
            "eih": columns["observation.images.eih"][row],
            "eth": columns["observation.images.eth"][row],
            "joint_positions": state[:7].astype(float),
            "joint_velocities": state[7:].astype(float),
        }
        loaded = {
            "observation.images.eih": torch.from_numpy(observation["eih"]).permute(2, 0, 1) / 255.0,
            "observation.images.eth": torch.from_numpy(observation["eth"]).permute(2, 0, 1) / 255.0,
            "observation.state": torch.from_numpy(state),
        }
        theirs = after(policy.select_action(before(loaded)))[0]
        torch.testing.assert_close(
            torch.from_numpy(player.select_action(observation)), theirs, atol=1e-6, rtol=0
        )


def test_the_configuration_refuses_what_the_network_cannot_read():
    from lerobot.configs import FeatureType, PolicyFeature

    from hvs_suite.policies.hvs import HvsConfig

    action = {"action": PolicyFeature(FeatureType.ACTION, (7,))}
    square = PolicyFeature(FeatureType.VISUAL, (3, 28, 28))
    for inputs in (
        {"observation.state": PolicyFeature(FeatureType.STATE, (14,))},
        {"observation.images.wrist": square},
        {"observation.images.eih": PolicyFeature(FeatureType.VISUAL, (3, 28, 20))},
        {
            "observation.images.eih": square,
            "observation.state": PolicyFeature(FeatureType.STATE, (6,)),
        },
    ):
        config = HvsConfig(input_features=inputs, output_features=action, device="cpu")
        with pytest.raises(ValueError, match="observation"):
            config.validate_features()
    with pytest.raises(ValueError, match="channels"):
        HvsConfig(channels=0, device="cpu")
