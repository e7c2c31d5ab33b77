"""The head: what it chooses from while no camera has seen the target, and what it answers."""

import math

import numpy as np
import pytest
import torch
import torch.nn.functional as F  # noqa: N812

import hvs_suite
from hvs_suite.datasets.features import STATE, observed_part
from hvs_suite.datasets.flyover import OVER_M
from hvs_suite.datasets.looking import Demonstrator
from hvs_suite.policies.belief import arm
from hvs_suite.policies.belief.belief import PLACE, TILT
from hvs_suite.policies.belief.cell_model import cell_model
from hvs_suite.policies.belief.eye import SIGHTING_SIZE
from hvs_suite.policies.belief.geometry import flange_motion
from hvs_suite.policies.belief.network import LEAN_SCALE, MOST_LEAN, BeliefNetwork, Shape

LEAN = math.radians(20.0)
UNSEEN = 5  # of the dev split: the arm, upright, hides the target from the eye to hand


def test_an_arm_that_sees_nothing_is_shown_the_way_to_where_it_looks_from() -> None:
    env = hvs_suite.load("align-thesis", split="dev", observations="state")
    network = BeliefNetwork(Shape({"eih": (3, 64), "eth": (3, 64)}, hidden=8), cell_model(env.spec))
    demonstrator = Demonstrator(env)
    time_step = env.reset(scenario=UNSEEN)
    memory, unseen = network.start(1), {n: torch.zeros(1, SIGHTING_SIZE) for n in ("eih", "eth")}
    steps = 0
    while not any(env.privileged()[f"target_{name}"][3] for name in ("eih", "eth")):
        state = torch.from_numpy(observed_part(env.spec, time_step.observation, env)[STATE])[None]
        action = torch.from_numpy(np.asarray(demonstrator.label(), np.float32))[None]
        with torch.no_grad():
            memory = network.remember(memory, unseen, state[:, :7])
            proposals = network.decide(memory, unseen, state).proposals[0]
        label = network.encode_label(action, memory)[0]
        off = (network.to_step(proposals) - network.to_step(label)).abs().amax(dim=1)
        assert off.min() < 1e-5
        memory = network.commanded(memory, action)
        time_step = env.step(action[0].numpy())
        steps += 1
    assert steps > 3


def test_among_obstacles_the_head_is_shown_the_way_up_and_over_and_down() -> None:
    env = hvs_suite.load("clutter-obstacles", split="dev", observations="state")
    cell = cell_model(env.spec)
    assert cell.over_m == OVER_M
    assert cell_model(hvs_suite.TASKS["clutter-choice"]).over_m is None
    network = BeliefNetwork(Shape({"eih": (3, 64), "eth": (3, 64)}, hidden=8), cell)
    demonstrator = Demonstrator(env)
    network.belief.standoff.fill_(env.spec.standoff_m)
    unseen = {n: torch.zeros(1, SIGHTING_SIZE) for n in network.shape.cameras}
    shown = []
    for scenario in range(3):
        time_step = env.reset(scenario=scenario)
        goal, memory = env.goal(), network.start(1)
        demonstrator.reset()
        while np.linalg.norm(env.tip().position - goal.position) > 0.05:
            state = torch.from_numpy(observed_part(env.spec, time_step.observation, env)[STATE])
            action = torch.from_numpy(np.asarray(demonstrator.label(), np.float32))[None]
            with torch.no_grad():
                memory = network.remember(memory, unseen, state[None, :7])
                memory[:, PLACE] = torch.tensor(goal.target)
                proposals = network.decide(memory, unseen, state[None]).proposals[0]
            label = network.encode_label(action, memory)[0]
            off = (network.to_step(proposals) - network.to_step(label)).abs().amax(dim=1)
            shown.append(float(off.min()))
            memory = network.commanded(memory, action)
            time_step = env.step(action[0].numpy())
    assert len(shown) > 30
    assert np.mean(np.array(shown) < 0.01) > 0.8


def test_a_head_that_sees_slopes_is_shown_the_way_to_where_the_tool_leans() -> None:
    env = hvs_suite.load("surface-hard", split="dev", observations="state")
    cameras = {"eih": (3, 112), "eth": (3, 512)}
    shape = Shape(cameras, hidden=8, slopes=("eih",), slopes_by="colour")
    network = BeliefNetwork(shape, cell_model(env.spec))
    demonstrator = Demonstrator(env)
    time_step = env.reset(scenario=0)
    goal = env.goal()
    network.belief.standoff.fill_(goal.standoff_m)
    memory, unseen = network.start(1), {n: torch.zeros(1, SIGHTING_SIZE) for n in cameras}
    steps = 0
    while np.linalg.norm(env.tip().position - goal.position) > 0.05:
        state = torch.from_numpy(observed_part(env.spec, time_step.observation, env)[STATE])[None]
        action = torch.from_numpy(np.asarray(demonstrator.label(), np.float32))[None]
        with torch.no_grad():
            memory = network.remember(memory, unseen, state[:, :7])
            memory[:, PLACE] = torch.tensor(goal.target)
            memory[:, TILT] = torch.tensor(goal.normal[:2] / goal.normal[2])
            proposals = network.decide(memory, unseen, state).proposals[0]
        label = network.encode_label(action, memory)[0]
        # The last joint turns by itself.
        off = (network.to_step(proposals) - network.to_step(label))[:, :-1].abs().amax(dim=1)
        assert off.min() < 1e-3, (steps, off)
        memory = network.commanded(memory, action)
        time_step = env.step(action[0].numpy())
        steps += 1
    assert steps > 10
    assert -env.tip().axis @ goal.normal < math.cos(math.radians(30.0))


