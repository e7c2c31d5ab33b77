"""What a policy that is not ours may know of a task: its name, its spaces, its nominal figures.

Built-in policies get the environment itself (the expert reads the true state). Everybody else gets
a `PolicyContext`: what the task's preset shows, and nothing that only training may see.
"""

import dataclasses
from typing import Any, Self

from hvs_suite.tasks.variants import AlignVariant


@dataclasses.dataclass(frozen=True)
class PolicyContext:
    """The public side of a task.

    Attributes:
        variant: Parameters of the task; camera poses are nominal.
        observations: Shape, type and bounds of each observation, by name.
        action: Shape and bounds of an action.
        period_s: Control period (s).
    """

    variant: AlignVariant
    observations: dict[str, Any]
    action: Any
    period_s: float

    @classmethod
    def of(cls, env: Any) -> Self:
        """Returns what may be known of an environment."""
        return cls(
            variant=env.variant,
            observations=dict(env.observation_spec()),
            action=env.action_spec(),
            period_s=env.variant.control_period_s,
        )

    def action_spec(self) -> Any:
        """Shape and bounds of an action, by the environment's own name for it."""
        return self.action
