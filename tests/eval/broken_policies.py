"""Policies that misbehave, for the tests; named on the command line as broken_policies:<name>."""

import gc
import os
import sys
import time
from collections.abc import Callable, Iterator
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


class MuteError(Exception):
    """An error which cannot even say what is wrong."""

    def __str__(self) -> str:
        raise RuntimeError("no words")


def mute(context: PolicyContext) -> Holds:
    def fail() -> None:
        raise MuteError

    return Holds(fail)


class Trap:
    """An array of its own making."""

    def __array__(self, *args: Any, **options: Any) -> Any:
        raise MuteError


def trap(context: PolicyContext) -> Holds:
    return Holds(Trap)


def leaves(context: PolicyContext) -> Holds:
    return Holds(lambda: sys.exit(0))


def interrupts(context: PolicyContext) -> Holds:
    def interrupt() -> None:
        raise KeyboardInterrupt

    return Holds(interrupt)


def ends(context: PolicyContext) -> Holds:
    return Holds(lambda: os._exit(0))


def shouts(context: PolicyContext) -> Holds:
    """Prints, which is no output of the evaluation's."""
    return Holds(lambda: [print("here I am"), [0.0] * 7][1])


def hangs(context: PolicyContext) -> Holds:
    # As stubborn as they come: it catches whatever it can.
    def wait() -> None:
        while True:
            try:
                time.sleep(60.0)
            except Exception:
                continue

    return Holds(wait)


def lingers(context: PolicyContext) -> Holds:
    """Says that it is at it, and hangs."""
    hang = hangs(context)._act
    return Holds(lambda: [print("at it"), hang()])


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


def _truth() -> Iterator[str]:
    """Whatever tells more than the observations: all that Python shows to anybody who looks."""
    simulator = ("mujoco", "dm_control", "hvs_suite.tasks.shared.environment")
    scenes = "hvs_suite.tasks.shared.scenario"
    yield from (name for name in sys.modules if name.startswith(simulator))
    for thing in gc.get_objects():
        kind = type(thing)
        modules = {str(getattr(base, "__module__", "")) for base in type.mro(kind)}
        if any(module.startswith((*simulator, scenes)) for module in modules):
            yield f"a {kind.__module__}.{kind.__qualname__}"
        if kind is dict and type(thing.get("scenario")) is int:
            yield "a scenario's index"
    frame = sys._getframe()
    while frame is not None:
        yield from (f"{name} in a frame" for name in ("env", "scenario") if name in frame.f_locals)
        frame = frame.f_back


def spies(context: PolicyContext) -> Holds:
    """Fails if it finds anything of the simulator in its process."""

    def look() -> Any:
        assert not (found := sorted(set(_truth()))), found
        return np.zeros(7)

    return Holds(look)


def nothing(context: PolicyContext) -> object:
    return object()


def no_arguments() -> Holds:
    return Holds(lambda: None)


def wordless(context: PolicyContext) -> Holds:
    raise MuteError


def exits(context: PolicyContext) -> Holds:
    sys.exit(0)
