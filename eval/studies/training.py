"""What the studies share: a policy trained one way, judged on scenarios of split ``dev``."""

import contextlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hvs_suite.errors import ResultError
from hvs_suite.eval import protocol
from hvs_suite.eval.scoring import result_file
from hvs_suite.eval.scoring.result_file import Result

Report = Callable[[str, float, str], None]
"""Takes a stage, the share of it that is done (0 to 1) and a few words."""

SPLIT = "dev"


def result_path(run: Path, scenarios: int) -> Path:
    """Where a run's result lies.

    Args:
        run: Folder of one policy of a study.
        scenarios: How many it is judged on.
    """
    return run / f"{SPLIT}-{scenarios}.json"


def earlier_result(run: Path, scenarios: int) -> Result | None:
    """The result of a run that is finished; None if it is not, or its result is damaged.

    Args:
        run: As in `result_path`.
        scenarios: As in `result_path`.
    """
    path = result_path(run, scenarios)
    if path.exists():
        with contextlib.suppress(ResultError):
            return result_file.load(path)
    return None


def train_and_judge(
    name: str,
    data: Path,
    task: str,
    run: Path,
    report: Report,
    *,
    scenarios: int,
    workers: int,
    **options: Any,
) -> Result:
    """Train a policy and play it, or go on where an earlier call was interrupted.

    Args:
        name: The policy in words, for the reports.
        data: Dataset to train on.
        task: Named task to play.
        run: Gets the policy and its result.
        report: Called as the work goes on.
        scenarios: How many to play.
        workers: Processes that play, in the training's rounds as well.
        **options: Of `pretrain`.

    Returns:
        The result.
    """
    from hvs_suite.policies.imitation.pretrain import pretrain

    policy = run / "policy"
    pretrain(
        data,
        policy,
        on_progress=lambda state: report(
            f"{name}, {state.stage}", state.share, f"{state.seconds_left:.0f} s left"
        ),
        workers=workers,
        **options,
    )
    return judge(name, policy, task, run, report, scenarios=scenarios, workers=workers)


def judge(
    name: str,
    policy: Path,
    task: str,
    run: Path,
    report: Report,
    *,
    scenarios: int,
    workers: int,
) -> Result:
    """Play a policy, or go on where an earlier call was interrupted.

    Args:
        name: The policy in words, for the reports.
        policy: Its checkpoint.
        task: Named task to play.
        run: Gets the result.
        report: Called as the work goes on.
        scenarios: How many to play.
        workers: Processes that play.

    Returns:
        The result.
    """
    n_played = 0

    def note(_trial: object) -> None:
        nonlocal n_played
        n_played += 1
        report(f"{name}, playing", n_played / scenarios, f"{n_played} episodes")

    return protocol.evaluate(
        str(policy),
        task,
        result_path(run, scenarios),
        split=SPLIT,
        episodes=scenarios,
        workers=workers,
        progress=note,
    )
