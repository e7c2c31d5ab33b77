"""Learning to tell slopes from the image moments of all frames at once.

Taught together with all else that an eye learns, by some dozens of frames a step, what judges the
moments stops at twice the error that a network of the same size reaches on the same moments alone
(docs/experiments/belief.md). Those of all frames fit into memory. So each time the eyes look at
every frame, a fresh judge learns from what they measured.
"""

import contextlib
import math
from collections.abc import Iterator, Mapping, Sequence

import torch
from torch import Tensor, nn

from hvs_suite.policies.belief.colour_slope import ColourSlopeEye, TurningJudge
from hvs_suite.policies.belief.eye import LOG_SIGMA_SLOPE, SLOPE, VISIBLE, Eye, doubt
from hvs_suite.policies.belief.network import BeliefNetwork
from hvs_suite.policies.belief.slope import SlopeEye

FACING = slice(SLOPE.start, LOG_SIGMA_SLOPE.stop)
"""The part of a sighting that the judge says."""
BATCH = 256
LEARNING_RATE = 2e-3
GRADIENT_NORM = 1.0


@contextlib.contextmanager
def measuring(network: BeliefNetwork) -> Iterator[dict[str, list[Tensor]]]:
    """Keep what the eyes of a network give their judges while they look.

    Args:
        network: In evaluation mode, so that the scales of its moments stay as they are.

    Yields:
        Camera name of each eye with a judge to what it was given, (B, k) for each call.
    """
    numbers: dict[str, list[Tensor]] = {}
    with contextlib.ExitStack() as hooks:
        for name, eye in _slope_eyes(network).items():
            given = numbers[name] = []
            hook = eye.judge.register_forward_pre_hook(
                lambda _, arguments, given=given: given.append(arguments[0])
            )
            hooks.callback(hook.remove)
        yield numbers


def fit_judges(
    network: BeliefNetwork,
    numbers: Mapping[str, Sequence[Tensor]],
    sightings: Mapping[str, Tensor],
    facing: Mapping[str, Tensor],
    visible: Mapping[str, Tensor],
    training: Tensor,
) -> None:
    """Give each eye that tells slopes a judge which learned from all that was measured.

    Args:
        network: Gets them.
        numbers: What its eyes measured of every frame, as `measuring` yields it.
        sightings: Camera name to what the eyes said of every frame, (n, 9); gets what the new
            judges say.
        facing: Camera name to what is true, (n, 2).
        visible: Camera name to whether the target can be seen, (n,) bool.
        training: Numbers of the frames to learn from.
    """
    for name, eye in _slope_eyes(network).items():
        measured, sighting = torch.cat([*numbers[name]]), sightings[name]
        seen = visible[name] & (sighting[:, VISIBLE.start] > 0.0)
        rows = training[seen[training]]
        if len(rows):
            _fit(eye, measured[rows], facing[name][rows].to(measured.device))
            with torch.no_grad():
                sighting[:, FACING] = eye.judge(measured).cpu()


def _slope_eyes(network: BeliefNetwork) -> dict[str, SlopeEye | ColourSlopeEye]:
    """What tells slopes by image moments, by camera name."""
    return {
        name: eye.slope
        for name, eye in network.eyes.items()
        if isinstance(eye, Eye) and isinstance(eye.slope, SlopeEye | ColourSlopeEye)
    }


def _fit(eye: SlopeEye | ColourSlopeEye, numbers: Tensor, facing: Tensor) -> None:
    """Replace an eye's judge by one that learned from numbers (n, k) to say slopes (n, 2)."""
    n_steps = math.ceil(eye.passes * len(numbers) / BATCH)
    # What comes out is to be a function of what was measured alone: a killed run fits it again.
    generator = torch.Generator().manual_seed(0)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(0)
        eye.judge.load_state_dict(eye.new_judge().state_dict())
    optimizer = torch.optim.AdamW(eye.judge.parameters(), LEARNING_RATE)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimizer, n_steps)
    with torch.enable_grad():
        for _ in range(n_steps):
            rows = torch.randint(len(numbers), (BATCH,), generator=generator).to(numbers.device)
            given, true = numbers[rows], facing[rows]
            if isinstance(eye.judge, TurningJudge):
                given, true = eye.judge.turned(given, true, generator)
            said = eye.judge(given)
            loss = doubt(said[:, :2] - true, said[:, 2:]).mean()
            optimizer.zero_grad()
            loss.backward()  # type: ignore[no-untyped-call]
            nn.utils.clip_grad_norm_(eye.judge.parameters(), GRADIENT_NORM)
            optimizer.step()
            schedule.step()
