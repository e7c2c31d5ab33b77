"""``track``: stay over a target that moves.

A disc moves over the table, on a conveyor (a straight line at constant speed) or along a smooth
curve that cannot be predicted. Episodes are always played to their time limit: what counts is to be
inside the tolerances at the end of each of the last control steps. The difficulty is that pictures
show where the target was, and the arm trails its set point, so a policy has to aim ahead.
"""

import dataclasses
import math
from collections import deque
from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, ClassVar, Literal

import numpy as np
import numpy.typing as npt

from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.family import Progress, register
from hvs_suite.tasks.shared.goal import POSITION, TILT, UP, Goal
from hvs_suite.tasks.shared.metric import Metric
from hvs_suite.tasks.shared.motion import Motion, draw_curve, draw_line
from hvs_suite.tasks.shared.placing import HARD, Placing, PlacingSpec
from hvs_suite.tasks.shared.scenario import Scenario, Streams
from hvs_suite.tasks.shared.spec import Description, scene

if TYPE_CHECKING:
    from dm_control import mjcf

    from hvs_suite.tasks.shared.certificate import Check
    from hvs_suite.tasks.shared.environment import Environment

FloatArray = npt.NDArray[np.float64]

WORST_POSITION = "worst_position_error_mm"
WORST_TILT = "worst_tilt_error_deg"
RMS_POSITION = "rms_position_error_mm"
TIME_INSIDE = "time_inside_pc"

