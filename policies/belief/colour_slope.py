"""The slope of a surface, by the shape of what has the target's colour.

A disc that is seen from the side is an ellipse, and of marks around it the near half lies farther
out than the far half. Both are measured on what has the colour of the target's middle, of which
each pixel has a share: so neither light nor the skin around the target counts.

The picture is first turned as if the camera looked straight at the target. There, what a slope
does to a shape is the same wherever the target was in the picture, and turns with the slope. So the
judge learns from every frame turned by any angle, and mirrored. Shapes are told by complex moments
(Abu-Mostafa and Psaltis 1984, "Recognitive aspects of moment invariants", IEEE Transactions on
Pattern Analysis and Machine Intelligence 6(6), 698-706), which turning multiplies by a phase.
"""

import math

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from hvs_suite.policies.belief.slope import LEAST, LEAST_SPREAD, RECENT, new_judge

CORE = 0.3
AROUND = 1.6
"""The target's colour is the mean so near to its centre, that of its surroundings the median so
near to it (diameters)."""
BETWEEN = (0.4, 0.6)
"""A pixel belongs to the target where its colour is so much of the way from the surroundings' to
the target's: not at all, wholly."""
BESIDE = (0.3, 0.6)
"""It does where its colour is so far beside this way, in lengths of it: wholly, not at all."""
WINDOWS = ((0.0, 0.62), (0.62, 1.0), (1.0, 1.5))
"""Inner and outer radius of the disc and of the rings around it whose moments are told
(diameters)."""
OUTLINE = 0.72
"""So near to the centre that was told the disc is measured (diameters)."""
EDGE = 0.05
"""How softly they end (diameters)."""
ORDER = 4
CENTRINGS = 2
"""How often centre and diameter are measured anew."""
HIDDEN = 256
PASSES = 200
"""Passes of a judge over all frames."""
LEAST_DIAMETER = 0.01
"""Smaller targets count as this large (image widths)."""
MOST_SLOPE = 0.98
PARTS = tuple((a, b) for a in range(ORDER + 1) for b in range(ORDER + 1 - a) if a >= b and a + b)
ROUND = tuple((a, b) for a, b in PARTS if a == b)
TURNING = tuple((a, b) for a, b in PARTS if a != b)
"""Complex moments of z^a z*^b: those which turning leaves as they are, and the others."""
_MONOMIALS = tuple((a, b) for a in range(ORDER + 1) for b in range(ORDER + 1 - a))


def _in_monomials(a: int, b: int) -> npt.NDArray[np.complex128]:
    """Coefficients of (x + iy)^a (x - iy)^b for each x^j y^k of `_MONOMIALS`, (n,) complex."""
    total = np.zeros(len(_MONOMIALS), dtype=complex)
    for i in range(a + 1):
        for k in range(b + 1):
            y = i + k
            factor = math.comb(a, i) * math.comb(b, k) * 1j**i * (-1j) ** k
            total[_MONOMIALS.index((a + b - y, y))] += factor
    return total


