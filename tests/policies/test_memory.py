"""The policy's memory: where a camera last saw the target stands in while it does not; how high the
target lies, from all looks at its size; and where the arm has been sent already."""

import numpy as np
import pytest
import torch

import hvs_suite
from hvs_suite.cell.robot import JOINT_RANGE_RAD, JOINT_SPEED_RAD_S
from hvs_suite.datasets.expert import Expert
from hvs_suite.datasets.looking import LOOK_OUT_RAD
from hvs_suite.policies.imitation.remembered import remembered
from hvs_suite.policies.network.geometry import Calibration, calibrate, flange_motion
from hvs_suite.policies.network.network import HEIGHT_SUMS, SET_POINT, HvsNetwork, Shape, Sighting

CAMERAS = {"eih": (3, 28), "eth": (3, 28)}
PLACE = torch.tensor([[0.4, 0.3, 0.0, 1.0]])
OTHER = torch.tensor([[-0.5, 0.1, 0.0, 1.0]])
NEVER = torch.zeros(1, 4)
BENT = torch.tensor([[0.0, 0.6, 0.0, -1.4, 0.0, 1.1, 0.0]])
NOTHING = torch.zeros(1, 10)


def network(
    visible_logit: float, eth_logit: float | None = None, from_set_point: bool = False
) -> HvsNetwork:
    """A network whose eyes are sure that they see the target, or that they do not."""
    torch.manual_seed(0)
    shape = Shape(CAMERAS, 14, channels=8, hidden=32, from_set_point=from_set_point)
    net = HvsNetwork(shape).eval()
    with torch.no_grad():
        for name, eye in net.eyes.items():
            sure = visible_logit if name == "eih" or eth_logit is None else eth_logit
            eye.judge[-1].bias[3] = sure
    return net


def look(net: HvsNetwork, *memory: torch.Tensor):
    """What the network makes of an empty scene, the arm bent so that the hand looks down."""
    images = {name: torch.full((1, 3, 28, 28), 0.5) for name in CAMERAS}
    state = torch.cat([BENT, torch.zeros(1, 7)], dim=1)
    with torch.no_grad():
        return net(images, state, torch.cat([*memory, NOTHING], dim=1) if memory else None)


@pytest.mark.parametrize("memory", [(PLACE, PLACE), (PLACE, NEVER), (NEVER, PLACE)])
def test_a_hidden_target_is_taken_to_be_where_it_was_last_seen(memory):
    decision = look(network(-20.0), *memory)
    torch.testing.assert_close(decision.target, PLACE[:, :3], atol=1e-4, rtol=0.0)
    torch.testing.assert_close(decision.memory[:, :8], torch.cat(memory, dim=1))


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
    assert not look(network(-20.0)).memory[:, :10].any()


@pytest.mark.parametrize(
    ("visible_logit", "memory", "goes_to_look"),
    [(-20.0, (NEVER, NEVER), True), (20.0, (NEVER, NEVER), False), (-20.0, (NEVER, PLACE), False)],
)
def test_until_a_camera_has_seen_the_target_the_arm_goes_to_look_for_it(
    visible_logit, memory, goes_to_look
):
    net = network(visible_logit)
    target = BENT + net.to_step(look(net, *memory).out)
    left, turn = torch.tensor(LOOK_OUT_RAD, dtype=torch.float32) - BENT, target - BENT
    as_fast_as_it_can = 0.125 * torch.tensor(JOINT_SPEED_RAD_S, dtype=torch.float32)
    there = left.sign() * torch.minimum(left.abs(), as_fast_as_it_can)
    assert torch.allclose(turn, there, atol=1e-4) == goes_to_look
    # The head learns from labels all the same, whatever its eyes can see by then.
    decision = look(net.train(), *memory)
    assert not torch.allclose(net.to_step(decision.out), there, atol=1e-2)


def test_the_set_point_moves_towards_each_action_as_fast_as_the_joints_may():
    net = network(-20.0)
    memory = look(net, NEVER, NEVER).memory
    torch.testing.assert_close(memory[:, SET_POINT], BENT)
    ranges, speeds = (torch.tensor(x).float() for x in (JOINT_RANGE_RAD, JOINT_SPEED_RAD_S))
    near = net.commanded(memory, (BENT + 0.01) / ranges)
    torch.testing.assert_close(near[:, SET_POINT], BENT + 0.01)
    far = net.commanded(near, torch.ones(1, 7))
    torch.testing.assert_close(far[:, SET_POINT], BENT + 0.01 + 0.1 * speeds)
    # What else is remembered stays.
    torch.testing.assert_close(far[:, :10], memory[:, :10])
    assert far[0, -1] == 1.0


