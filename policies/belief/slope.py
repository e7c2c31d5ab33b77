"""The slope of a surface, by image moments of what lies around a target.

What leans towards a camera looks larger: of a ring of marks around the target, the near half lies
farther out than the far half, by a hundredth of the ring. Convolutions did not learn to see this
in thousands of steps (docs/experiments/belief.md). Image moments, which visual servoing has used
for long (Chaumette 2004, "Image moments: a general and useful set of features for visual
servoing", IEEE Transactions on Robotics 20(4), 713-723), hold it in numbers from which a small
network learns it soon.

Colour contrasts are weighed by Gaussian windows about the target, some multiples of its size, and
their moments to the third order divided by their sum. What varies little among these numbers says
most, so each is put to the same scale by its own spread.
"""

import torch
from torch import Tensor, nn

OPPONENTS = (
    (1.0, -1.0, 0.0),
    (0.0, 1.0, -1.0),
    (1.0, -0.5, -0.5),
    (-1.0, 0.5, 0.5),
    (-0.5, 1.0, -0.5),
    (-0.5, -0.5, 1.0),
    (0.33, 0.33, 0.33),
    (-0.33, -0.33, -0.33),
)
"""Contrasts of red, green and blue: opponent colours, light and dark. Learned ones drift, and the
scales of their moments lag behind them."""
BRIGHTNESS = ((1.0,), (-1.0,))
"""The same of grey."""
WINDOWS = (0.5, 1.0, 1.6)
"""Standard deviations of the windows, in diameters of the target."""
ORDER = 3
PARTS = tuple((a, b) for a in range(ORDER + 1) for b in range(ORDER + 1 - a) if a + b)
SLOPE_SIZE = 3
HIDDEN = 128
MOST_PX = 112
"""Of an image, only a square of this side around the target is looked at."""
LEAST = 1e-3
"""Sums below it count as none (areas of the target's diameter squared)."""
LEAST_DIAMETER = 0.005
"""Smaller targets count as this large (image widths)."""
LEAST_SPREAD = 0.003
"""What varies less is not raised to the others' scale."""


def _judge(n_numbers: int) -> nn.Sequential:
    """A network from so many numbers to a slope and its doubt."""
    half = HIDDEN // 2
    return nn.Sequential(
        nn.Linear(n_numbers, HIDDEN),
        nn.SiLU(),
        nn.Linear(HIDDEN, half),
        nn.SiLU(),
        nn.Linear(half, SLOPE_SIZE),
    )


class SlopeEye(nn.Module):
    """Says how a surface faces the camera, by weights that ship: it does not learn any more.

    Args:
        in_channels: Channels of the image.
        side: Side of the image (px).
    """

    contrasts: Tensor
    mean: Tensor
    variance: Tensor
    n_batches: Tensor

    def __init__(self, in_channels: int, side: int) -> None:
        super().__init__()
        contrasts = OPPONENTS if in_channels == len(OPPONENTS[0]) else BRIGHTNESS
        self.register_buffer("contrasts", torch.tensor(contrasts), persistent=False)
        n = len(contrasts) * len(WINDOWS) * (1 + len(PARTS))
        self.register_buffer("mean", torch.zeros(n))
        self.register_buffer("variance", torch.ones(n))
        self.register_buffer("n_batches", torch.tensor(0.0))  # The shipped weights have it.
        self.judge = _judge(n + 3)
        self._side, self._window = side, min(side, MOST_PX)

    def forward(self, images: Tensor, uv: Tensor, log_diameter: Tensor) -> Tensor:
        """Look.

        Args:
            images: (B, C, H, W), float in [-0.5, 0.5].
            uv: The target's centre in [-1, 1], u right and v down, (B, 2).
            log_diameter: Logarithm of its apparent diameter in image widths, (B, 1).

        Returns:
            x and y of the surface's normal in the camera's optical frame, and the logarithm of
            their standard deviation, (B, 3).
        """
        uv = uv.clamp(-1.2, 1.2)
        diameter = log_diameter.exp().clamp(LEAST_DIAMETER, 1.0)
        numbers = self._moments(images, uv, diameter)
        alike = (numbers - self.mean) * torch.rsqrt(self.variance + LEAST_SPREAD**2)
        # A target that is cut or not there gives numbers that no other has.
        alike = alike.clamp(-10.0, 10.0)
        return self.judge(torch.cat([alike, uv, diameter.log() + 2.0], dim=1))

    def _moments(self, images: Tensor, uv: Tensor, diameter: Tensor) -> Tensor:
        """Logarithms of the sums, and moments over sums, (B, n).

        Args:
            images: As in `forward`.
            uv: As in `forward`.
            diameter: Apparent diameter in image widths, (B, 1).
        """
        n, window = len(images), self._window
        # Columns and rows of the square, in px of the image and then in diameters from the centre.
        centre = 0.5 * (uv + 1.0) * self._side  # (B, 2)
        first = (centre - 0.5 * window).round().clamp(0, self._side - window)
        px = torch.arange(window, device=uv.device)
        at = first[:, :, None] + px  # (B, 2, window)
        if window < self._side:
            columns, rows = at.long().unbind(dim=1)
            batch = torch.arange(n, device=uv.device)[:, None, None]
            cut = images.permute(0, 2, 3, 1)[batch, rows[:, :, None], columns[:, None]]
            images = cut.permute(0, 3, 1, 2)
        off = (at + 0.5 - centre[:, :, None]) / (diameter[:, :, None] * self._side)
        bases = []
        for sigma in WINDOWS:
            scaled = (off / sigma)[..., None]
            powers = scaled ** torch.arange(ORDER + 1, device=uv.device)
            bases.append(torch.exp(-0.5 * scaled**2) * powers)  # (B, 2, window, order + 1)
        along_u, along_v = torch.cat(bases, dim=3).unbind(dim=1)
        # Four times as fast as a convolution of one pixel.
        seen = torch.relu(self.contrasts @ images.flatten(2)).view(n, -1, window)
        rows_summed = seen @ along_u  # (B, c * window, k)
        rows_summed = rows_summed.view(n, -1, window, len(WINDOWS), ORDER + 1)
        along_v = along_v.view(n, window, len(WINDOWS), ORDER + 1)
        moments = torch.einsum("bchsp,bhsq->bcspq", rows_summed, along_v)
        moments = moments / ((diameter * self._side) ** 2)[:, :, None, None, None]
        total = moments[..., 0, 0]
        shares = [moments[..., a, b] / (total + LEAST) for a, b in PARTS]
        return torch.stack([torch.log(total + LEAST), *shares], dim=3).flatten(1)
