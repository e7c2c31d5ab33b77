"""What judges image moments learns from those of all frames, once the eyes have looked at them."""

import pytest
import torch

from hvs_suite.policies.belief.cell_model import cell_model
from hvs_suite.policies.belief.eye import SLOPE, VISIBLE
from hvs_suite.policies.belief.network import BeliefNetwork, Shape
from hvs_suite.policies.imitation.slopes import fit_judges, measuring
from hvs_suite.registry import find

N = 600
SEEN = torch.arange(N) % 3 != 0
TRAINING = torch.arange(N // 2)


@pytest.fixture
def network() -> BeliefNetwork:
    torch.manual_seed(0)
    shape = Shape({"eih": (3, 28), "eth": (3, 28)}, hidden=8, channels=8, slopes=("eih",))
    return BeliefNetwork(shape, cell_model(find("surface-tilted"))).eval()


def looked(
    network: BeliefNetwork, facing: torch.Tensor
) -> tuple[dict[str, list[torch.Tensor]], torch.Tensor]:
    """What an eye measures of pictures whose brightness falls off to where the surface leans."""
    ticks = torch.linspace(-1.0, 1.0, 28)
    falls_off = facing[:, :1, None] * ticks + facing[:, 1:, None] * ticks[:, None]
    pictures = (0.5 + falls_off)[:, None].expand(-1, 3, -1, -1)
    with torch.no_grad(), measuring(network) as numbers:
        sightings = network.eyes["eih"](pictures)
    sightings[:, VISIBLE] = torch.where(SEEN, 5.0, -5.0)[:, None]
    return numbers, sightings


def test_slopes_are_learned_from_all_frames_that_show_the_target(network):
    facing = 0.2 * (2.0 * torch.rand(N, 2) - 1.0)
    numbers, sightings = looked(network, facing)
    before = sightings.clone()
    # What is not seen, or not to be learned from, would teach something else.
    wrong = torch.where((SEEN & (torch.arange(N) < N // 2))[:, None], facing, -facing)
    fit_judges(network, numbers, {"eih": sightings}, {"eih": wrong}, {"eih": SEEN}, TRAINING)

    def error(told: torch.Tensor) -> float:
        return float((told[:, SLOPE] - facing)[SEEN].norm(dim=1).mean())

    assert error(sightings) < 0.5 * error(before)
    # Nothing else is said anew, and the eye itself says the same from now on.
    torch.testing.assert_close(sightings[:, : SLOPE.start], before[:, : SLOPE.start])
    again, fresh = looked(network, facing)
    torch.testing.assert_close(fresh[:, SLOPE], sightings[:, SLOPE])
    fit_judges(network, again, {"eih": fresh}, {"eih": wrong}, {"eih": SEEN}, TRAINING)
    torch.testing.assert_close(fresh, sightings)


def test_nothing_is_learned_of_a_target_that_is_never_seen(network):
    numbers, sightings = looked(network, torch.zeros(N, 2))
    before, weights = sightings.clone(), network.eyes["eih"].slope.judge[0].weight.clone()
    never = torch.zeros(N, dtype=torch.bool)
    fit_judges(
        network, numbers, {"eih": sightings}, {"eih": torch.ones(N, 2)}, {"eih": never}, TRAINING
    )
    torch.testing.assert_close(sightings, before)
    torch.testing.assert_close(network.eyes["eih"].slope.judge[0].weight, weights)
