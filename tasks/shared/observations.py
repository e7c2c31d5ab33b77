"""Observation presets and the observables behind them.

What a policy may see (``vision``) and what only training may see (``state``) are kept apart: no
privileged value stands among the observations of a vision preset.
"""

from collections.abc import Callable
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import numpy.typing as npt
from dm_control import mjcf
from dm_control.composer.observation import observable
from dm_env import specs
from scipy.ndimage import gaussian_filter

from hvs_suite.cell import cameras
from hvs_suite.cell.robot import JOINT_RANGE_RAD, JOINT_SPEED_RAD_S, JOINT_TORQUE_NM
from hvs_suite.tasks.shared import depth_noise
from hvs_suite.tasks.shared.scenario import StepStream

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.arm_task import ArmTask

FloatArray = npt.NDArray[np.float64]

POSITION_BOUND_RAD = JOINT_RANGE_RAD + 0.05
"""Bound of measured joint angles: the range, the encoder's zero error and the stop's give."""
SPEED_BOUND_RAD_S = 2.0 * JOINT_SPEED_RAD_S
"""Where measured joint speeds saturate. An arm whose set point jumps to and fro falls behind at its
torque limit and catches up faster than the set point moves; measurements still keep their bounds.
"""
FULL_SCALE = {
    "joint_positions": JOINT_RANGE_RAD,
    "joint_velocities": JOINT_SPEED_RAD_S,
    "joint_torques": JOINT_TORQUE_NM,
}
"""What reads as 1 where observations are normalised: the robot's published limits."""
DEPTH_BOUND_M = 20.0
_STATE_BOUND_M = 3.0
# One bank of unit noise, cut into frames at random places, costs a tenth of drawing it anew.
_NOISE_BANK = 1 << 20


class VectorObservable(observable.Observable):
    """Observable for a vector with known bounds."""

    def __init__(
        self, read: Callable[[mjcf.Physics], FloatArray], spec: specs.BoundedArray
    ) -> None:
        super().__init__(update_interval=1, buffer_size=1, delay=0, aggregator=None, corruptor=None)
        self._read = read
        self._spec = spec

    @property
    def array_spec(self) -> specs.BoundedArray:
        """Shape, type and bounds."""
        return self._spec

    def _callable(self, physics: mjcf.Physics) -> Callable[[], npt.NDArray[Any]]:
        return lambda: self._read(physics).astype(self._spec.dtype, copy=False)


class NoiseBank:
    """Normal noise on pictures.

    Args:
        sigma: Standard deviation, in steps of the 255 that a pixel has.
    """

    def __init__(self, sigma: float) -> None:
        random = np.random.Generator(np.random.Philox(key=0))
        rest = np.rint(random.normal(size=_NOISE_BANK) * sigma)
        # Saturated sums of bytes take a quarter of the time of wider ones. What a byte does not
        # hold is added by the next layer, which makes no difference, because its sign is the same.
        self._layers: list[npt.NDArray[np.int8]] = []
        while rest.any() or not self._layers:
            layer = np.clip(rest, -127.0, 127.0)
            self._layers.append(layer.astype(np.int8))
            rest -= layer

    def disturb(self, image: npt.NDArray[np.uint8], random: np.random.Generator) -> None:
        """Add noise to a picture (H, W, C), in place; the generator says which."""
        start = int(random.integers(_NOISE_BANK - image.size))
        pixels = image.reshape(-1)
        # From [0, 255] to [-128, 127], and back.
        pixels ^= 0x80
        for layer in self._layers:
            signed = pixels.view(np.int8)
            cv2.add(signed, layer[start : start + image.size], dst=signed)
        pixels ^= 0x80


def make_observables(task: "ArmTask") -> dict[str, observable.Observable]:
    """Build exactly the observables that the task's spec names, enabled.

    Args:
        task: The task they read from.

    Returns:
        Observables by name: ``eih``, ``eth`` uint8 (H, W, C); ``eih_depth``, ``eth_depth`` float32
        (H, W, 1) m, 0 where a noisy one has no measurement; ``joint_positions`` (7,) rad,
        ``joint_velocities`` (7,) rad/s, ``joint_torques`` (7,) N m (see
        ``ArmTask.joint_torques``), as measured; privileged: ``flange_position``,
        ``goal_position`` (3,) m, ``goal_normal`` (3,); and what the family adds. With
        ``normalise_observation`` pictures are float32 in [0, 1] and joints in [-1, 1].
    """
    spec = task.spec
    bank = NoiseBank(spec.image_noise) if spec.image_noise > 0 else None
    built: dict[str, observable.Observable] = {}
    for name in spec.observed:
        if name in ("eih", "eth"):
            built[name] = _picture(task, name, bank)
        elif name in ("eih_depth", "eth_depth"):
            built[name] = _depth(task, name)
        elif name in spec.further_observations:
            built[name] = _of_family(task, name)
        else:
            built[name] = _vector(task, name)
        built[name].enabled = True
    return built


