"""Axes of robustness: what may differ between a task as named and a real cell, at three strengths.

Each strength is a few options of the task, so that an episode played with it is recorded, verified
and played again like any other. They are `unannounced`: the scenes are the named task's but for
what the options change, and policies are told the named task's parameters. What a task disturbs
already is disturbed further: independent errors add as the root of the sum of their squares.
"""

import dataclasses
import math
from collections.abc import Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.spec import Spec

STRENGTHS = ("mild", "medium", "strong")

Options = Mapping[str, Any]


@dataclasses.dataclass(frozen=True)
class Axis:
    """One thing that differs from the named task.

    Attributes:
        name: As the command line takes it.
        title: In words.
        anchor: Where the strengths come from; where there are none, why it makes no sense here.
        levels: Each of `STRENGTHS` in words; none where it makes no sense.
        options: Options of the task for each of them.
    """

    name: str
    title: str
    anchor: str
    levels: tuple[str, ...] = ()
    options: tuple[Options, ...] = ()


def common_axes(spec: "Spec") -> tuple[Axis, ...]:
    """The axes that make sense for any task.

    Args:
        spec: The named task.
    """
    return (
        _look(
            "light",
            "light",
            "its range is one, two and three steps of 1.5, the least change of illuminance that "
            "EN 12464-1 takes to matter; two are what hard tasks draw",
            spec.light_strength if spec.vary_light else 0.0,
        ),
        _look(
            "colour",
            "colours",
            "half, once and one and a half times what hard tasks draw, from the cell's own",
            spec.colour_strength if spec.vary_colour else 0.0,
        ),
        _look(
            "texture",
            "texture",
            "half, once and one and a half times as deep as hard tasks paint it",
            spec.texture_strength if spec.vary_texture else 0.0,
        ),
        _pose(
            spec,
            "eth",
            "eth-pose",
            "ETH pose",
            "half of what hard tasks have, as much, and what sequence-hard has",
            ((0.0025, 0.25), (0.005, 0.5), (0.01, 1.0)),
        ),
        _pose(
            spec,
            "eih",
            "hand-eye",
            "hand-eye error",
            "what calibrations of an arm of this size leave: careful, usual and hasty ones",
            ((0.0005, 0.1), (0.001, 0.25), (0.002, 0.5)),
        ),
        _further(
            spec,
            "image-noise",
            "image noise",
            "EMVA 1288: a full well of 10,000 electrons leaves noise of 1 %, 2.5 grey levels; each "
            "doubling is 12 dB of gain; hard tasks have 4",
            "image_noise",
            (2.0, 4.0, 8.0),
            "{:g} grey levels",
        ),
        _further(
            spec,
            "blur",
            "blur",
            "half the contrast is left at 0.19 / sigma cycles a pixel: a sharp lens, a soft one, "
            "and one out of focus",
            "image_blur_px",
            (0.5, 1.0, 2.0),
            "{:g} px",
        ),
        Axis(
            "latency",
            "latency",
            "what camera and computing take, what a network in between adds, and twice that; "
            "align-drill has 1 step",
            tuple(f"+{steps} steps" if steps > 1 else "+1 step" for steps in (1, 2, 3)),
            tuple(_options(latency_steps=spec.latency_steps + steps) for steps in (1, 2, 3)),
        ),
        _further(
            spec,
            "joint-offset",
            "joint offsets",
            "what align-drill has, twice and four times that: 0.1 deg in one joint moves the tip "
            "by 1.4 mm at a reach of 0.8 m, as in an arm that was not calibrated",
            "joint_offset_deg",
            (0.05, 0.1, 0.2),
            "{:g}°",
        ),
        Axis(
            "distractors",
            "distractors",
            "strewn over the table; clutter-distractors has six to ten things",
            tuple(f"{count} things" for count in (2, 4, 8)),
            tuple(_options(n_strewn=count) for count in (2, 4, 8)),
        ),
        target_hue(),
    )


def replaced(axes: tuple[Axis, ...], axis: Axis) -> tuple[Axis, ...]:
    """The axes, with another one in place of the one of the same name."""
    return tuple(axis if each.name == axis.name else each for each in axes)


def target_size(diameter_m: float) -> Axis:
    """A target that is smaller than policies assume.

    Args:
        diameter_m: Of the named task's target (m).
    """
    shares = (0.98, 0.95, 0.80)
    return Axis(
        "target-size",
        "target size",
        "ISO 2768-1 lets a cut part of 50 mm be off by 0.8 mm in its coarse class; then thrice "
        "that, and another part",
        tuple(f"-{100 * (1 - share):.0f} %" for share in shares),
        tuple(_options(target_diameter_m=round(share * diameter_m, 6)) for share in shares),
    )


def unseen_marker() -> Axis:
    """A marker that did not occur in training, where a task has the choice."""
    return Axis(
        "marker",
        "unseen marker",
        "another outline, another paint (telemagenta, RAL 4010), and a black and white fiducial",
        ("ring", "hue -30°", "fiducial"),
        (_options(marker="ring"), _options(target_hue_deg=-30.0), _options(marker="fiducial")),
    )


def target_hue() -> Axis:
    """A target of another paint."""
    turns_deg = (-15.0, -30.0, -60.0)
    return Axis(
        "marker",
        "unseen marker",
        "other paints: raspberry red (RAL 3027), telemagenta (RAL 4010) and purple",
        tuple(f"hue {turn:g}°" for turn in turns_deg),
        tuple(_options(target_hue_deg=turn) for turn in turns_deg),
    )


def _look(name: str, title: str, anchor: str, own: float) -> Axis:
    """An axis of the look, whose strength is a share of what hard tasks draw."""
    shares = (0.5, 1.0, 1.5)
    options = tuple(
        _options(**{f"vary_{name}": True, f"{name}_strength": _together(own, share)})
        for share in shares
    )
    return Axis(name, title, anchor, tuple(f"{share:g} × hard" for share in shares), options)


def _pose(
    spec: "Spec",
    camera: str,
    name: str,
    title: str,
    anchor: str,
    errors: tuple[tuple[float, float], ...],
) -> Axis:
    """An axis of a camera's pose; errors are standard deviations (m, deg)."""
    position, rotation = f"{camera}_position_noise_m", f"{camera}_rotation_noise_deg"
    own_m, own_deg = getattr(spec, position), getattr(spec, rotation)
    options = tuple(
        _options(**{position: _together(own_m, m), rotation: _together(own_deg, deg)})
        for m, deg in errors
    )
    return Axis(
        name, title, anchor, tuple(f"{1000 * m:g} mm, {deg:g}°" for m, deg in errors), options
    )


def _further(
    spec: "Spec",
    name: str,
    title: str,
    anchor: str,
    option: str,
    values: tuple[float, ...],
    words: str,
) -> Axis:
    """An axis of one option, a standard deviation."""
    own = getattr(spec, option)
    options = tuple(_options(**{option: _together(own, value)}) for value in values)
    return Axis(name, title, anchor, tuple(map(words.format, values)), options)


def _together(own: float, further: float) -> float:
    """Standard deviation of two independent errors, to six digits."""
    return round(math.hypot(own, further), 6)


def _options(**options: Any) -> Options:
    return MappingProxyType({**options, "unannounced": True})
