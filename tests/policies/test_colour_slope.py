"""Eyes that tell slopes by the shape of what has the target's colour."""

import dataclasses
import math
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from hvs_suite.policies.belief.cell_model import cell_model
from hvs_suite.policies.belief.colour_slope import ColourSlopeEye
from hvs_suite.policies.belief.eye import SLOPE
from hvs_suite.policies.belief.network import BeliefNetwork, Shape
from hvs_suite.policies.catalogue import checkpoint_folder
from hvs_suite.policies.checkpoints.loading import load_network
from hvs_suite.policies.imitation.settings import take_eyes
from hvs_suite.policies.imitation.slopes import fit_judges, measuring
from hvs_suite.registry import find

TAN = math.tan(math.radians(30.0))
SIDE = 64
RED, GREY = (0.4, -0.3, -0.3), (0.0, 0.05, 0.1)


def seen(
    normals: Tensor,
    uv: Tensor,
    own: tuple[float, ...] = RED,
    other: tuple[float, ...] = GREY,
) -> tuple[Tensor, Tensor]:
    """A disc with six marks around it, on planes at unit distance, and a dark line beside it.

    Args:
        normals: x and y of each, optical frame, (B, 2).
        uv: The discs' centres, in [-1, 1], (B, 2).
        own: Colour of disc and marks.
        other: Colour of the plane.

    Returns:
        Images (B, C, SIDE, SIDE) in [-0.5, 0.5], and logarithms of apparent diameters, (B, 1).
    """
    radius = 0.12
    ticks = (2.0 * torch.arange(SIDE) + 1.0) / SIDE - 1.0
    v, u = torch.meshgrid(ticks, ticks, indexing="ij")
    rays = torch.stack([TAN * u, TAN * v, torch.ones_like(u)], dim=-1)
    n = torch.cat([normals, -(1.0 - normals.square().sum(dim=1, keepdim=True)).sqrt()], dim=1)
    centre = torch.cat([TAN * uv, torch.ones(len(uv), 1)], dim=1)
    centre = centre / centre.norm(dim=1, keepdim=True)
    depth = (n * centre).sum(dim=1)[:, None, None] / torch.einsum("bi,hwi->bhw", n, rays)
    off = depth[..., None] * rays - centre[:, None, None]
    x = torch.linalg.cross(n, torch.tensor([[0.0, 1.0, 0.0]]).expand_as(n))
    x = x / x.norm(dim=1, keepdim=True)
    a = torch.einsum("bi,bhwi->bhw", x, off) / radius
    b = torch.einsum("bi,bhwi->bhw", torch.linalg.cross(n, x), off) / radius
    from_centre, angle = (a**2 + b**2).sqrt(), torch.atan2(b, a)
    around = torch.remainder(angle * 6.0 / (2.0 * math.pi) + 0.5, 1.0) - 0.5
    along = around * (2.0 * math.pi / 6.0) * from_centre
    is_mark = ((from_centre - 1.6) ** 2 + along**2).sqrt() < 0.15
    is_own = ((from_centre < 1.0) | is_mark)[:, None]
    is_line = ((a - 2.2).abs() < 0.1)[:, None]
    colours = [torch.tensor(c).view(1, -1, 1, 1) for c in (own, other)]
    images = torch.where(is_own, colours[0], torch.where(is_line, -0.4, colours[1]))
    area = is_own[:, 0] & (from_centre < 1.0)
    diameter = 2.0 * (area.sum(dim=(1, 2)) / math.pi).sqrt() / SIDE
    return images, diameter.log()[:, None]


@pytest.fixture
def eye() -> ColourSlopeEye:
    torch.manual_seed(0)
    return ColourSlopeEye(SIDE, TAN).eval()


def test_a_slope_is_learned_from_some_hundred_frames() -> None:
    torch.manual_seed(0)
    shape = Shape({"eih": (3, SIDE)}, hidden=8, channels=8, slopes=("eih",), slopes_by="colour")
    network = BeliefNetwork(shape, cell_model(find("surface-hard"))).eval()
    eye = network.eyes["eih"].slope
    n, training = 300, torch.arange(240)
    facing, uv = 0.2 * torch.randn(n, 2).clamp(-2.0, 2.0), 0.3 * torch.randn(n, 2).clamp(-2.0, 2.0)
    images, size = seen(facing, uv)
    everyone = torch.ones(n, 1, dtype=torch.bool)
    with torch.no_grad(), measuring(network) as numbers:
        told = eye.train()(images, uv, size, everyone)
        numbers["eih"].clear()
        told = eye.eval()(images, uv, size, everyone)
    sightings = torch.zeros(n, 9)
    sightings[:, SLOPE] = told[:, :2]
    sightings[:, 3] = 5.0
    fit_judges(
        network, numbers, {"eih": sightings}, {"eih": facing}, {"eih": everyone[:, 0]}, training
    )
    off = (sightings[:, SLOPE] - facing)[240:].norm(dim=1)
    # To say "square on" every time is off by 0.24 in the median.
    assert off.median() < 0.08


