"""Guided exploration: a policy that plays some of the episodes that another one learns from.

Whose an episode is depends on the run's seed and the scene alone, and a guide acts from the first
step of its episodes to the last, so that one with a memory remembers only what it did itself. All
that it takes to play an episode again are the scene and the actions that the learner proposed.
"""

import dataclasses
from typing import Any

import gymnasium
import numpy as np
import numpy.typing as npt
from stable_baselines3.common.buffers import DictReplayBuffer

from hvs_suite.errors import OptionError
from hvs_suite.rollout import Policy, PolicyFactory

SHARE = 0.2
"""Probability that an episode is the guide's, by default."""
GUIDED = "guided"
"""Of ``info``: whether the episode is the guide's."""
PLAYED = "played"
"""Of ``info`` in such an episode: the action that was played instead of the proposed one."""


@dataclasses.dataclass(frozen=True)
class Guide:
    """Who guides, and how often.

    Attributes:
        name: What the run is noted with.
        make: Builds the policy for an environment; it may know what is true.
        share: Probability that an episode is the guide's.

    Raises:
        OptionError: The share is no probability above 0.
    """

    name: str
    make: PolicyFactory
    share: float = SHARE

    def __post_init__(self) -> None:
        """Check the share."""
        if not 0.0 < self.share <= 1.0:
            raise OptionError(f"guide_share must be above 0 and at most 1, not {self.share}")


class Guided(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Plays the guide's actions, not the proposed ones, in some episodes.

    ``info`` says whether it does (`GUIDED`), and what was played then (`PLAYED`).

    Args:
        env: A task of the suite; takes ``options={"scenario": i}`` in ``reset``.
        guide: Who guides, and how often.
        seed: Of the run.

    Raises:
        HvsError: The guide cannot play the task.
    """

    def __init__(self, env: gymnasium.Env[Any, Any], guide: Guide, seed: int) -> None:
        super().__init__(env)
        self._guide: Policy = guide.make(env.unwrapped.environment)  # type: ignore[attr-defined]
        self._share = guide.share
        self._seed = seed
        self._guided = False
        self._seen: Any = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode, and find out whose it is."""
        self._seen, info = self.env.reset(seed=seed, options=options)
        random = np.random.default_rng([self._seed, info["scenario"]])
        self._guided = bool(random.random() < self._share)
        if self._guided:
            self._guide.reset()
        return self._seen, {**info, GUIDED: self._guided}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Play one control step."""
        told: dict[str, Any] = {GUIDED: self._guided}
        if self._guided:
            action = told[PLAYED] = np.asarray(self._guide.select_action(self._seen), np.float32)
        self._seen, reward, terminated, truncated, info = self.env.step(action)
        return self._seen, reward, terminated, truncated, {**info, **told}


class PlayedActions(DictReplayBuffer):
    """SB3's replay memory, with the actions that were played where the guide chose them."""

    def add(  # type: ignore[override]
        self,
        obs: dict[str, npt.NDArray[Any]],
        next_obs: dict[str, npt.NDArray[Any]],
        action: npt.NDArray[Any],
        reward: npt.NDArray[Any],
        done: npt.NDArray[Any],
        infos: list[dict[str, Any]],
    ) -> None:
        """Remember a transition of each environment."""
        played = [info.get(PLAYED, own) for info, own in zip(infos, action, strict=True)]
        super().add(obs, next_obs, np.stack(played), reward, done, infos)