@pytest.mark.parametrize("from_set_point", [False, True])
def test_an_arm_that_is_on_its_way_already_is_not_sent_there_again(from_set_point):
    """Steps are measured from where the arm will be: with latency it has not even begun to move."""
    net = network(-20.0, from_set_point=from_set_point)
    with torch.no_grad():
        net.head[-1].weight.zero_()
        for name, parameter in net.named_parameters():
            if name.endswith(("step_gain", "stride_gain")):
                parameter.zero_()
        (net.step_gain if from_set_point else net.onward_step_gain).fill_(1.0)

    def goes_to(set_point: torch.Tensor) -> torch.Tensor:
        memory = torch.cat([PLACE, PLACE, NOTHING[:, :2], set_point, torch.ones(1, 1)], dim=1)
        images = {name: torch.full((1, 3, 28, 28), 0.5) for name in CAMERAS}
        state = torch.cat([BENT, torch.zeros(1, 7)], dim=1)
        with torch.no_grad():
            decision = net(images, state, memory)
            return net.origin(state, decision.memory) + net.to_step(decision.out)

    def distance(q: torch.Tensor) -> float:
        goal = PLACE[:, :3] + torch.tensor([[0.0, 0.0, 0.05]])
        return float((flange_motion(q).position - goal).norm())

    once = goes_to(BENT)
    again = goes_to(once)
    assert distance(again) < distance(once) < distance(BENT)


@pytest.mark.parametrize("height_m", [-0.001, 0.0, 0.0008])
def test_the_height_of_the_target_is_the_mean_of_what_its_size_says(height_m):
    """Looks from the goal count; one from far away, where a pixel is centimetres, does not."""
    net = network(20.0)
    net.set_calibration(Calibration(np.eye(3), np.eye(3), 0.0, 0.05, 0.01, 0.05))
    down = torch.tensor([[0.0, 0.6, 0.0, -1.4, 0.0, torch.pi - 0.6 - 1.4, 0.0]])
    motion = flange_motion(down)
    motion.position[:, 2] = 0.05

    def see(distance_m: float, sums: torch.Tensor) -> tuple[float, torch.Tensor]:
        log_diameter = torch.tensor([[0.01 / distance_m]]).log()
        sure = torch.full((1, 1), 6.0)
        sighting = Sighting(torch.zeros(1, 2), log_diameter, sure, sure)
        _, height, sums = net._height(motion, sighting, sums)
        return height.item(), sums

    sums = torch.zeros(1, 2)
    beliefs = []
    for _ in range(20):
        height, sums = see(0.05 - height_m, sums)
        beliefs.append(height)
    assert beliefs[0] == pytest.approx(0.5 * height_m, abs=0.1 * abs(height_m) + 1e-6)
    assert beliefs[-1] == pytest.approx(height_m, abs=0.1 * abs(height_m) + 1e-6)
    motion.position[:, 2] = 0.4
    assert see(0.405, sums)[0] == pytest.approx(beliefs[-1], abs=1e-5)


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
    memory = remembered(columns, ["eih", "eth"], calibration, np.random.default_rng(0))
    assert memory.shape == (n, 18)
    assert not memory[:, :4].any()
    np.testing.assert_array_equal(memory[:, 7], [0, 0, 1, 1, 0, 0, 0, 1])
    assert not memory[memory[:, 7] == 0].any()
    for frame, place in ((2, [0.4, 0.0]), (7, [0.65, 0.25])):
        off = memory[frame, 4:6] - place
        assert 0 < np.abs(off).max() < 0.01
        assert memory[frame, 6] == np.float32(0.02)
    # One sighting is one error, however long it is remembered.
    np.testing.assert_array_equal(memory[2], memory[3])


