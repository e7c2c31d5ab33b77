"""What stands around: how the table is taken up, and how the head weighs ways through it."""

import contextlib

import numpy as np
import pytest
import torch

import hvs_suite
from hvs_suite.cell.kinematics import kinematics
from hvs_suite.cell.solid import obstacle_distance
from hvs_suite.datasets.features import STATE, observed_part
from hvs_suite.datasets.looking import Demonstrator
from hvs_suite.policies.belief.belief import PLACE
from hvs_suite.policies.belief.cell_model import cell_model
from hvs_suite.policies.belief.eye import SIGHTING_SIZE
from hvs_suite.policies.belief.geometry import along_links
from hvs_suite.policies.belief.network import BeliefNetwork, Shape
from hvs_suite.policies.belief.surroundings import (
    BOX,
    CELLS,
    HALF_M,
    SIZE,
    SurroundingsEye,
    blocked,
    surroundings_loss,
    taken_up,
)

TASK = "clutter-obstacles"
CAMERAS = {"eih": (3, 112), "eth": (3, 336)}


def cell_of(x: float, y: float) -> tuple[int, int]:
    """Row and column of the grid that a place is in."""
    column, row = (int((each + HALF_M) / (2.0 * HALF_M) * CELLS) for each in (x, y))
    return row, column


def said_of(boxes: torch.Tensor) -> torch.Tensor:
    """What a perfect eye says of boxes, (B, SIZE)."""
    true = taken_up(boxes)
    there = torch.where(true[:, 1:] > 0.0, 12.0, -12.0)
    return torch.cat([there, true], dim=1).flatten(1)


def test_a_post_and_a_beam_take_up_the_heights_that_they_have() -> None:
    post = torch.tensor([0.4, -0.2, 0.1, 0.03, 0.03, 0.1, 0.3])
    beam = torch.tensor([-0.3, 0.5, 0.4, 0.2, 0.03, 0.02, np.pi / 2])
    none = torch.zeros(BOX)
    under, top = taken_up(torch.stack([post, beam, none])[None])[0]
    assert (under[cell_of(0.4, -0.2)], top[cell_of(0.4, -0.2)]) == pytest.approx((0.0, 0.2))
    along = cell_of(-0.3, 0.6)  # turned by a quarter, the beam lies along y
    assert (under[along], top[along]) == pytest.approx((0.38, 0.42))
    assert top[cell_of(-0.15, 0.5)] == 0.0
    assert top[cell_of(0.0, 0.0)] == 0.0


def test_a_ball_meets_a_beam_and_passes_under_and_over_it() -> None:
    said = said_of(torch.tensor([[[-0.3, 0.5, 0.4, 0.2, 0.1, 0.02, 0.0]]]))
    points = torch.tensor([[[-0.3, 0.5, z] for z in (0.1, 0.4, 0.7)] + [[0.5, 0.0, 0.4]]])
    met = blocked(said, points, 0.08)[0]
    assert met[1] > 0.8
    assert met[[0, 2, 3]].max() < 0.05


def test_a_recording_says_where_obstacles_stand() -> None:
    with contextlib.closing(hvs_suite.load(TASK, split="dev", observations="state")) as env:
        env.reset(scenario=0)
        boxes = torch.from_numpy(env.privileged()["obstacles"]).float().view(1, -1, BOX)
        top = taken_up(boxes)[0, 1]
        for solid in env.obstacles:
            x, y, z = solid.centre
            assert top[cell_of(x, y)] >= z + solid.half[2] - 1e-6
        assert (boxes[0, :, 5] > 0).sum() == len(env.obstacles)


def test_what_an_eye_learns_of_some_places_holds_for_others() -> None:
    cell = cell_model(hvs_suite.load(TASK, split="dev", observations="state").spec)
    torch.manual_seed(0)
    eye = SurroundingsEye(8, cell.tan["eth"], cell.eth_origin, cell.eth_rotation)

    def scenes(n: int) -> tuple[torch.Tensor, torch.Tensor, list[tuple[int, int]]]:
        """Features that mark where the camera sees the foot of a post, and the post."""
        maps, boxes, cells = torch.zeros(n, 28, 28, 8), torch.zeros(n, 1, BOX), []
        for each, box in zip(maps, boxes, strict=True):
            x, y = (0.5 * (2.0 * torch.rand(2) - 1.0)).tolist()
            row, column = cell_of(x, y)
            u, v = (13.5 + 14.0 * eye.at[0, row, column]).round().long().tolist()
            each[v - 1 : v + 2, u - 1 : u + 2, 0] = 1.0
            box[0] = torch.tensor([x, y, 0.15, 0.04, 0.04, 0.15, 0.0])
            cells.append((row, column))
        return maps, boxes, cells

    optimizer = torch.optim.AdamW(eye.parameters(), 3e-3)
    for _ in range(200):
        maps, boxes, _ = scenes(16)
        loss = surroundings_loss(eye(maps), boxes)
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    maps, boxes, cells = scenes(16)
    with torch.no_grad():
        logits, _, top = eye(maps).view(16, 3, CELLS, CELLS).unbind(dim=1)
    there = [float(each[at]) for each, at in zip(logits, cells, strict=True)]
    high = [float(each[at]) for each, at in zip(top, cells, strict=True)]
    assert np.mean(np.array(there) > 0.0) > 0.8
    assert (logits > 0.0).float().mean() < 0.03
    assert np.median(high) == pytest.approx(0.3, abs=0.05)


