"""The network: what it reads, what it must not read, and the geometry it stands on."""

from pathlib import Path

import miniature
import numpy as np
import pytest
import torch

from hvs_suite.cell.kinematics import kinematics
from hvs_suite.cell.robot import JOINT_RANGE_RAD
from hvs_suite.policies.network import geometry
from hvs_suite.policies.network.compiled import CompiledFeatures, CompiledNetwork
from hvs_suite.policies.network.network import (
    FEATURE_SIZE,
    HvsNetwork,
    Shape,
    action_loss,
    flange_loss,
    sighting_loss,
    strides,
)

CAMERAS = {"eih": (3, 28), "eth": (3, 28)}


def network(cameras=CAMERAS, state_dim=14, seed=0, from_set_point=False):
    torch.manual_seed(seed)
    return HvsNetwork(
        Shape(cameras, state_dim, channels=8, hidden=32, from_set_point=from_set_point)
    )


def inputs(cameras=CAMERAS, state_dim=14, n=5):
    generator = torch.Generator().manual_seed(1)
    images = {
        name: torch.rand(n, c, side, side, generator=generator)
        for name, (c, side) in cameras.items()
    }
    state = torch.rand(n, state_dim, generator=generator) - 0.5 if state_dim else None
    return images, state


def test_kinematics_agree_with_pinocchio():
    q = np.random.default_rng(0).uniform(-2.0, 2.0, (20, 7))
    motion = geometry.flange_motion(torch.from_numpy(q))
    for i, configuration in enumerate(q):
        rotation, position = kinematics().flange_pose(configuration)
        np.testing.assert_allclose(motion.rotation[i], rotation, atol=1e-9)
        np.testing.assert_allclose(motion.position[i], position, atol=1e-9)
        np.testing.assert_allclose(
            motion.jacobian[i], kinematics().jacobian(configuration), atol=1e-9
        )


def test_plain_postures_hold_the_flange_over_the_goal_facing_down():
    generator = np.random.default_rng(0)
    angle, radius = generator.uniform(-np.pi, np.pi, 50), generator.uniform(0.4, 0.78, 50)
    goal = np.stack([radius * np.cos(angle), radius * np.sin(angle), np.full(50, 0.05)], axis=1)
    both = geometry.postures(torch.from_numpy(goal))
    assert both.shape == (50, 2, 6)
    for i, pair in enumerate(both.numpy()):
        # The expert's own, with the elbow straight above: the demonstrator's two.
        family = kinematics().goal_configurations_at_tool_angle(
            goal[i], np.array([0.0, 0.0, 1.0]), tool_angle=0.0, n_swivel=1
        )
        for posture in pair:
            q = np.append(posture, 0.0)
            rotation, position = kinematics().flange_pose(q)
            # Where the arm is nearly straight, rounding passes through an arc cosine near one.
            np.testing.assert_allclose(position, goal[i], atol=1e-6)
            np.testing.assert_allclose(rotation[:, 2], [0.0, 0.0, -1.0], atol=1e-6)
            within = (np.abs(q) <= JOINT_RANGE_RAD).all()
            assert within == any(np.abs(q - each).max() < 1e-6 for each in family)


def test_joint_step_brings_the_flange_to_a_near_goal_facing_down():
    poses = kinematics().goal_configurations(np.array([0.5, 0.2, 0.05]), np.array([0.0, 0.0, 1.0]))
    q = torch.from_numpy(poses[:3] + 0.01)
    goal = torch.tensor([0.5, 0.2, 0.05], dtype=torch.float64)
    for _ in range(30):
        motion = geometry.flange_motion(q)
        q = q + geometry.joint_step(motion, goal - motion.position)
    motion = geometry.flange_motion(q)
    np.testing.assert_allclose(motion.position, goal.expand(3, 3), atol=1e-4)
    np.testing.assert_allclose(motion.rotation[:, 2, 2], -np.ones(3), atol=1e-6)


