"""Foresight: where a target that moves will be soon, from where it has been.

An action acts a step or two late, so it has to go to where the target will be by then. On
``track-hard``, place, velocity and acceleration carried on are off by a millimetre there, because a
motion that stays within bounds turns back. How such motions go on, demonstrations show: the best
linear prediction has the second moments of their places for a covariance, and the belief's
variances for the noise of what was seen (Gaussian process regression; Rasmussen and Williams, 2006,
equation 2.25).
"""

import torch
from torch import Tensor, nn

PAST_STEPS = 20
"""Remembered by networks whose targets move: two seconds, at ten control steps a second."""
N_AHEAD = 3
"""Control steps that are foreseen; between them it is interpolated."""
FLOOR_M = 3e-5
"""Standard deviation of a believed place at the least: the errors of one step and the next are
alike, and the belief does not say so."""
UNKNOWN_M = 100.0
"""Standard deviation of what counts for nothing: places before the episode, and of a target that
was forgotten."""
SUDDEN = 2.0
"""So many times as fast as any target of the demonstrations, one is suddenly elsewhere."""


class Foresight(nn.Module):
    """Remembers where the target was, and says how far it will have moved.

    Args:
        n_past: Control steps that it remembers.
        period_s: Control period (s).

    Attributes:
        size: Numbers that it remembers: the places of the last steps, latest first, and the
            variance of each, along the axes of the base frame.
        moments: How targets move along each axis: the second moments of where they were in the
            last `n_past` steps, latest first, and will be in the next `N_AHEAD`, relative to where
            they are, (3, `n_past` + `N_AHEAD`, `n_past` + `N_AHEAD`) m2.
    """

    moments: Tensor

    def __init__(self, n_past: int, period_s: float) -> None:
        super().__init__()
        self._n_past, self._period_s = n_past, period_s
        self.size = 6 * n_past
        n = n_past + N_AHEAD
        self.register_buffer("moments", torch.zeros(3, n, n, dtype=torch.float64))

    def learn(self, place: Tensor, velocity: Tensor, episode: Tensor) -> None:
        """Learn how targets move; those that nobody follows for long enough stand still.

        Args:
            place: Of the target at each frame, (n, 3) m.
            velocity: (n, 3) m/s.
            episode: Which one each frame belongs to, (n,), one after the other.
        """
        n = self._n_past
        fastest = velocity.norm(dim=1).max() * self._period_s
        begins = (episode.diff() != 0) | (place.diff(dim=0).norm(dim=1) > SUDDEN * fastest)
        followed = nn.functional.pad(begins.cumsum(dim=0), (1, 0))
        now = torch.arange(n, max(n, len(place) - N_AHEAD))
        now = now[followed[now - n] == followed[now + N_AHEAD]]
        steps = [*range(-1, -n - 1, -1), *range(1, N_AHEAD + 1)]
        moved = torch.stack([place[now + step] - place[now] for step in steps], dim=2)
        self.moments.copy_(moved.permute(1, 2, 0) @ moved.transpose(0, 1) / max(1, len(now)))

    def start(self, n: int) -> Tensor:
        """Before anything was seen, (n, `size`) float64."""
        places = torch.zeros(n, self.size // 2, dtype=torch.float64)
        return torch.cat([places, torch.full_like(places, UNKNOWN_M**2)], dim=1)

    def remember(self, past: Tensor, place: Tensor, variance: Tensor, forget: Tensor) -> Tensor:
        """Take in where the target was believed to be a step ago.

        Args:
            past: What is remembered, (B, `size`).
            place: (B, 3) m.
            variance: Of each coordinate, (B, 3) m2.
            forget: Share of the belief that was forgotten since, (B, 1).

        Returns:
            (B, `size`).
        """
        places, variances = (part[:, :-3] for part in past.chunk(2, dim=1))
        variances = torch.cat([variance, variances], dim=1)
        # A little is always forgotten; squared, that is nothing.
        variances = variances + (UNKNOWN_M * forget) ** 2
        return torch.cat([place, places, variances], dim=1)

    def ahead(self, past: Tensor, place: Tensor, variance: Tensor, lead_s: Tensor) -> Tensor:
        """How far the target will have moved.

        Args:
            past: What is remembered, (B, `size`).
            place: Where the target is believed to be, (B, 3) m.
            variance: Of each coordinate, (B, 3) m2.
            lead_s: In how long, (B, 1) s, up to `N_AHEAD` control steps.

        Returns:
            (B, 3) m.
        """
        n = self._n_past
        places, variances = (part.view(-1, n, 3).transpose(1, 2) for part in past.chunk(2, dim=1))
        seen, sought = self.moments[:, :n, :n], self.moments[:, :n, n:]
        with torch.no_grad():
            # Each is told relative to the present place, whose error is therefore in all of them.
            noise = torch.diag_embed(variances + FLOOR_M**2)
            noise = noise + (variance + FLOOR_M**2)[:, :, None, None]
            weights = torch.linalg.solve(seen + noise, sought.expand(len(past), -1, -1, -1))
        moved = ((places - place[:, :, None])[:, :, None] @ weights)[:, :, 0]
        u = lead_s / self._period_s
        # Lagrange's polynomials, of 0 now and of what is foreseen after one, two and three steps.
        shares = [u * (u - 2) * (u - 3) / 2, -u * (u - 1) * (u - 3) / 2, u * (u - 1) * (u - 2) / 6]
        return (moved * torch.cat(shares, dim=1)[:, None]).sum(dim=2)
