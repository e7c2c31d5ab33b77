"""Scenarios: everything random in an episode, as a pure function of an index.

A scenario depends on the task's name and version, on the options that shape the scene, on the split
and on the index, and on nothing else: not on the batch size, the worker, the policy or when earlier
episodes ended. Each quantity is drawn from a Philox stream of its own (a counter-based generator,
Salmon et al., "Parallel random numbers: as easy as 1, 2, 3", SC 2011), so that adding one leaves
the others as they are. Options that do not shape the scene (cameras switched off, rewards, action
mode, tolerances) leave it alone, so that studies of them are paired.
"""

import dataclasses
import hashlib
import json
import math
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import numpy.typing as npt

from hvs_suite.errors import ScenarioError
from hvs_suite.tasks.shared.spec import Spec

FloatArray = npt.NDArray[np.float64]

TEST_SPLIT = "test"
TEST_SCENARIOS = 1000
# Indices are one 64-bit word of the generator's counter; half of it is room enough.
MAX_INDEX = 2**62
# Coprime with 1,000: a stream of bare resets on `test` meets every scenario, and streams whose
# seeds differ by less than 37 share none within their first 26 resets.
_TEST_STRIDE = 37
_CUT_SIGMA = 2.0
_LATER = ("eih_shift", "eih_turn")
"""Quantities that came when scenes were frozen; without them a scene keeps the digest it had."""


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Look:
    """What every scene has, whatever the family.

    Attributes:
        joint_offset: Encoder zero error, (7,) rad: measured = true + offset.
        eth_shift: Displacement of the eye-to-hand camera, (3,) m, base frame.
        eth_turn: Rotation vector that turns it, (3,) rad, base frame.
        eih_shift: Displacement of the eye in the hand, (3,) m, frame of the body that carries it;
            None without a hand-eye error.
        eih_turn: Rotation vector that turns it, (3,) rad, the same frame; None likewise.
        light_direction: Direction of the light, (3,), or None for the cell's own.
        light_level: Brightness of the light and the ambient light, (2,), 1 = the cell's own.
        surface_rgb: Colour of the surface, (3,) in [0, 1], or None for the cell's own.
        target_rgb: Colour of the target, (3,) in [0, 1], or None for the marker's own.
        robot_tint: Factor on the robot's colours, (3,).
        texture_seed: Key of the surface's texture, or None for a plain one.
    """

    joint_offset: FloatArray
    eth_shift: FloatArray
    eth_turn: FloatArray
    light_direction: FloatArray | None
    light_level: FloatArray
    surface_rgb: FloatArray | None
    target_rgb: FloatArray | None
    robot_tint: FloatArray
    texture_seed: int | None
    eih_shift: FloatArray | None = None
    eih_turn: FloatArray | None = None


@dataclasses.dataclass(frozen=True, eq=False, kw_only=True)
class Scenario(Look):
    """One drawn scene; families add what is their own.

    Attributes:
        split: Name of the split.
        index: Index within it.
        start: True joint angles at reset, (7,) rad.
    """

    split: str
    index: int
    start: FloatArray

    def digest(self) -> str:
        """SHA-256 of all values, rounded so that the last bits of a processor do not matter."""
        values = dataclasses.asdict(self)
        for name in _LATER:
            if values[name] is None:
                del values[name]
        text = json.dumps(values, sort_keys=True, default=_rounded)
        return hashlib.sha256(text.encode()).hexdigest()


def _rounded(array: FloatArray) -> Any:
    return np.round(array, 9).tolist()


@dataclasses.dataclass(frozen=True)
class Streams:
    """The random streams of one scenario: one for each quantity, by name.

    Attributes:
        key: Of the task, its options and the split.
        split: Name of the split.
        index: Index within it.
    """

    key: int
    split: str
    index: int

    def generator(self, stream: str, step: int = 0) -> np.random.Generator:
        """The stream of one quantity in this scenario (at one control step)."""
        return self._generator(stream, self.index, step)

    def once(self, stream: str) -> np.random.Generator:
        """The stream of a quantity that is the same in all scenarios of the split."""
        return self._generator(stream, 0, 0)

    def cut_normal(self, stream: str, size: int) -> FloatArray:
        """Standard normal values, (size,), cut at two sigma by drawing again what lies outside."""
        random = self.generator(stream)
        values = random.normal(size=size)
        while (outside := np.abs(values) > _CUT_SIGMA).any():
            values[outside] = random.normal(size=int(outside.sum()))
        return values

    def _generator(self, stream: str, index: int, step: int) -> np.random.Generator:
        counter = np.array([0, step, zlib.crc32(stream.encode()), index], np.uint64)
        return np.random.Generator(np.random.Philox(key=self.key, counter=counter))


class StepStream:
    """The stream of one quantity at any control step, from one generator that is set to it.

    To make a generator takes longer than to draw from it what a step needs.

    Args:
        source: Of the scenarios.
        stream: Name of the quantity.
    """

    def __init__(self, source: "ScenarioSource", stream: str) -> None:
        self._generator = source.generator(stream, 0)
        self._state = self._generator.bit_generator.state

    def at(self, index: int, step: int) -> np.random.Generator:
        """As `ScenarioSource.generator`; draw from it before the next is asked for."""
        counter = self._state["state"]["counter"]
        counter[1], counter[3] = step, index
        self._generator.bit_generator.state = self._state
        return self._generator


