"""The policy's memory: where a camera last saw the target stands in while it does not."""

import numpy as np
import pytest
import torch

import hvs_suite
from hvs_suite.cell.robot import JOINT_SPEED_RAD_S
from hvs_suite.datasets.expert import Expert
from hvs_suite.datasets.looking import LOOK_OUT_RAD
from hvs_suite.policies.demonstrations import remembered_targets
from hvs_suite.policies.hvs.geometry import Calibration, calibrate
from hvs_suite.policies.hvs.network import HvsNetwork, Shape

CAMERAS = {"eih": (3, 28), "eth": (3, 28)}
PLACE = torch.tensor([[0.4, 0.3, 0.0, 1.0]])
OTHER = torch.tensor([[-0.5, 0.1, 0.0, 1.0]])
NEVER = torch.zeros(1, 4)


def network(visible_logit: float, eth_logit: float | None = None) -> HvsNetwork:
    """A network whose eyes are sure that they see the target, or that they do not."""
    torch.manual_seed(0)
    net = HvsNetwork(Shape(CAMERAS, 14, channels=8, hidden=32)).eval()
    with torch.no_grad():
        for name, eye in net.eyes.items():
            sure = visible_logit if name == "eih" or eth_logit is None else eth_logit
            eye.judge[-1].bias[3] = sure
    return net


def look(net: HvsNetwork, *memory: torch.Tensor):
    """What the network makes of an empty scene, the arm bent so that the hand looks down."""
    images = {name: torch.full((1, 3, 28, 28), 0.5) for name in CAMERAS}
    state = torch.zeros(1, 14)
    state[0, [1, 3, 5]] = torch.tensor([0.6, -1.4, 1.1])
    with torch.no_grad():
        return net(images, state, torch.cat(memory, dim=1) if memory else None)


@pytest.mark.parametrize("memory", [(PLACE, PLACE), (PLACE, NEVER), (NEVER, PLACE)])
def test_a_hidden_target_is_taken_to_be_where_it_was_last_seen(memory):
    decision = look(network(-20.0), *memory)
    torch.testing.assert_close(decision.target, PLACE[:, :3], atol=1e-4, rtol=0.0)
    torch.testing.assert_close(decision.memory, torch.cat(memory, dim=1))


def test_a_seen_target_replaces_the_memory_and_is_not_swayed_by_it():
    net = network(20.0)
    fresh, late = look(net), look(net, PLACE, OTHER)
    torch.testing.assert_close(fresh.target, late.target, atol=1e-6, rtol=0.0)
    torch.testing.assert_close(fresh.memory, late.memory, atol=1e-6, rtol=0.0)
    assert fresh.memory[0, 3] == fresh.memory[0, 7] == 1.0


def test_a_camera_replaces_its_own_memory_alone():
    """What the eye in hand saw is not lost to what the eye to hand sees now."""
    decision = look(network(-20.0, eth_logit=20.0), PLACE, OTHER)
    torch.testing.assert_close(decision.memory[:, :4], PLACE)
    assert not torch.allclose(decision.memory[:, 4:7], OTHER[:, :3], atol=0.01)
    # Both count, one by what it remembers, the other by what it sees; training says how much.
    net = network(-20.0, eth_logit=20.0)
    with torch.no_grad():
        net.memory_trust[0] = 20.0
    torch.testing.assert_close(look(net, PLACE, OTHER).target, PLACE[:, :3], atol=1e-4, rtol=0.0)


def test_nothing_is_remembered_before_anything_was_seen():
    assert not look(network(-20.0)).memory.any()


