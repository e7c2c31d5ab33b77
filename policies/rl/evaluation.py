"""How a policy stands amid its training: a few scenes of their own split, and a clip."""

import dataclasses
import json
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hvs_suite.files import replacing
from hvs_suite.pictures import film_episode, write_film
from hvs_suite.registry import load
from hvs_suite.rollout import Policy, run_episode
from hvs_suite.statistics import wilson_interval
from hvs_suite.tasks.shared.spec import Spec

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.environment import Environment

SPLIT = "validation"
"""Neither what is trained on nor what is scored."""


@dataclasses.dataclass(frozen=True)
class Evaluation:
    """Greedy episodes after some training; means over the episodes.

    Attributes:
        env_steps: Environment steps trained.
        updates: Updates done.
        episodes: Episodes played.
        episode_return: Undiscounted sum of rewards.
        length: Control steps.
        outside: Control steps that end outside the tolerances.
        success_rate: Share that reached the goal.
        collision_rate: Share that ended in a forbidden contact.
        errors: The task's metrics at the end of the episode.
    """

    env_steps: int
    updates: int
    episodes: int
    episode_return: float
    length: float
    outside: float
    success_rate: float
    collision_rate: float
    errors: dict[str, float]

    def figures(self) -> dict[str, float]:
        """What goes on the board, by name."""
        names = [field.name for field in dataclasses.fields(self)][3:-1]
        return {name: float(getattr(self, name)) for name in names} | self.errors

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the success rate (percent)."""
        return wilson_interval(round(self.success_rate * self.episodes), self.episodes)

    def in_words(self) -> str:
        """The figures as one line."""
        errors = ", ".join(f"{name} {value:.3g}" for name, value in self.errors.items())
        return (
            f"return {self.episode_return:.2f} in {self.length:.1f} steps, "
            f"{self.outside:.1f} outside, success {100 * self.success_rate:.0f} %, "
            f"collisions {100 * self.collision_rate:.0f} %, "
            f"{errors}"
        )


class Evaluator:
    """Plays the first scenes of `SPLIT`, always the same ones.

    Attributes:
        episodes: Scenes that an evaluation plays.

    Args:
        spec: The named task.
        options: Task options that differ from it.
        episodes: Scenes to play.
    """

    def __init__(self, spec: Spec, options: Mapping[str, Any], episodes: int) -> None:
        self._env: Environment = load(spec.name, split=SPLIT, **options)
        self.episodes = episodes

    def evaluate(
        self,
        policy: Policy,
        env_steps: int,
        updates: int,
        clip: Path | None = None,
        on_episode: Callable[[int], None] | None = None,
    ) -> Evaluation:
        """Play every scene once.

        Args:
            policy: Without exploration.
            env_steps: Environment steps trained so far.
            updates: Updates done so far.
            clip: Film of scene 0 to write (.mp4 or .gif).
            on_episode: Called with the number of episodes played.
        """
        rewards: list[float] = []
        outside = 0
        played = []

        def note(*step: Any) -> None:
            nonlocal outside
            rewards.append(float(step[3].reward))
            outside += not self._env.info["n_inside"]

        for scenario in range(self.episodes):
            played.append(run_episode(self._env, policy, scenario, note))
            if on_episode is not None:
                on_episode(scenario + 1)
        if clip is not None:
            _, frames = film_episode(self._env, policy, 0)
            write_film(clip, frames, 1.0 / self._env.spec.control_period_s)
        return Evaluation(
            env_steps=env_steps,
            updates=updates,
            episodes=len(played),
            episode_return=sum(rewards) / len(played),
            length=float(np.mean([episode.steps for episode in played])),
            outside=outside / len(played),
            success_rate=float(np.mean([episode.success for episode in played])),
            collision_rate=float(np.mean([episode.collision for episode in played])),
            errors={
                name: float(np.mean([episode.errors[name] for episode in played]))
                for name in played[0].errors
            },
        )

    def close(self) -> None:
        """Free the environment."""
        self._env.close()


def read_evaluations(path: Path, env_steps: int) -> list[Evaluation]:
    """Evaluations of a run up to where it is resumed; none if there is no file.

    Args:
        path: As given to `write_evaluations`.
        env_steps: Later ones belong to a sitting that was lost.
    """
    try:
        rows = [Evaluation(**row) for row in json.loads(path.read_bytes())]
    except (OSError, ValueError, TypeError):
        return []
    return [row for row in rows if row.env_steps <= env_steps]


def write_evaluations(path: Path, evaluations: list[Evaluation]) -> None:
    """Write the evaluations of a run as JSON.

    Args:
        path: The file.
        evaluations: In order.
    """
    with replacing(path) as temporary:
        rows = [dataclasses.asdict(row) for row in evaluations]
        temporary.write_text(json.dumps(rows, indent=2) + "\n")


def standing(evaluation: Evaluation) -> tuple[float, float]:
    """What evaluations of the same scenes are compared by: success, and of equals haste.

    Haste is about the steps outside, because some tasks last as long whatever is done.

    Args:
        evaluation: Of some state of a run.

    Returns:
        More is better.
    """
    return evaluation.success_rate, -evaluation.outside


def fallen(evaluations: Sequence[Evaluation]) -> bool:
    """Whether the last evaluation is worse than an earlier one beyond chance.

    That is where Wilson's 95 % intervals of their success rates lie apart.

    Args:
        evaluations: In order.
    """
    if not evaluations:
        return False
    ranges = [each.interval for each in evaluations]
    return ranges[-1][1] < max(low for low, _ in ranges)