class ScenarioSource:
    """Draws the scenarios of one task, with its options, in one split.

    Args:
        spec: Parameters of the task.
        named: Those that its name stands for; None for a task without a registered name.
        split: Any name; ``test`` holds 1,000 scenarios, every other one is unbounded.
        draw: The family's way to draw.

    Raises:
        ScenarioError: The split's name is empty.
    """

    def __init__(
        self, spec: Spec, named: Spec | None, split: str, draw: Callable[[Streams], Scenario]
    ) -> None:
        if not isinstance(split, str) or not split.strip():
            raise ScenarioError(f"a split is a name such as 'train' or 'test', not {split!r}")
        self._name = spec.name
        self._draw = draw
        self.split = split
        identity = {
            "task": spec.name,
            "version": spec.version,
            "options": scene_options(spec, named),
            "split": split,
        }
        text = json.dumps(identity, sort_keys=True, default=list)
        self._key = int.from_bytes(hashlib.sha256(text.encode()).digest()[:16], "little")

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
                f"scenario {index} is out of range: split {self.split!r} of {self._name} "
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

    def streams(self, index: int) -> Streams:
        """The random streams of a scenario."""
        return Streams(self._key, self.split, index)

    def generator(self, stream: str, index: int, step: int = 0) -> np.random.Generator:
        """The random stream of one quantity in one scenario (at one control step)."""
        return self.streams(index).generator(stream, step)

    def draw(self, index: int) -> Scenario:
        """Draw a scenario.

        Args:
            index: Index within the split.

        Raises:
            ScenarioError: The index is out of range.
            OptionError: A start or goal that was asked for cannot be drawn.
        """
        return self._draw(self.streams(self.check(index)))


def towards(own: FloatArray, drawn: FloatArray, strength: float) -> FloatArray:
    """From one value towards another, which strength 1 reaches to the last bit."""
    return np.asarray((1.0 - strength) * own + strength * drawn, np.float64)


def draw_look(spec: Spec, streams: Streams) -> dict[str, Any]:
    """Draw what every scene has: the fields of `Look`, to be passed on to a scenario."""
    # A measured disturbance is normal, cut at two sigma: redrawing keeps the shape inside.
    light_direction, light_level = _light(spec, streams)
    has_hand_eye_error = spec.eih_position_noise_m > 0 or spec.eih_rotation_noise_deg > 0
    colour = streams.generator("colour")
    surface_rgb = target_rgb = None
    tint: FloatArray = np.ones(3)
    if spec.vary_colour:
        surface_rgb = np.clip(colour.uniform(0.35, 0.85) + colour.uniform(-0.08, 0.08, 3), 0.0, 1.0)
        target_rgb = np.array([colour.uniform(0.55, 0.95), *colour.uniform(0.02, 0.16, 2)])
        tint = np.asarray(colour.uniform(0.8, 1.1) * colour.uniform(0.95, 1.05, 3))
    return {
        "split": streams.split,
        "index": streams.index,
        "joint_offset": streams.cut_normal("joint_offset", 7) * np.deg2rad(spec.joint_offset_deg),
        "eth_shift": streams.cut_normal("eth_shift", 3) * spec.eth_position_noise_m,
        "eth_turn": streams.cut_normal("eth_turn", 3) * np.deg2rad(spec.eth_rotation_noise_deg),
        "light_direction": light_direction,
        "light_level": light_level,
        "surface_rgb": surface_rgb,
        "target_rgb": target_rgb,
        "robot_tint": tint,
        "texture_seed": int(colour.integers(2**32)) if spec.vary_texture else None,
        "eih_shift": streams.cut_normal("eih_shift", 3) * spec.eih_position_noise_m
        if has_hand_eye_error
        else None,
        "eih_turn": streams.cut_normal("eih_turn", 3) * np.deg2rad(spec.eih_rotation_noise_deg)
        if has_hand_eye_error
        else None,
    }


def _light(spec: Spec, streams: Streams) -> tuple[FloatArray | None, FloatArray]:
    if not spec.vary_light:
        return None, np.ones(2)
    random = streams.generator("light")
    tilt, azimuth = random.uniform(0.0, 0.9), random.uniform(-math.pi, math.pi)
    direction = -np.array(
        [math.sin(tilt) * math.cos(azimuth), math.sin(tilt) * math.sin(azimuth), math.cos(tilt)]
    )
    return direction, np.array([random.uniform(0.6, 1.3), random.uniform(0.6, 1.4)])


def scene_options(spec: Spec, named: Spec | None) -> dict[str, Any]:
    """The options that shape the scene and differ from the named task's own.

    None where they come unannounced: each stream is then the named task's, and what no option
    changes is where it is there.
    """
    if spec.unannounced:
        return {}
    return {
        name: getattr(spec, name)
        for name in spec.scene_fields
        if named is None or getattr(spec, name) != getattr(named, name)
    }
