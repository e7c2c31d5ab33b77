"""Policies that misbehave, for the tests; named on the command line as broken_policies:<name>."""

import time
from collections.abc import Callable
from typing import Any

import numpy as np

from hvs_suite.policies.context import PolicyContext


class Holds:
    """Holds still, until its turn comes to do something else."""

    def __init__(self, act: Callable[[], Any], at: int = 2) -> None:
        self._act, self._at = act, at

    def reset(self) -> None:
        self._step = 0

    def select_action(self, observation: Any) -> Any:
        self._step += 1
        return self._act() if self._step == self._at else np.zeros(7, np.float32)


def still(context: PolicyContext) -> Holds:
    return Holds(lambda: None, at=0)


def nan(context: PolicyContext) -> Holds:
    return Holds(lambda: np.full(7, np.nan))


def shape(context: PolicyContext) -> Holds:
    return Holds(lambda: np.zeros((1, 7)))


def text(context: PolicyContext) -> Holds:
    return Holds(lambda: "up")


def raises(context: PolicyContext) -> Holds:
    return Holds(lambda: [][1])


def hangs(context: PolicyContext) -> Holds:
    # As stubborn as they come: it catches whatever it can.
    def wait() -> None:
        while True:
            try:
                time.sleep(60.0)
            except Exception:
                continue

    return Holds(wait)


def dives(context: PolicyContext) -> Holds:
    """Leans over until it hits the ground."""
    policy = still(context)
    policy.select_action = lambda observation: np.array([0.0, 0.98, 0.0, 0.0, 0.0, 0.0, 0.0])
    return policy


def draws(context: PolicyContext) -> Holds:
    """Draws from the global generator, as other people's policies do."""
    policy = still(context)
    policy.select_action = lambda observation: np.random.uniform(-1, 1, 7)  # noqa: NPY002
    return policy


def curious(context: PolicyContext) -> Holds:
    """Fails if it is shown anything but the task's preset."""
    assert set(context.observations) == {"eih", "eth", "joint_positions", "joint_velocities"}
    assert not any(hasattr(context, name) for name in ("privileged", "scenario", "task", "info"))
    policy = still(context)

    def select_action(observation: Any) -> Any:
        assert set(observation) == set(context.observations)
        return np.zeros(context.action.shape)

    policy.select_action = select_action
    return policy


def nothing(context: PolicyContext) -> object:
    return object()