SETTLING_STEPS = 20
"""Control steps at the beginning that do not count for the share of time inside."""
_MAX_REDRAWS = 10_000
_CHECK_PERIOD_S = 0.1
"""How often along a motion its place, speed and acceleration are looked at (s)."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class TrackSpec(PlacingSpec):
    """Every parameter of ``track``; ``hold_steps`` is how many of the last steps have to be inside.

    Attributes:
        motion: ``line``, straight at constant speed; ``curve``, a sum of three sines for each axis.
        speed_m_s: Least and largest speed (m/s): constant on a line, the largest on a curve.
        acceleration_m_s2: Largest acceleration on a curve (m/s^2).
        motion_s: For how long the motion stays on the ring (s); the episode of the named task.
    """

    family: ClassVar[str] = "track"
    headline: ClassVar[tuple[str, ...]] = (RMS_POSITION, TIME_INSIDE)
    further_privileged: ClassVar[Mapping[str, tuple[str, ...]]] = {"goal_velocity": ("x", "y", "z")}
    plays_on: ClassVar[bool] = False

    # Farther out the arm is nearly stretched, and following takes most of the joints' speed.
    ring_m: tuple[float, float] = scene((0.42, 0.74))
    motion: Literal["line", "curve"] = scene("line")
    speed_m_s: tuple[float, float] = scene((0.05, 0.15))
    acceleration_m_s2: float = scene(0.3)
    motion_s: float = scene(6.0)
    hold_steps: int = 20
    time_limit_steps: int = 60

    def __post_init__(self) -> None:
        """Refuse values that make no sense, with a sentence.

        Raises:
            OptionError: One of them does not.
        """
        super().__post_init__()
        self._check_positive("acceleration_m_s2", "motion_s")
        if not 0.0 < self.speed_m_s[0] <= self.speed_m_s[1]:
            raise OptionError(f"speed_m_s is {self.speed_m_s}; use a least and a larger speed")
        if self.position_tolerance_mm is None:
            raise OptionError("track scores the position as a whole; give position_tolerance_mm")
        if self.hold_steps > self.time_limit_steps:
            raise OptionError(
                f"hold_steps is {self.hold_steps}, more than time_limit_steps "
                f"{self.time_limit_steps}"
            )

    @property
    def metrics(self) -> tuple[Metric, ...]:
        """Errors now; the worst and the mean of the last steps; the share of time inside."""
        position, tilt = self.position_tolerance_mm, self.tilt_tolerance_deg
        return (
            *super().metrics,
            Metric(WORST_POSITION, "mm", "worst position error", position, over="episode"),
            Metric(WORST_TILT, "deg", "worst tilt error", tilt, over="episode"),
            Metric(RMS_POSITION, "mm", "RMS position error", over="episode"),
            Metric(TIME_INSIDE, "%", "time inside", over="episode"),
        )

    def instruction(self, scenario: Scenario | None = None) -> str:
        """The task as one sentence."""
        return (
            "Keep the flange centred over the moving target, facing it, "
            f"{self.standoff_m * 1000:.0f} mm above the surface."
        )

    def describe(self) -> Description:
        """The task in words."""
        words = super().describe()
        slowest, fastest = (1000.0 * speed for speed in self.speed_m_s)
        return dataclasses.replace(
            words,
            target=f"on a {self.motion}, {slowest:.0f}-{fastest:.0f} mm/s, {words.target}",
            held=f"the last {self.hold_steps} steps",
        )


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class TrackScenario(Scenario):
    """One scene.

    Attributes:
        motion: How the target moves.
    """

    motion: Motion


class Track(Placing[TrackSpec, TrackScenario]):
    """A target that moves over the level table."""

    hard: ClassVar[Mapping[str, str]] = {
        "track-line": (
            "Pictures show where the target was, and the arm trails its set point: at 100 mm/s "
            "a policy that aims at what it sees is ten millimetres behind."
        ),
        "track-curve": (
            "Direction and speed change all the time, so the past predicts the motion only for "
            "a short time; the arm still has to aim ahead."
        ),
        "track-hard": (
            "Commands act a step late, and the policy is not told so: it has to predict to a "
            "millimetre where the target will be 0.2 s from now, on an irregular motion."
        ),
    }

    def draw(self, streams: Streams) -> TrackScenario:
        """Draw motion, start and look."""
        motion = self._draw_motion(streams)
        first = self.goal_over(*motion.place(0.0))
        return TrackScenario(motion=motion, **self.draw_common(streams, first))

    def _draw_motion(self, streams: Streams) -> Motion:
        """Draw motions until one stays on the ring for the whole episode."""
        spec, random = self.spec, streams.generator("motion")
        fastest = random.uniform(*spec.speed_m_s)
        n_times = round(spec.motion_s / _CHECK_PERIOD_S) + 1
        times = _CHECK_PERIOD_S * np.arange(n_times, dtype=np.float64)
        for _ in range(_MAX_REDRAWS):
            if spec.motion == "line":
                motion = draw_line(random, self.draw_on_ring, fastest)
            else:
                motion = draw_curve(
                    random, self.draw_on_ring, fastest, spec.acceleration_m_s2, times
                )
            radius = np.hypot(*motion.place(times).T)
            if spec.ring_m[0] <= radius.min() and radius.max() <= spec.ring_m[1]:
                return motion
        raise OptionError(
            f"no motion of {spec.motion_s:g} s at {fastest:.2f} m/s found that stays on the ring; "
            "lower speed_m_s or motion_s"
        )

    def begin(self, physics: "mjcf.Physics", scenario: TrackScenario) -> None:
        """Lay the marker where it starts."""
        super().begin(physics, scenario)
        self._last: deque[Mapping[str, float]] = deque(maxlen=self.spec.hold_steps)
        self._n_inside = self._n_counted = 0
        # All goals at once: one after each picture takes several times as long, because drawing
        # leaves nothing of the code in the processor's caches.
        times = [n * self.spec.control_period_s for n in range(self.spec.time_limit_steps + 1)]
        self._goals = {time_s: self._goal_at(time_s) for time_s in times}
        self.advance(physics, 0.0)

    def advance(self, physics: "mjcf.Physics", time_s: float) -> None:
        """Move the marker to where it is at a time."""
        self._time_s, self._goal = time_s, self._goals.get(time_s) or self._goal_at(time_s)
        self.put_marker(physics, self._goal)

    def goal(self, ahead_s: float = 0.0) -> Goal:
        """Over where the target is, or will be."""
        return self._goal_at(self._time_s + ahead_s) if ahead_s else self._goal

    def _goal_at(self, time_s: float) -> Goal:
        motion = self.scenario.motion
        x, y = motion.place(time_s).tolist()
        vx, vy = motion.speed(time_s).tolist()
        return Goal(
            np.array([x, y, 0.0]), UP, self.spec.standoff_m, velocity=np.array([vx, vy, 0.0])
        )

    def occupied(self) -> FloatArray:
        """The whole way of the target."""
        n_times = round(self.spec.motion_s / _CHECK_PERIOD_S) + 1
        return self.scenario.motion.place(_CHECK_PERIOD_S * np.arange(n_times, dtype=np.float64))

    def privileged(self) -> dict[str, FloatArray]:
        """How fast the goal moves, (3,) m/s."""
        return {"goal_velocity": self.goal().velocity}

    def at_reset(self) -> dict[str, float]:
        """Before the first step there is nothing to measure."""
        return {WORST_POSITION: 0.0, WORST_TILT: 0.0, RMS_POSITION: 0.0, TIME_INSIDE: 0.0}

    def tally(
        self, physics: "mjcf.Physics", errors: Mapping[str, float], progress: Progress
    ) -> dict[str, float]:
        """The worst and the mean of the last steps, and the share of time inside."""
        self._last.append(errors)
        if progress.steps > SETTLING_STEPS:
            self._n_counted += 1
            self._n_inside += progress.is_inside
        positions = [each[POSITION] for each in self._last]
        return {
            WORST_POSITION: max(positions),
            WORST_TILT: max([each[TILT] for each in self._last]),
            RMS_POSITION: math.sqrt(np.add.reduce(np.square(positions)) / len(positions)),
            TIME_INSIDE: 100.0 * self._n_inside / max(self._n_counted, 1),
        }

    def is_complete(self, progress: Progress) -> bool:
        """Whether the time limit has come, and the last steps all ended inside."""
        return (
            progress.steps == self.spec.time_limit_steps
            and progress.n_inside >= self.spec.hold_steps
        )

    def steps_to_goal(self, progress: Progress) -> int:
        """First step of the unbroken hold that made the success."""
        return progress.steps - progress.n_inside + 1

    @classmethod
    def certify(cls, env: "Environment", scenarios: Iterable[int]) -> list["Check"]:
        """The whole path reachable at a moderate speed; observable and accurate at its start."""
        from hvs_suite.tasks.shared import certificate

        return [
            *certificate.check_path(env, scenarios),
            *certificate.check_visibility(env, scenarios),
            *certificate.check_accuracy(env, scenarios),
        ]


_LINE = TrackSpec(
    name="track-line",
    # The arm may half cover a target: at 112 px two pixels would be left of it.
    eth_resolution=168,
)

register(
    Track,
    _LINE,
    dataclasses.replace(_LINE, name="track-curve", motion="curve"),
    dataclasses.replace(
        _LINE,
        name="track-hard",
        motion="curve",
        start="random",
        target_diameter_m=0.020,
        tilt_tolerance_deg=0.5,
        time_limit_steps=80,
        motion_s=8.0,
        latency_steps=1,
        **HARD,
    ),
)
