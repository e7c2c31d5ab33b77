"""A curriculum for any training loop: tasks that grow harder as success rises (thesis, D.6).

    env = Curriculum("align-thesis", levels_of("align-thesis", "tolerance"), split="train")

Observations and actions are the same at every level, and so is the scene of an index, but for where
the arm starts.
"""

import dataclasses
from collections import deque
from collections.abc import Mapping, Sequence
from types import MappingProxyType
from typing import Any, Literal

import gymnasium

from hvs_suite.errors import OptionError
from hvs_suite.registry import find

Kind = Literal["tolerance", "start"]
Level = Mapping[str, Any]

TOLERANCE_FACTORS = (8.0, 4.0, 2.0, 1.0)
STARTS = ("near_goal", "mixed")
WINDOW = 50
"""Episodes that a level is judged by, at least."""
THRESHOLD = 0.8
"""Share of them to solve before the next level."""


def levels_of(
    task: str, kind: Kind, options: Mapping[str, Any] = MappingProxyType({})
) -> list[dict[str, Any]]:
    """Levels of a named task, easiest first; the last is the task itself.

    Args:
        task: Named task.
        kind: ``tolerance`` shrinks all tolerances from eightfold by halves; ``start`` begins near
            the goal, then half of the episodes there, then where the task begins.
        options: Options of the task that differ from the named one.

    Returns:
        Task options of each level.

    Raises:
        UnknownTaskError: There is no such task.
        OptionError: There is no such kind.
    """
    spec = find(task).with_options(options)
    if kind == "start":
        return [*({"start": start} for start in STARTS), {}]
    if kind != "tolerance":
        raise OptionError(f"unknown curriculum {kind!r}; use tolerance or start")
    bounds = {
        field.name: getattr(spec, field.name)
        for field in dataclasses.fields(spec)
        if "_tolerance_" in field.name and getattr(spec, field.name) is not None
    }
    return [{name: factor * b for name, b in bounds.items()} for factor in TOLERANCE_FACTORS]


class Ladder:
    """Which level is played: the next one once most of the last episodes succeeded.

    Args:
        n_levels: How many there are.
        threshold: Share of the last episodes to solve before the next level, up to 1.
        window: How many those are.

    Attributes:
        level: The level now, from 0.

    Raises:
        OptionError: There are no levels, or a number makes no sense.
    """

    def __init__(self, n_levels: int, threshold: float = THRESHOLD, window: int = WINDOW) -> None:
        if not n_levels:
            raise OptionError("a curriculum needs at least one level")
        if not 0.0 < threshold <= 1.0 or window < 1:
            raise OptionError(
                f"threshold must be above 0 and at most 1, window at least 1, not {threshold} and "
                f"{window}"
            )
        self.level = 0
        self._last = n_levels - 1
        self._threshold = threshold
        self._recent: deque[bool] = deque(maxlen=window)

    def note(self, success: bool) -> None:
        """Take in how an episode ended."""
        self._recent.append(success)

    def climb(self) -> bool:
        """Go to the next level if this one has been learnt and is not the last; whether it did."""
        learnt = len(self._recent) == self._recent.maxlen
        learnt = learnt and sum(self._recent) >= self._threshold * len(self._recent)
        if not learnt or self.level == self._last:
            return False
        self._recent.clear()
        self.level += 1
        return True

    def state_dict(self) -> dict[str, Any]:
        """Level and outcomes that decide on the next, as JSON has it."""
        return {"level": self.level, "recent": list(self._recent)}

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go to where `state_dict` said that it was.

        Args:
            state: As `state_dict` gave it.
        """
        self.level = int(state["level"])
        self._recent.clear()
        self._recent.extend(bool(outcome) for outcome in state["recent"])


class Curriculum(gymnasium.Wrapper[Any, Any, Any, Any]):
    """Plays a task at the first level until most episodes succeed there, then at the next.

    Success is that of the level, so an easier one may end an episode that the task would go on
    with. ``info["level"]`` counts from 0.

    Args:
        task: Named task.
        levels: Task options of each level, easiest first.
        threshold: Share of the last episodes to solve before the next level, up to 1.
        window: How many those are.
        **options: Of every level, and ``split`` as `hvs_suite.gym.TaskEnv` takes it.

    Raises:
        UnknownTaskError: There is no such task.
        OptionError: There are no levels, or a number makes no sense.
    """

    def __init__(
        self,
        task: str,
        levels: Sequence[Level],
        *,
        threshold: float = THRESHOLD,
        window: int = WINDOW,
        **options: Any,
    ) -> None:
        self._ladder = Ladder(len(levels), threshold, window)
        self._identifier = f"hvs_suite/{task}-v{find(task).version}"
        self._levels = [dict(level) for level in levels]
        self._options = options
        super().__init__(self._make())

    @property
    def level(self) -> int:
        """The level now, from 0."""
        return self._ladder.level

    def state_dict(self) -> dict[str, Any]:
        """Level and outcomes that decide on the next, as JSON has it."""
        return self._ladder.state_dict()

    def load_state_dict(self, state: Mapping[str, Any]) -> None:
        """Go to where `state_dict` said that it was.

        Args:
            state: As `state_dict` gave it.
        """
        self._ladder.load_state_dict(state)
        self._make_anew()

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[Any, dict[str, Any]]:
        """Start an episode, at the next level if this one has been learnt."""
        if self._ladder.climb():
            self._make_anew()
        observation, info = self.env.reset(seed=seed, options=options)
        return observation, {**info, "level": self.level}

    def step(self, action: Any) -> tuple[Any, Any, bool, bool, dict[str, Any]]:
        """Play one control step."""
        observation, reward, terminated, truncated, info = self.env.step(action)
        if terminated or truncated:
            self._ladder.note(bool(info["is_success"]))
        return observation, reward, terminated, truncated, {**info, "level": self.level}

    def _make_anew(self) -> None:
        self.env.close()
        self.env = self._make()

    def _make(self) -> gymnasium.Env[Any, Any]:
        options = {**self._options, **self._levels[self.level]}
        return gymnasium.make(self._identifier, disable_env_checker=True, **options)
