"""Eyes: one small encoder a camera, from an image to a sighting of the target.

A softmax over one channel's map is a distribution over the image; its mean is the target's place.
Features around that place, as far as the target is large, then say the rest: by how much the mean
is off, how large the target appears, which way it faces, and how sure all of this is.
"""

import dataclasses
import math

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

FEATURE_SIZE = 28
"""Cells along the side of a feature map, about."""
PATCH_SIZE = 8
PATCH_CHANNELS = 16
N_POINTS = 8
POINTS_SIZE = 20
POINTS_GAIN = 10.0
PATCH_DIAMETERS = 2.5
"""The patch around the target reaches so many of its diameters to either side."""
SIGHTING_SIZE = 9
UV, LOG_DIAMETER, VISIBLE, LOG_SIGMA_UV, LOG_SIGMA_SIZE, SLOPE, LOG_SIGMA_SLOPE = (
    slice(0, 2),
    slice(2, 3),
    slice(3, 4),
    slice(4, 5),
    slice(5, 6),
    slice(6, 8),
    slice(8, 9),
)
"""What a sighting (B, 9) holds: the target's centre in [-1, 1] (u right, v down), the logarithm of
its apparent diameter in image widths, the logit that it is in view, x and y of its normal in the
camera's optical frame, and the logarithms of the standard deviations of these."""


MAP_WEIGHT = 0.1
MAP_SIGMA_CELLS = 0.7
"""What the map is taught: a hill of this standard deviation over the target."""


@dataclasses.dataclass(frozen=True, eq=False)
class Seen:
    """What an eye made of images.

    Attributes:
        sighting: (B, 9).
        scores: Logits of the target's place over cells, (B, h, w).
    """

    sighting: Tensor
    scores: Tensor


def strides(side: int) -> tuple[int, ...]:
    """Strides of 4, 3 or 2 px that bring an image to about `FEATURE_SIZE` cells.

    Args:
        side: Side of the square image (px).

    Returns:
        Strides of the down-sampling convolutions; empty for tiny images.
    """
    factor = max(1, round(side / FEATURE_SIZE))
    plan: list[int] = []
    while factor > 1:
        step = 3 if factor % 3 == 0 else 2
        plan.append(step)
        factor = round(factor / step)
    return tuple(sorted(plan, reverse=True))


