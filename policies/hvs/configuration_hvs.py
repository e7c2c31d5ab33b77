"""Configuration of the `hvs` policy."""

from dataclasses import dataclass, field
from typing import Any

from lerobot.configs import NormalizationMode, PreTrainedConfig
from lerobot.optim import AdamWConfig, CosineDecayWithWarmupSchedulerConfig

from hvs_suite.errors import PolicyError
from hvs_suite.policies.belief.network import N_JOINTS, Shape
from hvs_suite.policies.belief.settings import Settings, further_keys
from hvs_suite.policies.trained_for import CONTROL_PERIOD_S, FAMILY
from hvs_suite.reading import validated


@PreTrainedConfig.register_subclass("hvs")
@dataclass
class HvsConfig(PreTrainedConfig):
    """Configuration of the `hvs` policy.

    Inputs are ``observation.images.eih``, ``observation.images.eth`` (square) or both,
    ``observation.state`` (14), and what `goal_key` and `wrench_key` name. The output is ``action``:
    seven joint position targets in units of the joint range.

    Attributes:
        normalization_mapping: All identity: the network scales images and numbers itself.
        channels: Channels of the eyes.
        hidden: Width of the head.
        error_scale: Below this, errors weigh linearly, above logarithmically: of a joint's step
            (rad) and of a place (m). Some five times the tolerance that is aimed at.
        goal_key: Input that says which target is meant, one-hot; None without. A new policy takes
            the one of its inputs that has ``goal`` in its name.
        wrench_key: Input that holds force and torque, (6,) N and Nm; None without. A new policy
            takes ``observation.wrench`` if that is one of its inputs.
        cell: What is known of the cell beforehand, as `hvs_suite.policies.belief.settings.Cell`
            has it; None for a new policy, which takes that of its dataset's task.
        residual_hidden: Width of the residual that RL has learned; 0 without one.
        residual_step_m: The most that it moves the goal in a step: sideways, and along the normal
            (m).
        residual_reach_m: How far from the believed goal it does (m).
        choice_beyond_m: How far from the believed goal what policy search has found shifts the
            choice among the head's proposals (m); None without it.
        reads_positions: Whether it reads measured joint positions, see `Shape`.
        reads_velocities: Whether it reads measured joint velocities.
        slopes: Cameras whose eyes tell slopes, see `Shape`.
        slopes_by: See `Shape`; ``hvs pretrain`` makes it ``colour``.
        offsets: Cameras whose pose is not exact, see `Shape`.
        foresight: Control steps of which it remembers where the target was, see `Shape`; a new
            policy, where the targets of its dataset move.
        remembers: Whether it remembers what it has seen, see `Shape`.
        corrects_within_m: How far from the goal the head corrects its ways, see `Shape`.
        elbow_aside: Whether plain postures may have the elbow to a side, see `Shape`; for a new
            policy they may.
        family: Family of the tasks that it was trained for.
        control_period_s: Length of their control step (s).
        options: Options of the task that it was trained with, where they differ from the named one;
            `hvs_suite.policies.trained_for` holds them against what is to be played.
        window: Frames of the sequences that stock ``lerobot-train`` trains on, the memory with
            them. Where less of the episode came before, the window is padded.
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
    error_scale: float = 0.005
    goal_key: str | None = None
    wrench_key: str | None = None
    cell: dict[str, Any] | None = None
    residual_hidden: int = 0
    residual_step_m: tuple[float, float] = Shape.residual_step_m
    residual_reach_m: float = Shape.residual_reach_m
    choice_beyond_m: float | None = None
    reads_positions: bool = True
    reads_velocities: bool = True
    slopes: tuple[str, ...] = ()
    slopes_by: str = "contrasts"
    offsets: tuple[str, ...] = ()
    foresight: int = 0
    remembers: bool = True
    corrects_within_m: float | None = None
    elbow_aside: bool = False
    family: str = FAMILY
    control_period_s: float = CONTROL_PERIOD_S
    options: dict[str, Any] = field(default_factory=dict)
    window: int = 16
    optimizer_lr: float = 2e-3
    optimizer_weight_decay: float = 1e-4

    def __post_init__(self) -> None:
        """Refuse training that makes no sense; the network's own sizes see `settings`."""
        super().__post_init__()
        if self.window < 1:
            raise ValueError(f"`window` must be at least 1, got {self.window}.")
        if self.n_obs_steps != 1:
            raise ValueError(f"The policy reads one observation, got {self.n_obs_steps=}.")

    def name_inputs(self) -> None:
        """Set which of a new policy's inputs are goal and wrench, unless they are set already."""
        goal, wrench = further_keys(self.input_features or {})
        self.goal_key = self.goal_key or goal
        self.wrench_key = self.wrench_key or wrench

    def validate_features(self) -> None:
        """Check that the network can read these inputs and drive this robot.

        Raises:
            ValueError: An input or the action has a name or shape that the network has no use for,
                or a size is none that a network can have.
        """
        self.settings()
        action = self.action_feature
        if action is None or tuple(action.shape) != (N_JOINTS,):
            raise ValueError("`action` must hold 7 joint position targets.")

    def settings(self) -> Settings:
        """What of this decides which network there is.

        Raises:
            ValueError: There is no such network.
        """
        inputs = {key: {"shape": list(f.shape)} for key, f in (self.input_features or {}).items()}
        content = {
            **{name: getattr(self, name) for name in Settings.model_fields},
            "input_features": inputs,
        }
        try:
            return validated(Settings, content, "configuration", error=PolicyError)
        except PolicyError as error:
            raise ValueError(str(error)) from error

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
    def observation_delta_indices(self) -> list[int]:
        """The present observation and those before it."""
        return list(range(1 - self.window, 1))

    @property
    def action_delta_indices(self) -> list[int]:
        """The actions of the same frames."""
        return self.observation_delta_indices

    @property
    def reward_delta_indices(self) -> None:
        """No rewards."""
        return None