@pytest.mark.parametrize(
    ("visible_logit", "memory", "goes_to_look"),
    [(-20.0, (NEVER, NEVER), True), (20.0, (NEVER, NEVER), False), (-20.0, (NEVER, PLACE), False)],
)
def test_until_a_camera_has_seen_the_target_the_arm_goes_to_look_for_it(
    visible_logit, memory, goes_to_look
):
    net = network(visible_logit)
    bent = torch.tensor([[0.0, 0.6, 0.0, -1.4, 0.0, 1.1, 0.0]])
    target = bent + net.to_step(look(net, *memory).out)
    left, turn = torch.tensor(LOOK_OUT_RAD, dtype=torch.float32) - bent, target - bent
    as_fast_as_it_can = 0.125 * torch.tensor(JOINT_SPEED_RAD_S, dtype=torch.float32)
    there = left.sign() * torch.minimum(left.abs(), as_fast_as_it_can)
    assert torch.allclose(turn, there, atol=1e-4) == goes_to_look
    # The head learns from labels all the same, whatever its eyes can see by then.
    decision = look(net.train(), *memory)
    assert not torch.allclose(net.to_step(decision.out), there, atol=1e-2)


def test_training_remembers_what_each_camera_saw_earlier_in_the_same_episode_alone():
    n = 8
    seen = np.zeros((n, 4), np.float32)
    seen[[1, 6], 3] = 1.0  # second frame of the first episode, third of the second
    seen[6, :2] = 0.5
    never = np.zeros((n, 4), np.float32)
    columns = {
        "episode_index": np.repeat([3, 4], 4),
        "observation.state": np.zeros((n, 14), np.float32),
        "privileged.target_eih": never,
        "privileged.target_eth": seen,
    }
    # The eye to hand maps its image onto a square metre around x = 0.4.
    homography = np.array([[0.5, 0.0, 0.4], [0.0, 0.5, 0.0], [0.0, 0.0, 1.0]])
    calibration = Calibration(np.eye(3), homography, 0.02, 0.05, 0.1, 0.07)
    memory = remembered_targets(columns, ["eih", "eth"], calibration, np.random.default_rng(0))
    assert memory.shape == (n, 8)
    assert not memory[:, :4].any()
    np.testing.assert_array_equal(memory[:, 7], [0, 0, 1, 1, 0, 0, 0, 1])
    assert not memory[memory[:, 7] == 0].any()
    for frame, place in ((2, [0.4, 0.0]), (7, [0.65, 0.25])):
        off = memory[frame, 4:6] - place
        assert 0 < np.abs(off).max() < 0.01
        assert memory[frame, 6] == np.float32(0.02)
    # One sighting is one error, however long it is remembered.
    np.testing.assert_array_equal(memory[2], memory[3])


def test_what_is_remembered_is_where_the_target_is():
    """Of cameras that stand where they should, seen on the expert's ways."""
    rows = []
    with hvs_suite.load("align-thesis", split="train", observations="state") as env:
        expert = Expert(env)
        for scenario in range(30):
            time_step = env.reset(scenario=scenario)
            while not time_step.last():
                rows.append(
                    {"episode_index": scenario, "q": env.joint_positions, **env.privileged()}
                )
                time_step = env.step(expert.label())
    column = {name: np.array([row[name] for row in rows]) for name in rows[0]}
    calibration = calibrate(
        q=column["q"],
        goal_position=column["goal_position"],
        goal_normal=column["goal_normal"],
        standoff_m=0.05,
        target_eih=column["target_eih"],
        target_eth=column["target_eth"],
    )
    columns = {
        "episode_index": column["episode_index"],
        "observation.state": np.concatenate([column["q"], 0 * column["q"]], 1).astype(np.float32),
        "privileged.target_eih": column["target_eih"],
        "privileged.target_eth": column["target_eth"],
    }
    memory = remembered_targets(columns, ["eih", "eth"], calibration, np.random.default_rng(0))
    for slot, usual_m in ((memory[:, :4], 0.006), (memory[:, 4:], 0.006)):
        known = slot[:, 3] > 0
        assert known.sum() > 10
        off = np.linalg.norm(slot[known, :3] - column["target_position"][known], axis=1)
        assert 0 < np.median(off) < usual_m
        assert off.max() < 0.05