class Eye(nn.Module):
    """Encoder of one camera.

    Args:
        in_channels: Channels of the image.
        side: Side of the image (px).
        channels: Channels of the features.
        n_goals: Length of the one-hot vector that says which target is meant; 0 for none.
        slope: What tells slopes of what it sees, and learns it by itself; None where the features
            have to do so.

    Attributes:
        channels: Channels of the features.
        train_in_bfloat16: Train the convolutions in bfloat16, where the processor is faster at it.
            Evaluation is always in float32, and so is everything that measures.
    """

    train_in_bfloat16 = False

    def __init__(
        self,
        in_channels: int,
        side: int,
        channels: int,
        n_goals: int = 0,
        *,
        slope: nn.Module | None = None,
    ) -> None:
        super().__init__()
        self.channels = channels
        layers: list[nn.Module] = []
        width = in_channels
        plan = strides(side)
        for i, stride in enumerate(plan):
            out = channels if i == len(plan) - 1 else max(8, channels >> (len(plan) - 1 - i))
            size = 5 if i == 0 else 3
            layers += [nn.Conv2d(width, out, size, stride, size // 2), nn.ReLU(inplace=True)]
            width = out
        for _ in range(2):
            layers += [nn.Conv2d(width, channels, 3, 1, 1), nn.ReLU(inplace=True)]
            width = channels
        self.features = nn.Sequential(*layers)
        self.asked_for = nn.Linear(n_goals, 2 * channels) if n_goals else None
        self.chosen = nn.Sequential(nn.Linear(channels, channels), nn.ReLU(inplace=True))
        self.score = nn.Linear(channels, 1)
        # A mean over cells cannot reach the border, and strides shift it by a fraction of a cell.
        self.uv_scale = nn.Parameter(torch.full((2,), 1.05))
        self.uv_shift = nn.Parameter(torch.zeros(2))
        judge_size = nn.Linear(32, 1)
        nn.init.constant_(judge_size.bias, math.log(0.15))
        self.first_size = nn.Sequential(nn.Linear(2 * channels + 4, 32), nn.SiLU(), judge_size)
        self.patch = nn.Linear(channels, PATCH_CHANNELS)
        last = nn.Linear(128, SIGHTING_SIZE)
        nn.init.zeros_(last.weight)
        with torch.no_grad():
            last.bias.copy_(torch.tensor([0.0, 0.0, 0.0, 0.0, -3.5, -2.0, 0.0, 0.0, -1.0]))
        self.points = nn.Linear(channels, N_POINTS)
        n_around = PATCH_CHANNELS * PATCH_SIZE**2 + 4 * N_POINTS
        self.judge = nn.Sequential(nn.Linear(2 * channels + n_around + 5, 128), nn.SiLU(), last)
        self.slope = slope

    def forward(self, images: Tensor, goal: Tensor | None = None) -> Tensor:
        """Look.

        Args:
            images: (B, C, H, W), uint8, or float in [0, 1].
            goal: Which target is meant, one-hot (B, n_goals); None for a policy that is not told.

        Returns:
            The sighting, (B, 9).
        """
        return self.see(images, goal).sighting

    def see(self, images: Tensor, goal: Tensor | None = None) -> Seen:
        """Look, and say where.

        Args:
            images: As in `forward`.
            goal: As in `forward`.
        """
        maps = self._maps(images, goal)  # (B, h, w, channels)
        scores = self.score(maps)[..., 0]
        weights = torch.softmax(scores.flatten(1), dim=1)
        grid = weights.view_as(scores)
        u, u_spread = _moments(grid.sum(dim=1))
        v, v_spread = _moments(grid.sum(dim=2))
        uv = torch.cat([u, v], dim=1) * self.uv_scale + self.uv_shift
        flat = maps.flatten(1, 2)
        pooled = torch.cat([(weights[:, None] @ flat)[:, 0], flat.amax(dim=1)], dim=1)
        size = self.first_size(torch.cat([pooled, uv, u_spread, v_spread], dim=1))
        place = uv.detach(), size.detach()
        patch = _around(self.patch(maps), *place, PATCH_SIZE).flatten(1)
        points = _points(_around(self.points(maps), *place, POINTS_SIZE))
        judged = self.judge(torch.cat([pooled, patch, points, uv, u_spread, v_spread, size], dim=1))
        # A mark that is cut by the image's border has its centre elsewhere than what is in view.
        uv, size = uv + judged[:, UV], size + judged[:, LOG_DIAMETER]
        facing = judged[:, SLOPE.start :]
        if self.slope is not None and not self.training:
            bright = images.float() / 255.0 if images.dtype == torch.uint8 else images
            facing = self.slope(bright - 0.5, uv, size)
        return Seen(torch.cat([uv, size, judged[:, 3 : SLOPE.start], facing], dim=1), scores)

    def attention(self, images: Tensor, goal: Tensor | None = None) -> Tensor:
        """The distribution over cells whose mean is where the target is looked for first.

        Args:
            images: As in `forward`.
            goal: As in `forward`.

        Returns:
            (B, h, w), each of which sums to 1.
        """
        scores = self.see(images, goal).scores
        return torch.softmax(scores.flatten(1), dim=1).view_as(scores)

    def _maps(self, images: Tensor, goal: Tensor | None) -> Tensor:
        """Features of every cell, (B, h, w, channels)."""
        half = self.train_in_bfloat16 and self.training
        if images.dtype == torch.uint8:
            # Bytes less their mean are exact in bfloat16, and half the size to begin with.
            x = images.to(torch.bfloat16 if half else torch.float32).sub_(127.5).mul_(1.0 / 255.0)
        else:
            x = images - 0.5
        x = x.contiguous(memory_format=torch.channels_last)
        with torch.autocast(x.device.type, dtype=torch.bfloat16, enabled=half):
            maps: Tensor = self.features(x)
        maps = maps.float().permute(0, 2, 3, 1)
        if self.asked_for is not None and goal is not None:
            gain, shift = self.asked_for(goal)[:, None, None].chunk(2, dim=3)
            maps = maps * (1.0 + gain) + shift
        return self.chosen(maps)


def _around(maps: Tensor, uv: Tensor, log_diameter: Tensor, size: int) -> Tensor:
    """Features around a place, its surroundings scaled by the target's size.

    Args:
        maps: (B, h, w, c).
        uv: The place, (B, 2).
        log_diameter: Of the target, (B, 1).
        size: Samples in a row.

    Returns:
        (B, c, size, size).
    """
    reach = (PATCH_DIAMETERS * 2.0 * log_diameter.exp()).clamp(0.15, 1.2)
    ticks = torch.linspace(-1.0, 1.0, size, device=maps.device)
    dv, du = torch.meshgrid(ticks, ticks, indexing="ij")
    offsets = torch.stack([du, dv], dim=2)[None]  # (1, k, k, 2)
    at = uv[:, None, None] + reach[:, None, None] * offsets
    return F.grid_sample(maps.permute(0, 3, 1, 2), at, align_corners=False, padding_mode="zeros")


def _points(scores: Tensor) -> Tensor:
    """Where each channel's softmax lies and how wide it is: (B, c, k, k) to (B, 4 c).

    What surrounds a target shows its slope by where it lies: the near half of a ring of marks is
    farther from the target's centre than the far half, by a few hundredths of what is in view.
    """
    grid = scores.flatten(2).softmax(dim=2).view_as(scores)
    moments = [_moments(grid.sum(dim=axis).flatten(0, 1)) for axis in (2, 3)]
    both = torch.cat([torch.cat([POINTS_GAIN * mean, spread], dim=1) for mean, spread in moments])
    return both.view(2, len(scores), -1).permute(1, 0, 2).flatten(1)


def _moments(marginal: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and standard deviation in [-1, 1] of a distribution over n cells, (B, 1) each."""
    n = marginal.shape[1]
    centres = (2.0 * torch.arange(n, device=marginal.device, dtype=marginal.dtype) + 1.0) / n - 1.0
    mean = (marginal * centres).sum(dim=1, keepdim=True)
    variance = (marginal * centres**2).sum(dim=1, keepdim=True) - mean**2
    return mean, variance.clamp(min=1e-8).sqrt()


def sighting_loss(seen: Seen, truth: Tensor, normal: Tensor) -> tuple[Tensor, dict[str, Tensor]]:
    """Loss of a camera against the projected target.

    Centre, size and normal are learned by Huber losses, and their doubts by the likelihood of the
    errors that remain. The map is learned by cross-entropy: the mean of one that hesitates between
    two things lies between them, where there is nothing.

    Args:
        seen: What the eye made of B images.
        truth: u, v, apparent diameter in image widths, visible 0/1, (B, 4).
        normal: x and y of the target's normal in the camera's optical frame, (B, 2).

    Returns:
        Scalar, and what it is made of.
    """
    sighting, visible = seen.sighting, truth[:, 3:]
    inside = visible * (truth[:, :2].abs().amax(dim=1, keepdim=True) <= 1.1)
    count = inside.sum().clamp(min=1.0)

    def mean(loss: Tensor) -> Tensor:
        return (loss * inside).sum() / count

    off = sighting[:, UV] - truth[:, :2]
    size_off = sighting[:, LOG_DIAMETER] - truth[:, 2:3].clamp(min=1e-3).log()
    slope_off = sighting[:, SLOPE] - normal
    parts = {
        "map": MAP_WEIGHT * mean(_map_loss(seen.scores, truth[:, :2])),
        "uv": 10.0
        * mean(F.smooth_l1_loss(off, torch.zeros_like(off), beta=0.01, reduction="none")),
        "size": mean(
            F.smooth_l1_loss(size_off, torch.zeros_like(size_off), beta=0.05, reduction="none")
        ),
        "sigma_uv": 0.1 * mean(doubt(off.detach(), sighting[:, LOG_SIGMA_UV])),
        "sigma_size": 0.1 * mean(doubt(size_off.detach(), sighting[:, LOG_SIGMA_SIZE])),
        "slope": mean(
            F.smooth_l1_loss(slope_off, torch.zeros_like(slope_off), beta=0.02, reduction="none")
        ),
        "sigma_slope": 0.1 * mean(doubt(slope_off.detach(), sighting[:, LOG_SIGMA_SLOPE])),
        "visible": 0.3 * F.binary_cross_entropy_with_logits(sighting[:, VISIBLE], visible),
    }
    return sum(parts.values(), torch.zeros(())), parts


def _map_loss(scores: Tensor, uv: Tensor) -> Tensor:
    """Cross-entropy of maps (B, h, w) against a hill over a place (B, 2) in [-1, 1], (B, 1)."""
    h, w = scores.shape[1:]
    hill = _hill(uv[:, 1:], h)[:, :, None] * _hill(uv[:, :1], w)[:, None]
    logs = torch.log_softmax(scores.flatten(1), dim=1)
    return -(hill.flatten(1) * logs).sum(dim=1, keepdim=True)


def _hill(place: Tensor, n: int) -> Tensor:
    """A distribution over n cells around a place (B, 1) in [-1, 1], (B, n)."""
    cells = torch.arange(n, device=place.device) + 0.5
    off = cells - 0.5 * n * (1.0 + place)
    return torch.softmax(-0.5 * (off / MAP_SIGMA_CELLS) ** 2, dim=1)


def doubt(error: Tensor, log_sigma: Tensor) -> Tensor:
    """Negative log-likelihood under Student's t with four degrees of freedom, summed over axes.

    Its long tails keep the few gross errors from drowning the rest.

    Args:
        error: (B, n).
        log_sigma: Logarithm of the standard deviation that was told, (B, 1).

    Returns:
        (B, 1).
    """
    log_sigma = log_sigma.clamp(-8.0, 2.0)
    n = error.shape[1]
    squared = (error / log_sigma.exp()).square().sum(dim=1, keepdim=True)
    return n * log_sigma + 0.5 * (4.0 + n) * torch.log1p(squared / 4.0)
