"""Settings of fine-tuning, and what they were chosen for."""

import dataclasses
import math

from hvs_suite.errors import OptionError
from hvs_suite.policies.network.network import RESIDUAL_BOUND


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of TD3 on a residual inside the network's logarithmic scale.

    Exploration is a share of the bound, so that it shrinks with the distance to the goal: noise of
    fixed size in the joints destroyed the precision that imitation had reached.

    Attributes:
        actor_rate: Learning rate of the residual.
        critic_rate: Learning rate of the critics.
        batch_size: Transitions an update.
        tau: Share of the critics that goes into their targets after an update.
        actor_tau: Share of the actor that goes into its target, which is what plays in the end.
        gamma: Discount; below 1 it also pays for haste.
        replay_size: Transitions kept.
        warm_up_steps: Environment steps in which the critics learn alone.
        collect_steps: Environment steps an iteration.
        updates: Updates an iteration, made while its steps are played; four times as many while
            the critics learn alone.
        noise: Standard deviation of the exploration, as a share of the bound.
        target_noise: Standard deviation of the noise on the target's actions, likewise.
        bound: The most that the residual adds to the head's output.
        penalty: Weight of the squared residual against the normalised value.
        critics: How many.
        hidden: Width of the dense layers of residual and critics.
        shaping: Weight of the potential, which is minus the logarithm of the error; 0 leaves the
            sparse reward alone.
        eye_rounds: How often, before, to let the policy play and train its eyes on what it saw.
        eye_frames: Frames a round.
        eye_steps: Optimiser steps a round.
        eye_rate: Learning rate of the eyes.
        lost_share: Share of the episodes that play scenes again that were lost, once there are any.
        environments: Worker processes that play.
    """

    actor_rate: float = 1e-4
    critic_rate: float = 3e-4
    batch_size: int = 256
    tau: float = 0.02
    actor_tau: float = 0.005
    gamma: float = 0.97
    replay_size: int = 200_000
    warm_up_steps: int = 2_000
    collect_steps: int = 40
    updates: int = 20
    noise: float = 0.2
    target_noise: float = 0.1
    bound: float = RESIDUAL_BOUND
    penalty: float = 0.1
    critics: int = 4
    hidden: int = 128
    shaping: float = 0.01
    eye_rounds: int = 2
    eye_frames: int = 6_000
    eye_steps: int = 1_000
    eye_rate: float = 5e-4
    lost_share: float = 0.0
    environments: int = 2

    def __post_init__(self) -> None:
        """Refuse values that make no sense.

        Raises:
            OptionError: One of them does not.
        """
        for name in ("actor_rate", "critic_rate", "eye_rate", "tau", "actor_tau", "gamma"):
            value = getattr(self, name)
            if not (math.isfinite(value) and 0.0 < value <= 1.0):
                raise OptionError(f"{name} must be above 0 and at most 1, not {value}")
        counts = ("batch_size", "replay_size", "collect_steps", "updates", "hidden")
        for name in (*counts, "environments", "eye_frames", "eye_steps"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.critics < 2:
            raise OptionError(f"critics must be at least 2, not {self.critics}")
        for name in ("warm_up_steps", "eye_rounds", "noise", "target_noise", "penalty", "shaping"):
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise OptionError(f"{name} must be 0 or more, not {value}")
        if not 0.0 <= self.lost_share < 1.0:
            raise OptionError(
                f"lost_share must be at least 0 and less than 1, not {self.lost_share}"
            )
        if not (math.isfinite(self.bound) and self.bound > 0):
            raise OptionError(f"bound must be above 0, not {self.bound}")
        if self.collect_steps % self.environments:
            raise OptionError(
                f"collect_steps must be a multiple of the {self.environments} environments, not "
                f"{self.collect_steps}"
            )
