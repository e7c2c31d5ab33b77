"""Eyes that tell slopes by the shape of what has the target's colour."""

import dataclasses
import math
from types import SimpleNamespace

import pytest
import torch
from torch import Tensor

from hvs_suite.policies.belief.cell_model import cell_model
from hvs_suite.policies.belief.colour_slope import SIDE as SIDE_TURNED
from hvs_suite.policies.belief.colour_slope import ColourSlopeEye, turn_around, turn_to
from hvs_suite.policies.belief.eye import LOG_DIAMETER, SIGHTING_SIZE, SLOPE, UV, VISIBLE
from hvs_suite.policies.belief.network import BeliefNetwork, Shape
from hvs_suite.policies.catalogue import checkpoint_folder
from hvs_suite.policies.checkpoints.loading import load_network
from hvs_suite.policies.imitation import slopes
from hvs_suite.policies.imitation.settings import take_eyes
from hvs_suite.policies.imitation.slopes import (
    BATCH,
    FIRST_PASSES,
    FURTHER_PASSES,
    learn_slopes,
)
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


@pytest.fixture
def network() -> BeliefNetwork:
    torch.manual_seed(0)
    shape = Shape({"eih": (3, SIDE)}, hidden=8, channels=8, slopes=("eih",), slopes_by="colour")
    return BeliefNetwork(shape, cell_model(find("surface-hard"))).eval()


def as_bytes(images: Tensor) -> Tensor:
    return ((images + 0.5) * 255.0).round().to(torch.uint8)


