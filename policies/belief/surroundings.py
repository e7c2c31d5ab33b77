"""What stands around: how high the table is taken up, seen by a camera that does not move.

For each cell of a grid over the table the eye says whether something stands or hangs there, and
between which heights. It samples its features where the camera sees the cell's middle at some
heights (inverse perspective mapping at several planes, as in Roddick et al. 2019, "Orthographic
feature transform for monocular 3D object detection"), so what it learns of a picture's one corner
holds for the others. Base frame, metres.
"""

import math
from collections.abc import Sequence

import torch
import torch.nn.functional as F  # noqa: N812
from torch import Tensor, nn

CELLS = 24
"""Along each side of the grid."""
HALF_M = 0.9
"""The grid reaches so far from the base's axis, to either side."""
LEVELS_M = (0.0, 0.30)
"""Heights at which features are sampled."""
SIZE = 3 * CELLS**2
"""Of the surroundings: logits that cells are taken up, from which heights, and up to which."""
BOX = 7
"""Numbers of a box: its centre (x, y, z), half its sides (m), and its turn about the vertical
(rad)."""
SHARPNESS_M = 0.02


class SurroundingsEye(nn.Module):
    """Tells from an eye's features what stands around.

    Args:
        channels: Of the features.
        tan: Tangent of half the camera's field of view.
        origin: Where the camera is, (3,) m.
        rotation: Its optical axes as columns, (3, 3).
    """

    at: Tensor

    def __init__(
        self,
        channels: int,
        tan: float,
        origin: Sequence[float],
        rotation: Sequence[Sequence[float]],
    ) -> None:
        super().__init__()
        R = torch.tensor(rotation, dtype=torch.float64)
        eye = torch.tensor(origin, dtype=torch.float64)
        ticks = _middles().double()
        y, x = torch.meshgrid(ticks, ticks, indexing="ij")
        views = []
        for level in LEVELS_M:
            ways = torch.stack([x, y, torch.full_like(x, level)], dim=2) - eye
            optical = ways @ R
            views.append(optical[..., :2] / (tan * optical[..., 2:]))
        at = torch.stack(views)  # (levels, cells, cells, 2)
        self.register_buffer("at", at.float(), persistent=False)
        width = 3 * channels // 2
        self.judge = nn.Sequential(
            nn.Conv2d(len(LEVELS_M) * channels + 2, width, 1),
            nn.ReLU(inplace=True),
            nn.Conv2d(width, width, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(width, width, 3, padding=1),
            nn.ReLU(inplace=True),
            nn.Conv2d(width, 3, 1),
        )
        last = self.judge[-1]
        assert isinstance(last, nn.Conv2d)
        assert last.bias is not None
        with torch.no_grad():
            last.weight.mul_(0.1)
            last.bias.copy_(torch.tensor([-3.0, 0.0, 0.3]))

    def forward(self, maps: Tensor) -> Tensor:
        """Look.

        Args:
            maps: Features, (B, h, w, channels).

        Returns:
            (B, `SIZE`).
        """
        n = len(maps)
        planes = maps.permute(0, 3, 1, 2)
        sampled = [
            F.grid_sample(planes, at.expand(n, -1, -1, -1), align_corners=False) for at in self.at
        ]
        ticks = _middles().to(maps)
        y, x = torch.meshgrid(ticks, ticks, indexing="ij")
        place = torch.stack([x, y])[None].expand(n, -1, -1, -1)
        return self.judge(torch.cat([*sampled, place], dim=1)).flatten(1)


def _middles() -> Tensor:
    """Middles of the cells along a side, (`CELLS`,) m."""
    return HALF_M * ((2.0 * torch.arange(CELLS) + 1.0) / CELLS - 1.0)


def taken_up(boxes: Tensor) -> Tensor:
    """What boxes take up of the table.

    Args:
        boxes: (B, n, `BOX`); a box without height is none.

    Returns:
        From which height and up to which cells are taken up that a box reaches into, 0 and 0 for
        those that are free, (B, 2, `CELLS`, `CELLS`) m.
    """
    ticks = _middles().to(boxes)
    y, x = torch.meshgrid(ticks, ticks, indexing="ij")
    centre, half, yaw = boxes[..., :3], boxes[..., 3:6], boxes[..., 6]
    c, s = (f(yaw)[..., None, None] for f in (torch.cos, torch.sin))
    dx, dy = x - centre[..., 0, None, None], y - centre[..., 1, None, None]
    along, across = (c * dx + s * dy).abs(), (c * dy - s * dx).abs()
    reach = 0.5 * (2.0 * HALF_M / CELLS)
    inside = (along <= half[..., 0, None, None] + reach) & (
        across <= half[..., 1, None, None] + reach
    )
    inside &= (half[..., 2] > 0.0)[..., None, None]
    low = (centre[..., 2] - half[..., 2])[..., None, None].clamp(min=0.0)
    high = (centre[..., 2] + half[..., 2])[..., None, None]
    under = torch.where(inside, low, math.inf).amin(dim=1)
    top = torch.where(inside, high, 0.0).amax(dim=1)
    return torch.stack([torch.where(top > 0.0, under, 0.0), top], dim=1)


def surroundings_loss(said: Tensor, boxes: Tensor) -> Tensor:
    """Loss of what an eye says of the surroundings.

    Args:
        said: (B, `SIZE`).
        boxes: What stands there, (B, n, `BOX`).

    Returns:
        Scalar.
    """
    true = taken_up(boxes)
    maps = said.view(-1, 3, CELLS, CELLS)
    is_taken = (true[:, 1] > 0.0).to(said)
    there = F.binary_cross_entropy_with_logits(maps[:, 0], is_taken)
    off = F.smooth_l1_loss(maps[:, 1:], true, beta=0.05, reduction="none").sum(dim=1)
    return 10.0 * there + 5.0 * (off * is_taken).sum() / is_taken.sum().clamp(min=1.0)


def blocked(said: Tensor, points: Tensor, radius_m: float) -> Tensor:
    """How likely balls meet something.

    Args:
        said: What the eye says, (B, `SIZE`).
        points: Their middles, (B, n, 3) m.
        radius_m: Of each.

    Returns:
        0 to 1, (B, n).
    """
    logits, under, top = said.view(-1, 3, CELLS, CELLS).unbind(dim=1)
    maps = torch.stack([torch.sigmoid(logits), under, top], dim=1)
    at = points[:, None, :, :2] / HALF_M
    here = F.grid_sample(maps, at, align_corners=False, padding_mode="zeros")[:, :, 0]
    there, under, top = here.unbind(dim=1)
    z = points[..., 2]
    depth = torch.minimum(top + radius_m - z, z + radius_m - under)
    return there * torch.sigmoid(depth / SHARPNESS_M)
