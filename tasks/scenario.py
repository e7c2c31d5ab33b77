"""Scenarios: everything random in an episode, as a pure function of an index.

A scenario depends on the task's name and version, on the options that shape the scene, on the split
and on the index, and on nothing else: not on the batch size, the worker, the policy or when earlier
episodes ended. Each quantity is drawn from a Philox stream of its own (a counter-based generator,
Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011), so that adding one leaves
the others as they are. Options that do not shape the scene (cameras switched off, rewards, action
mode, tolerances) leave it alone, so that studies of them are paired.
"""

import dataclasses
import functools
import hashlib
import json
import math
import zlib
from typing import Any

import numpy as np
import numpy.typing as npt

from hvs_suite.cell.kinematics import kinematics, travel_time
from hvs_suite.cell.robot import JOINT_NAMES, JOINT_RANGE_RAD
from hvs_suite.errors import OptionError, ScenarioError
from hvs_suite.tasks.variants import TASKS, AlignVariant

FloatArray = npt.NDArray[np.float64]

TEST_SPLIT = "test"
TEST_SCENARIOS = 1000
# Indices are one 64-bit word of the generator's counter; half of it is room enough.
MAX_INDEX = 2**62
# Coprime with 1,000: a stream of bare resets on `test` meets every scenario, and streams whose
# seeds differ by less than 37 share none within their first 26 resets.
_TEST_STRIDE = 37

RANDOM_START_RANGE = 0.8
START_CLEARANCE_M = 0.05
START_GOAL_DISTANCE_M = 0.10
SPARE_STEPS = 5
# A start near the goal: joint deviations between a tenth of a degree and 14 degrees, log-uniform,
# so that the last millimetres are met as often as the last decimetres.
_NEAR_GOAL_SCALE_RAD = (0.002, 0.25)
_NEAR_GOAL_CLEARANCE_M = 0.015
_MAX_REDRAWS = 1000
_CUT_SIGMA = 2.0

_SCENE_FIELDS = (
    "start",
    "goal",
    "ring_m",
    "surface",
    "standoff_m",
    "vary_light",
    "vary_colour",
    "vary_texture",
    "eth_position_noise_m",
    "eth_rotation_noise_deg",
    "image_noise",
    "joint_offset_deg",
)


@dataclasses.dataclass(frozen=True, eq=False)
class Scenario:
    """One drawn scene.

    Attributes:
        split: Name of the split.
        index: Index within it.
        target: Centre of the target on the surface, (3,) m, base frame.
        normal: Outward surface normal there, (3,).
        start: True joint angles at reset, (7,) rad.
        joint_offset: Encoder zero error, (7,) rad: measured = true + offset.
        eth_shift: Displacement of the eye-to-hand camera, (3,) m, base frame.
        eth_turn: Rotation vector that turns it, (3,) rad, base frame.
        light_direction: Direction of the light, (3,), or None for the cell's own.
        light_level: Brightness of the light and the ambient light, (2,), 1 = the cell's own.
        surface_rgb: Colour of the surface, (3,) in [0, 1], or None for the cell's own.
        target_rgb: Colour of the target, (3,) in [0, 1], or None for the marker's own.
        robot_tint: Factor on the robot's colours, (3,).
        texture_seed: Key of the surface's texture, or None for a plain one.
    """

    split: str
    index: int
    target: FloatArray
    normal: FloatArray
    start: FloatArray
    joint_offset: FloatArray
    eth_shift: FloatArray
    eth_turn: FloatArray
    light_direction: FloatArray | None
    light_level: FloatArray
    surface_rgb: FloatArray | None
    target_rgb: FloatArray | None
    robot_tint: FloatArray
    texture_seed: int | None

    def digest(self) -> str:
        """SHA-256 of all values, rounded so that the last bits of a processor do not matter."""
        values = {
            name: np.round(value, 9).tolist() if isinstance(value, np.ndarray) else value
            for name, value in dataclasses.asdict(self).items()
        }
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


