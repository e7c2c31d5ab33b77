"""Training the head on frames without their images.

A frame costs about seventy times as much computing in the eyes as in the head at 112 px, and twice
that at 512 px. The head needs more frames, because it has to learn how to move from anywhere. So it
also learns from many frames that the eyes do not process. For these, the output of the eyes is
replaced by the true place of the target plus the error and the uncertainty that an eye had on
another frame with a target of about the same size.
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
    """Draws what the eyes would see in frames that they do not process.

    Args:
        sightings: Camera name to what its eye made of some frames.
        truths: Camera name to where the target was in them: u, v, apparent diameter in image
            widths, visible 0/1, (B, 4).
        wanted: The same for the other frames, (n, 4).
        generator: Draws from which other frame each frame gets its error.

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
