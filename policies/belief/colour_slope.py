"""The slope of a surface, by the shape of what has the target's colour.

A disc that is seen from the side is an ellipse, and of marks around it the near half lies farther
out than the far half. A small convolutional network sees both in a picture of how much of each
pixel has the colour of the target's middle: so neither light nor the skin around the target counts.

The picture is first turned as if the camera looked straight at the target, which has the same size
there always. What a slope does to a shape is then the same wherever the target was in the picture,
and turns with the slope. So the network learns from every frame turned by any angle, and mirrored.
"""

import math

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

CORE = 0.3
AROUND = 1.6
"""The target's colour is the mean so near to its centre, that of its surroundings the median so
near to it (diameters)."""
SIDE = 48
"""Side of the turned picture (px)."""
REACH = 1.5
"""How far it reaches from the target's centre (diameters)."""
CHANNELS = 3
"""Of the turned picture: how far each pixel's colour is on the way from the surroundings' to the
target's, how far beside this way, and whether the camera saw it."""
WIDTH = 48
GROUPS = 4
SQUEEZED = 24
HIDDEN = 128
SIZE_JITTER = 0.1
"""Standard deviation of what is added to the logarithm of the diameter when the judge learns. An
exact size would tell how far away the target is, and demonstrations are upright at the goal: the
judge would say so of what leans there."""
SAID_SCALE = 0.2
SAID_SIGMA = -3.0
"""A fresh network says slopes of about so much, with a standard deviation of e to the power of
that."""
LEAST_DIAMETER = 0.01
"""Smaller targets count as this large (image widths)."""
MOST_SLOPE = 0.98


class ColourSlopeEye(nn.Module):
    """Says how a surface faces the camera.

    Args:
        side: Side of the image (px).
        tan: Tangent of half the camera's field of view.

    Attributes:
        judge: From a turned picture to the slope that is seen there.
        n_lessons: How often the judge has learned from all frames.
    """

    at: Tensor
    grid: Tensor
    n_lessons: Tensor

    def __init__(self, side: int, tan: float) -> None:
        super().__init__()
        self._tan = tan
        for name, n, reach in (("at", side, 1.0), ("grid", SIDE, REACH)):
            ticks = reach * ((2.0 * torch.arange(n) + 1.0) / n - 1.0)
            v, u = torch.meshgrid(ticks, ticks, indexing="ij")
            self.register_buffer(name, torch.stack([u, v]), persistent=False)
        self.register_buffer("n_lessons", torch.tensor(0))
        self.judge = Judge()

    def forward(self, images: Tensor, uv: Tensor, log_diameter: Tensor) -> Tensor:
        """Look; as `hvs_suite.policies.belief.slope.SlopeEye.forward`, without a gradient."""
        with torch.no_grad():
            uv, log_diameter = _within(uv, log_diameter)
            frame = turn_to(uv, self._tan)
            told = self._colours(images, uv, log_diameter.exp())
            said = self.judge(self._straight(told, frame, log_diameter.exp()), log_diameter)
            slope = said[:, :2]
            slope = slope / (slope.norm(dim=1, keepdim=True) / MOST_SLOPE).clamp(min=1.0)
            up = -(1.0 - slope.square().sum(dim=1, keepdim=True)).sqrt()
            normal = torch.cat([slope, up], dim=1)[..., None]
            facing = (frame.transpose(1, 2) @ normal)[:, :2, 0]
            return torch.cat([facing, said[:, 2:]], dim=1)

    def lesson(
        self,
        images: Tensor,
        uv: Tensor,
        log_diameter: Tensor,
        facing: Tensor,
        generator: torch.Generator,
    ) -> tuple[Tensor, Tensor]:
        """What the judge says of frames turned by any angle, half of them mirrored, and the truth.

        Args:
            images: As in `forward`.
            uv: As in `forward`.
            log_diameter: As in `forward`.
            facing: x and y of the true normal in the optical frame, (B, 2).
            generator: Draws the angles.

        Returns:
            What the judge says, (B, 3), and x and y of the true normal in the turned picture,
            (B, 2).
        """
        uv, log_diameter = _within(uv, log_diameter)
        off = torch.randn(len(uv), 1, generator=generator).to(uv.device)
        log_diameter = log_diameter + SIZE_JITTER * off
        drawn = torch.rand(2, len(uv), 1, generator=generator).to(uv.device)
        mirror = torch.where(drawn[1] < 0.5, -1.0, 1.0)
        frame = turn_around(2.0 * math.pi * drawn[0], mirror) @ turn_to(uv, self._tan)
        told = self._colours(images, uv, log_diameter.exp())
        said = self.judge(self._straight(told, frame, log_diameter.exp()), log_diameter)
        up = -(1.0 - facing.square().sum(dim=1, keepdim=True)).clamp(min=0.0).sqrt()
        normal = torch.cat([facing, up], dim=1)[..., None]
        return said, (frame @ normal)[:, :2, 0]

    def _colours(self, images: Tensor, uv: Tensor, diameter: Tensor) -> Tensor:
        """Each pixel's colour, measured by the way from that of the surroundings to the target's.

        Returns:
            How far it is on this way, 1 at its end, and how far beside it, in lengths of the way,
            (B, 2, H, W).
        """
        # Several times as fast as the norm.
        off = (self.at[None] - uv[..., None, None]).square().sum(dim=1, keepdim=True).sqrt()
        radius = off / (2.0 * diameter[..., None, None])
        core = (radius < CORE).to(images.dtype)
        own = (images * core).sum(dim=(2, 3)) / core.sum(dim=(2, 3)).clamp(min=1.0)
        # A quarter of the pixels says it as well.
        near = images[:, :, ::2, ::2].masked_fill(radius[:, :, ::2, ::2] > AROUND, math.nan)
        other = near.flatten(2).nanmedian(dim=2).values.nan_to_num(0.0)[..., None, None]
        way = own[..., None, None] - other
        length = way.square().sum(dim=1, keepdim=True).clamp(min=1e-4)
        along = ((images - other) * way).sum(dim=1, keepdim=True) / length
        rest = images - other - along * way
        beside = (rest.square().sum(dim=1, keepdim=True) / length).sqrt()
        return torch.cat([along.clamp(-1.0, 2.0), beside.clamp(max=2.0)], dim=1)

    def _straight(self, told: Tensor, frame: Tensor, diameter: Tensor) -> Tensor:
        """What was told of each pixel, as a camera sees it that looks straight at the target.

        Args:
            told: (B, 2, H, W).
            frame: Rotations from the optical frame to that camera's, (B, 3, 3).
            diameter: In image widths, (B, 1).

        Returns:
            (B, `CHANNELS`, `SIDE`, `SIDE`).
        """
        n = len(told)
        across = 2.0 * self._tan * diameter[..., None] * self.grid.flatten(1)
        rays = frame.transpose(1, 2) @ torch.cat([across, torch.ones_like(across[:, :1])], dim=1)
        # Far beside a ray through the border, a place may be behind the camera.
        places = (rays[:, :2] / rays[:, 2:].clamp(min=0.1) / self._tan).transpose(1, 2)
        places = places.reshape(n, SIDE, SIDE, 2)
        in_view = (places.abs() < 1.0).all(dim=-1)[:, None].to(told.dtype)
        seen = F.grid_sample(told, places, align_corners=False) * in_view
        return torch.cat([seen, in_view], dim=1)


