"""What the studies share: a policy trained one way, judged on scenarios of split ``dev``."""

import contextlib
import dataclasses
import json
import math
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pydantic

from hvs_suite.errors import ResultError
from hvs_suite.eval import protocol
from hvs_suite.eval.scoring import result_file
from hvs_suite.eval.scoring.result_file import Result
from hvs_suite.executor import Workers
from hvs_suite.files import replacing

Report = Callable[[str, float, str], None]
"""Takes a stage, the share of it that is done (0 to 1) and a few words."""
Note = Callable[[Any], None]
"""Takes the progress of a training."""

SPLIT = "dev"
POLICY = "policy"
"""Folder of a run that holds what was trained."""
TRAINED = "trained.json"
"""File of a run that says that nothing is left to train."""
NOT_NEEDED_AGAIN = ("cache", "dagger", "replay", "seen.safetensors")
"""What takes most of the room in the folder of a training that is finished."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Scenes:
    """What a policy is judged on.

    Attributes:
        task: Named task.
        options: Task options that differ from it.
        name: Of its result files, and in tables.
    """

    task: str
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    name: str = SPLIT


class Point(pydantic.BaseModel):
    """Success after some environment steps.

    Attributes:
        env_steps: Played so far.
        n: Scenes.
        n_success: Solved.
    """

    env_steps: int
    n: int
    n_success: int


def train_and_judge(
    name: str,
    run: Path,
    train: Callable[[Path, Note], object],
    report: Report,
    *,
    on: Sequence[Scenes],
    scenarios: int,
    workers: Workers,
) -> list[Result]:
    """Train a policy and play it, or go on where an earlier call was interrupted.

    Args:
        name: The policy in words, for the reports.
        run: Gets the policy and its results; what is there and whole is not made again.
        train: Trains into a folder, telling how it goes.
        report: Called as the work goes on.
        on: What to play.
        scenarios: How many of each.
        workers: Processes that play, or others elsewhere.

    Returns:
        The results, in that order.
    """
    results = []
    for scenes in on:
        path = result_path(run, scenes, scenarios)
        with contextlib.suppress(ResultError):
            if path.exists():
                results.append(result_file.load(path))
                continue
        train_once(name, run, train, report)
        results.append(_judged(name, run, scenes, path, scenarios, workers, report))
    return results


def result_path(run: Path, scenes: Scenes, scenarios: int) -> Path:
    """Where the result of a run on some scenes stands."""
    return run / f"{scenes.name.replace(' ', '-')}-{scenarios}.json"


def train_once(name: str, run: Path, train: Callable[[Path, Note], object], report: Report) -> None:
    """Train a policy unless that is done, and keep only what is needed of it.

    Args:
        name: As in `train_and_judge`.
        run: Gets the policy.
        train: As in `train_and_judge`.
        report: Called as the work goes on.
    """
    if (run / TRAINED).exists():
        return

    def note(state: Any) -> None:
        left = "" if math.isnan(state.seconds_left) else f"{state.seconds_left:.0f} s left"
        report(f"{name}, {state.stage}", state.share, left)

    training = run / POLICY / "training"
    train(run / POLICY, note)
    with replacing(run / TRAINED) as temporary:
        temporary.write_bytes((training / "outcome.json").read_bytes())
    for each in NOT_NEEDED_AGAIN:
        path = training / each
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def minutes(run: Path) -> float:
    """How long a finished training took: learning, and playing to learn from (min)."""
    outcome = json.loads((run / POLICY / "training" / "outcome.json").read_text(encoding="utf-8"))
    return float(outcome["train_s"] + outcome.get("play_s", 0.0)) / 60.0


def _judged(
    name: str,
    run: Path,
    scenes: Scenes,
    path: Path,
    scenarios: int,
    workers: Workers,
    report: Report,
) -> Result:
    n_played = 0

    def note(_trial: object) -> None:
        nonlocal n_played
        n_played += 1
        report(f"{name}, playing", n_played / scenarios, f"{n_played} episodes")

    return protocol.evaluate(
        str(run / POLICY),
        scenes.task,
        path,
        split=SPLIT,
        episodes=scenarios,
        options=scenes.options,
        workers=workers,
        progress=note,
    )


def evaluated(run: Path) -> list[Point]:
    """How RL did on its way, on scenes of ``validation``."""
    text = (run / POLICY / "training" / "evaluations.json").read_text(encoding="utf-8")
    return [
        Point(
            env_steps=row["env_steps"],
            n=row["episodes"],
            n_success=round(row["success_rate"] * row["episodes"]),
        )
        for row in json.loads(text)
    ]


def played_rounds(run: Path) -> list[Point]:
    """How DAgger did on its way, on each round's own scenes before it learned from them.

    The last is the end, of which only the steps are known here. What the first round plays has
    learned more than a base, and has no steps yet: it is left out.
    """
    rounds = json.loads((run / TRAINED).read_text(encoding="utf-8"))["rounds"]
    points, env_steps = [], 0
    for each in rounds:
        point = Point(env_steps=env_steps, n=each["episodes"], n_success=each["successes"])
        points.append(point)
        env_steps += each["frames"]
    return [*points[1:], Point(env_steps=env_steps, n=0, n_success=0)] if points else []