def test_turning_a_picture_turns_what_is_measured(eye: ColourSlopeEye) -> None:
    images, size = seen(torch.tensor([[0.3, 0.1]]), torch.zeros(1, 2))
    uv = torch.zeros(1, 2)
    plain, real, imaginary, _ = eye._moments(images, uv, size.exp())
    # In the picture v points down, so this turns x to y.
    turned = eye._moments(torch.rot90(images, -1, (2, 3)), uv, size.exp())
    torch.testing.assert_close(turned[0], plain, atol=1e-4, rtol=1e-4)
    expected = torch.complex(real, imaginary) * (1j**eye.judge.orders)
    torch.testing.assert_close(torch.complex(turned[1], turned[2]), expected, atol=1e-4, rtol=1e-4)


def test_turned_frames_face_where_they_are_turned_to(eye: ColourSlopeEye) -> None:
    facing, uv = torch.tensor([[0.3, 0.1], [-0.2, 0.4]]), torch.tensor([[0.0, 0.0], [0.4, -0.3]])
    images, size = seen(facing, uv)
    given: list[Tensor] = []
    eye.judge.register_forward_pre_hook(lambda _, arguments: given.append(arguments[0]))
    eye(images, uv, size, torch.ones(2, 1, dtype=torch.bool))
    _, turned = eye.judge.turned(given[0], facing, torch.Generator().manual_seed(0))
    assert not torch.isclose(turned, facing, atol=0.02).all(dim=1).any()

    def against_ray(normals: Tensor) -> Tensor:
        n = torch.cat([normals, -(1.0 - normals.square().sum(dim=1, keepdim=True)).sqrt()], dim=1)
        ray = torch.cat([TAN * given[0][:, -2:], torch.ones(2, 1)], dim=1)
        return (n * ray).sum(dim=1) / ray.norm(dim=1)

    torch.testing.assert_close(against_ray(turned), against_ray(facing))


def test_neither_colours_nor_light_count(eye: ColourSlopeEye) -> None:
    facing, uv = torch.tensor([[0.3, 0.1]]), torch.tensor([[0.2, -0.1]])
    red, size = seen(facing, uv)
    blue, _ = seen(facing, uv, own=(-0.4, -0.2, 0.3), other=(0.2, 0.3, -0.2))
    grey, _ = seen(facing, uv, own=(0.3,), other=(-0.1,))
    for other in (blue, 0.5 * red, grey):
        torch.testing.assert_close(
            eye._moments(other, uv, size.exp()), eye._moments(red, uv, size.exp())
        )


@pytest.mark.parametrize("n_seen", [0, 1])
def test_targets_out_of_view_do_not_count_for_the_scales(eye: ColourSlopeEye, n_seen: int) -> None:
    before = eye.mean.clone(), eye.variance.clone()
    uv, size = torch.full((4, 2), 1.2), torch.full((4, 1), -9.0)
    counts = (torch.arange(4) < n_seen)[:, None]
    told = eye.train()(torch.rand(4, 3, SIDE, SIDE) - 0.5, uv, size, counts)
    torch.testing.assert_close((eye.mean, eye.variance), before)
    assert told.isfinite().all()


def test_eyes_begin_with_those_that_told_slopes_otherwise() -> None:
    folder = checkpoint_folder("pretrained", "surface-fuselage")
    other = load_network(folder)
    torch.manual_seed(0)
    network = BeliefNetwork(dataclasses.replace(other.shape, slopes_by="colour"), other.cell)
    told = network.eyes["eih"].slope.judge.layers[0].weight.clone()
    take_eyes(SimpleNamespace(network=network), folder)
    torch.testing.assert_close(
        network.eyes["eih"].features[0].weight, other.eyes["eih"].features[0].weight
    )
    torch.testing.assert_close(network.eyes["eih"].slope.judge.layers[0].weight, told)
