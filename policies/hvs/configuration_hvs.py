"""Configuration of the `hvs` policy."""

import math
from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig
from lerobot.utils.constants import OBS_STATE

from hvs_suite.policies.network.network import (
    ERROR_SCALE,
    IMAGE_PREFIX,
    N_JOINTS,
    POSITIONS_AND_VELOCITIES,
    RESIDUAL_BOUND,
    Shape,
)
from hvs_suite.policies.trained_for import CONTROL_PERIOD_S, FAMILY

CAMERAS = ("eih", "eth")


@PreTrainedConfig.register_subclass("hvs")
@dataclass
class HvsConfig(PreTrainedConfig):
    """Configuration of the `hvs` policy.

    Inputs are any of ``observation.images.eih``, ``observation.images.eth`` (square) and
    ``observation.state``, at least one of them an image. The output is ``action``: seven joint
    position targets in units of the joint range.

    Attributes:
        normalization_mapping: All identity: the network scales images and joints itself.
        channels: Channels of the image encoders.
        hidden: Width of the perceptron that decides.
        error_scale: Below this, errors weigh linearly, above logarithmically: of a joint's step
            (rad) and of a place (m). Some five times the tolerance that is aimed at.
        residual_hidden: Width of the residual that ``hvs finetune`` learns; 0 for none.
        residual_bound: The most that it adds to the output of the head.
        from_set_point: Joint steps are counted from where the arm has been sent, and not from where
            it stands; for a policy that learned with that in its memory, of an arm with latency
            (docs/experiments/from-set-point.md).
        family: Family of the tasks that it was trained for.
        control_period_s: Length of their control step (s).
        options: Options of the task that it was trained with, where they differ from the named one;
            `hvs_suite.policies.trained_for` compares them with the task to be played.
        keypoint_weight: Weight of the losses against the projected target and its place in space,
            where the dataset has ``privileged.*`` columns; 0 trains on actions alone.
        optimizer_lr: Peak learning rate of stock ``lerobot-train``.
        optimizer_weight_decay: AdamW's weight decay.
    """

    normalization_mapping: dict[str, NormalizationMode] = field(
        default_factory=lambda: {
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.IDENTITY,
            "ACTION": NormalizationMode.IDENTITY,
        }
    )
    channels: int = 32
    hidden: int = 256
    error_scale: float = ERROR_SCALE
    residual_hidden: int = 0
    residual_bound: float = RESIDUAL_BOUND
    from_set_point: bool = False
    family: str = FAMILY
    control_period_s: float = CONTROL_PERIOD_S
    options: dict[str, Any] = field(default_factory=dict)
    keypoint_weight: float = 1.0
    optimizer_lr: float = 2e-3
    optimizer_weight_decay: float = 1e-4

    def __post_init__(self) -> None:
        """Refuse sizes that no network can have."""
        super().__post_init__()
        if self.channels < 4 or self.hidden < 4:
            raise ValueError(
                f"`channels` and `hidden` must be at least 4, got {self.channels} and "
                f"{self.hidden}."
            )
        if not 0 < self.error_scale < math.inf:
            raise ValueError(f"`error_scale` must be above 0, got {self.error_scale}.")
        if self.residual_hidden < 0 or not 0 < self.residual_bound < math.inf:
            raise ValueError(
                "`residual_hidden` must not be negative and `residual_bound` above 0, got "
                f"{self.residual_hidden} and {self.residual_bound}."
            )
        if self.keypoint_weight < 0:
            raise ValueError(f"`keypoint_weight` must not be negative, got {self.keypoint_weight}.")
        if self.n_obs_steps != 1:
            raise ValueError(f"The policy reads one observation, got {self.n_obs_steps=}.")

    def validate_features(self) -> None:
        """Check that the network can read these inputs and drive this robot.

        Raises:
            ValueError: An input or the action has a name or shape that the network has no use for.
        """
        if not self.image_features:
            raise ValueError("The policy needs `observation.images.eih`, `.eth` or both.")
        for key, feature in self.image_features.items():
            if key.removeprefix(IMAGE_PREFIX) not in CAMERAS:
                raise ValueError(f"Unknown camera `{key}`; the policy knows {', '.join(CAMERAS)}.")
            if len(feature.shape) != 3 or feature.shape[1] != feature.shape[2]:
                raise ValueError(f"`{key}` must be a square (C, H, W) image, got {feature.shape}.")
        state = self.robot_state_feature
        if state is not None and state.shape[0] not in (N_JOINTS, POSITIONS_AND_VELOCITIES):
            raise ValueError(
                f"`{OBS_STATE}` must hold 7 joint positions, or 7 positions and 7 velocities, got "
                f"{state.shape[0]} numbers."
            )
        action = self.action_feature
        if action is None or tuple(action.shape) != (N_JOINTS,):
            raise ValueError("`action` must hold 7 joint position targets.")

    def shape(self) -> Shape:
        """Sizes of the network for these inputs."""
        cameras = {
            key.removeprefix(IMAGE_PREFIX): (feature.shape[0], feature.shape[1])
            for key, feature in sorted(self.image_features.items())
        }
        state = self.robot_state_feature
        return Shape(
            cameras,
            state.shape[0] if state else 0,
            self.channels,
            self.hidden,
            self.error_scale,
            self.residual_hidden,
            self.residual_bound,
            self.from_set_point,
        )

    def get_optimizer_preset(self) -> AdamWConfig:
        """AdamW with this configuration's rate and decay."""
        return AdamWConfig(
            lr=self.optimizer_lr, weight_decay=self.optimizer_weight_decay, grad_clip_norm=1.0
        )

    def get_scheduler_preset(self) -> CosineDecayWithWarmupSchedulerConfig:
        """Cosine decay to zero over the run; LeRobot shortens it to the number of steps."""
        return CosineDecayWithWarmupSchedulerConfig(
            num_warmup_steps=100,
            num_decay_steps=30_000,
            peak_lr=self.optimizer_lr,
            decay_lr=self.optimizer_lr * 0.01,
        )

    @property
    def observation_delta_indices(self) -> None:
        """One observation, the present one."""
        return None

    @property
    def action_delta_indices(self) -> None:
        """One action, the present one."""
        return None

    @property
    def reward_delta_indices(self) -> None:
        """No rewards."""
        return None
