"""The policy's memory: where the target was last seen stands in while the arm hides it."""

import numpy as np
import torch

from hvs_suite.policies.demonstrations import remembered_targets
from hvs_suite.policies.hvs.network import HvsNetwork, Shape

CAMERAS = {"eih": (3, 28), "eth": (3, 28)}
PLACE = torch.tensor([[0.4, 0.3, 0.0, 1.0]])


def network(visible_logit: float) -> HvsNetwork:
    """A network whose eyes are sure that they see the target, or that they do not."""
    torch.manual_seed(0)
    net = HvsNetwork(Shape(CAMERAS, 14, channels=8, hidden=32)).eval()
    with torch.no_grad():
        for eye in net.eyes.values():
            eye.judge[-1].bias[3] = visible_logit
    return net


def look(net: HvsNetwork, memory: torch.Tensor | None):
    images = {name: torch.full((1, 3, 28, 28), 0.5) for name in CAMERAS}
    with torch.no_grad():
        return net(images, torch.zeros(1, 14), memory)


def test_a_hidden_target_is_taken_to_be_where_it_was_last_seen():
    decision = look(network(-20.0), PLACE)
    torch.testing.assert_close(decision.target, PLACE[:, :3], atol=1e-6, rtol=0.0)
    torch.testing.assert_close(decision.memory, PLACE)


def test_a_seen_target_replaces_the_memory_and_is_not_swayed_by_it():
    net = network(20.0)
    fresh, late = look(net, None), look(net, PLACE)
    torch.testing.assert_close(fresh.target, late.target, atol=1e-6, rtol=0.0)
    torch.testing.assert_close(late.memory[:, :3], late.target, atol=1e-6, rtol=0.0)
    assert fresh.memory[0, 3] == late.memory[0, 3] == 1.0


def test_nothing_is_remembered_before_anything_was_seen():
    assert not look(network(-20.0), None).memory.any()


def test_training_remembers_what_was_seen_earlier_in_the_same_episode_alone():
    n = 8
    goal = np.tile([0.5, 0.2, 0.05], (n, 1)).astype(np.float32)
    goal[4:, 0] = -0.5
    seen = np.zeros((n, 4), np.float32)
    seen[[1, 6], 3] = 1.0  # second frame of the first episode, third of the second
    columns = {
        "episode_index": np.repeat([3, 4], 4),
        "observation.state": np.zeros((n, 14), np.float32),
        "privileged.goal_position": goal,
        "privileged.goal_normal": np.tile(np.float32([0, 0, 1]), (n, 1)),
        "privileged.target_eth": seen,
    }
    memory = remembered_targets(columns, 0.05, np.random.default_rng(0))
    np.testing.assert_array_equal(memory[:, 3], [0, 0, 1, 1, 0, 0, 0, 1])
    assert not memory[memory[:, 3] == 0].any()
    known = memory[:, 3] == 1
    off = memory[known, :3] - (goal - [0, 0, 0.05])[known]
    assert 0 < np.abs(off[:, :2]).max() < 0.02
    np.testing.assert_allclose(off[:, 2], 0.0, atol=1e-6)
    # One sighting is one error, however long it is remembered.
    np.testing.assert_array_equal(memory[2], memory[3])
