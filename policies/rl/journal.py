"""The environment that RL learns in, which can be put back into the middle of an episode.

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

    Args:
        env: Takes ``options={"scenario": i}`` in ``reset``.
        seed: Of the run; below 2^32.
        part: Which of the run's environments this is.
        parts: How many the run has; they share its scenes between them.
    """

    def __init__(
        self, env: gymnasium.Env[Any, Any], seed: int, part: int = 0, parts: int = 1
    ) -> None:
        super().__init__(env)
        self._first = seed * SCENES_A_SEED + part
        self._parts = parts
        self._episode = 0
        self._actions: list[npt.NDArray[np.float32]] = []
        self._standing: dict[str, Any] | None = None

    def place(self) -> dict[str, Any]:
        """Where it is, as JSON has it: the episode's number, and the actions since its reset.

        Of a `Curriculum` inside, also its standing at that reset.
        """
        place = {"episode": self._episode, "actions": [a.tolist() for a in self._actions]}
        return place if self._standing is None else {**place, "curriculum": self._standing}

    def go_to(self, place: Mapping[str, Any]) -> None:
        """Let the next reset lead to where `place` said that it was.

        Args:
            place: As `place` gave it.
        """
        self._episode = int(place["episode"])
        self._actions = [np.array(action, np.float32) for action in place["actions"]]
        if "curriculum" in place:
            self.get_wrapper_attr("restore")(place["curriculum"])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Goes to where the journal ends: the next scene, or the middle of one just restored.

        Args:
            seed: Not used; the scenes are the run's own.
            options: Not used.
        """
        scene = {"scenario": self._first + self._parts * self._episode}
        observation, info = self.env.reset(options=scene)
        if self.has_wrapper_attr("standing"):
            self._standing = self.get_wrapper_attr("standing")()
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
