"""The head: what it chooses from while no camera has seen the target, and what it answers."""

import numpy as np
import torch

import hvs_suite
from hvs_suite.datasets.features import STATE, observed_part
from hvs_suite.datasets.looking import Demonstrator
from hvs_suite.policies.belief.cell_model import cell_model
from hvs_suite.policies.belief.eye import SIGHTING_SIZE
from hvs_suite.policies.belief.network import BeliefNetwork, Shape

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


def test_no_zero_has_a_sign_because_logs_are_twice_as_long_with_it() -> None:
    spec = hvs_suite.load("align-thesis", observations="state").spec
    network = BeliefNetwork(Shape({"eih": (3, 64)}, hidden=8), cell_model(spec))
    memory = network.sent_on(network.start(1), torch.full((1, 7), -1e-9, dtype=torch.float64))
    action = network.to_action(torch.zeros(1, 7), memory)
    assert (action == 0.0).any()
    assert not torch.signbit(action[action == 0.0]).any()
