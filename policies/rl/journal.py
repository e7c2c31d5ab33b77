"""The environment that RL learns in, which can be put back into the middle of an episode.

A scene is a function of its index, and physics of scene and actions: which scene it is and the
actions since its reset are all there is to keep.

Who is good already loses one scene in thirty, and learns from little else. So scenes that were lost
may come again, in turn, between those that are new; a plain form of prioritised level replay (Jiang
and others, 2021: https://arxiv.org/abs/2010.03934).
"""

from collections.abc import Mapping
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from stable_baselines3.common.monitor import Monitor

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
        part: Which of the run's environments this is.
        parts: How many the run has; they share its scenes between them.
        lost_share: Share of the episodes, from the first lost one on, that play lost scenes again.
    """

    def __init__(
        self,
        env: gymnasium.Env[Any, Any],
        seed: int,
        part: int = 0,
        parts: int = 1,
        lost_share: float = 0.0,
    ) -> None:
        super().__init__(env)
        self._first = seed * SCENES_A_SEED + part
        self._parts = parts
        self._lost_share = lost_share
        self._episode = 0
        self._again = 0
        self._lost: list[int] = []
        self._actions: list[npt.NDArray[np.float32]] = []
        self._curriculum: dict[str, Any] | None = None

    def state_dict(self) -> dict[str, Any]:
        """Where it is, as JSON has it: what decides on the scene, and the actions since its reset.

        Of a `Curriculum` inside, also its state at that reset.
        """
        state = {
            "episode": self._episode,
            "again": self._again,
            "lost": list(self._lost),
            "actions": [a.tolist() for a in self._actions],
        }
        return state if self._curriculum is None else {**state, "curriculum": self._curriculum}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Let the next reset lead to where `state_dict` said that it was.

        Args:
            state: As `state_dict` gave it.
        """
        self._episode, self._again = int(state["episode"]), int(state["again"])
        self._lost = [int(scene) for scene in state["lost"]]
        self._actions = [np.array(action, np.float32) for action in state["actions"]]
        if "curriculum" in state:
            self.env.get_wrapper_attr("load_state_dict")(state["curriculum"])

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Goes to where the journal ends: the scene that is due, or its middle if just restored.

        Args:
            seed: Not used; the scenes are the run's own.
            options: Not used.
        """
        observation, info = self.env.reset(options={"scenario": self._scene()})
        if self.env.has_wrapper_attr("state_dict"):
            self._curriculum = self.env.get_wrapper_attr("state_dict")()
        for action in self._actions:
            observation, _, _, _, info = self.env.step(action)
        return observation, info

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Plays one control step and notes it down."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        self._actions.append(np.array(action, np.float32))
        if terminated or truncated:
            self._end(bool(info["is_success"]))
        return observation, reward, terminated, truncated, info

    def _is_again(self) -> bool:
        """Whether the scene that is due is one that was lost before."""
        if not self._lost:
            return False
        new = self._episode - (self._lost[0] - self._first) // self._parts
        return self._again * (1.0 - self._lost_share) < self._lost_share * new

    def _scene(self) -> int:
        if self._is_again():
            return self._lost[self._again % len(self._lost)]
        return self._first + self._parts * self._episode

    def _end(self, success: bool) -> None:
        """Note how the episode ended; from here on the next is due."""
        if self._is_again():
            self._again += 1
        else:
            if not success:
                self._lost.append(self._scene())
            self._episode += 1
        self._actions = []


def make_journal(spec: Spec, options: Mapping[str, Any], split: str, seed: int) -> Journal:
    """Makes the Gymnasium environment of a named task, monitored and with a journal.

    Args:
        spec: The named task.
        options: Task options that differ from it.
        split: Stream of scenes.
        seed: Of the run.
    """
    env = gymnasium.make(
        f"hvs_suite/{spec.name}-v{spec.version}",
        disable_env_checker=True,
        split=split,
        **options,
    )
    # The monitor inside: it sees the steps that a restored journal plays again.
    return Journal(Monitor(env, info_keywords=OUTCOMES), seed)
