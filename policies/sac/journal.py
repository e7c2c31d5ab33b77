"""The environment that SAC learns in, which can be put back into the middle of an episode.

A scene is a function of its index, and physics of scene and actions: the number of the episode and
the actions since its reset are all there is to keep.
"""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from stable_baselines3.common.monitor import Monitor

from hvs_suite.tasks.variants import AlignVariant

SCENES_A_SEED = 10**9
"""Runs with different seeds learn from different scenes."""
OUTCOMES = (
    "is_success",
    "collision",
    "position_error_mm",
    "lateral_error_mm",
    "height_error_mm",
    "tilt_error_deg",
)
"""What SB3's monitor keeps of the end of an episode, besides return ``r`` and length ``l``."""


class Journal(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Plays one scene of a split after the other, and remembers how it got where it is.

    Attributes:
        episode: Number of the episode that is being played.
        actions: Those given since its reset, (7,) each.

    Args:
        env: Takes ``options={"scenario": i}`` in ``reset``.
        seed: Of the run; below 2^32.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], seed: int) -> None:
        super().__init__(env)
        self._first = seed * SCENES_A_SEED
        self.episode = 0
        self.actions: list[npt.NDArray[np.float32]] = []

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Goes to where the journal ends: the next scene, or the middle of one just restored.

        Args:
            seed: Not used; the scenes are the run's own.
            options: Not used.
        """
        scene = {"scenario": self._first + self.episode}
        observation, info = self.env.reset(options=scene)
        for action in self.actions:
            observation, _, _, _, info = self.env.step(action)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Plays one control step and notes it down."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self.actions.append(np.array(action, np.float32))
        if terminated or truncated:
            self.episode += 1
            self.actions = []
        return observation, reward, terminated, truncated, info


def make_journal(
    variant: AlignVariant, options: Mapping[str, Any], split: str, seed: int
) -> Journal:
    """Makes the Gymnasium environment of a named task, monitored and with a journal.

    Args:
        variant: The named task.
        options: Task options that differ from it.
        split: Stream of scenes.
        seed: Of the run.
    """
    env = gymnasium.make(
        f"hvs_suite/{variant.name}-v{variant.version}",
        disable_env_checker=True,
        split=split,
        **options,
    )
    # The monitor inside: it sees the steps that a restored journal plays again.
    return Journal(Monitor(env, info_keywords=OUTCOMES), seed)
