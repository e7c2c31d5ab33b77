"""What other people's policies may know of a task: its name, spaces and nominal figures.

The expert, which reads the true state, and random, which starts its stream from the scenario, get
the environment itself. All other policies get a `PolicyContext`: what the task's preset shows, and
nothing that only training may see.
"""

import dataclasses
from typing import Any, Self

from hvs_suite.registry import announced
from hvs_suite.rollout import Policy, PolicyFactory
from hvs_suite.tasks.shared.spec import Spec


@dataclasses.dataclass(frozen=True)
class PolicyContext:
    """The public side of a task.

    Attributes:
        spec: Parameters of the task as they were announced; camera poses are nominal.
        observations: Shape, type and bounds of each observation, by name.
        action: Shape and bounds of an action.
        period_s: Control period (s).
    """

    spec: Spec
    observations: dict[str, Any]
    action: Any
    period_s: float

    @classmethod
    def of(cls, env: Any) -> Self:
        """Returns what may be known of an environment."""
        return cls(
            spec=announced(env.spec),
            observations=dict(env.observation_spec()),
            action=env.action_spec(),
            period_s=env.spec.control_period_s,
        )

    def observation_spec(self) -> dict[str, Any]:
        """Shape, type and bounds of each observation, by the environment's own name for it."""
        return self.observations

    def action_spec(self) -> Any:
        """Shape and bounds of an action, by the environment's own name for it."""
        return self.action


@dataclasses.dataclass(frozen=True)
class Blindfolded:
    """Builds a policy that knows nothing but a `PolicyContext`.

    Attributes:
        make: Builds the policy for a context.
    """

    make: PolicyFactory

    def __call__(self, env: Any) -> Policy:
        """Builds the policy for an environment to which it has no access."""
        return self.make(PolicyContext.of(env))
