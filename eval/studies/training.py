"""What the studies share: a policy trained one way, judged on scenarios of split ``dev``."""

import contextlib
import math
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from hvs_suite.errors import ResultError
from hvs_suite.eval import protocol
from hvs_suite.eval.scoring import result_file
from hvs_suite.eval.scoring.result_file import Result
from hvs_suite.executor import Workers

Report = Callable[[str, float, str], None]
"""Takes a stage, the share of it that is done (0 to 1) and a few words."""
Note = Callable[[Any], None]
"""Takes the progress of a training."""

SPLIT = "dev"
NOT_NEEDED_AGAIN = ("cache", "dagger", "replay", "seen.safetensors")
"""What takes most of the room in the folder of a training that is finished."""


def train_and_judge(
    name: str,
    task: str,
    run: Path,
    train: Callable[[Path, Note], object],
    report: Report,
    *,
    scenarios: int,
    workers: Workers,
) -> Result:
    """Train a policy and play it, or go on where an earlier call was interrupted.

    Args:
        name: The policy in words, for the reports.
        task: Named task to play.
        run: Gets the policy and its result; where that is there and whole, nothing is done.
        train: Trains into a folder, telling how it goes.
        report: Called as the work goes on.
        scenarios: How many to play.
        workers: Processes that play, or others elsewhere.

    Returns:
        The result.
    """
    path = run / f"{SPLIT}-{scenarios}.json"
    if path.exists():
        with contextlib.suppress(ResultError):
            return result_file.load(path)
    n_played = 0

    def note_training(state: Any) -> None:
        left = "" if math.isnan(state.seconds_left) else f"{state.seconds_left:.0f} s left"
        report(f"{name}, {state.stage}", state.share, left)

    def note_playing(_trial: object) -> None:
        nonlocal n_played
        n_played += 1
        report(f"{name}, playing", n_played / scenarios, f"{n_played} episodes")

    train(run / "policy", note_training)
    result = protocol.evaluate(
        str(run / "policy"),
        task,
        path,
        split=SPLIT,
        episodes=scenarios,
        workers=workers,
        progress=note_playing,
    )
    for name in NOT_NEEDED_AGAIN:
        path = run / "policy" / "training" / name
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)
    return result
