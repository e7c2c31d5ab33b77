"""Takes the ``eval_info.json`` of ``lerobot-eval`` in, as what it is: a claim without proof.

Such a file names neither task nor policy nor scenarios and logs no actions. It is kept with its
successes under the same keys as ours, marked ``"verified": false``; it can be compared with others
(``hvs compare``) and has no place on the board.
"""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import pydantic

from hvs_suite import files, reading, registry, statistics
from hvs_suite.errors import ResultError
from hvs_suite.eval.scoring.result_file import MOST_BYTES
from hvs_suite.tasks.shared.scenario import TEST_SCENARIOS, TEST_SPLIT

LEROBOT_SEED = 1000
"""``lerobot-eval`` counts its seeds up from here unless told otherwise (``--seed``)."""


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
    sum_reward: float
    max_reward: float


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


def read(
    path: Path, *, task: str, policy: str, split: str = TEST_SPLIT, seed: int = LEROBOT_SEED
) -> ImportedResult:
    """Reads an ``eval_info.json`` that holds one task.

    Args:
        path: The file.
        task: Named task that was evaluated; the file does not say.
        policy: Name for the policy; the file does not say.
        split: Split that was played.
        seed: First seed; the environment plays scenario seed (mod 1,000 on ``test``).

    Raises:
        ResultError: The file is no such file, holds several tasks, or claims what its own rows do
            not give.
        UnknownTaskError: There is no such task.
    """
    registry.find(task)
    content = reading.read_json(path, error=ResultError, most=MOST_BYTES)
    try:
        successes, sums, largest, claimed = _lists(content)
    except (ValueError, KeyError, TypeError, IndexError, OverflowError) as error:
        raise ResultError(
            f"{path}: is no eval_info.json of one task, as lerobot-eval writes it ({error!r})"
        ) from error
    if not len(successes) == len(sums) == len(largest) > 0:
        raise ResultError(f"{path}: successes and rewards do not belong together")
    count = TEST_SCENARIOS if split == TEST_SPLIT else seed + len(successes)
    rows = [
        ImportedRow(
            scenario=(seed + i) % count,
            success=success,
            sum_reward=sums[i],
            max_reward=largest[i],
        )
        for i, success in enumerate(successes)
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


def _lists(content: Mapping[str, Any]) -> tuple[list[bool], list[float], list[float], float]:
    """Successes, sums and maxima of rewards, and the success rate claimed (percent)."""
    if "per_episode" in content:
        rows = content["per_episode"]
        successes, sums, largest = (
            [row[name] for row in rows] for name in ("success", "sum_reward", "max_reward")
        )
        claimed = content["aggregated"]["pc_success"]
    else:
        (task,) = content["per_task"]
        metrics = task["metrics"]
        successes, sums, largest = (
            metrics[name] for name in ("successes", "sum_rewards", "max_rewards")
        )
        claimed = content["overall"]["pc_success"]
    return (
        [bool(success) for success in successes],
        [float(reward) for reward in sums],
        [float(reward) for reward in largest],
        float(claimed),
    )