def _picture(task: "ArmTask", name: str, bank: NoiseBank | None) -> Any:
    spec = task.spec
    side = spec.eih_resolution if name == "eih" else spec.eth_resolution
    channels = spec.eih_channels if name == "eih" else spec.eth_channels
    normalise = spec.normalise_observation
    noise = StepStream(task.source, f"noise-{name}")

    def take(physics: mjcf.Physics) -> npt.NDArray[Any]:
        image = task.environment.renderer.colour(
            physics.data.ptr, task.cameras[name].id, side, side
        )
        if spec.image_blur_px > 0:
            # The lens comes before the sensor's noise.
            image = gaussian_filter(image, (spec.image_blur_px, spec.image_blur_px, 0.0))
        if bank is not None:
            bank.disturb(image, noise.at(task.scenario.index, task.environment.control_steps))
        if channels == 1:
            image = cameras.to_grey(image)
        return image.astype(np.float32) / np.float32(255) if normalise else image

    shape = (side, side, channels)
    array = (
        specs.BoundedArray(shape, np.float32, 0.0, 1.0)
        if normalise
        else specs.BoundedArray(shape, np.uint8, 0, 255)
    )
    return cameras.CameraImage(take, array)


def _depth(task: "ArmTask", name: str) -> Any:
    camera = name.removesuffix("_depth")
    side = task.spec.eih_resolution if camera == "eih" else task.spec.eth_resolution
    sigma_px = task.spec.depth_noise_px
    noise = StepStream(task.source, f"noise-{name}")

    def take(physics: mjcf.Physics) -> npt.NDArray[Any]:
        known = task.cameras[camera]
        depth = task.environment.renderer.depth(physics.data.ptr, known.id, side, side)
        if sigma_px == 0.0:
            return depth
        random = noise.at(task.scenario.index, task.environment.control_steps)
        baseline_m = depth_noise.BASELINES_M[camera]
        measured = depth_noise.as_measured(depth, known.fov_deg, baseline_m, sigma_px, random)
        return np.minimum(measured, np.float32(DEPTH_BOUND_M))

    return cameras.CameraImage(
        take, specs.BoundedArray((side, side, 1), np.float32, 0.0, DEPTH_BOUND_M)
    )


def _vector(task: "ArmTask", name: str) -> VectorObservable:
    reads: dict[str, tuple[Callable[[mjcf.Physics], FloatArray], FloatArray]] = {
        "joint_positions": (task.measured_positions, POSITION_BOUND_RAD),
        "joint_velocities": (task.joint_velocities, SPEED_BOUND_RAD_S),
        "joint_torques": (task.joint_torques, JOINT_TORQUE_NM),
        "flange_position": (task.flange_position, np.full(3, _STATE_BOUND_M)),
        "goal_position": (lambda physics: task.goal().position, np.full(3, _STATE_BOUND_M)),
        "goal_normal": (lambda physics: task.goal().normal, np.ones(3)),
    }
    read, bound = reads[name]
    if task.spec.normalise_observation and name in FULL_SCALE:
        scale = FULL_SCALE[name]

        def normalised(physics: mjcf.Physics) -> FloatArray:
            return np.minimum(np.maximum(read(physics) / scale, -1.0), 1.0)

        return VectorObservable(normalised, specs.BoundedArray((7,), np.float32, -1.0, 1.0))

    def saturated(physics: mjcf.Physics) -> FloatArray:
        return np.minimum(np.maximum(read(physics), -bound), bound)

    return VectorObservable(saturated, specs.BoundedArray(bound.shape, np.float64, -bound, bound))


def _of_family(task: "ArmTask", name: str) -> VectorObservable:
    known = task.spec.further_observations[name]
    shape = (len(known.dimensions),)
    noise = StepStream(task.source, f"noise-{name}")

    def read(physics: mjcf.Physics) -> FloatArray:
        value = task.family.observe(physics)[name]
        if known.noise:
            random = noise.at(task.scenario.index, task.environment.control_steps)
            value = value + random.normal(size=shape) * known.noise
        return np.minimum(np.maximum(value, known.low), known.high)

    return VectorObservable(read, specs.BoundedArray(shape, np.float64, known.low, known.high))