def test_a_head_that_sees_slopes_can_turn_the_last_joint_and_knows_the_time() -> None:
    torch.manual_seed(0)
    spec = hvs_suite.load("surface-hard", observations="state").spec
    shape = Shape({"eih": (3, 64)}, hidden=8, slopes=("eih",), slopes_by="colour")
    network = BeliefNetwork(shape, cell_model(spec))
    q = torch.tensor([[0.0, 0.6, 0.0, -1.4, 0.0, 1.1, 0.5]])
    state, sightings = F.pad(q, (0, 7)), {"eih": torch.zeros(1, SIGHTING_SIZE)}
    clock = network.guide[0].in_features - 1
    with torch.no_grad():
        # It turns once there have been ten observations.
        network.guide[0].weight.zero_()
        network.guide[0].bias.zero_()
        network.guide[0].weight[0, clock], network.guide[0].bias[0] = 100.0, -105.0
        network.guide[2].weight.zero_()
        network.guide[2].bias.zero_()
        network.guide[2].weight[0, 0] = 1.0
        network.guide[4].weight[9, 0] = 0.2
        memory, turns = network.start(1), []
        for _ in range(15):
            memory = network.remember(memory, sightings, q)
            leaning = network.decide(memory, sightings, state).proposals[0, 1:6, -1]
            turns.append(network.to_step(leaning))
            memory = network.sent_on(memory, q.double())
    assert all(turn.abs().max() < 1e-3 for turn in turns[:10])
    assert all(turn.min() > 0.01 for turn in turns[11:])


def test_no_zero_has_a_sign_because_logs_are_twice_as_long_with_it() -> None:
    spec = hvs_suite.load("align-thesis", observations="state").spec
    network = BeliefNetwork(Shape({"eih": (3, 64)}, hidden=8), cell_model(spec))
    memory = network.sent_on(network.start(1), torch.full((1, 7), -1e-9, dtype=torch.float64))
    action = network.to_action(torch.zeros(1, 7), memory)
    assert (action == 0.0).any()
    assert not torch.signbit(action[action == 0.0]).any()


@pytest.mark.parametrize(
    ("slopes_by", "said"),
    [
        ("contrasts", math.atanh(math.tan(LEAN) / MOST_LEAN)),
        ("colour", math.asinh(math.tan(LEAN) / LEAN_SCALE)),
    ],
)
def test_a_head_that_sees_slopes_can_lean_around_the_target(slopes_by: str, said: float) -> None:
    torch.manual_seed(0)
    spec = hvs_suite.load("surface-tilted", observations="state").spec
    shape = Shape({"eih": (3, 64)}, hidden=8, slopes=("eih",), slopes_by=slopes_by)
    network = BeliefNetwork(shape, cell_model(spec))
    target, standoff_m = torch.tensor([[0.5, 0.2, 0.1]]), 0.05
    with torch.no_grad():
        network.belief.prior[:3] = target[0]
        network.belief.standoff.fill_(standoff_m)
        network.guide[-1].bias[6:8] = torch.tensor([0.0, said])
    up = torch.tensor([[0.0, 0.0, 1.0]])
    q = F.pad(arm.postures(target + standoff_m * up, up)[:, 0], (0, 1))
    memory = network.start(1)
    sightings = {"eih": torch.zeros(1, SIGHTING_SIZE)}
    for _ in range(20):
        memory = network.sent_on(memory, q.double())
        decision = network.decide(memory, sightings, F.pad(q, (0, 7)))
        q = q + network.to_step(decision.proposals[:, 0]).detach()
    motion = flange_motion(q)
    facing = torch.tensor([[0.0, math.sin(LEAN), math.cos(LEAN)]])
    torch.testing.assert_close(-motion.rotation[:, :, 2], facing, atol=2e-3, rtol=0.0)
    torch.testing.assert_close(motion.position, target + standoff_m * facing, atol=5e-4, rtol=0.0)
    # And it can be taught to.
    decision.proposals[:, 0].sum().backward()
    assert (network.guide[-1].bias.grad[6:] != 0.0).all()