class Judge(nn.Module):
    """From a turned picture and the size of the target to the slope and its doubt.

    Attributes:
        train_in_bfloat16: As of `hvs_suite.policies.belief.eye.Eye`.
    """

    train_in_bfloat16 = False

    def __init__(self) -> None:
        super().__init__()
        w = WIDTH
        plan = ((w, 1), (w, 2), (2 * w, 1), (2 * w, 2), (3 * w, 1), (3 * w, 2))
        layers: list[nn.Module] = []
        n_in = CHANNELS
        for n_out, stride in plan:
            conv = nn.Conv2d(n_in, n_out, 3, stride, 1)
            layers += [conv, nn.GroupNorm(GROUPS, n_out), nn.GELU()]
            n_in = n_out
        layers.append(nn.Conv2d(n_in, SQUEEZED, 1))
        self.features = nn.Sequential(*layers)
        n = SQUEEZED * (SIDE // 8) ** 2
        self.head = nn.Sequential(nn.Linear(n + 1, HIDDEN), nn.GELU(), nn.Linear(HIDDEN, 3))

    def forward(self, pictures: Tensor, log_diameter: Tensor) -> Tensor:
        """Judge.

        Args:
            pictures: (B, `CHANNELS`, `SIDE`, `SIDE`).
            log_diameter: Logarithm of the target's apparent diameter in image widths, (B, 1).

        Returns:
            x and y of the normal in the turned picture, and the logarithm of their standard
            deviation, (B, 3).
        """
        half = self.train_in_bfloat16 and self.training
        with torch.autocast(pictures.device.type, dtype=torch.bfloat16, enabled=half):
            features = self.features(pictures)
        said = self.head(torch.cat([features.float().flatten(1), log_diameter], dim=1))
        return torch.cat([SAID_SCALE * said[:, :2], said[:, 2:] + SAID_SIGMA], dim=1)


def turn_to(uv: Tensor, tan: float) -> Tensor:
    """Rotations (B, 3, 3) by the least angle that bring the ray through a place to the z axis.

    Args:
        uv: The places in [-1, 1], (B, 2).
        tan: Tangent of half the camera's field of view.
    """
    x, y = (tan * uv).unbind(dim=1)
    length = (1.0 + x.square() + y.square()).sqrt()
    x, y, z = x / length, y / length, 1.0 / length
    f = 1.0 / (1.0 + z)
    rows = [1.0 - f * x * x, -f * x * y, -x, -f * x * y, 1.0 - f * y * y, -y, x, y, z]
    return torch.stack(rows, dim=1).view(-1, 3, 3)


def turn_around(angle: Tensor, mirror: Tensor) -> Tensor:
    """Rotations about the z axis, mirrored first where asked for.

    Args:
        angle: (B, 1) rad.
        mirror: 1, or -1 to mirror y, (B, 1).

    Returns:
        (B, 3, 3).
    """
    cos, sin, zero, one = angle.cos(), angle.sin(), torch.zeros_like(angle), torch.ones_like(angle)
    rows = [cos, -mirror * sin, zero, sin, mirror * cos, zero, zero, zero, one]
    return torch.cat(rows, dim=1).view(-1, 3, 3)


def _within(uv: Tensor, log_diameter: Tensor) -> tuple[Tensor, Tensor]:
    """Places and sizes that a picture can be turned to, whatever the eye says."""
    return uv.clamp(-1.2, 1.2), log_diameter.clamp(math.log(LEAST_DIAMETER), 0.0)