class ColourSlopeEye(nn.Module):
    """Says how a surface faces the camera.

    Args:
        side: Side of the image (px).
        tan: Tangent of half the camera's field of view.
    """

    passes = PASSES
    rays: Tensor
    round: Tensor
    turning: Tensor
    mean: Tensor
    variance: Tensor
    n_batches: Tensor

    def __init__(self, side: int, tan: float) -> None:
        super().__init__()
        self._side, self._tan = side, tan
        ticks = (2.0 * torch.arange(side) + 1.0) / side - 1.0
        v, u = torch.meshgrid(ticks, ticks, indexing="ij")
        rays = torch.stack([tan * u, tan * v, torch.ones_like(u)]).flatten(1)
        self.register_buffer("rays", rays, persistent=False)
        for name, parts in (("round", ROUND), ("turning", TURNING)):
            rows = np.stack([_in_monomials(a, b) for a, b in parts])
            both = np.stack([rows.real, rows.imag])
            self.register_buffer(name, torch.tensor(both, dtype=torch.float32), persistent=False)
        n_windows = len(WINDOWS)
        orders = [1] + [a - b for a, b in TURNING] * n_windows
        n_plain = 2 + n_windows * (1 + len(ROUND))
        self.register_buffer("mean", torch.zeros(n_plain))
        self.register_buffer("variance", torch.ones(n_plain + len(orders)))
        self.register_buffer("n_batches", torch.tensor(0.0))
        self._orders = tuple(orders)
        self.judge = self.new_judge()

    def new_judge(self) -> "TurningJudge":
        """A fresh network from numbers to a slope and its doubt."""
        return TurningJudge(len(self.mean), self._orders, self._tan)

    def forward(self, images: Tensor, uv: Tensor, log_diameter: Tensor, counts: Tensor) -> Tensor:
        """Look; as `hvs_suite.policies.belief.slope.SlopeEye.forward`."""
        diameter = log_diameter.exp().clamp(LEAST_DIAMETER, 1.0)
        with torch.no_grad():
            plain, real, imaginary, centre = self._moments(images, uv.clamp(-1.2, 1.2), diameter)
            if self.training:
                self._take_in(plain, real, imaginary, counts)
            n = len(self.mean)
            scale = torch.rsqrt(self.variance + LEAST_SPREAD**2)
            alike = [(plain - self.mean) * scale[:n], real * scale[n:], imaginary * scale[n:]]
            # A target that is cut or not there gives numbers that no other has.
            numbers = torch.cat(alike, dim=1).clamp(-10.0, 10.0)
        said: Tensor = self.judge(torch.cat([numbers, centre], dim=1))
        return said

    def _moments(
        self, images: Tensor, uv: Tensor, diameter: Tensor
    ) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The shape of what has the target's colour, as from a camera that looks straight at it.

        Args:
            images: (B, C, H, W), float in [-0.5, 0.5].
            uv: The target's centre, (B, 2).
            diameter: Its apparent diameter in image widths, (B, 1).

        Returns:
            What turning leaves as it is, (B, n), real and imaginary parts of the rest, (B, m) each,
            and the centre that was measured, in [-1, 1], (B, 2).
        """
        share = self._membership(images, uv, diameter)
        wide = 2.0 * self._tan * diameter
        for _ in range(CENTRINGS):
            to_ray, x, y, area = self._turned(uv)
            disc = share * area * _inside((x.square() + y.square()).sqrt() / wide, OUTLINE)
            total = disc.sum(dim=1, keepdim=True).clamp(min=1e-9)
            off = torch.stack([(disc * x).sum(dim=1), (disc * y).sum(dim=1)], dim=1) / total
            wide = (2.0 * (total / math.pi).sqrt()).clamp(2.0 * self._tan * LEAST_DIAMETER, 4.0)
            towards = torch.cat([off, torch.ones_like(total)], dim=1)[..., None]
            ray = (to_ray.transpose(1, 2) @ towards)[..., 0]
            uv = (ray[:, :2] / ray[:, 2:].clamp(min=0.1) / self._tan).clamp(-1.2, 1.2)
        _, x, y, area = self._turned(uv)
        x, y, area = x / wide, y / wide, area / wide.square()
        radius = (x.square() + y.square()).sqrt()
        inside = [_between(radius, near, far) for near, far in WINDOWS]
        powers_x, powers_y = ([c**i for i in range(ORDER + 1)] for c in (x, y))
        monomials = torch.stack([powers_x[a] * powers_y[b] for a, b in _MONOMIALS], dim=2)
        weights = torch.stack(inside, dim=1) * (share * area)[:, None]
        moments = weights @ monomials  # (B, windows, monomials)
        total = moments[..., :1]
        moments = moments / (total + LEAST)
        # How much of all this is in the picture at all, and where that lies.
        whole = area * _inside(radius, WINDOWS[-1][1])
        in_view = whole.sum(dim=1, keepdim=True)
        plain = [wide.log(), (in_view + LEAST).log(), (total[..., 0] + LEAST).log()]
        plain.append((moments @ self.round[0].T).flatten(1))
        real, imaginary = (
            torch.cat(
                [(whole * c).sum(dim=1, keepdim=True) / (in_view + LEAST), told.flatten(1)], dim=1
            )
            for c, told in zip((x, y), (moments @ part.T for part in self.turning), strict=True)
        )
        return torch.cat(plain, dim=1), real, imaginary, uv

    def _turned(self, uv: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
        """The pixels as a camera sees them that looks straight at a place (B, 2).

        Returns:
            The rotation to there, (B, 3, 3), and of each pixel x, y and area at unit distance,
            (B, H W).
        """
        to_ray = turn_to(uv, self._tan)
        x, y, z = (to_ray @ self.rays).unbind(dim=1)
        # Far beside a ray through the border, a pixel may be behind the turned picture.
        z = z.clamp(min=0.1)
        return to_ray, x / z, y / z, (2.0 * self._tan / self._side) ** 2 / z**3

    def _membership(self, images: Tensor, uv: Tensor, diameter: Tensor) -> Tensor:
        """How much of each pixel is of the target's colour, (B, H W) in [0, 1]."""
        n, side = len(images), self._side
        at = self.rays[:2] / self._tan
        off = (at[None] - uv[:, :, None]) / (2.0 * diameter[:, :, None])
        radius = off.square().sum(dim=1).sqrt().view(n, 1, side, side)
        core = (radius < CORE).to(images.dtype)
        own = (images * core).sum(dim=(2, 3)) / core.sum(dim=(2, 3)).clamp(min=1.0)
        # A quarter of the pixels says it as well.
        near = images.masked_fill(radius > AROUND, math.nan)[:, :, ::2, ::2].flatten(2)
        other = near.nanmedian(dim=2).values.nan_to_num(0.0)
        way = (own - other)[:, :, None]
        length = way.square().sum(dim=1).clamp(min=1e-4)  # (B, 1)
        rest = images.flatten(2) - other[:, :, None]
        along = (rest * way).sum(dim=1) / length
        beside = (rest - along[:, None] * way).square().sum(dim=1).sqrt() / length.sqrt()
        low, high = BETWEEN
        wholly, not_at_all = BESIDE
        is_on = 1.0 - ((beside - wholly) / (not_at_all - wholly)).clamp(0.0, 1.0)
        return ((along - low) / (high - low)).clamp(0.0, 1.0) * is_on

    def _take_in(self, plain: Tensor, real: Tensor, imaginary: Tensor, counts: Tensor) -> None:
        """Means and spreads follow those of a batch; what turns has none but a spread."""
        weight = counts.to(plain.dtype)
        n = weight.sum()
        if n < 2:
            return
        mean = (plain * weight).sum(dim=0) / n
        squares = [(plain - mean).square(), 0.5 * (real.square() + imaginary.square())]
        variance = (torch.cat(squares, dim=1) * weight).sum(dim=0) / n
        self.n_batches += 1.0
        share = 1.0 / self.n_batches.clamp(max=float(RECENT))
        self.mean += share * (mean - self.mean)
        self.variance += share * (variance - self.variance)


