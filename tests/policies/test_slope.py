"""Eyes that tell slopes: they learn them soon, wherever the target is in whatever image."""

import math

import pytest
import torch
from torch import Tensor

from hvs_suite.policies.belief.slope import MOST_PX, SlopeEye

DIAMETER = 0.2


def rings(normals: Tensor, centres: Tensor, side: int = 112) -> Tensor:
    """A red disc and eight red marks around it on grey, on planes of those normals, by pinhole.

    Args:
        normals: x and y of each, camera frame, (B, 2).
        centres: The discs', in [-1, 1], (B, 2).
        side: Of the images (px).

    Returns:
        Images (B, 3, side, side) in [-0.5, 0.5].
    """
    ticks = (2.0 * torch.arange(side) + 1.0) / side - 1.0
    u = (ticks - centres[:, :1])[:, None]
    v = (ticks - centres[:, 1:])[:, :, None]
    nx, ny = (n[:, None, None] for n in normals.unbind(dim=1))
    nz = -torch.sqrt(1.0 - nx**2 - ny**2)
    # The plane goes through (0, 0, 1): a ray (u, v, 1) meets it at this depth.
    depth = nz / (nx * u + ny * v + nz)
    x, y, z = u * depth, v * depth, depth - 1.0
    from_centre = torch.sqrt(x**2 + y**2 + z**2)
    angle = torch.atan2(y, x)
    around = torch.remainder(angle * 8.0 / (2.0 * math.pi) + 0.5, 1.0) - 0.5
    along = around * (2.0 * math.pi / 8.0) * from_centre
    mark = torch.sqrt((from_centre - 2.2 * DIAMETER) ** 2 + along**2) < 0.25 * DIAMETER
    red = (from_centre < DIAMETER) | mark
    return red[:, None] * torch.tensor([0.3, -0.4, -0.4])[:, None, None]


def place(uv: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """The places, the discs' size, and that they count."""
    n = len(uv)
    return uv, torch.full((n, 1), math.log(DIAMETER)), torch.ones(n, 1, dtype=torch.bool)


def test_a_slope_is_learned_in_some_hundred_steps() -> None:
    torch.manual_seed(0)
    eye = SlopeEye(3, 112)
    optimizer = torch.optim.Adam(eye.parameters(), 3e-3)

    def error(n: int) -> Tensor:
        normals, centres = 0.1 * torch.randn(n, 2), 0.2 * torch.randn(n, 2)
        told = eye(rings(normals, centres), *place(centres))[:, :2]
        return (told - normals).norm(dim=1)

    for _ in range(150):
        loss = error(16).mean()
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    eye.eval()
    with torch.no_grad():
        # To say "square on" every time is off by 0.12 in the median.
        assert error(64).median() < 0.04


def test_what_is_told_of_a_target_is_told_wherever_it_is() -> None:
    torch.manual_seed(0)
    eye = SlopeEye(3, 112).eval()
    normals = 0.1 * torch.randn(4, 2)
    shift = 2.0 * 10 / 112  # Ten pixels.

    def numbers(u: float, v: float) -> Tensor:
        uv, size, _ = place(torch.tensor([u, v]).expand(4, 2))
        return eye._moments(rings(normals, uv), uv, size.exp())

    torch.testing.assert_close(numbers(0.0, 0.0), numbers(shift, -shift), atol=0.05, rtol=0.01)


def test_of_a_large_image_a_square_around_the_target_is_looked_at() -> None:
    torch.manual_seed(0)
    small, large = SlopeEye(3, MOST_PX).eval(), SlopeEye(3, 3 * MOST_PX).eval()
    large.load_state_dict(small.state_dict())
    image = rings(torch.tensor([[0.1, -0.05]]), torch.zeros(1, 2))
    around = torch.rand(1, 3, 3 * MOST_PX, 3 * MOST_PX) - 0.5
    around[:, :, MOST_PX : 2 * MOST_PX, 2 * MOST_PX :] = image
    uv, size, counts = place(torch.zeros(1, 2))
    far = uv + torch.tensor([[2.0 / 3.0, 0.0]])
    # Only the numbers: where in the image the target is and how large is told besides.
    torch.testing.assert_close(
        large._moments(around, far, size.exp() / 3.0), small._moments(image, uv, size.exp())
    )
    assert large(around, far, size - math.log(3.0), counts).isfinite().all()


@pytest.mark.parametrize("n_seen", [0, 1])
def test_targets_out_of_view_do_not_count_for_the_scales(n_seen: int) -> None:
    eye = SlopeEye(3, 56)
    before = eye.mean.clone(), eye.variance.clone()
    uv, size, counts = place(torch.zeros(4, 2))
    eye(torch.rand(4, 3, 56, 56) - 0.5, uv, size, counts & (torch.arange(4) < n_seen)[:, None])
    torch.testing.assert_close((eye.mean, eye.variance), before)


def test_grey_images_have_contrasts_too() -> None:
    eye = SlopeEye(1, 56)
    uv, size, counts = place(torch.zeros(2, 2))
    assert eye(torch.rand(2, 1, 56, 56) - 0.5, uv, size, counts).shape == (2, 3)
