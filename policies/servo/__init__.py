"""``servo``: classical hybrid visual servoing, as a practitioner would write it; no learning.

One file a kind of task; `make_servo` and `make_push` are the one place that knows which family
takes which.
"""

from collections.abc import Mapping
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
    from hvs_suite.policies.servo.insertion import InsertionServo
    from hvs_suite.policies.servo.moving_target import MovingTargetServo
    from hvs_suite.policies.servo.sloped_target import SlopedTargetServo
    from hvs_suite.policies.servo.still_target import StillTargetServo

    servos: dict[str, type[Any]] = {
        "align": StillTargetServo,
        "sequence": ChangingTargetServo,
        "track": MovingTargetServo,
        "clutter": AmongOthersServo,
        "surface": SlopedTargetServo,
        "insert": InsertionServo,
    }
    return _made("servo", servos, env)


def make_push(env: Playground) -> Policy:
    """``push``: as ``servo``, but straight down where it sees the hole, by vision alone.

    Raises:
        PolicyError: There is nothing to insert.
    """
    from hvs_suite.policies.servo.insertion import PushServo

    return _made("push", {"insert": PushServo}, env)


def _made(name: str, servos: Mapping[str, type[Any]], env: Playground) -> Policy:
    spec = env.spec
    if spec.family not in servos:
        raise PolicyError(f"{name} does not know tasks of family {spec.family}")
    servo: Policy = servos[spec.family](spec)
    return servo
