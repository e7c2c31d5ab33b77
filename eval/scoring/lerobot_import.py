"""Imports the ``eval_info.json`` of ``lerobot-eval``, marked as unverified.

Such a file names neither policy nor scenarios and logs no actions. It is kept with its
successes under the same keys as ours, marked ``"verified": false``; it can be compared with others
(``hvs compare``) and has no place on the board.
"""

import json
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import pydantic

from hvs_suite import files, reading, registry, statistics
from hvs_suite.errors import OptionError, ResultError
from hvs_suite.eval.scoring.result_file import MOST_BYTES
from hvs_suite.names import shown
from hvs_suite.tasks.shared.scenario import TEST_SCENARIOS, TEST_SPLIT

LEROBOT_SEED = 1000
"""``lerobot-eval`` counts its seeds up from here unless told otherwise (``--seed``)."""


Reward = Annotated[float, pydantic.Field(allow_inf_nan=False)]


class _Block(pydantic.BaseModel):
    model_config = pydantic.ConfigDict(extra="forbid", strict=True, frozen=True)


class ImportedRow(_Block):
    """One episode.

    Attributes:
        scenario: Index in the split, from the seed.
        success: As claimed.
        sum_reward: As claimed.
        max_reward: As claimed.
    """

    scenario: Annotated[int, pydantic.Field(ge=0)]
    success: bool
    sum_reward: Reward
    max_reward: Reward


class ImportedSummary(_Block):
    """The numbers, under LeRobot's names and ours.

    Attributes:
        task: Named task, as the importer says.
        policy: Name of the policy, as the importer says.
        split: Split that was played, as the importer says.
        n_episodes: Episodes.
        n_success: Successes among them.
        pc_success: Success rate (percent).
        pc_success_ci95: Wilson 95 % interval (percent).
        avg_sum_reward: Mean sum of rewards.
        avg_max_reward: Mean largest reward.
    """

    task: str
    policy: str
    split: str
    n_episodes: int
    n_success: int
    pc_success: float
    pc_success_ci95: list[float]
    avg_sum_reward: float
    avg_max_reward: float


class ImportedResult(_Block):
    """An imported file.

    Attributes:
        origin: Where it comes from.
        verified: Never.
        summary: Its numbers.
        episodes: Its rows, by scenario.
    """

    origin: Literal["lerobot-eval"]
    verified: Literal[False]
    summary: ImportedSummary
    episodes: Annotated[list[ImportedRow], pydantic.Field(min_length=1)]

    @classmethod
    def of(cls, task: str, policy: str, split: str, rows: list[ImportedRow]) -> Self:
        """Returns the result of one or more rows."""
        n, n_success = len(rows), sum(row.success for row in rows)
        return cls(
            origin="lerobot-eval",
            verified=False,
            summary=ImportedSummary(
                task=task,
                policy=policy,
                split=split,
                n_episodes=n,
                n_success=n_success,
                pc_success=100 * n_success / n,
                pc_success_ci95=list(statistics.wilson_interval(n_success, n)),
                avg_sum_reward=sum(row.sum_reward for row in rows) / n,
                avg_max_reward=sum(row.max_reward for row in rows) / n,
            ),
            episodes=sorted(rows, key=lambda row: row.scenario),
        )


class _Episode(pydantic.BaseModel):
    success: bool
    sum_reward: Reward
    max_reward: Reward


class _Overall(pydantic.BaseModel):
    pc_success: Reward


class _Older(pydantic.BaseModel):
    """What ``lerobot-eval`` wrote when it knew one task: a row an episode."""

    per_episode: Annotated[list[_Episode], pydantic.Field(min_length=1)]
    overall: Annotated[_Overall, pydantic.Field(alias="aggregated")]

    def of(self, task: str) -> tuple[list[_Episode], float]:
        """Episodes of a task, and their success rate as claimed."""
        return self.per_episode, self.overall.pc_success


class _Metrics(pydantic.BaseModel):
    successes: Annotated[list[bool], pydantic.Field(min_length=1)]
    sum_rewards: list[Reward]
    max_rewards: list[Reward]

    @pydantic.model_validator(mode="after")
    def _agree(self) -> Self:
        if not len(self.successes) == len(self.sum_rewards) == len(self.max_rewards):
            raise ValueError("successes and rewards do not belong together")
        return self


