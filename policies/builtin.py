"""Policies that need no learning: the lower bound for all others."""

import hashlib
from typing import Any, Protocol

import numpy as np
import numpy.typing as npt

from hvs_suite.rollout import Observation

Action = npt.NDArray[np.float32]


class Playground(Protocol):
    """What these policies need of an environment."""

    @property
    def info(self) -> dict[str, Any]:
        """``split`` and ``scenario`` of the present episode, among others."""

    def action_spec(self) -> Any:
        """Shape and bounds of an action."""


class ZeroPolicy:
    """Always the zero action: with joint positions, hold (or move to) the upright arm.

    Args:
        env: Where it acts.
    """

    def __init__(self, env: Playground) -> None:
        self._action = np.zeros(env.action_spec().shape, np.float32)

    def reset(self) -> None:
        """Nothing to forget."""

    def select_action(self, observation: Observation) -> Action:
        """Zeros, (7,) float32."""
        return self._action.copy()


class RandomPolicy:
    """Uniform actions in [-1, 1], a function of the scenario alone.

    Args:
        env: Where it acts.
    """

    def __init__(self, env: Playground) -> None:
        self._env = env
        self._shape = env.action_spec().shape
        self._stream: np.random.Generator | None = None

    def reset(self) -> None:
        """Start the stream of the environment's present scenario."""
        info = self._env.info
        digest = hashlib.sha256(f"random policy {info['split']}".encode()).digest()
        key = np.frombuffer(digest[:16], np.uint64)
        # The scenario goes into the counter's high word, so that streams never overlap.
        counter = np.array([0, 0, 0, info["scenario"]], np.uint64)
        self._stream = np.random.Generator(np.random.Philox(key=key, counter=counter))

    def select_action(self, observation: Observation) -> Action:
        """Uniform in [-1, 1], (7,) float32."""
        if self._stream is None:
            self.reset()
        assert self._stream is not None
        return self._stream.uniform(-1.0, 1.0, self._shape).astype(np.float32)


def make_zero(env: Playground) -> ZeroPolicy:
    """A `ZeroPolicy`."""
    return ZeroPolicy(env)


def make_random(env: Playground) -> RandomPolicy:
    """A `RandomPolicy`."""
    return RandomPolicy(env)