def network_for(env: "hvs_suite.Environment") -> BeliefNetwork:
    torch.manual_seed(0)
    shape = Shape(CAMERAS, hidden=8, obstacles=("eth",))
    network = BeliefNetwork(shape, cell_model(env.spec))
    network.belief.standoff.fill_(0.0)
    return network


def test_points_along_the_arm_end_at_the_flange() -> None:
    q = torch.tensor(np.random.default_rng(0).uniform(-1.5, 1.5, (5, 7)))
    points = along_links(q)
    for each, angles in zip(points, q.numpy(), strict=True):
        np.testing.assert_allclose(each[-1], kinematics().flange_pose(angles)[1], atol=1e-9)


def test_a_way_through_an_obstacle_is_weighed_less() -> None:
    with contextlib.closing(hvs_suite.load(TASK, split="dev", observations="state")) as env:
        time_step = env.reset(scenario=0)
        network = network_for(env)
        state = torch.from_numpy(observed_part(env.spec, time_step.observation, env)[STATE])[None]
        free = torch.cat([torch.zeros(1, SIGHTING_SIZE), torch.full((1, SIZE), -12.0)], dim=1)
        # A block all over the table, to above the arm's reach.
        full = torch.tensor([[[0.0, 0.0, 0.8, 0.9, 0.9, 0.8, 0.0]]])
        filled = torch.cat([torch.zeros(1, SIGHTING_SIZE), said_of(full)], dim=1)
        memory = network.start(1)
        nothing = {"eih": torch.zeros(1, SIGHTING_SIZE)}
        with torch.no_grad():
            memory = network.remember(memory, {**nothing, "eth": free}, state[:, :7])
            memory[:, PLACE] = torch.tensor(env.goal().target)
            joints, ways = state[:, :7], torch.zeros(1, 2, 7)
            ways[0, 1, 1] = 1.2
            assert network._meets({**nothing, "eth": free}, joints, ways).max() < 1e-3
            assert network._meets({**nothing, "eth": filled}, joints, ways).min() > 0.9
            first = network.decide(memory, {**nothing, "eth": free}, state)
            assert first.proposals.shape[1] == first.weights.shape[1] == 13


def test_the_head_is_shown_the_way_that_the_demonstrator_takes_around_obstacles() -> None:
    """Where the straight ways are blocked, too: it leads through postures that the head knows."""
    detours = 0
    with contextlib.closing(hvs_suite.load(TASK, split="dev", observations="state")) as env:
        network = network_for(env)
        demonstrator = Demonstrator(env)
        for scenario in range(12):
            time_step = env.reset(scenario=scenario)
            demonstrator.reset()
            network.belief.standoff.fill_(env.goal().standoff_m)
            unseen = {n: torch.zeros(1, network.sighting_size(n)) for n in CAMERAS}
            memory = network.start(1)
            distance = obstacle_distance(env.obstacles)
            for _ in range(6):
                state = torch.from_numpy(
                    observed_part(env.spec, time_step.observation, env)[STATE]
                )[None]
                action = torch.from_numpy(np.asarray(demonstrator.label(), np.float32))[None]
                with torch.no_grad():
                    memory = network.remember(memory, unseen, state[:, :7])
                    memory[:, PLACE] = torch.tensor(env.goal().target)
                    decision = network.decide(memory, unseen, state)
                label = network.encode_label(action, memory)[0]
                off = (network.to_step(decision.proposals[0]) - network.to_step(label))[:, :-1]
                near = off.abs().amax(dim=1)
                detours += int(near[1:3].min() > 0.01 and near.min() < 0.01)
                memory = network.commanded(memory, action)
                time_step = env.step(action[0].numpy())
                assert distance(env.joint_positions) > 0.0
    assert detours > 0
