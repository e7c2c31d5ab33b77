"""Learning to tell slopes from all frames at once.

What tells slopes has to know where the target is and how large, which the eyes find first. So it
learns by itself, each time that they have looked at every frame: for long at first, and later only
what is new. Together with all else that an eye learns it would see each frame a few times; it needs
to see it more often than that, each time turned otherwise.
"""

import math
from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt
import torch
from torch import Tensor, nn

from hvs_suite.policies.belief.colour_slope import ColourSlopeEye
from hvs_suite.policies.belief.eye import (
    LOG_DIAMETER,
    LOG_SIGMA_SLOPE,
    SLOPE,
    UV,
    VISIBLE,
    Eye,
    doubt,
)
from hvs_suite.policies.belief.network import BeliefNetwork

FACING = slice(SLOPE.start, LOG_SIGMA_SLOPE.stop)
"""The part of a sighting that is learned here."""
BATCH = 256
FIRST_PASSES, FURTHER_PASSES = 20, 2
"""How often every frame is learned from: by a fresh judge, by one that goes on."""
FIRST_RATE, FURTHER_RATE = 2e-3, 5e-4
GRADIENT_NORM = 1.0
LEAN_BIN_RAD = math.radians(2.0)
LEAST_SHARE = 0.02
"""Leans that are rarer among all frames are not drawn as if they were as frequent as the others."""
LOOKED_AT_ONCE = 256

Meter = Callable[[str, int], Callable[[int], None]]
"""Given a stage and how many frames it takes, gives what counts those that are done."""
Pictures = Callable[[str, npt.NDArray[np.int64]], Tensor]


def learn_slopes(
    network: BeliefNetwork,
    pictures: Pictures,
    sightings: Mapping[str, Tensor],
    facing: Mapping[str, Tensor],
    visible: Mapping[str, Tensor],
    training: Tensor,
    meter: Meter | None = None,
) -> None:
    """Teach each eye that tells slopes from all frames.

    Those that are kept as they are say what they say.

    Args:
        network: Gets what is learned; in evaluation mode.
        pictures: Gives a camera's images of frames in ascending order, (B, C, H, W) uint8.
        sightings: Camera name to what the eyes said of every frame, (n, 9); gets the slopes that
            they say now.
        facing: Camera name to what is true, (n, 2).
        visible: Camera name to whether the target can be seen, (n,) bool.
        training: Numbers of the frames to learn from.
        meter: Reports how far it is.
    """
    for name, eye in network.eyes.items():
        if not isinstance(eye, Eye) or not isinstance(eye.slope, ColourSlopeEye):
            continue
        if not all(weight.requires_grad for weight in eye.slope.judge.parameters()):
            continue
        sighting = sightings[name]
        seen = visible[name] & (sighting[:, VISIBLE.start] > 0.0)
        rows = training[seen[training]]
        if not len(rows):
            continue

        def shown(rows: Tensor, name: str = name) -> Tensor:
            images = pictures(name, rows.numpy()).to(network.eyes_device)
            return images.float() / 255.0 - 0.5

        _learn(eye.slope, shown, sighting, facing[name], rows, meter)
        with torch.no_grad():
            for some in torch.split(torch.arange(len(sighting)), LOOKED_AT_ONCE):
                given = sighting[some].to(network.eyes_device)
                said = eye.slope(shown(some), given[:, UV], given[:, LOG_DIAMETER])
                sighting[some, FACING] = said.cpu()


def _learn(
    eye: ColourSlopeEye,
    shown: Callable[[Tensor], Tensor],
    sighting: Tensor,
    facing: Tensor,
    frames: Tensor,
    meter: Meter | None,
) -> None:
    """Teach an eye from some of all frames: what was said of all (n, 9), what is true (n, 2)."""
    # What comes out is to be a function of what was seen alone: a killed run learns it again.
    generator = torch.Generator().manual_seed(int(eye.n_lessons))
    is_first = eye.n_lessons == 0
    passes, rate = (FIRST_PASSES, FIRST_RATE) if is_first else (FURTHER_PASSES, FURTHER_RATE)
    n_steps = math.ceil(passes * len(frames) / BATCH)
    optimizer = torch.optim.AdamW(eye.judge.parameters(), rate)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimizer, rate, total_steps=n_steps)
    device = eye.n_lessons.device
    count = meter("learning slopes", n_steps * BATCH) if meter else None
    weights = _leans_alike(facing[frames])
    eye.judge.train()
    for _ in range(n_steps):
        some = torch.multinomial(weights, BATCH, replacement=True, generator=generator)
        drawn = frames[some].sort().values
        given = sighting[drawn].to(device)
        said, true = eye.lesson(
            shown(drawn),
            given[:, UV],
            given[:, LOG_DIAMETER],
            facing[drawn].to(device),
            generator,
        )
        loss = doubt(said[:, :2] - true, said[:, 2:]).mean()
        optimizer.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        nn.utils.clip_grad_norm_(eye.judge.parameters(), GRADIENT_NORM)
        optimizer.step()
        schedule.step()
        if count:
            count(BATCH)
    eye.judge.eval()
    eye.n_lessons += 1


def _leans_alike(facing: Tensor) -> Tensor:
    """How often to draw frames so that no lean of the camera is more likely than others, (n,).

    Demonstrations end upright. A judge that has learned this says of what leans a little that it
    does not lean, in every picture again, and the belief takes its word.

    Args:
        facing: x and y of the true normals in the camera's optical frame, (n, 2).
    """
    lean = facing.norm(dim=1).clamp(max=1.0).asin()
    which = (lean / LEAN_BIN_RAD).long()
    counts = torch.bincount(which).clamp(min=math.ceil(LEAST_SHARE * len(lean)))
    # On a disc of leans, a ring is as likely as it is long.
    return (which + 0.5) / counts[which]
