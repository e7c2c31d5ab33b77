"""The named variants of ``align``: every parameter that a task name fixes, with its unit.

A *variant* is plain data: this module imports neither MuJoCo nor torch, so listing tasks is
instant. Changing what a registered name means needs a new ``version``; ``tasks/lock.json`` holds
the digests.
"""

import dataclasses
import difflib
import math
import types
import typing
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, Literal

from hvs_suite.errors import OptionError

Start = Literal["zero", "random", "fixed", "near_goal", "mixed"] | tuple[float, ...]
Goal = Literal["random", "fixed", "places"] | tuple[float, float]
ActionMode = Literal["joint_position", "joint_delta", "joint_velocity", "flange_twist"]
RewardTerm = Literal[
    "goal", "collision", "time", "position", "rotation", "joint_space", "exponential"
]

PRESETS: Mapping[str, tuple[str, ...]] = MappingProxyType(
    {
        "vision": ("eih", "eth", "joint_positions", "joint_velocities"),
        "state": (
            "joint_positions",
            "joint_velocities",
            "flange_position",
            "goal_position",
            "goal_normal",
        ),
    }
)
"""Observations by preset; ``state`` is privileged and never mixes with pictures."""
VISION_OBSERVATIONS = (*PRESETS["vision"], "eih_depth", "eth_depth")
JOINTS = 7
JOINT_LIMITS_DEG = (170, 120, 170, 120, 170, 120, 175)
MAX_RESOLUTION = 2048
THESIS_REWARDS: tuple[RewardTerm, ...] = ("goal", "collision", "time", "position", "rotation")


