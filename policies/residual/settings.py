"""Settings of fine-tuning; the defaults are those of the weights that are shipped."""

import dataclasses
import math

from hvs_suite.errors import OptionError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of TD3 on a residual that moves the believed goal.

    Exploration is correlated from step to step: a search goes somewhere, and noise that is drawn
    anew in each step stays where it is.

    Attributes:
        sideways_m: The most that the goal is moved in a step, each way along the surface (m).
        along_m: The same along the normal (m).
        reach_m: How far from the believed goal the tip may be for the goal to be moved (m).
        hidden: Width of the two layers of residual and critics.
        actor_rate: Learning rate of the residual.
        critic_rate: Learning rate of the critics.
        batch_size: Transitions an update.
        tau: Share of the critics that goes into their targets after an update.
        actor_tau: Share of the actor that goes into its average, which is what plays in the end.
        gamma: Discount; below 1 an early success is worth more.
        replay_size: Transitions kept.
        warm_up_steps: Decisions in which the critics learn alone.
        updates: Updates a decision, made while the next is played.
        noise: Standard deviation of what is added to the noise in a step, sideways, as a share of
            the largest step.
        noise_along: The same along the normal.
        noise_decay: Share of the noise that is lost in a step (theta of Ornstein and Uhlenbeck).
        target_noise: Standard deviation of the noise on the target's actions.
        penalty: Weight of the squared action against the normalised value.
        shaping: Weight of the potential, which is minus the logarithm of the error.
        step_cost: What a step outside the tolerances costs.
        environments: How many play, in processes of their own; a single one in the learner's.
    """

    sideways_m: float = 0.0008
    along_m: float = 0.001
    reach_m: float = 0.02
    hidden: int = 128
    actor_rate: float = 3e-4
    critic_rate: float = 3e-4
    batch_size: int = 256
    tau: float = 0.005
    actor_tau: float = 0.005
    gamma: float = 0.98
    replay_size: int = 100_000
    warm_up_steps: int = 3_000
    updates: int = 2
    noise: float = 0.25
    noise_along: float = 0.1
    noise_decay: float = 0.3
    target_noise: float = 0.1
    penalty: float = 0.05
    shaping: float = 0.05
    step_cost: float = 0.01
    environments: int = 2

    def __post_init__(self) -> None:
        """Refuse values that make no sense.

        Raises:
            OptionError: One of them does not.
        """
        for name in ("actor_rate", "critic_rate", "tau", "actor_tau", "gamma", "noise_decay"):
            value = getattr(self, name)
            if not (math.isfinite(value) and 0.0 < value <= 1.0):
                raise OptionError(f"{name} must be above 0 and at most 1, not {value}")
        for name in ("batch_size", "replay_size", "updates", "hidden", "environments"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} must be at least 1, not {getattr(self, name)}")
        for name in ("warm_up_steps", "noise", "noise_along", "target_noise", "penalty", "shaping",
                     "step_cost"):  # fmt: skip
            value = getattr(self, name)
            if not (math.isfinite(value) and value >= 0):
                raise OptionError(f"{name} must be 0 or more, not {value}")
        for name, most in (("sideways_m", 0.1), ("along_m", 0.1), ("reach_m", 10.0)):
            value = getattr(self, name)
            if not 0.0 < value <= most:
                raise OptionError(f"{name} must be above 0 and at most {most:g}, not {value}")
