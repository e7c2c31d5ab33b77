"""Specs: every parameter that a task's name fixes, with its unit, as plain data.

A `Spec` is made of parts (`Timing`, `Cameras`, `Disturbances`), which a family extends by its own
fields. Parts are base classes, so that every parameter is a flat keyword of `hvs_suite.load`. This
module imports neither MuJoCo nor torch: listing tasks is instant. Changing what a registered name
means needs a new ``version``; ``tasks/lock.json`` holds the digests.
"""

import dataclasses
import difflib
import functools
import math
import typing
from collections.abc import Iterable, Mapping
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, ClassVar, Literal, Self

from hvs_suite.embodiment import BARE_ARM, Embodiment
from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared import option_types
from hvs_suite.tasks.shared.metric import Metric

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.robustness import Axis
    from hvs_suite.tasks.shared.scenario import Scenario

Start = Literal["zero", "random", "fixed", "near_goal", "mixed"] | tuple[float, ...]
ActionMode = Literal["joint_position", "joint_delta", "joint_velocity", "flange_twist"]
RewardTerm = Literal[
    "goal",
    "collision",
    "time",
    "position",
    "lateral",
    "height",
    "rotation",
    "joint_space",
    "exponential",
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
VISION_OBSERVATIONS = (*PRESETS["vision"], "joint_torques", "eih_depth", "eth_depth")
JOINTS = 7
JOINT_LIMITS_DEG = (170, 120, 170, 120, 170, 120, 175)
MAX_RESOLUTION = 2048
THESIS_REWARDS: tuple[RewardTerm, ...] = ("goal", "collision", "time", "position", "rotation")

_SHAPES_SCENE = "shapes_scene"


def scene[T](default: T) -> T:
    """Declare a field that shapes the scene: another value draws other scenarios.

    Fields without it (cameras switched off, rewards, tolerances) leave the scenarios as they are,
    so that studies of them are paired.

    Args:
        default: The field's default.
    """
    return dataclasses.field(default=default, metadata={_SHAPES_SCENE: True})


@dataclasses.dataclass(frozen=True, kw_only=True)
class Timing:
    """When things happen.

    Attributes:
        control_period_s: Length of a control step (s).
        time_limit_steps: Control steps after which the episode is truncated.
        time_limit: ``soft`` truncates silently, ``hard`` also costs the goal reward r*.
        hold_steps: Consecutive control-step ends inside tolerance that make a success.
        latency_steps: Control steps between an action and its effect.
        acceleration_limits: Let the cell's controller respect the published accelerations too.
        discount: Discount while the episode goes on.
    """

    control_period_s: float = 0.1
    time_limit_steps: int = 20
    time_limit: Literal["soft", "hard"] = "soft"
    hold_steps: int = 1
    latency_steps: int = 0
    acceleration_limits: bool = False
    discount: float = 1.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Cameras:
    """The eye in the hand (EIH) and the eye to hand (ETH), a camera above the cell.

    Attributes:
        eih_resolution: Side of the square eye-in-hand image (px).
        eth_resolution: Side of the square eye-to-hand image (px).
        eih_channels: 3 for RGB, 1 for grey.
        eth_channels: 3 for RGB, 1 for grey.
        eih_fov_deg: Field of view of the eye-in-hand camera (deg).
        eth_fov_deg: Field of view of the eye-to-hand camera (deg).
        eth_position_m: Nominal position of the eye-to-hand camera (m, base frame).
        eth_look_at_m: Point the nominal eye-to-hand camera looks at (m, base frame).
        multisampling: Samples per pixel, 0 for none.
    """

    eih_resolution: int = 112
    eth_resolution: int = 112
    eih_channels: int = 3
    eth_channels: int = 3
    eih_fov_deg: float = 70.0
    eth_fov_deg: float = 31.0
    eth_position_m: tuple[float, float, float] = (-1.01, 0.76, 2.72)
    eth_look_at_m: tuple[float, float, float] = (-0.064, 0.048, 0.0)
    multisampling: int = 0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Disturbances:
    """What differs from scenario to scenario besides the task itself.

    Attributes:
        vary_light: Draw the light's direction and brightness.
        vary_colour: Draw the colours of surface, target and robot.
        vary_texture: Draw a texture for the surface.
        light_strength: How far the light goes from the cell's own to the one drawn: 1 all the way,
            more goes past it.
        colour_strength: The same of the colours.
        texture_strength: The same of the texture.
        target_hue_deg: Turn of the target's hue, from red towards yellow (deg).
        eth_position_noise_m: Standard deviation of the eye-to-hand position (m), cut at 2 sigma.
        eth_rotation_noise_deg: Standard deviation of its orientation (deg), cut at 2 sigma.
        eih_position_noise_m: Hand-eye error: standard deviation of where the eye in the hand is off
            its nominal place on the flange (m a direction), cut at 2 sigma.
        eih_rotation_noise_deg: Standard deviation of its orientation there (deg), cut at 2 sigma.
        image_noise: Standard deviation of pixel noise (grey levels of 255).
        image_blur_px: Standard deviation of the Gaussian that pictures are blurred with (px).
        joint_offset_deg: Standard deviation of the encoder zero error (deg), cut at 2 sigma.
        action_noise: Standard deviation of the noise on each number of an action, whose full scale
            is 1: a fraction of the joint's range, of 0.1 rad, of the joint's speed, or of 0.5 m/s
            and 1.5 rad/s, by the action mode. Each control step of a scene has noise of its own,
            and what is commanded stays in [-1, 1].
        depth_noise_px: Standard deviation of the disparities behind depth pictures (px of a sensor
            640 px wide), which then have steps and holes as well; 0 for true depth.
        n_strewn: Things that lie around and are not the target: discs of other colours, red squares
            and half discs, as large as it is.
        unannounced: Policies are not told of the other options: they get the named task's
            parameters, and the scenes are the named task's except for what the options change in
            them.
    """

    vary_light: bool = scene(False)
    vary_colour: bool = scene(False)
    vary_texture: bool = scene(False)
    light_strength: float = 1.0
    colour_strength: float = 1.0
    texture_strength: float = 1.0
    target_hue_deg: float = 0.0
    eth_position_noise_m: float = scene(0.0)
    eth_rotation_noise_deg: float = scene(0.0)
    eih_position_noise_m: float = scene(0.0)
    eih_rotation_noise_deg: float = scene(0.0)
    image_noise: float = scene(0.0)
    image_blur_px: float = 0.0
    joint_offset_deg: float = scene(0.0)
    action_noise: float = 0.0
    depth_noise_px: float = 0.0
    n_strewn: int = scene(0)
    unannounced: bool = False


@dataclasses.dataclass(frozen=True)
class VectorObservation:
    """A vector that a family shows beside cameras and joints.

    Attributes:
        dimensions: Names of its numbers.
        low: Least value of each of them.
        high: Largest value of each of them.
        noise: Standard deviation of the noise on each of them; empty for none.
    """

    dimensions: tuple[str, ...]
    low: float
    high: float
    noise: tuple[float, ...] = ()


@dataclasses.dataclass(frozen=True)
class Description:
    """A task in words, for tables, cards and pictures.

    Attributes:
        start: How the arm starts.
        target: What it goes to.
        tolerance: Bounds of a success, such as ``1 mm, 1 deg``.
        held: For how long they have to be kept; empty for a single control step.
        time: How much time there is.
        disturbances: What else differs from scenario to scenario; a dash for nothing.
    """

    start: str
    target: str
    tolerance: str
    held: str
    time: str
    disturbances: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class Spec(Timing, Cameras, Disturbances):
    """Every parameter of a task; families add their own.

    Attributes:
        name: Registered name, ``<family>-<variant>``.
        version: Raised whenever the meaning of the name changes.
        start: Joint angles at reset: all ``zero``; ``random`` in 80 % of the range, clear of
            surface, self and goal; ``fixed``, one random start drawn once per split; ``near_goal``,
            a few centimetres and degrees from the goal pose; ``mixed``, half the task's ``zero``
            or ``random`` start, half ``near_goal``; or seven angles (rad).
        observations: Preset, or names joined by ``+``: ``eih``, ``eth``, ``eih_depth``,
            ``eth_depth``, ``joint_positions``, ``joint_velocities``, ``joint_torques`` (what the
            drives exert, N m, the arm's weight included), and what the family adds
            (``further_observations``), which presets show as well.
        normalise_observation: Images to [0, 1] and joints to [-1, 1], as in the thesis.
        action_mode: Meaning of the seven (``flange_twist``: six) action numbers.
        rewards: Reward terms that are switched on; never changes success or termination.
    """

    family: ClassVar[str]
    """Name of the family, the first word of its tasks' names."""
    keypoints: ClassVar[tuple[str, ...]] = ("target",)
    """Points whose projections supervise eyes; `Family.keypoints` gives their places."""
    further_privileged: ClassVar[Mapping[str, tuple[str, ...]]] = MappingProxyType({})
    """Columns of `Family.privileged`, with the names of their dimensions."""
    headline: ClassVar[tuple[str, ...]]
    """Metrics that boards show beside success, the most telling first."""
    plays_on: ClassVar[bool] = True
    """Whether an episode can go on past its goal, to see where a policy settles."""

    name: str
    version: int = 1
    start: Start = scene("zero")  # noqa: RUF009 - a field, and frozen
    observations: str = "vision"
    normalise_observation: bool = False
    action_mode: ActionMode = "joint_position"
    rewards: tuple[RewardTerm, ...] = ("goal", "collision")

    def __post_init__(self) -> None:
        """Refuse values that make no sense, with a sentence; families add their own checks.

        Raises:
            OptionError: One of them does not.
        """
        _check_types(self)
        _ = self.observed
        self._check_cameras()
        self._check_timing()
        if isinstance(self.start, tuple):
            _check_joints(self.start)
        self._check_not_negative(
            "light_strength",
            "colour_strength",
            "texture_strength",
            "eth_position_noise_m",
            "eth_rotation_noise_deg",
            "eih_position_noise_m",
            "eih_rotation_noise_deg",
            "image_noise",
            "image_blur_px",
            "joint_offset_deg",
            "action_noise",
            "depth_noise_px",
            "n_strewn",
        )

    def _check_cameras(self) -> None:
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
        if self.eth_position_m[:2] == self.eth_look_at_m[:2]:
            raise OptionError("eth_position_m lies straight above eth_look_at_m; shift one of them")

    def _check_timing(self) -> None:
        self._check_positive("control_period_s")
        self._check("must be at most 1", lambda value: value <= 1.0, "control_period_s")
        for name in ("hold_steps", "time_limit_steps"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} is {getattr(self, name)}; use a whole number from 1 up")
        if not 0 <= self.latency_steps < self.time_limit_steps:
            raise OptionError(
                f"latency_steps is {self.latency_steps}; use 0 or a few control steps"
            )
        if not 0.0 <= self.discount <= 1.0:
            raise OptionError(f"discount is {self.discount}; use 0 to 1")

    def _check(self, rule: str, holds: typing.Callable[[float], bool], *names: str) -> None:
        """Check fields by a rule.

        Args:
            rule: In words, after "it ".
            holds: The same as a function; False for NaN.
            names: Of the fields.

        Raises:
            OptionError: A field breaks it.
        """
        for name in names:
            value = getattr(self, name)
            if not holds(value):
                raise OptionError(f"{name} is {value}; it {rule}")

    def _check_positive(self, *names: str) -> None:
        self._check("must be positive", lambda value: value > 0, *names)

    def _check_not_negative(self, *names: str) -> None:
        self._check("cannot be negative", lambda value: value >= 0, *names)

    def _check_range(self, *names: str, least: float = 0.0, most: float = math.inf) -> None:
        """Check fields that are a least and a largest value against bounds.

        Raises:
            OptionError: A field breaks them.
        """
        for name in names:
            low, high = getattr(self, name)
            if not least <= low <= high <= most:
                bounds = f"{least:g} up" if most == math.inf else f"{least:g} to {most:g}"
                raise OptionError(
                    f"{name} is {(low, high)}; use a least and a larger value, from {bounds}"
                )

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """What is measured, in the order of a dataset's columns."""
        raise NotImplementedError

    @property
    def embodiment(self) -> Embodiment:
        """The robot: the arm alone, unless the family says otherwise."""
        return BARE_ARM

    def is_overload(self, errors: Mapping[str, float]) -> bool:
        """Whether a metric is beyond a bound whose breach ends the episode at once."""
        return any(
            metric.is_limit and metric.bound is not None and errors[metric.name] > metric.bound
            for metric in self.metrics
        )

    @property
    def privileged(self) -> dict[str, tuple[str, ...]]:
        """Vectors that only training may see, with the names of their dimensions.

        The goal, the encoders' zero errors where there are any, where each keypoint is in each
        camera's picture (see ``ArmTask.privileged``), and the family's own.
        """
        joints = tuple(f"A{i}" for i in range(1, 8))
        return {
            "goal_position": ("x", "y", "z"),
            "goal_normal": ("x", "y", "z"),
            **({"joint_offset": joints} if self.joint_offset_deg > 0 else {}),
            **{
                f"{keypoint}_{camera}": ("u", "v", "diameter", "visible")
                for keypoint in self.keypoints
                for camera in CAMERA_NAMES
            },
            **self.further_privileged,
        }

    @property
    def tolerances(self) -> dict[str, float]:
        """Bounds of the metrics that decide success, by name, in the metric's unit.

        Where a figure of the whole episode is bounded it decides; elsewhere what is measured at the
        end of each control step does.
        """
        bounded = [metric for metric in self.metrics if metric.bound is not None]
        deciding = [m for m in bounded if m.over == "episode" and not m.is_limit] or bounded
        return {metric.name: metric.bound for metric in deciding if metric.bound is not None}

    @functools.cached_property
    def step_bounds(self) -> Mapping[str, float]:
        """Bounds on the step metrics: a control step that ends inside all of them is held."""
        return {
            metric.name: metric.bound
            for metric in self.metrics
            if metric.over == "step" and metric.bound is not None
        }

    @property
    def tightest_tolerance_mm(self) -> float:
        """Smallest bound on a length at the end of a control step (mm)."""
        units = {metric.name: metric.unit for metric in self.metrics}
        return min(bound for name, bound in self.step_bounds.items() if units[name] == "mm")

    @property
    def counts_goals(self) -> tuple[str, ...]:
        """Metrics that have to be 0 in the end, which count goals that were not reached; by name.

        Empty where there is one goal.
        """
        return tuple(metric.name for metric in self.metrics if metric.bound == 0.0)

    @property
    def fps(self) -> int:
        """Control steps a second, to the nearest whole number."""
        return round(1.0 / self.control_period_s)

    @property
    def landing_metric(self) -> Metric | None:
        """The distance from the goal in its plane that counts; None where nothing lands."""
        return None

    def instruction(self, scenario: "Scenario | None" = None) -> str:
        """The task as one sentence, identical in environment and dataset.

        Args:
            scenario: For tasks whose sentence depends on it; None for the sentence that fits all.
        """
        raise NotImplementedError

    def describe(self) -> Description:
        """The task in words: the one place that phrases tolerances and disturbances."""
        bounds = [
            f"{metric.bound:g} {metric.unit} {metric.title.removesuffix(' error')}"
            for metric in self.metrics
            if metric.over == "step" and metric.bound is not None
        ]
        present = {
            "light": self.vary_light,
            "colour": self.vary_colour,
            "texture": self.vary_texture,
            "ETH pose": self.eth_position_noise_m > 0 or self.eth_rotation_noise_deg > 0,
            "hand-eye error": self.eih_position_noise_m > 0 or self.eih_rotation_noise_deg > 0,
            "target's hue": self.target_hue_deg != 0,
            "things around": self.n_strewn > 0,
            "image noise": self.image_noise > 0,
            "blur": self.image_blur_px > 0,
            "joint offsets": self.joint_offset_deg > 0,
            "action noise": self.action_noise > 0,
            "latency": self.latency_steps > 0,
            "depth noise": self.depth_noise_px > 0,
        }
        return Description(
            start=in_words(self.start),
            target="goal",
            tolerance=", ".join(bounds),
            held=f"{self.hold_steps} steps" if self.hold_steps > 1 else "",
            time=f"{self.time_limit_steps} x {self.control_period_s:g} s",
            disturbances=", ".join(name for name, there in present.items() if there) or "-",
        )

    @property
    def reach_m(self) -> float:
        """Largest distance of a goal from the base's axis (m), which scales shaped rewards."""
        return 0.78

    @property
    def target_size_m(self) -> float:
        """Diameter of the target, and of what is strewn around it (m)."""
        return 0.050

    def robustness_axes(self) -> tuple["Axis", ...]:
        """What a robustness study disturbs; families change what makes no sense for them."""
        from hvs_suite.tasks.shared import robustness

        return robustness.common_axes(self)

    @property
    def further_observations(self) -> Mapping[str, VectorObservation]:
        """What the family shows beside cameras and joints, by name; see `Family.observe`."""
        return {}

    @property
    def observed(self) -> tuple[str, ...]:
        """Names of the observations, in order."""
        return observation_names(self.observations, tuple(self.further_observations))

    @property
    def scene_fields(self) -> tuple[str, ...]:
        """Names of the fields that shape the scene; see `scene`."""
        return tuple(
            field.name for field in dataclasses.fields(self) if field.metadata.get(_SHAPES_SCENE)
        )

    def with_options(self, options: Mapping[str, Any]) -> Self:
        """The spec with some parameters changed, for studies.

        Args:
            options: New values by field name; lists, as JSON gives them, become tuples.

        Returns:
            A new spec with the same name.

        Raises:
            OptionError: An option does not exist or its value makes no sense.
        """
        for name in options:
            self._check_option(name)
        values: dict[str, Any] = {
            name: tuple(value) if isinstance(value, list) else value
            for name, value in options.items()
        }
        return dataclasses.replace(self, **values)

    def options_from_text(self, words: Iterable[str]) -> dict[str, Any]:
        """Read options as a command line gives them.

        Args:
            words: Each ``name=value``, the value as the type of the option says; see
                `option_types.from_text`.

        Returns:
            New values by field name; one that the spec has already is left out.

        Raises:
            OptionError: A word is none, an option does not exist, or its value makes no sense.
        """
        hints = typing.get_type_hints(type(self))
        options: dict[str, Any] = {}
        for word in words:
            name, equals, text = word.partition("=")
            name = name.strip()
            if not equals:
                raise OptionError(
                    f"an option is given as name=value, such as time_limit_steps=40, not {word!r}"
                )
            self._check_option(name)
            if name in options:
                raise OptionError(f"option {name} is given twice; give it once")
            options[name] = option_types.from_text(text, hints[name])
        self.with_options(options)
        return {name: v for name, v in options.items() if v != getattr(self, name)}

    def _check_option(self, name: str) -> None:
        """Refuse a name that is no option.

        Raises:
            OptionError: It is none; the text offers the nearest, or all.
        """
        names = sorted({field.name for field in dataclasses.fields(self)} - {"name", "version"})
        if name not in names:
            close = difflib.get_close_matches(name, names, n=2)
            hint = f"did you mean {' or '.join(close)}?" if close else f"use {', '.join(names)}"
            raise OptionError(f"{self.name} has no option {name!r}; {hint}")


CAMERA_NAMES = ("eih", "eth")


def in_words(choice: object) -> str:
    """An option as text; numbers as a list."""
    if isinstance(choice, tuple):
        return "(" + ", ".join(f"{number:g}" for number in choice) + ")"
    return str(choice)


def observation_names(observations: str, further: tuple[str, ...] = ()) -> tuple[str, ...]:
    """Names behind a preset or a list joined by ``+``.

    Args:
        observations: ``vision``, ``state``, or names such as ``eih+joint_positions``.
        further: What the family adds; presets show it as well.

    Returns:
        Names in the order given.

    Raises:
        OptionError: A name is unknown or stands twice, or no camera is left.
    """
    if observations in PRESETS:
        return PRESETS[observations] + further
    names = tuple(observations.split("+"))
    for name in names:
        if name not in VISION_OBSERVATIONS + further:
            raise OptionError(
                f"unknown observation {name!r}; use {', '.join(PRESETS)}, or join some of "
                f"{', '.join(VISION_OBSERVATIONS + further)} with '+'"
            )
    if len(set(names)) < len(names):
        raise OptionError(f"observations {observations!r} name something twice")
    if not any(name.startswith(("eih", "eth")) for name in names):
        raise OptionError(
            f"observations {observations!r} switch both cameras off; keep eih or eth, or use the "
            "preset 'state'"
        )
    return names


def _check_types(spec: Spec) -> None:
    hints = typing.get_type_hints(type(spec))
    for field in dataclasses.fields(spec):
        value = getattr(spec, field.name)
        hint = hints[field.name]
        if not option_types.fits(value, hint):
            wanted = option_types.in_words(hint)
            raise OptionError(f"{field.name} is {value!r}, which is not {wanted}")


def _check_joints(start: tuple[float, ...]) -> None:
    if len(start) != JOINTS:
        raise OptionError(f"start has {len(start)} angles; give one for each of {JOINTS} joints")
    for i, (angle, limit) in enumerate(zip(start, JOINT_LIMITS_DEG, strict=True)):
        if abs(math.degrees(angle)) > limit:
            raise OptionError(f"start[{i}] is {angle} rad, beyond joint A{i + 1}'s {limit} deg")