@dataclasses.dataclass(frozen=True, kw_only=True)
class AlignVariant:
    """Every parameter of ``align``: place the flange over a disc, facing it, at a set distance.

    Attributes:
        name: Registered name, ``<task>-<variant>``.
        version: Raised whenever the meaning of the name changes.
        start: Joint angles at reset: all ``zero``; ``random`` in 80 % of the range, clear of
            surface, self and goal; ``fixed``, one random start drawn once per split; ``near_goal``,
            a few centimetres and degrees from the goal pose; ``mixed``, half the task's ``zero``
            or ``random`` start, half ``near_goal``; or seven angles (rad).
        goal: ``random`` on the ring, uniform in area; ``fixed``, one place drawn once per split;
            ``places``, the ten places of ``align-fixed``, by index; or ``(x, y)`` (m, base frame).
        ring_m: Inner and outer radius of the ring of targets (m).
        surface: Shape of the work surface.
        surface_size_m: Side lengths of the surface (m).
        target_diameter_m: Diameter of the marker (m).
        marker: Picture on the target.
        standoff_m: Distance from surface to flange face at the goal (m).
        position_tolerance_mm: Bound on the norm of the position error, or None where each
            component has its own bound.
        lateral_tolerance_mm: Bound on the error in the target plane, or None.
        height_tolerance_mm: Bound on the error along the normal, or None.
        tilt_tolerance_deg: Bound on the angle between flange axis and inward surface normal.
        hold_steps: Consecutive control-step ends inside tolerance that make a success.
        time_limit_steps: Control steps after which the episode is truncated.
        time_limit: ``soft`` truncates silently, ``hard`` also costs the goal reward r*.
        control_period_s: Length of a control step (s).
        discount: Discount while the episode goes on.
        observations: Preset, or names joined by ``+``: ``eih``, ``eth``, ``eih_depth``,
            ``eth_depth``, ``joint_positions``, ``joint_velocities``.
        normalise_observation: Images to [0, 1] and joints to [-1, 1], as in the thesis.
        eih_resolution: Side of the square eye-in-hand image (px).
        eth_resolution: Side of the square eye-to-hand image (px).
        eih_channels: 3 for RGB, 1 for grey.
        eth_channels: 3 for RGB, 1 for grey.
        eih_fov_deg: Field of view of the eye-in-hand camera (deg).
        eth_fov_deg: Field of view of the eye-to-hand camera (deg).
        eth_position_m: Nominal position of the eye-to-hand camera (m, base frame).
        eth_look_at_m: Point the nominal eye-to-hand camera looks at (m, base frame).
        multisampling: Samples per pixel, 0 for none.
        action_mode: Meaning of the seven (``flange_twist``: six) action numbers.
        rewards: Reward terms that are switched on; never changes success or termination.
        vary_light: Draw the light's direction and brightness.
        vary_colour: Draw the colours of surface, target and robot.
        vary_texture: Draw a texture for the surface.
        eth_position_noise_m: Standard deviation of the eye-to-hand position (m), cut at 2 sigma.
        eth_rotation_noise_deg: Standard deviation of its orientation (deg), cut at 2 sigma.
        image_noise: Standard deviation of pixel noise (grey levels of 255).
        joint_offset_deg: Standard deviation of the encoder zero error (deg), cut at 2 sigma.
        latency_steps: Control steps between an action and its effect.
        acceleration_limits: Let the cell's controller respect the published accelerations too.
    """

    name: str
    version: int = 1
    start: Start = "zero"
    goal: Goal = "random"
    ring_m: tuple[float, float] = (0.40, 0.78)
    surface: Literal["flat", "tilted", "curved"] = "flat"
    surface_size_m: tuple[float, float] = (2.0, 2.0)
    target_diameter_m: float = 0.050
    marker: Literal["disc", "ring", "fiducial"] = "disc"
    standoff_m: float = 0.050
    position_tolerance_mm: float | None = 1.0
    lateral_tolerance_mm: float | None = None
    height_tolerance_mm: float | None = None
    tilt_tolerance_deg: float = 1.0
    hold_steps: int = 1
    time_limit_steps: int = 20
    time_limit: Literal["soft", "hard"] = "soft"
    control_period_s: float = 0.1
    discount: float = 1.0
    observations: str = "vision"
    normalise_observation: bool = False
    eih_resolution: int = 112
    eth_resolution: int = 112
    eih_channels: int = 3
    eth_channels: int = 3
    eih_fov_deg: float = 70.0
    eth_fov_deg: float = 31.0
    eth_position_m: tuple[float, float, float] = (-1.01, 0.76, 2.72)
    eth_look_at_m: tuple[float, float, float] = (-0.064, 0.048, 0.0)
    multisampling: int = 0
    action_mode: ActionMode = "joint_position"
    rewards: tuple[RewardTerm, ...] = ("goal", "collision")
    vary_light: bool = False
    vary_colour: bool = False
    vary_texture: bool = False
    eth_position_noise_m: float = 0.0
    eth_rotation_noise_deg: float = 0.0
    image_noise: float = 0.0
    joint_offset_deg: float = 0.0
    latency_steps: int = 0
    acceleration_limits: bool = False

    def __post_init__(self) -> None:
        """Refuse values that make no sense, with a sentence.

        Raises:
            OptionError: One of them does not.
        """
        _check_types(self)
        observation_names(self.observations)
        _check_start_and_goal(self)
        for name in ("eih_resolution", "eth_resolution"):
            side = getattr(self, name)
            if not 8 <= side <= MAX_RESOLUTION:
                raise OptionError(f"{name} is {side} px; use 8 to {MAX_RESOLUTION}")
        for name in ("eih_channels", "eth_channels"):
            if getattr(self, name) not in (1, 3):
                raise OptionError(f"{name} is {getattr(self, name)}; use 3 (RGB) or 1 (grey)")
        for name in ("eih_fov_deg", "eth_fov_deg"):
            if not 1.0 <= getattr(self, name) <= 150.0:
                raise OptionError(f"{name} is {getattr(self, name)} deg; use 1 to 150")
        if self.multisampling not in (0, 2, 4, 8):
            raise OptionError(f"multisampling is {self.multisampling}; use 0, 2, 4 or 8")
        positive = ("target_diameter_m", "standoff_m", "tilt_tolerance_deg", "control_period_s")
        for name in positive:
            if not getattr(self, name) > 0:
                raise OptionError(f"{name} is {getattr(self, name)}; it must be positive")
        for name in ("position_tolerance_mm", "lateral_tolerance_mm", "height_tolerance_mm"):
            value = getattr(self, name)
            if value is not None and not value > 0:
                raise OptionError(f"{name} is {value}; it must be positive, or None for no bound")
        if self.position_tolerance_mm is None and None in (
            self.lateral_tolerance_mm,
            self.height_tolerance_mm,
        ):
            raise OptionError(
                "give position_tolerance_mm, or both lateral_tolerance_mm and height_tolerance_mm"
            )
        for name in ("hold_steps", "time_limit_steps"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} is {getattr(self, name)}; use a whole number from 1 up")
        if not 0 <= self.latency_steps < self.time_limit_steps:
            raise OptionError(
                f"latency_steps is {self.latency_steps}; use 0 or a few control steps"
            )
        noise = (
            "eth_position_noise_m",
            "eth_rotation_noise_deg",
            "image_noise",
            "joint_offset_deg",
        )
        for name in noise:
            if not getattr(self, name) >= 0:
                raise OptionError(f"{name} is {getattr(self, name)}; it cannot be negative")
        if not 0.0 <= self.discount <= 1.0:
            raise OptionError(f"discount is {self.discount}; use 0 to 1")
        if not 0.0 < self.ring_m[0] < self.ring_m[1]:
            raise OptionError(f"ring_m is {self.ring_m}; use an inner and a larger outer radius")
        if not min(self.surface_size_m) > 0:
            raise OptionError(f"surface_size_m is {self.surface_size_m}; both sides are positive")
        if self.eth_position_m[:2] == self.eth_look_at_m[:2]:
            raise OptionError("eth_position_m lies straight above eth_look_at_m; shift one of them")

    @property
    def tolerances(self) -> dict[str, float]:
        """Errors that are bounded, by their name in ``info``: mm, and deg of tilt."""
        bounds = {
            "position_error_mm": self.position_tolerance_mm,
            "lateral_error_mm": self.lateral_tolerance_mm,
            "height_error_mm": self.height_tolerance_mm,
            "tilt_error_deg": self.tilt_tolerance_deg,
        }
        return {name: bound for name, bound in bounds.items() if bound is not None}

    @property
    def tightest_tolerance_mm(self) -> float:
        """Smallest of the bounds on the position (mm)."""
        return min(bound for name, bound in self.tolerances.items() if name.endswith("_mm"))

    @property
    def instruction(self) -> str:
        """The task as one sentence, identical in environment and dataset."""
        return (
            f"Place the flange centred over the target, facing it, "
            f"{self.standoff_m * 1000:.0f} mm above the surface."
        )