class TurningJudge(nn.Module):
    """From numbers of a picture that was turned to the target, to a slope and its doubt.

    Args:
        n_plain: Numbers which turning about the ray leaves as they are.
        orders: By how many angles it turns each of the others, of which there are two parts.
        tan: Tangent of half the camera's field of view.
    """

    orders: Tensor

    def __init__(self, n_plain: int, orders: tuple[int, ...], tan: float) -> None:
        super().__init__()
        self._n_plain, self._tan = n_plain, tan
        self.register_buffer("orders", torch.tensor(orders, dtype=torch.float32), persistent=False)
        self.layers = new_judge(n_plain + 2 * len(orders), HIDDEN)

    def forward(self, numbers: Tensor) -> Tensor:
        """Judge.

        Args:
            numbers: Those of the picture, and the target's centre in [-1, 1], (B, n + 2).

        Returns:
            As `hvs_suite.policies.belief.slope.SlopeEye.forward`.
        """
        said = self.layers(numbers[:, :-2])
        to_ray = turn_to(numbers[:, -2:], self._tan)
        facing = (to_ray.transpose(1, 2) @ _normal(said[:, :2])[..., None])[:, :2, 0]
        return torch.cat([facing, said[:, 2:]], dim=1)

    def turned(
        self, numbers: Tensor, facing: Tensor, generator: torch.Generator
    ) -> tuple[Tensor, Tensor]:
        """The same frames, each turned about the ray by any angle, and half of them mirrored.

        Args:
            numbers: As in `forward`.
            facing: x and y of the true normal in the optical frame, (B, 2).
            generator: Draws the angles.

        Returns:
            As `numbers` and `facing`.
        """
        n = len(numbers)
        drawn = torch.rand(2, n, 1, generator=generator).to(numbers.device)
        angle, mirror = 2.0 * math.pi * drawn[0], torch.where(drawn[1] < 0.5, -1.0, 1.0)
        sizes = [self._n_plain, len(self.orders), len(self.orders), 2]
        plain, real, imaginary, centre = torch.split(numbers, sizes, dim=1)
        cos, sin = (angle * self.orders).cos(), (angle * self.orders).sin()
        turned = [real * cos - imaginary * sin, mirror * (real * sin + imaginary * cos)]
        to_ray = turn_to(centre, self._tan)
        x, y, z = torch.split((to_ray @ _normal(facing)[..., None])[..., 0], 1, dim=1)
        cos, sin = angle.cos(), angle.sin()
        normal = torch.cat([x * cos - y * sin, mirror * (x * sin + y * cos), z], dim=1)
        back = (to_ray.transpose(1, 2) @ normal[..., None])[:, :2, 0]
        return torch.cat([plain, *turned, centre], dim=1), back


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


def _normal(xy: Tensor) -> Tensor:
    """The unit normal (B, 3) towards the camera, whose z axis points away from it."""
    xy = xy / (xy.norm(dim=1, keepdim=True) / MOST_SLOPE).clamp(min=1.0)
    return torch.cat([xy, -(1.0 - xy.square().sum(dim=1, keepdim=True)).sqrt()], dim=1)


def _inside(radius: Tensor, limit: float) -> Tensor:
    return torch.sigmoid((limit - radius) / EDGE)


def _between(radius: Tensor, near: float, far: float) -> Tensor:
    inside = _inside(radius, far)
    return inside * (1.0 - _inside(radius, near)) if near else inside
