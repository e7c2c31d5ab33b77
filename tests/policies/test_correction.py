"""Where the head may correct the mean of its proposals: near the goal alone, if it is told so."""

import pytest
import torch
from torch import Tensor, nn

import hvs_suite
from hvs_suite.policies.belief import arm, geometry
from hvs_suite.policies.belief.belief import PLACE
from hvs_suite.policies.belief.cell_model import cell_model
from hvs_suite.policies.belief.network import N_JOINTS, BeliefNetwork, Shape

CAMERAS = {"eih": (3, 32), "eth": (3, 32)}
STATE = torch.tensor([[0.1, 0.4, 0.0, -1.4, 0.0, 1.3, 0.0, *[0.0] * N_JOINTS]])


def corrected_by(network: BeliefNetwork, distance_m: float) -> Tensor:
    """What is added to the mean, where the goal is believed to be so far from the tip; (7,)."""
    q = STATE[:, :N_JOINTS]
    memory = network.sent_on(network.start(1), q.double())
    tip = arm.tip_of(geometry.flange_motion(q.double()), network.cell.tool_length_m).position
    up = network.belief.standoff * torch.tensor([0.0, 0.0, 1.0]).double()
    memory[:, PLACE] = tip - up + torch.tensor([distance_m, 0.0, 0.0]).double()
    with torch.no_grad():
        decided = network.decide(memory, {name: torch.zeros(1, 9) for name in CAMERAS}, STATE)
        scale = network.shape.error_scale
        steps = scale * torch.sinh(decided.proposals)
        mean = (decided.weights.softmax(dim=1)[:, :, None] * steps).sum(dim=1)
        return (decided.out - torch.asinh(mean / scale))[0]


@pytest.fixture
def networks() -> dict[float | None, BeliefNetwork]:
    """Heads of which each wants to take a joint's turn away, by how far off they may."""
    cell, made = cell_model(hvs_suite.TASKS["align-thesis"]), {}
    for within_m in (None, 0.04):
        torch.manual_seed(0)
        network = BeliefNetwork(Shape(CAMERAS, hidden=8, corrects_within_m=within_m), cell).eval()
        last = network.head[-1]
        assert isinstance(last, nn.Linear)
        last.bias.data[3], last.bias.data[N_JOINTS] = -5.0, 8.0
        made[within_m] = network
    return made


def test_far_from_the_goal_nothing_is_corrected_and_near_it_all(
    networks: dict[float | None, BeliefNetwork],
) -> None:
    everywhere, near = networks[None], networks[0.04]
    for distance_m in (0.0, 0.03, 0.2, 0.6):
        assert corrected_by(everywhere, distance_m)[3] < -1.0
    for distance_m in (0.0, 0.03):
        torch.testing.assert_close(
            corrected_by(near, distance_m), corrected_by(everywhere, distance_m)
        )
    for distance_m in (0.09, 0.2, 0.6):
        torch.testing.assert_close(
            corrected_by(near, distance_m), torch.zeros(N_JOINTS), atol=1e-4, rtol=0
        )


def test_between_it_fades(networks: dict[float | None, BeliefNetwork]) -> None:
    shares = [
        (corrected_by(networks[0.04], distance_m) / corrected_by(networks[None], distance_m))[3]
        for distance_m in (0.045, 0.06, 0.075)
    ]
    assert shares == pytest.approx([0.875, 0.5, 0.125], abs=0.01)