def observation_names(observations: str) -> tuple[str, ...]:
    """Names behind a preset or a list joined by ``+``.

    Args:
        observations: ``vision``, ``state``, or names such as ``eih+joint_positions``.

    Returns:
        Names in the order given.

    Raises:
        OptionError: A name is unknown or stands twice, or no camera is left.
    """
    if observations in PRESETS:
        return PRESETS[observations]
    names = tuple(observations.split("+"))
    for name in names:
        if name not in VISION_OBSERVATIONS:
            raise OptionError(
                f"unknown observation {name!r}; use {', '.join(PRESETS)}, or join some of "
                f"{', '.join(VISION_OBSERVATIONS)} with '+'"
            )
    if len(set(names)) < len(names):
        raise OptionError(f"observations {observations!r} name something twice")
    if not any(name.startswith(("eih", "eth")) for name in names):
        raise OptionError(
            f"observations {observations!r} switch both cameras off; keep eih or eth, or use the "
            "preset 'state'"
        )
    return names


def with_options(variant: AlignVariant, options: Mapping[str, Any]) -> AlignVariant:
    """The variant with some parameters changed, for studies.

    Args:
        variant: A named task's parameters.
        options: New values by field name.

    Returns:
        A new variant with the same name.

    Raises:
        OptionError: An option does not exist or its value makes no sense.
    """
    fields = {field.name for field in dataclasses.fields(AlignVariant)} - {"name", "version"}
    for name in options:
        if name not in fields:
            close = difflib.get_close_matches(name, sorted(fields), n=2)
            hint = f"; did you mean {' or '.join(close)}?" if close else ""
            raise OptionError(f"{variant.name} has no option {name!r}{hint}")
    values: dict[str, Any] = {
        name: tuple(value) if isinstance(value, list) else value for name, value in options.items()
    }
    return dataclasses.replace(variant, **values)