def test_calibration_finds_the_cameras_that_made_the_data():
    rng = np.random.default_rng(0)
    n = 200
    target = np.column_stack([rng.uniform(-0.6, 0.6, (n, 2)), np.zeros(n)])
    q = rng.uniform(-1.0, 1.0, (n, 7))
    motion = geometry.flange_motion(torch.from_numpy(q))
    rays = np.array([[0.0, -0.7, 0.01], [0.7, 0.0, -0.02], [0.0, 0.0, 1.0]])
    offset = np.einsum("nji,nj->ni", motion.rotation.numpy(), target - motion.position.numpy())
    uv_eih = (offset @ np.linalg.inv(rays).T)[:, :2]
    uv_eih /= (offset @ np.linalg.inv(rays).T)[:, 2:]
    homography = np.array([[0.0, 0.9, 0.1], [-1.0, 0.1, 0.0], [0.05, 0.1, 1.0]])
    mapped = np.column_stack([target[:, :2], np.ones(n)]) @ np.linalg.inv(homography).T
    seen = np.column_stack([0.04 / offset[:, 2], np.ones(n)])
    found = geometry.calibrate(
        q=q,
        goal_position=target + np.array([0.0, 0.0, 0.05]),
        goal_normal=np.tile([0.0, 0.0, 1.0], (n, 1)),
        standoff_m=0.05,
        target_eih=np.column_stack([uv_eih, seen]),
        target_eth=np.column_stack([mapped[:, :2] / mapped[:, 2:], seen]),
    )
    np.testing.assert_allclose(found.rays, rays, atol=1e-6)
    np.testing.assert_allclose(found.homography, homography, atol=1e-6)
    assert found.plane_height_m == pytest.approx(0.0)
    assert found.size_at_1m == pytest.approx(0.04)
    assert found.lowest_goal_m == pytest.approx(0.05)


def test_going_astray_costs_more_the_nearer_the_goal_and_nothing_where_the_arm_only_swivels():
    motion = geometry.flange_motion(torch.tensor([[0.3, 0.9, 0.1, -0.8, 0.2, 1.0, 0.0]]))
    error = torch.full((1, 7), 0.01)
    losses = [flange_loss(error, motion, torch.tensor([[d]]), 0.005) for d in (0.5, 0.05, 0.0)]
    assert losses[0] < losses[1] < losses[2]
    # The motion that keeps the flange where it is: the null space of the Jacobian.
    swivel = torch.linalg.svd(motion.jacobian)[2][:, -1]
    still = flange_loss(0.1 * swivel, motion, torch.tensor([[0.0]]), 0.005)
    assert still < 0.01 < losses[0]


@pytest.mark.parametrize("state_dim", [0, 7, 14])
@pytest.mark.parametrize("names", [("eih",), ("eth",), ("eih", "eth")])
def test_every_subset_of_inputs_trains_and_acts(names, state_dim):
    cameras = {name: CAMERAS[name] for name in names}
    net = network(cameras, state_dim)
    images, state = inputs(cameras, state_dim)
    decision = net(images, state)
    out, sightings = decision.out, decision.sightings
    assert out.shape == (5, 7)
    assert (decision.target is None) == (state is None)
    truth = torch.tensor([[0.1, 0.2, 0.3, 1.0]]).expand(5, 4)
    loss = action_loss(out, torch.ones(5, 7))
    for sighting in sightings.values():
        loss = loss + sighting_loss(sighting, truth)
    loss.backward()
    assert all(torch.isfinite(p.grad).all() for p in net.parameters() if p.grad is not None)
    origin = None if state is None else net.origin(state, decision.memory)
    action = net.to_action(out, origin)
    assert action.shape == (5, 7)
    assert (action.abs() <= 1.0).all()


@pytest.mark.parametrize(("channels", "side"), [(1, 28), (3, 84), (3, 112), (1, 224), (3, 336)])
def test_every_resolution_and_channel_count_has_about_28_cells(channels, side):
    assert abs(side / np.prod(strides(side)) - FEATURE_SIZE) <= 2
    cameras = {"eth": (channels, side)}
    images, state = inputs(cameras, n=1)
    assert network(cameras)(images, state).out.shape == (1, 7)


def test_the_label_is_what_the_action_decodes_to():
    net = network()
    _, state = inputs()
    assert state is not None
    reachable = state[:, :7] + 0.05 * torch.randn(5, 7, generator=torch.Generator().manual_seed(0))
    action = reachable / torch.tensor(JOINT_RANGE_RAD, dtype=torch.float32)
    decoded = net.to_action(net.encode_label(action, state[:, :7]), state[:, :7])
    torch.testing.assert_close(decoded, action, atol=1e-6, rtol=0.0)


