"""Which of the measured joints a network reads: what it is not given changes nothing."""

import pytest
import torch

import hvs_suite
from hvs_suite.policies.belief.acting import act
from hvs_suite.policies.belief.cell_model import cell_model
from hvs_suite.policies.belief.network import N_JOINTS, BeliefNetwork, Shape

CAMERAS = {"eih": (3, 32), "eth": (3, 32)}


def second_action(network: BeliefNetwork, change: torch.Tensor) -> torch.Tensor:
    """What is done in the second step, where the measured joints were changed."""
    images = {name: torch.full((1, 3, 32, 32), 0.5) for name in CAMERAS}
    state = torch.zeros(1, 2 * N_JOINTS)
    with torch.no_grad():
        _, memory = act(network, images, state, network.start(1))
        return act(network, images, state + change, memory)[0]


@pytest.mark.parametrize(
    ("part", "option"),
    [(slice(0, 7), "reads_positions"), (slice(7, 14), "reads_velocities")],
)
def test_what_is_not_read_changes_nothing(part: slice, option: str) -> None:
    cell = cell_model(hvs_suite.TASKS["align-thesis"])
    change = torch.zeros(1, 2 * N_JOINTS)
    change[:, part] = 0.2
    for reads in (True, False):
        torch.manual_seed(0)
        network = BeliefNetwork(Shape(CAMERAS, hidden=8, **{option: reads}), cell).eval()
        same = torch.equal(
            second_action(network, change), second_action(network, torch.zeros(1, 14))
        )
        assert same is not reads


def test_without_a_memory_nothing_counts_but_what_is_seen_now_and_where_the_arm_was_sent() -> None:
    torch.manual_seed(0)
    cell, q = cell_model(hvs_suite.TASKS["align-thesis"]), torch.full((1, 7), 0.3)
    now = {name: torch.randn(1, 9) for name in CAMERAS}
    for remembers in (True, False):
        network = BeliefNetwork(Shape(CAMERAS, hidden=8, remembers=remembers), cell)
        ends = []
        for sent in (0.3, 0.3, 0.31):
            seen = {name: torch.randn(1, 9) for name in CAMERAS}
            memory = network.remember(network.start(1), seen, q)
            memory = network.commanded(memory, torch.full((1, 7), sent) / network.joint_range)
            ends.append(network.remember(memory, now, q))
        assert torch.equal(ends[0], ends[1]) is not remembers
        assert not torch.equal(ends[1], ends[2])


def test_without_positions_the_arm_is_reckoned_from_where_it_started() -> None:
    cell = cell_model(hvs_suite.TASKS["align-thesis"])
    network = BeliefNetwork(Shape(CAMERAS, hidden=8, reads_positions=False), cell)
    q = torch.full((1, 7), 0.3)
    memory = network.start(1)
    assert torch.equal(network._joints(memory, q), q)
    unseen = {name: torch.zeros(1, 9) for name in CAMERAS}
    memory = network.remember(memory, unseen, q)
    memory = network.commanded(memory, (q + 0.05) / network.joint_range)
    reckoned = network._joints(memory, torch.zeros(1, 7))
    assert ((reckoned > 0.3) & (reckoned < 0.35)).all()


def test_without_velocities_they_are_reckoned_from_how_far_the_arm_trails() -> None:
    task = "align-easy"
    network = BeliefNetwork(
        Shape(CAMERAS, hidden=8, reads_velocities=False), cell_model(hvs_suite.TASKS[task])
    )
    memory = network.start(1)
    unseen = {name: torch.zeros(1, 9) for name in CAMERAS}
    errors = []
    with hvs_suite.load(task, split="dev") as env:
        shown = env.reset(scenario=0).observation
        start = shown["joint_positions"]
        for step in range(1, 9):
            q, velocity = (
                torch.from_numpy(shown[name])[None].float()
                for name in ("joint_positions", "joint_velocities")
            )
            memory = network.remember(memory, unseen, q)
            reckoned = network._read(memory, torch.cat([q, torch.zeros(1, 7)], dim=1))
            errors.append((reckoned[0, 7:] - velocity[0]).abs().max().item())
            # It turns the first joint, faster and faster.
            action = torch.from_numpy(start)[None].float() / network.joint_range
            action[0, 0] += 0.002 * step**2
            memory = network.commanded(memory, action)
            shown = env.step(action[0].numpy()).observation
    assert abs(velocity[0, 0].item()) > 0.3
    assert max(errors) < 0.003
