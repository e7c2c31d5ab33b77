"""How long a training run goes on."""

import dataclasses
import math

from hvs_suite.errors import OptionError


@dataclasses.dataclass(frozen=True)
class Budget:
    """How long to train: steps, minutes, or whichever is reached first.

    Attributes:
        steps: Of the optimiser, or in RL of the environment.
        minutes: Of what the run counts as training.

    Raises:
        OptionError: Neither is given, or one makes no sense.
    """

    steps: int | None
    minutes: float | None

    def __post_init__(self) -> None:
        """Refuse what is no budget."""
        if self.minutes is None and self.steps is None:
            raise OptionError("say how long to train: give minutes or steps")
        for name, value in (("minutes", self.minutes), ("steps", self.steps)):
            if value is not None and not (value > 0 and math.isfinite(value)):
                raise OptionError(f"{name} must be above 0, not {value}")

    def share(self, steps: int, elapsed_s: float) -> float:
        """Part that is used up, 1 at the end."""
        shares = [0.0]
        if self.steps is not None:
            shares.append(steps / self.steps)
        if self.minutes is not None:
            shares.append(elapsed_s / (60.0 * self.minutes))
        return max(shares)
