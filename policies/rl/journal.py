"""The environment that RL learns in, which can be put back into the middle of an episode.

A scene is a function of its index, and physics of scene and actions: which scene it is and the
actions since its reset are all there is to keep.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from stable_baselines3.common.monitor import Monitor

from hvs_suite.policies.rl.guide import GUIDED, Guide, Guided
from hvs_suite.tasks.shared.spec import Spec

SCENES_A_SEED = 10**9
"""Runs with different seeds learn from different scenes."""
OUTCOMES = ("is_success", "collision", "errors")
"""What SB3's monitor keeps of the end of an episode, besides return ``r`` and length ``l``."""


class Journal(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Plays one scene of a split after the other, and remembers how it got where it is.

    Args:
        env: Takes ``options={"scenario": i}`` in ``reset``.
        seed: Of the run; below 2^32.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], seed: int) -> None:
        super().__init__(env)
        self._first = seed * SCENES_A_SEED
        self._episode = 0
        self._actions: list[npt.NDArray[np.float32]] = []

    def state_dict(self) -> dict[str, Any]:
        """Where it is, as JSON has it: which scene, and the actions since its reset."""
        return {"episode": self._episode, "actions": [a.tolist() for a in self._actions]}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Let the next reset lead to where `state_dict` said that it was.

        Args:
            state: As `state_dict` gave it.
        """
        self._episode = int(state["episode"])
        self._actions = [np.array(action, np.float32) for action in state["actions"]]

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Goes to where the journal ends: the scene that is due, or its middle if just restored.

        Args:
            seed: Not used; the scenes are the run's own.
            options: Not used.
        """
        observation, info = self.env.reset(options={"scenario": self._first + self._episode})
        for action in self._actions:
            observation, _, _, _, info = self.env.step(action)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Plays one control step and notes it down."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._actions.append(np.array(action, np.float32))
        if terminated or truncated:
            self._episode += 1
            self._actions = []
        return observation, reward, terminated, truncated, info


def make_journal(
    spec: Spec, options: Mapping[str, Any], split: str, seed: int, guide: Guide | None = None
) -> Journal:
    """Makes the Gymnasium environment of a named task, monitored and with a journal.

    Args:
        spec: The named task.
        options: Task options that differ from it.
        split: Stream of scenes.
        seed: Of the run.
        guide: Plays some of the episodes; None for none.
    """
    env: gymnasium.Env[Any, Any] = gymnasium.make(
        f"hvs_suite/{spec.name}-v{spec.version}",
        disable_env_checker=True,
        split=split,
        **options,
    )
    outcomes: tuple[str, ...] = OUTCOMES
    if guide is not None:
        env = Guided(env, guide, seed)
        outcomes = (*OUTCOMES, GUIDED)
    # The monitor inside: it sees the steps that a restored journal plays again.
    return Journal(Monitor(env, info_keywords=outcomes), seed)