def expert_columns(task: str, **options: object) -> dict[str, np.ndarray]:
    """What is recorded of the expert's episodes, and the true joints besides."""
    rows = []
    with hvs_suite.load(task, split="train", observations="state", **options) as env:
        expert = Expert(env)
        for scenario in range(30):
            time_step = env.reset(scenario=scenario)
            while not time_step.last():
                action = expert.label()
                rows.append(
                    {
                        "episode_index": scenario,
                        "measured": time_step.observation["joint_positions"],
                        "executed": action,
                        "set_point": env.setpoint,
                        **env.privileged(),
                    }
                )
                time_step = env.step(action)
    return {name: np.array([row[name] for row in rows]) for name in rows[0]}


def recalled(column: dict[str, np.ndarray]) -> np.ndarray:
    """What a policy would remember at each of these frames."""
    q = column["measured"]
    calibration = calibrate(
        q=q,
        goal_position=column["goal_position"],
        goal_normal=column["goal_normal"],
        standoff_m=0.05,
        target_eih=column["target_eih"],
        target_eth=column["target_eth"],
    )
    columns = {
        "episode_index": column["episode_index"],
        "observation.state": np.concatenate([q, 0 * q], 1).astype(np.float32),
        "privileged.action_executed": column["executed"],
        "privileged.target_eih": column["target_eih"],
        "privileged.target_eth": column["target_eth"],
    }
    return remembered(columns, ["eih", "eth"], calibration, np.random.default_rng(0))


def test_what_is_remembered_is_where_the_target_is():
    """Of cameras that stand where they should, seen on the expert's ways."""
    column = expert_columns("align-thesis")
    memory = recalled(column)
    for slot, usual_m in ((memory[:, :4], 0.006), (memory[:, 4:8], 0.006)):
        known = slot[:, 3] > 0
        assert known.sum() > 10
        off = np.linalg.norm(slot[known, :3] - column["target_position"][known], axis=1)
        assert 0 < np.median(off) < usual_m
        assert off.max() < 0.05


@pytest.mark.parametrize(("task", "latency"), [("align-thesis", 0), ("align-drill", 1)])
def test_where_the_arm_has_been_sent_is_remembered_also_what_it_has_not_begun_to_do(task, latency):
    column = expert_columns(task)
    memory = recalled(column)
    number = np.concatenate(
        [np.arange(n) for n in np.unique(column["episode_index"], return_counts=True)[1]]
    )
    np.testing.assert_array_equal(memory[:, -1], number > 0)
    # What the encoders call it differs from what is true by their zero errors.
    off = column["measured"] - column["joint_positions"]
    sent = memory[:, SET_POINT] - off
    later = np.flatnonzero(number > latency)
    np.testing.assert_allclose(sent[later - latency], column["set_point"][later], atol=1e-5)


def test_to_stay_where_the_arm_is_sent_is_no_step_at_all_however_far_it_has_yet_to_go():
    net = network(-20.0, from_set_point=True)
    ahead = BENT + 0.35 * torch.eye(7)[2]
    memory = torch.cat([PLACE, PLACE, NOTHING[:, :2], ahead, torch.ones(1, 1)], dim=1)
    images = {name: torch.full((1, 3, 28, 28), 0.5) for name in CAMERAS}
    state = torch.cat([BENT, torch.zeros(1, 7)], dim=1)
    with torch.no_grad():
        origin = net.origin(state, net(images, state, memory).memory)
    ranges = torch.tensor(JOINT_RANGE_RAD, dtype=torch.float32)
    torch.testing.assert_close(
        net.encode_label(ahead / ranges, origin), torch.zeros(1, 7), atol=1e-3, rtol=0.0
    )
    torch.testing.assert_close(net.to_action(torch.zeros(1, 7), origin), ahead / ranges)


def test_the_height_that_joint_offsets_hide_shows_in_what_is_remembered():
    """At the end of an episode, of the encoders' error in height three quarters are known."""
    column = expert_columns("align-drill")
    memory = recalled(column)
    last = np.diff(column["episode_index"], append=-1) != 0
    heights = memory[last, HEIGHT_SUMS]
    known = heights[:, 0] / (heights[:, 1] + 1.0)
    measured = flange_motion(torch.from_numpy(column["measured"][last])).position[:, 2].numpy()
    true = flange_motion(torch.from_numpy(column["joint_positions"][last])).position[:, 2].numpy()
    hidden = measured - true
    assert np.abs(hidden).max() > 5e-4
    assert np.std(hidden - known) < 0.5 * np.std(hidden)