def test_no_action_sends_the_flange_below_where_goals_lie():
    net = network()
    net.lowest_goal.fill_(0.05)
    joint_range = torch.tensor(JOINT_RANGE_RAD, dtype=torch.float32)
    # Elbow bent, the other way round, stretched, and one that stays high enough.
    q = torch.tensor(
        [
            [0.3, 1.2, 0.0, -1.2, 0.0, 0.8, 0.0],
            [-0.8, -1.4, 0.0, 0.8, 0.0, -1.0, 1.0],
            [0.3, 1.5, 0.0, -0.5, 0.0, 1.1, 0.0],
            [0.3, 0.8, 0.0, -1.5, 0.0, 0.8, 0.0],
        ]
    )
    step = 0.25 * torch.tensor([[1.0], [-1.0], [1.0], [1.0]]) * torch.eye(7)[1]
    said = net.encode_label((q + step) / joint_range, q)
    heights = geometry.flange_motion(net.to_action(said, q) * joint_range).position[:, 2]
    assert (geometry.flange_motion(q + step).position[:3, 2] < 0.0).all()
    assert heights[:3].tolist() == pytest.approx([0.04] * 3, abs=2e-3)
    assert heights[3].item() == pytest.approx(0.084, abs=1e-3)


@pytest.mark.parametrize("from_set_point", [False, True])
@pytest.mark.parametrize("state_dim", [7, 14])
@pytest.mark.parametrize("names", [("eih",), ("eth",), ("eih", "eth")])
def test_compiled_the_network_decides_as_before(names, state_dim, from_set_point):
    cameras = {name: CAMERAS[name] for name in names}
    net = network(cameras, state_dim, from_set_point=from_set_point).eval()
    images, state = inputs(cameras, state_dim, n=20)
    assert state is not None
    state[:, [1, 3, 5]] += torch.tensor([0.6, -1.4, 1.1])
    # Half of the postures are too low, so that both ways out are taken.
    net.lowest_goal.copy_(geometry.flange_motion(state[:, :7]).position[:, 2].median())
    compiled, features, memory = CompiledNetwork(net), CompiledFeatures(net), None
    raised = []
    with torch.inference_mode():
        for i in range(len(state)):
            seen = {name: image[i : i + 1] for name, image in images.items()}
            memory = None if i % 2 else memory
            decision = net(seen, state[i : i + 1], memory)
            origin = net.origin(state[i : i + 1], decision.memory)
            expected = net.to_action(decision.out, origin)
            made_of = features(seen, state[i : i + 1], memory)
            for made, known in zip(made_of, (decision.features, decision.memory), strict=True):
                torch.testing.assert_close(made, known, atol=1e-6, rtol=0.0)
            action, memory = compiled(seen, state[i : i + 1], memory)
            torch.testing.assert_close(action, expected, atol=1e-6, rtol=0.0)
            after = net.commanded(decision.memory, expected)
            torch.testing.assert_close(memory, after, atol=1e-6, rtol=0.0)
            unbounded = net.to_target(decision.out, origin) / net.joint_range
            raised.append(not torch.allclose(expected, unbounded.clamp(-1.0, 1.0), atol=1e-5))
    assert 0 < sum(raised) < len(raised)


def test_a_few_images_are_learned_by_heart():
    columns = miniature.scene(16)
    net = network()
    images = {
        name: torch.from_numpy(columns[f"observation.images.{name}"]).permute(0, 3, 1, 2) / 255.0
        for name in CAMERAS
    }
    state = torch.from_numpy(columns["observation.state"])
    label = net.encode_label(torch.from_numpy(columns["action"]), state[:, :7])
    truth = {name: torch.from_numpy(columns[f"privileged.target_{name}"]) for name in CAMERAS}
    optimizer = torch.optim.AdamW(net.parameters(), lr=3e-3)
    losses = []
    for _ in range(250):
        decision = net(images, state)
        loss = action_loss(decision.out, label)
        for name, sighting in decision.sightings.items():
            loss = loss + sighting_loss(sighting, truth[name])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
        losses.append(loss.item())
    assert losses[-1] < 0.15 * losses[0]


def test_the_network_needs_no_lerobot(tmp_path: Path):
    import subprocess
    import sys

    code = (
        "import sys; import hvs_suite.policies.checkpoints.loading, hvs_suite.policies.catalogue;"
        "sys.exit(any(m.split('.')[0] in ('lerobot', 'datasets') for m in sys.modules))"
    )
    assert subprocess.run([sys.executable, "-c", code], cwd=tmp_path).returncode == 0
