"""``servo``: classical hybrid visual servoing, as a practitioner would write it; no learning.

One file a kind of task; `make_servo` is the one place that knows which family takes which.
"""

from typing import Any, Protocol

from hvs_suite.errors import PolicyError
from hvs_suite.rollout import Policy
from hvs_suite.tasks.shared.spec import Spec


class Playground(Protocol):
    """What the policy takes of an environment: the task's parameters, nothing else."""

    @property
    def spec(self) -> Spec:
        """The task's parameters."""


def make_servo(env: Playground) -> Policy:
    """The policy for an environment, of which it takes the parameters alone.

    Raises:
        PolicyError: The task needs what this method does not do.
    """
    from hvs_suite.policies.servo.among_others import AmongOthersServo
    from hvs_suite.policies.servo.changing_target import ChangingTargetServo
    from hvs_suite.policies.servo.moving_target import MovingTargetServo
    from hvs_suite.policies.servo.sloped_target import SlopedTargetServo
    from hvs_suite.policies.servo.still_target import StillTargetServo

    servos: dict[str, type[Any]] = {
        "align": StillTargetServo,
        "sequence": ChangingTargetServo,
        "track": MovingTargetServo,
        "clutter": AmongOthersServo,
        "surface": SlopedTargetServo,
    }
    spec = env.spec
    if spec.family not in servos:
        raise PolicyError(f"servo does not know tasks of family {spec.family}")
    servo: Policy = servos[spec.family](spec)
    return servo