class ScenarioSource:
    """Draws the scenarios of one task, with its options, in one split.

    Args:
        variant: Parameters of the task.
        split: Any name; ``test`` holds 1,000 scenarios, every other one is unbounded.

    Raises:
        ScenarioError: The split's name is empty.
        OptionError: The goal that was asked for is out of reach.
    """

    def __init__(self, variant: AlignVariant, split: str, surface: Any) -> None:
        if not isinstance(split, str) or not split.strip():
            raise ScenarioError(f"a split is a name such as 'train' or 'test', not {split!r}")
        self._variant = variant
        self._surface = surface
        self.split = split
        identity = {
            "task": variant.name,
            "version": variant.version,
            "options": scene_options(variant),
            "split": split,
        }
        text = json.dumps(identity, sort_keys=True, default=list)
        self._key = int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "little")
        if isinstance(variant.goal, tuple) and not self._is_reachable(*variant.goal):
            raise OptionError(
                f"goal {variant.goal} is out of the arm's reach, {variant.standoff_m} m off the "
                "surface; choose a radius from 0.40 to 0.78 m"
            )

    def check(self, index: Any) -> int:
        """Return the index as an int.

        Raises:
            ScenarioError: It is not a whole number of this split.
        """
        count = TEST_SCENARIOS if self.split == TEST_SPLIT else MAX_INDEX
        if isinstance(index, bool) or not isinstance(index, int | np.integer):
            raise ScenarioError(f"a scenario is a whole number, not {index!r}")
        if not 0 <= index < count:
            raise ScenarioError(
                f"scenario {index} is out of range: split {self.split!r} of {self._variant.name} "
                f"holds 0 to {count - 1}"
            )
        return int(index)

    def seeded_index(self, seed: int, count: int) -> int:
        """Scenario of the ``count``-th reset after a reset with this seed.

        The first is the seed itself. On ``test`` later ones go on in strides of 37; elsewhere they
        are hashed from seed and count, so that workers seeded s, s + 1, ... share no scenes.
        """
        if self.split == TEST_SPLIT:
            return (seed + _TEST_STRIDE * count) % TEST_SCENARIOS
        if count == 0:
            return seed % MAX_INDEX
        digest = hashlib.sha256(f"{seed}/{count}".encode()).digest()
        return int.from_bytes(digest[:8], "little") % MAX_INDEX

    def generator(self, stream: str, index: int, step: int = 0) -> np.random.Generator:
        """The random stream of one quantity in one scenario (at one control step)."""
        word = zlib.crc32(stream.encode())
        counter = np.array([0, step, word, index], np.uint64)
        return np.random.Generator(np.random.Philox(key=self._key, counter=counter))

    def draw(self, index: int) -> Scenario:
        """Draw a scenario.

        Args:
            index: Index within the split.

        Raises:
            ScenarioError: The index is out of range.
            OptionError: A start or goal that was asked for cannot be drawn.
        """
        index = self.check(index)
        variant = self._variant
        target, normal = self._target(index)
        # A measured disturbance is normal, cut at two sigma: redrawing keeps the shape inside.
        offset = self._cut_normal("joint_offset", index, 7) * np.deg2rad(variant.joint_offset_deg)
        shift = self._cut_normal("eth_shift", index, 3) * variant.eth_position_noise_m
        turn = self._cut_normal("eth_turn", index, 3) * np.deg2rad(variant.eth_rotation_noise_deg)
        light_direction, light_level = self._light(index)
        colour = self.generator("colour", index)
        surface_rgb = target_rgb = None
        tint: FloatArray = np.ones(3)
        if variant.vary_colour:
            surface_rgb = np.clip(
                colour.uniform(0.35, 0.85) + colour.uniform(-0.08, 0.08, 3), 0.0, 1.0
            )
            target_rgb = np.array([colour.uniform(0.55, 0.95), *colour.uniform(0.02, 0.16, 2)])
            tint = np.asarray(colour.uniform(0.8, 1.1) * colour.uniform(0.95, 1.05, 3))
        texture = int(colour.integers(2**32)) if variant.vary_texture else None
        return Scenario(
            split=self.split,
            index=index,
            target=target,
            normal=normal,
            start=self._start(index, target, normal),
            joint_offset=offset,
            eth_shift=shift,
            eth_turn=turn,
            light_direction=light_direction,
            light_level=light_level,
            surface_rgb=surface_rgb,
            target_rgb=target_rgb,
            robot_tint=tint,
            texture_seed=texture,
        )

    def _target(self, index: int) -> tuple[FloatArray, FloatArray]:
        goal = self._variant.goal
        inner, outer = self._variant.ring_m
        if goal == "places":
            x, y = fixed_places(inner, outer)[index % len(fixed_places(inner, outer))]
        elif isinstance(goal, str):
            # "fixed" is drawn once a split: from a stream of its own that ignores the index.
            random = self.generator(f"target-{goal}", index if goal == "random" else 0)
            for _ in range(_MAX_REDRAWS):
                radius = math.sqrt(random.uniform(inner**2, outer**2))
                azimuth = random.uniform(-math.pi, math.pi)
                x, y = radius * math.cos(azimuth), radius * math.sin(azimuth)
                # The ring is what the arm reaches over a flat surface; others lie partly lower.
                if self._variant.surface == "flat" or self._is_reachable(x, y):
                    break
            else:
                raise OptionError(f"no target within reach found for scenario {index}")
        else:
            x, y = goal
        height = self._surface.height(x, y)
        return np.array([x, y, height]), self._surface.normal(x, y)

    def _is_reachable(self, x: float, y: float) -> bool:
        target, normal = np.array([x, y, self._surface.height(x, y)]), self._surface.normal(x, y)
        goal = target + normal * self._variant.standoff_m
        return bool(len(kinematics().goal_configurations_at_tool_angle(goal, normal, 0.0)))

    def _start(self, index: int, target: FloatArray, normal: FloatArray) -> FloatArray:
        start = self._variant.start
        if start == "mixed":
            own = TASKS[self._variant.name].start if self._variant.name in TASKS else "zero"
            near = self.generator("mixed", index).random() < 0.5
            start = "near_goal" if near else own
        if start == "zero":
            return np.zeros(len(JOINT_NAMES))
        if start == "random":
            return self._random_start(index, target, normal)
        if start == "fixed":
            return self._fixed_start()
        if start == "near_goal":
            return self._near_goal_start(index, target, normal)
        return np.array(start, dtype=np.float64)

    def _fixed_start(self) -> FloatArray:
        # Kept for all goals, so it cannot depend on one: clear of surface and self is all it is.
        random = self.generator("start-fixed", 0)
        bound = RANDOM_START_RANGE * JOINT_RANGE_RAD
        for _ in range(_MAX_REDRAWS):
            q = random.uniform(-bound, bound)
            if self._clearance(q, self._floor_normal()) >= START_CLEARANCE_M:
                return q
        raise OptionError("no fixed start found that is clear of surface and self")

    def _random_start(self, index: int, target: FloatArray, normal: FloatArray) -> FloatArray:
        model, variant = kinematics(), self._variant
        goal = target + normal * variant.standoff_m
        random = self.generator("start", index)
        bound = RANDOM_START_RANGE * JOINT_RANGE_RAD
        steps = variant.time_limit_steps - SPARE_STEPS
        for _ in range(_MAX_REDRAWS):
            q = random.uniform(-bound, bound)
            if np.linalg.norm(model.flange_pose(q)[1] - goal) < START_GOAL_DISTANCE_M:
                continue
            if self._clearance(q, self._floor_normal()) < START_CLEARANCE_M:
                continue
            if steps_lower_bound(variant, q, goal, normal) <= steps:
                return q
        raise OptionError(
            f"no random start found for scenario {index}: the goal at radius "
            f"{math.hypot(goal[0], goal[1]):.2f} m cannot be reached in {steps} steps"
        )

    def _near_goal_start(self, index: int, target: FloatArray, normal: FloatArray) -> FloatArray:
        goal = target + normal * self._variant.standoff_m
        reachable = kinematics().goal_configurations_at_tool_angle(goal, normal, 0.0)
        if not len(reachable):
            raise OptionError(
                f"scenario {index}: the goal {goal.round(3).tolist()} is out of reach"
            )
        random = self.generator("near_goal", index)
        # Any posture that faces the target, quick ones from the task's own start more often.
        times = travel_time(np.zeros(len(JOINT_NAMES)), reachable, acceleration_limits=True)
        best = reachable[np.argsort(times)[: max(1, len(reachable) // 8)]]
        for _ in range(_MAX_REDRAWS):
            posture = best[random.integers(len(best))].copy()
            posture[6] = random.uniform(-1.0, 1.0) * 0.5
            low, high = np.log(_NEAR_GOAL_SCALE_RAD)
            scale = math.exp(random.uniform(low, high))
            q = posture + random.normal(size=7) * scale * [0.5, 0.5, 0.5, 0.5, 1, 1, 2]
            # No surface here bends up, so none rises above the plane that touches it at the target.
            if (np.abs(q) < JOINT_RANGE_RAD).all() and (
                self._clearance(q, normal, target) >= _NEAR_GOAL_CLEARANCE_M
            ):
                return q
        raise OptionError(f"no start near the goal found for scenario {index}")

    def _clearance(
        self, q: FloatArray, normal: FloatArray, through: FloatArray | None = None
    ) -> float:
        height = 0.0 if through is None else float(through @ normal / normal[2])
        return kinematics().clearance(q, height, normal)

    def _floor_normal(self) -> FloatArray:
        """Normal of the plane through the origin that the whole surface lies in or below."""
        return np.asarray(self._surface.normal(0.0, 0.0))

    def _light(self, index: int) -> tuple[FloatArray | None, FloatArray]:
        if not self._variant.vary_light:
            return None, np.ones(2)
        random = self.generator("light", index)
        tilt, azimuth = random.uniform(0.0, 0.9), random.uniform(-math.pi, math.pi)
        direction = -np.array(
            [math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), math.cos(tilt)]
        )
        return direction, np.array([random.uniform(0.6, 1.3), random.uniform(0.6, 1.4)])

    def _cut_normal(self, stream: str, index: int, size: int) -> FloatArray:
        random = self.generator(stream, index)
        values = random.normal(size=size)
        while (outside := np.abs(values) > _CUT_SIGMA).any():
            values[outside] = random.normal(size=int(outside.sum()))
        return values


def scene_options(variant: AlignVariant) -> dict[str, Any]:
    """The options that shape the scene and differ from the named task's own."""
    named = TASKS.get(variant.name)
    return {
        name: getattr(variant, name)
        for name in _SCENE_FIELDS
        if named is None or getattr(variant, name) != getattr(named, name)
    }


def steps_lower_bound(
    variant: AlignVariant, start: FloatArray, goal: FloatArray, normal: FloatArray
) -> int:
    """Least control steps to success from rest, under joint speed and acceleration limits.

    The travel time over all goal configurations (yaw is free, so A7 stays), rounded up to control
    steps, plus the further steps of the hold and the latency.

    Args:
        variant: Task whose period, hold and latency count.
        start: Joint angles, (7,) rad.
        goal: Flange position at the goal, (3,) m, base frame.
        normal: Outward surface normal, (3,).

    Returns:
        Steps; a large number where the goal is out of reach.
    """
    configurations = kinematics().goal_configurations_at_tool_angle(goal, normal, float(start[6]))
    if not len(configurations):
        return 10**6
    seconds = float(travel_time(start, configurations, acceleration_limits=True).min())
    steps = math.ceil(seconds / variant.control_period_s - 1e-9)
    return max(1, steps) + variant.hold_steps - 1 + variant.latency_steps


@functools.cache
def fixed_places(inner: float, outer: float) -> tuple[tuple[float, float], ...]:
    """The ten places of ``align-fixed``: a golden-angle spiral, even in area over the ring (m)."""
    places = []
    for i in range(10):
        radius = math.sqrt(inner**2 + (i + 0.5) / 10 * (outer**2 - inner**2))
        azimuth = 0.5 + i * math.pi * (3.0 - math.sqrt(5.0))
        places.append((radius * math.cos(azimuth), radius * math.sin(azimuth)))
    return tuple(places)