def learn(
    network: BeliefNetwork, images: Tensor, sightings: Tensor, facing: Tensor, visible: Tensor
) -> None:
    """Teach from the first four fifths of all frames."""
    pictures = as_bytes(images)
    learn_slopes(
        network,
        lambda camera, rows: pictures[torch.from_numpy(rows)],
        {"eih": sightings},
        {"eih": facing},
        {"eih": visible},
        torch.arange(4 * len(images) // 5),
    )


def looked(uv: Tensor, size: Tensor) -> Tensor:
    """What an eye said of frames that it sees, but for the slopes."""
    sightings = torch.zeros(len(uv), SIGHTING_SIZE)
    sightings[:, UV], sightings[:, LOG_DIAMETER], sightings[:, VISIBLE] = uv, size, 5.0
    return sightings


@pytest.mark.slow
def test_slopes_are_learned_from_all_frames_that_show_the_target(
    network: BeliefNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A few hundred frames are a step or two of what learns from tens of thousands.
    monkeypatch.setattr(slopes, "BATCH", 16)
    n = 500
    facing, uv = (size * torch.randn(n, 2).clamp(-2.0, 2.0) for size in (0.3, 0.3))
    images, size = seen(facing, uv)
    is_seen = torch.arange(n) % 4 != 0
    sightings = looked(uv, size)
    before = sightings.clone()
    # What is not seen, or not to be learned from, would teach something else.
    told = torch.where((is_seen & (torch.arange(n) < 4 * n // 5))[:, None], facing, -facing)
    learn(network, images, sightings, told, is_seen)
    off = (sightings[:, SLOPE] - facing)[4 * n // 5 :].norm(dim=1)
    # To say "square on" every time is off by 0.35 in the median.
    assert off.median() < 0.2
    # Nothing else is said anew, and the eye itself says the same from now on.
    torch.testing.assert_close(sightings[:, : SLOPE.start], before[:, : SLOPE.start])
    eye = network.eyes["eih"].slope
    again = eye(as_bytes(images).float() / 255.0 - 0.5, uv, size)
    torch.testing.assert_close(again[:, :2], sightings[:, SLOPE])


def test_a_judge_that_has_learned_goes_on_from_there(
    network: BeliefNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    eye = network.eyes["eih"].slope
    passes = []
    step = torch.optim.AdamW.step
    monkeypatch.setattr(torch.optim.AdamW, "step", lambda *args: (passes.append(0), step(*args)))
    facing, uv = 0.2 * torch.randn(10, 2), torch.zeros(10, 2)
    images, size = seen(facing, uv)
    for lesson in (1, 2):
        learn(network, images, looked(uv, size), facing, torch.ones(10, dtype=torch.bool))
        assert eye.n_lessons == lesson
    first = math.ceil(FIRST_PASSES * 8 / BATCH)
    assert len(passes) == first + math.ceil(FURTHER_PASSES * 8 / BATCH)


def test_what_is_always_upright_in_the_end_is_not_taken_to_be_so(
    network: BeliefNetwork, monkeypatch: pytest.MonkeyPatch
) -> None:
    lean = torch.cat([torch.full((300,), 0.01), torch.linspace(0.0, 0.6, 100)])
    angle = torch.linspace(0.0, 60.0, 400)
    facing = lean.sin()[:, None] * torch.stack([angle.cos(), angle.sin()], dim=1)
    drawn: list[Tensor] = []
    lesson = ColourSlopeEye.lesson

    def noted(self: ColourSlopeEye, *given: object) -> tuple[Tensor, Tensor]:
        drawn.append(given[3])
        return lesson(self, *given)

    monkeypatch.setattr(ColourSlopeEye, "lesson", noted)
    monkeypatch.setattr(slopes, "FIRST_PASSES", 1)
    images, size = seen(torch.zeros(1, 2), torch.zeros(1, 2))
    uv = torch.zeros(500, 2)
    learn(
        network,
        images.expand(500, -1, -1, -1),
        looked(uv, size.expand(500, 1)),
        torch.cat([facing, torch.zeros(100, 2)]),
        torch.ones(500, dtype=torch.bool),
    )
    leans = torch.cat(drawn).norm(dim=1).asin()
    # On a disc of leans up to 0.6, a ninth is below 0.2, and a quarter below 0.3.
    assert (leans < 0.2).float().mean() == pytest.approx(1 / 9, abs=0.05)
    assert (leans < 0.3).float().mean() == pytest.approx(1 / 4, abs=0.06)


def test_nothing_is_learned_of_a_target_that_is_never_seen(network: BeliefNetwork) -> None:
    images, size = seen(torch.zeros(10, 2), torch.zeros(10, 2))
    sightings = looked(torch.zeros(10, 2), size)
    before, weights = sightings.clone(), network.eyes["eih"].slope.state_dict()
    weights = {name: value.clone() for name, value in weights.items()}
    learn(network, images, sightings, torch.ones(10, 2), torch.zeros(10, dtype=torch.bool))
    torch.testing.assert_close(sightings, before)
    torch.testing.assert_close(network.eyes["eih"].slope.state_dict(), weights)


def test_a_target_looks_the_same_wherever_it_is_in_the_picture(eye: ColourSlopeEye) -> None:
    uv = torch.tensor([[0.0, 0.0], [0.4, -0.3]])
    # The same slope against the ray to the target.
    here = torch.tensor([0.3, 0.1, -math.sqrt(0.9)])
    facing = (turn_to(uv, TAN).transpose(1, 2) @ here)[:, :2]
    images, size = seen(facing, uv)
    generator = torch.Generator().manual_seed(0)
    said = eye(images, uv, size)
    straight = eye._straight(
        eye._colours(images, uv, size.exp()), turn_to(uv, TAN), size[:1].exp().expand(2, 1)
    )
    # But for the edges, which fall on other pixels.
    assert (straight[0] - straight[1]).abs().mean() < 0.1
    assert said.shape == (2, 3)
    _, true = eye.lesson(images, uv, size, facing, generator)
    torch.testing.assert_close(true.norm(dim=1), here[:2].norm().expand(2))


def test_what_is_learned_from_turns_with_the_picture(eye: ColourSlopeEye) -> None:
    facing, uv = torch.tensor([[0.3, 0.1]]), torch.tensor([[0.2, -0.1]])
    images, size = seen(facing, uv)
    told = eye._colours(images, uv, size.exp())
    quarter = turn_around(torch.tensor([[0.5 * math.pi]]), torch.ones(1, 1)) @ turn_to(uv, TAN)
    plain = eye._straight(told, turn_to(uv, TAN), size.exp())
    # In the picture v points down, so this turns x to y.
    turned = torch.rot90(plain, -1, (2, 3))
    torch.testing.assert_close(eye._straight(told, quarter, size.exp()), turned, atol=2e-3, rtol=0)
    mirrored = turn_around(torch.zeros(1, 1), -torch.ones(1, 1)) @ turn_to(uv, TAN)
    torch.testing.assert_close(
        eye._straight(told, mirrored, size.exp()), plain.flip(2), atol=2e-3, rtol=0
    )


def test_neither_colours_nor_light_count(eye: ColourSlopeEye) -> None:
    facing, uv = torch.tensor([[0.3, 0.1]]), torch.tensor([[0.2, -0.1]])
    red, size = seen(facing, uv)
    blue, _ = seen(facing, uv, own=(-0.4, -0.2, 0.3), other=(0.2, 0.3, -0.2))
    half = 0.5 * red
    grey, _ = seen(facing, uv, own=(0.3,), other=(-0.1,))
    for other in (blue, half, grey):
        along = [eye._colours(each, uv, size.exp())[:, :1] for each in (other, red)]
        # The dark line beside the target is of another colour, so it is left out.
        is_line = (red[:, 1:2] + 0.4).abs() < 1e-3
        torch.testing.assert_close(along[0][~is_line], along[1][~is_line], atol=1e-4, rtol=0)


def test_what_the_camera_did_not_see_is_marked(eye: ColourSlopeEye) -> None:
    facing, uv = torch.zeros(1, 2), torch.tensor([[0.95, 0.0]])
    images, size = seen(facing, uv)
    frame = turn_to(uv, TAN)
    straight = eye._straight(eye._colours(images, uv, size.exp()), frame, size.exp())
    in_view = straight[0, 2]
    assert in_view[:, : SIDE_TURNED // 3].all()
    assert not in_view[:, -SIDE_TURNED // 3 :].any()
    assert (straight[0, :2, :, -SIDE_TURNED // 3 :] == 0.0).all()


@pytest.mark.parametrize(("uv", "log_diameter"), [(1.7, 0.5), (-3.0, -9.0), (0.0, -30.0)])
def test_whatever_an_eye_says_a_slope_is_told(
    eye: ColourSlopeEye, uv: float, log_diameter: float
) -> None:
    said = eye(
        torch.rand(1, 3, SIDE, SIDE) - 0.5, torch.full((1, 2), uv), torch.full((1, 1), log_diameter)
    )
    assert said.isfinite().all()


def test_eyes_begin_with_those_that_told_slopes_otherwise() -> None:
    folder = checkpoint_folder("pretrained", "surface-fuselage")
    other = load_network(folder)
    torch.manual_seed(0)
    network = BeliefNetwork(dataclasses.replace(other.shape, slopes_by="colour"), other.cell)
    told = network.eyes["eih"].slope.judge.features[0].weight.clone()
    take_eyes(SimpleNamespace(network=network), [folder])
    torch.testing.assert_close(
        network.eyes["eih"].features[0].weight, other.eyes["eih"].features[0].weight
    )
    torch.testing.assert_close(network.eyes["eih"].slope.judge.features[0].weight, told)
