"""How an RL run is doing, what it came to, and what none can be made with."""

import dataclasses
import math

from hvs_suite.errors import OptionError
from hvs_suite.policies.rl.evaluation import Evaluation
from hvs_suite.tasks.shared.scenario import TEST_SPLIT


@dataclasses.dataclass(frozen=True)
class Progress:
    """How a run is doing.

    Attributes:
        stage: ``training``, ``evaluating``, or what comes before them.
        share: Part of the stage that is done, 0 to 1.
        env_steps: Environment steps over all sittings.
        updates: Updates over all sittings.
        env_steps_per_s: Rate of late, evaluations not counted; 0 before anything was played.
        seconds_left: Of the budget, at the rate of late, evaluations not counted (s); NaN before
            anything was played.
        episode_return: Mean of the last hundred episodes; NaN before the first has ended.
        evaluation: The last one; None before.
    """

    stage: str
    share: float
    env_steps: int
    updates: int
    env_steps_per_s: float
    seconds_left: float
    episode_return: float
    evaluation: Evaluation | None

    def in_words(self) -> str:
        """Steps, rate, time left and standing as one line; empty before anything was played."""
        if not self.env_steps and self.evaluation is None:
            return ""
        parts = [f"step {self.env_steps}", f"{self.updates} updates"]
        if self.stage == "training":
            parts.append(f"{self.env_steps_per_s:.1f} steps/s")
        if self.stage == "training" and not math.isnan(self.seconds_left):
            parts.append(f"{self.seconds_left:.0f} s left")
        if not math.isnan(self.episode_return):
            parts.append(f"return {self.episode_return:.2f}")
        if self.evaluation is not None:
            parts.append(f"success {100 * self.evaluation.success_rate:.0f} %")
        return ", ".join(parts)


@dataclasses.dataclass(frozen=True)
class Outcome:
    """What a run came to; also in ``training/outcome.json``.

    Attributes:
        step: Updates, over all sittings.
        env_steps: Environment steps, over all sittings.
        updates_per_env_step: Their ratio.
        episodes: Episodes ended.
        train_s: Time spent playing and learning over all sittings, evaluations not counted (s).
        env_steps_per_s: Rate over all sittings.
        n_parameters: Trainable numbers of the actor.
        evaluation: The last one.
        has_fallen: The run was ended because success fell; what plays is from before.
    """

    step: int
    env_steps: int
    updates_per_env_step: float
    episodes: int
    train_s: float
    env_steps_per_s: float
    n_parameters: int
    evaluation: Evaluation | None
    has_fallen: bool

    def in_words(self) -> str:
        """What was done, and how it ended, a line each."""
        lines = [
            f"{self.env_steps} environment steps in {self.train_s:.0f} s, "
            f"{self.env_steps_per_s:.1f} steps/s; {self.step} updates, "
            f"{self.updates_per_env_step:.3f} a step; {self.n_parameters:,} parameters"
        ]
        if self.has_fallen:
            lines.append("success fell, so the run was ended; what plays is from before")
        if self.evaluation is not None:
            lines.append(f"last evaluation: {self.evaluation.in_words()}")
        return "\n".join(lines)


def check_run(seed: int, split: str, eval_every: int, eval_episodes: int) -> None:
    """Refuse what no RL run can be made with.

    Args:
        seed: Of the run.
        split: Stream of scenes to learn from.
        eval_every: Environment steps between evaluations.
        eval_episodes: Scenes an evaluation.

    Raises:
        OptionError: A value makes no sense, or the split is the one that scores.
    """
    if not 0 <= seed < 2**32:
        raise OptionError(f"seed must be from 0 to 2^32 - 1, not {seed}")
    if split == TEST_SPLIT:
        raise OptionError(f"split {TEST_SPLIT!r} is for scoring; train on another, such as train")
    for name, count in (("eval_every", eval_every), ("eval_episodes", eval_episodes)):
        if count < 1:
            raise OptionError(f"{name} must be at least 1, not {count}")