class _Task(pydantic.BaseModel):
    task_group: str = ""
    metrics: _Metrics


class _Newer(pydantic.BaseModel):
    """What it writes now: columns, by task."""

    per_task: Annotated[list[_Task], pydantic.Field(min_length=1, max_length=100)]
    per_group: dict[str, _Overall] = {}
    overall: _Overall

    def of(self, task: str) -> tuple[list[_Episode], float]:
        """Episodes of a task, and their success rate as claimed.

        Raises:
            ResultError: There are several tasks, and none or more than one has this name.
        """
        groups = [each.task_group for each in self.per_task]
        alone = len(groups) == 1 and groups[0] not in registry.TASKS
        named = [each for each in self.per_task if alone or each.task_group == task]
        if len(named) != 1 or not (alone or task in self.per_group):
            raise ResultError(f"holds {', '.join(map(shown, groups))}, and {task} not once")
        metrics = named[0].metrics
        columns = metrics.successes, metrics.sum_rewards, metrics.max_rewards
        episodes = [
            _Episode(success=success, sum_reward=total, max_reward=largest)
            for success, total, largest in zip(*columns, strict=True)
        ]
        return episodes, (self.overall if alone else self.per_group[task]).pc_success


def read(
    path: Path, *, task: str, policy: str, split: str = TEST_SPLIT, seed: int = LEROBOT_SEED
) -> ImportedResult:
    """Reads one task of an ``eval_info.json``.

    Args:
        path: The file.
        task: Named task that was evaluated; where the file holds several, that one of them.
        policy: Name for the policy; the file does not contain it.
        split: Split that was played.
        seed: First seed; the environment plays scenario seed (mod 1,000 on ``test``).

    Raises:
        ResultError: The file is no such file, holds several tasks and not this one, or claims what
            its own rows do not give.
        OptionError: `seed` is negative.
        UnknownTaskError: There is no such task.
    """
    registry.find(task)
    if seed < 0:
        raise OptionError(f"a seed is a whole number from 0 up, not {seed}")
    content = reading.read_object(path, error=ResultError, most=MOST_BYTES)
    what = f"{path}: is no eval_info.json, as lerobot-eval writes it"
    info: _Older | _Newer = (
        reading.validated(_Older, content, what, error=ResultError)
        if "per_episode" in content
        else reading.validated(_Newer, content, what, error=ResultError)
    )
    try:
        episodes, claimed = info.of(task)
    except ResultError as error:
        raise ResultError(f"{path}: {error}") from None
    count = TEST_SCENARIOS if split == TEST_SPLIT else seed + len(episodes)
    rows = [
        ImportedRow(scenario=(seed + i) % count, **episode.model_dump())
        for i, episode in enumerate(episodes)
    ]
    if len({row.scenario for row in rows}) < len(rows):
        raise ResultError(f"{path}: holds a scenario twice; {TEST_SCENARIOS} make the test split")
    result = ImportedResult.of(task, policy, split, rows)
    if abs(result.summary.pc_success - claimed) > 0.01:
        raise ResultError(
            f"{path}: pc_success is {claimed}, but its rows give {result.summary.pc_success:.2f}"
        )
    return result


def write(result: ImportedResult, path: Path) -> None:
    """Writes an imported result atomically.

    Raises:
        OutputError: The file cannot be written.
    """
    with files.replacing(path) as temporary:
        temporary.write_text(json.dumps(result.model_dump(mode="json"), indent=2) + "\n")


def load(path: Path) -> ImportedResult:
    """Reads an imported result.

    Raises:
        ResultError: The file cannot be read or is none.
    """
    content = reading.read_json(path, error=ResultError, most=MOST_BYTES)
    return reading.validated(ImportedResult, content, path, error=ResultError)


def is_imported(content: Any) -> bool:
    """Returns whether a parsed JSON file is an imported result."""
    return isinstance(content, dict) and content.get("origin") == "lerobot-eval"
