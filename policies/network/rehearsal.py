"""Training the head on frames whose images nobody looks at.

A frame costs the eyes some seventy times what it costs the head at 112 px, twice that at 512 px,
and the head needs more of them: it has to learn how to move from anywhere. So it rehearses on many
more frames than the eyes see. What the eyes would have made of those is drawn from what they made
of others: where the target truly was, plus the error and the doubts of an eye that saw a target of
about the same size.
"""

from collections.abc import Mapping

import torch
from torch import Tensor

from hvs_suite.policies.network.network import Sighting

NEIGHBOURS = 8
"""Errors are drawn from so many frames next in apparent size, on either side."""
SURE_LOGIT = 6.0
"""What stands in where no eye has seen, or not seen, a target: sure of itself."""


def drawn_sightings(
    sightings: Mapping[str, Sighting],
    truths: Mapping[str, Tensor],
    wanted: Mapping[str, Tensor],
    generator: torch.Generator,
) -> dict[str, Sighting]:
    """What eyes would make of frames that they do not look at.

    Args:
        sightings: Camera name to what its eye made of some frames.
        truths: Camera name to where the target was in them: u, v, apparent diameter in image
            widths, visible 0/1, (B, 4).
        wanted: The same for the other frames, (n, 4).
        generator: Draws whose error each frame gets.

    Returns:
        Camera name to sightings (n, ...), through which no gradient flows.
    """
    return {
        name: _drawn(sighting, truths[name], wanted[name], generator)
        for name, sighting in sightings.items()
    }


def _drawn(
    sighting: Sighting, truth: Tensor, wanted: Tensor, generator: torch.Generator
) -> Sighting:
    seen, shown = wanted[:, 3] > 0.5, truth[:, 3] > 0.5
    sure = torch.where(seen, SURE_LOGIT, -SURE_LOGIT)[:, None]
    parts = torch.cat([wanted[:, :2], _log_diameter(wanted), sure, sure], dim=1)
    made = torch.cat(
        [sighting.uv, sighting.log_diameter, sighting.visible_logit, sighting.trust_logit], dim=1
    ).detach()
    n_seen, n_hidden = int(seen.sum()), int((~seen).sum())
    if shown.any():
        order = truth[:, 2].argsort()
        pool = order[shown[order]]
        nearest = torch.searchsorted(truth[pool, 2].contiguous(), wanted[seen, 2].contiguous())
        shift = torch.randint(-NEIGHBOURS, NEIGHBOURS + 1, (n_seen,), generator=generator)
        donor = pool[(nearest + shift).clamp(0, len(pool) - 1)]
        true = torch.cat([truth[donor, :2], _log_diameter(truth[donor])], dim=1)
        parts[seen, :3] += made[donor, :3] - true
        parts[seen, 3:] = made[donor, 3:]
    if not shown.all():
        pool = torch.nonzero(~shown)[:, 0]
        parts[~seen] = made[pool[torch.randint(len(pool), (n_hidden,), generator=generator)]]
    return Sighting(parts[:, :2], parts[:, 2:3], parts[:, 3:4], parts[:, 4:])


def _log_diameter(truth: Tensor) -> Tensor:
    return truth[:, 2:3].clamp(min=1e-3).log()
