"""Eyes: how they look at images of any size, and where."""

import numpy as np
import pytest
import torch

from hvs_suite.policies.belief.eye import (
    FEATURE_SIZE,
    SIGHTING_SIZE,
    Eye,
    Seen,
    sighting_loss,
    strides,
)


@pytest.mark.parametrize(("channels", "side"), [(1, 28), (3, 84), (3, 112), (1, 224), (3, 336)])
def test_every_resolution_and_channel_count_has_about_28_cells(channels: int, side: int) -> None:
    assert abs(side / np.prod(strides(side)) - FEATURE_SIZE) <= 2
    eye = Eye(channels, side, 8)
    assert eye(torch.rand(2, channels, side, side)).shape == (2, SIGHTING_SIZE)


def test_attention_is_a_distribution_whose_mean_an_untrained_eye_takes_for_the_target() -> None:
    torch.manual_seed(0)
    eye = Eye(3, 56, 8).eval()
    images = torch.rand(2, 3, 56, 56)
    with torch.no_grad():
        attention, sighting = eye.attention(images), eye(images)
    torch.testing.assert_close(attention.sum(dim=(1, 2)), torch.ones(2))
    centres = (2.0 * torch.arange(attention.shape[2]) + 1.0) / attention.shape[2] - 1.0
    mean = (attention.sum(dim=1) * centres).sum(dim=1)
    # It corrects nothing, and scales by its initial value.
    torch.testing.assert_close(sighting[:, 0], mean * eye.uv_scale[0])


def test_a_map_that_hesitates_between_two_places_costs_more_than_one_that_decides() -> None:
    """Though the mean of both lies over the target."""
    truth = torch.tensor([[0.0, 0.0, 0.1, 1.0]])
    sighting = torch.zeros(1, SIGHTING_SIZE)
    sighting[:, 2] = truth[:, 2].log()

    def map_loss(*columns: int) -> float:
        cells = torch.arange(27.0)
        hills = [
            -0.5 * (cells[:, None] - 13) ** 2 - 0.5 * (cells - column) ** 2 for column in columns
        ]
        scores = torch.logsumexp(torch.stack(hills), dim=0)[None]
        _, parts = sighting_loss(Seen(sighting, scores), truth, torch.zeros(1, 2))
        return parts["map"].item()

    assert map_loss(13) < 0.5 * map_loss(8, 18)
