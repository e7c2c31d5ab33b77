"""Settings of policy search on the way; the defaults are those of docs/experiments/the-way.md."""

import dataclasses
import math

from hvs_suite.errors import OptionError


@dataclasses.dataclass(frozen=True, kw_only=True)
class WaySettings:
    """Settings of policy search on the way to the goal.

    Attributes:
        population: Candidates a generation.
        scenes: Scenes that each of them plays, new ones in each generation.
        spread: Standard deviation of the first candidates, as a share of the largest shift.
        penalty: What the sum of squared weights costs (control steps).
        patience_steps: What a scene costs in which the tip does not arrive at a lone goal (control
            steps). It ends there, so that the few such scenes do not hide all others.
        reach_m: From which distance to the believed goal the way is learned (m).
    """

    population: int = 12
    scenes: int = 60
    spread: float = 0.25
    penalty: float = 0.005
    patience_steps: int = 30
    reach_m: float = 0.02

    def __post_init__(self) -> None:
        """Refuse values that make no sense.

        Raises:
            OptionError: One of them does not.
        """
        for name, least in (("population", 4), ("scenes", 1), ("patience_steps", 1)):
            if getattr(self, name) < least:
                raise OptionError(f"{name} must be at least {least}, not {getattr(self, name)}")
        if not 0.0 < self.spread <= 1.0:
            raise OptionError(f"spread must be above 0 and at most 1, not {self.spread}")
        if not (math.isfinite(self.penalty) and self.penalty >= 0.0):
            raise OptionError(f"penalty must be 0 or more, not {self.penalty}")
        if not 0.0 < self.reach_m < 1.0:
            raise OptionError(f"reach_m must be above 0 and below 1, not {self.reach_m}")