def _check_types(variant: AlignVariant) -> None:
    hints = typing.get_type_hints(AlignVariant)
    for field in dataclasses.fields(variant):
        value = getattr(variant, field.name)
        hint = hints[field.name]
        if not _fits(value, hint):
            wanted = hint.__name__ if isinstance(hint, type) else str(hint).replace("typing.", "")
            raise OptionError(f"{field.name} is {value!r}, which is not {wanted}")


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value has a type, for the few kinds of types that variants use."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin is Literal:
        return value in arguments
    if origin in (typing.Union, types.UnionType):
        return any(_fits(value, choice) for choice in arguments)
    if origin is tuple:
        if not isinstance(value, tuple):
            return False
        if arguments[-1] is Ellipsis:
            return all(_fits(item, arguments[0]) for item in value)
        return len(value) == len(arguments) and all(map(_fits, value, arguments))
    if hint is float:
        return (
            isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
        )
    if hint is int:
        return isinstance(value, int) and not isinstance(value, bool)
    return isinstance(value, hint)


def _check_start_and_goal(variant: AlignVariant) -> None:
    start, goal = variant.start, variant.goal
    if isinstance(start, tuple):
        if len(start) != JOINTS:
            raise OptionError(
                f"start has {len(start)} angles; give one for each of {JOINTS} joints"
            )
        for i, (angle, limit) in enumerate(zip(start, JOINT_LIMITS_DEG, strict=True)):
            if abs(math.degrees(angle)) > limit:
                raise OptionError(f"start[{i}] is {angle} rad, beyond joint A{i + 1}'s {limit} deg")
    if isinstance(goal, tuple) and not math.hypot(*goal) > 0.1:
        raise OptionError(f"goal {goal} lies under the robot's base; move it at least 0.1 m away")


_THESIS = AlignVariant(name="align-thesis", position_tolerance_mm=1.0, tilt_tolerance_deg=1.0)

_HARD = dataclasses.replace(
    _THESIS,
    name="align-hard",
    start="random",
    target_diameter_m=0.020,
    position_tolerance_mm=0.5,
    tilt_tolerance_deg=0.5,
    hold_steps=3,
    time_limit_steps=40,
    # A small disc leaves margin in a narrower view, which shows it larger.
    eih_fov_deg=60.0,
    eth_resolution=336,
    # Wide enough for the ring when the camera is turned by the largest disturbance.
    eth_fov_deg=33.0,
    vary_light=True,
    vary_colour=True,
    vary_texture=True,
    # Cut at two sigma: up to 1 cm and 1 deg a direction.
    eth_position_noise_m=0.005,
    eth_rotation_noise_deg=0.5,
    image_noise=4.0,
)

_ALL = (
    dataclasses.replace(
        _THESIS,
        name="align-fixed",
        goal="places",
        position_tolerance_mm=5.0,
        tilt_tolerance_deg=5.0,
    ),
    dataclasses.replace(
        _THESIS, name="align-easy", position_tolerance_mm=5.0, tilt_tolerance_deg=5.0
    ),
    _THESIS,
    _HARD,
    dataclasses.replace(
        _HARD,
        name="align-drill",
        target_diameter_m=0.010,
        position_tolerance_mm=None,
        lateral_tolerance_mm=0.25,
        height_tolerance_mm=1.0,
        tilt_tolerance_deg=0.4,
        hold_steps=5,
        eih_resolution=224,
        eth_resolution=512,
        joint_offset_deg=0.05,
        latency_steps=1,
    ),
    dataclasses.replace(
        _THESIS,
        name="align-limit",
        start="random",
        target_diameter_m=0.020,
        position_tolerance_mm=None,
        lateral_tolerance_mm=0.1,
        height_tolerance_mm=0.3,
        tilt_tolerance_deg=0.2,
        hold_steps=5,
        time_limit_steps=40,
        eih_resolution=224,
        eth_resolution=336,
        eih_fov_deg=60.0,
    ),
)

TASKS: Mapping[str, AlignVariant] = MappingProxyType({variant.name: variant for variant in _ALL})
"""The named tasks, easiest first."""
