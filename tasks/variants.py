"""The named variants of ``align``: every parameter that a task name fixes, with its unit.

A *variant* is plain data: this module imports neither MuJoCo nor torch, so listing tasks is instant.
Changing what a registered name means needs a new ``version``; ``tasks/lock.json`` holds the digests.
"""

import dataclasses
from collections.abc import Mapping
from types import MappingProxyType
from typing import Literal

Start = Literal["zero", "random", "fixed", "near_goal", "mixed"] | tuple[float, ...]
Goal = Literal["random", "fixed", "places"] | tuple[float, float]
ActionMode = Literal["joint_position", "joint_delta", "joint_velocity", "flange_twist"]
RewardTerm = Literal[
    "goal", "collision", "time", "position", "rotation", "joint_space", "exponential"
]

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
    position_tolerance_mm: float | None = None
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
    eth_fov_deg: float = 34.0
    eth_position_m: tuple[float, float, float] = (-1.2, 0.8, 2.6)
    eth_look_at_m: tuple[float, float, float] = (0.0, 0.0, 0.0)
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

    @property
    def instruction(self) -> str:
        """The task as one sentence, identical in environment and dataset."""
        return (
            f"Place the flange centred over the target, facing it, "
            f"{self.standoff_m * 1000:.0f} mm above the surface."
        )
