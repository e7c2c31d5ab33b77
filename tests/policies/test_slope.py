"""Eyes that tell slopes by contrasts: the same wherever the target is, in whatever image."""

import math

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


def place(uv: Tensor) -> tuple[Tensor, Tensor]:
    """The places, and the discs' size."""
    return uv, torch.full((len(uv), 1), math.log(DIAMETER))


def test_what_is_told_of_a_target_is_told_wherever_it_is() -> None:
    torch.manual_seed(0)
    eye = SlopeEye(3, 112).eval()
    normals = 0.1 * torch.randn(4, 2)
    shift = 2.0 * 10 / 112  # Ten pixels.

    def numbers(u: float, v: float) -> Tensor:
        uv, size = place(torch.tensor([u, v]).expand(4, 2))
        return eye._moments(rings(normals, uv), uv, size.exp())

    torch.testing.assert_close(numbers(0.0, 0.0), numbers(shift, -shift), atol=0.05, rtol=0.01)


def test_of_a_large_image_a_square_around_the_target_is_looked_at() -> None:
    torch.manual_seed(0)
    small, large = SlopeEye(3, MOST_PX).eval(), SlopeEye(3, 3 * MOST_PX).eval()
    large.load_state_dict(small.state_dict())
    image = rings(torch.tensor([[0.1, -0.05]]), torch.zeros(1, 2))
    around = torch.rand(1, 3, 3 * MOST_PX, 3 * MOST_PX) - 0.5
    around[:, :, MOST_PX : 2 * MOST_PX, 2 * MOST_PX :] = image
    uv, size = place(torch.zeros(1, 2))
    far = uv + torch.tensor([[2.0 / 3.0, 0.0]])
    # Only the numbers: where in the image the target is and how large is told besides.
    torch.testing.assert_close(
        large._moments(around, far, size.exp() / 3.0), small._moments(image, uv, size.exp())
    )
    assert large(around, far, size - math.log(3.0)).isfinite().all()


def test_grey_images_have_contrasts_too() -> None:
    eye = SlopeEye(1, 56)
    uv, size = place(torch.zeros(2, 2))
    assert eye(torch.rand(2, 1, 56, 56) - 0.5, uv, size).shape == (2, 3)
