"""The thesis's table of SAC settings, and where this suite's values must differ from it."""

import dataclasses
import math
from typing import Literal, get_args

from hvs_suite.errors import OptionError
from hvs_suite.tasks.shared.option_types import in_words

EyeKind = Literal["apart", "shared", "pretrained"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """Settings of soft actor-critic; the defaults are the thesis's wherever it states a value.

    It states none for `updates` and `hidden`. One update after every 20 environment steps is the
    default of its library, and two layers of 256 are those of that library's example.
    `random_steps` counts steps where the thesis counts episodes: 500 of at most 20 steps.
    `replay_size` is the smaller of its two: SB3 keeps the images before and after every step, so
    that 10,000 steps at 112 px take 1.5 GB of memory, and 50,000 would take 7.5 GB.

    Adam trains actor, critics and temperature, and the target critics follow after every update,
    as in the thesis; the target entropy, which it does not state, is minus the number of joints.

    Attributes:
        learning_rate: Of actor, critics and temperature; one run of the thesis had 3e-5.
        batch_size: Transitions an update.
        tau: Share of the critics that goes into their targets after an update.
        gamma: Discount.
        replay_size: Transitions kept.
        random_steps: Environment steps with uniformly random actions before learning starts.
        collect_steps: Environment steps an iteration.
        updates: Updates after an iteration, once learning has started.
        hidden: Widths of the dense layers behind the joined sub-networks.
        eyes: ``apart``, a network for each image, as the thesis has it; ``shared``, both images
            through one network; ``pretrained``, the eyes of the weights shipped for the task, which
            are not trained further: what they say of the target goes through two dense layers, as
            a joint input does.
        shared_trunk: Let actor and critics share their sub-networks. As SB3 has it, only the
            actor's loss trains them then.
    """

    learning_rate: float = 3e-4
    batch_size: int = 256
    tau: float = 0.005
    gamma: float = 0.99
    replay_size: int = 10_000
    random_steps: int = 10_000
    collect_steps: int = 20
    updates: int = 1
    hidden: tuple[int, ...] = (256, 256)
    eyes: EyeKind = "apart"
    shared_trunk: bool = False

    def __post_init__(self) -> None:
        """Refuse values that make no sense.

        Raises:
            OptionError: One of them does not.
        """
        for name in ("learning_rate", "tau", "gamma"):
            value = getattr(self, name)
            if not (math.isfinite(value) and 0.0 < value <= 1.0):
                raise OptionError(f"{name} must be above 0 and at most 1, not {value}")
        for name in ("batch_size", "replay_size", "collect_steps", "updates"):
            if getattr(self, name) < 1:
                raise OptionError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.eyes not in get_args(EyeKind):
            raise OptionError(f"eyes must be {in_words(EyeKind)}, not {self.eyes!r}")
        if self.random_steps < 0:
            raise OptionError(f"random_steps must be 0 or more, not {self.random_steps}")
        if not self.hidden or min(self.hidden) < 1:
            raise OptionError(f"hidden must name one or more layer widths, not {self.hidden}")
