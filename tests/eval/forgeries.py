"""Results that claim what their actions do not give, made as carefully as a forger would."""

import hashlib
import itertools
import json
import shutil
from collections.abc import Callable, Collection
from pathlib import Path
from typing import Any

import numpy as np

import hvs_suite
from hvs_suite.eval import protocol
from hvs_suite.eval.scoring import action_log, result_file, trial, verification
from hvs_suite.eval.scoring.result_file import EpisodeRow, Summary

RESULTS = Path(__file__).parents[2] / "eval" / "results"
SAMPLE = 20


def rewrite(path: Path, change: Callable[[EpisodeRow], EpisodeRow], **metadata: Any) -> None:
    """Changes rows, gives the result a name of its own, and makes summary and seal agree."""
    result = result_file.load(path)
    rows = [change(row) for row in result.episodes]
    metadata = {"policy_kind": "module", "policy_hash": "mine"} | metadata
    changed = result.metadata.model_copy(update=metadata)
    summary = Summary.of(
        result.summary.task,
        "mine",
        result.summary.split,
        rows,
        tolerances=changed.tolerances,
        time_limit_steps=changed.time_limit_steps,
    )
    update = {"episodes": rows, "metadata": changed, "summary": summary}
    result_file.write(result.model_copy(update=update), path)


def with_log(path: Path, log: list[Any], change: Callable[[EpisodeRow], EpisodeRow]) -> None:
    """As `rewrite`, with another action log."""
    content = action_log.encode(log)
    result_file.actions_path(path).write_bytes(content)
    rewrite(path, change, actions_sha256=hashlib.sha256(content).hexdigest())


def near_a_bound(folder: Path) -> Path:
    """Two arms that miss by far; in one step their tilt is brought to a rounding of its bound."""
    path = folder / "results" / "mine" / "align-fixed.json"
    protocol.evaluate("expert", "align-fixed", path, episodes=10)
    log = action_log.load(
        result_file.actions_path(path), result_file.load(path).metadata.actions_sha256
    )
    rows: dict[int, EpisodeRow] = {}
    with hvs_suite.load("align-fixed", split="test", observations="state") as env:
        for scenario in range(10):
            log[scenario] = np.zeros_like(log[scenario]) if scenario > 1 else log[scenario]
            step = brought_to_the_bound(env, scenario, log) if scenario < 2 else None
            rows[scenario], _ = play(env, scenario, log[scenario])
            if step is not None:
                rows[scenario] = claimed(rows[scenario], step)
    with_log(path, log, lambda row: rows[row.scenario])
    return path


def play(env: Any, scenario: int, actions: Any) -> tuple[EpisodeRow, list[dict[str, float]]]:
    """The row that actions give, and the errors at the start and after each of them."""
    remaining, errors = iter(actions), []

    def decide(_: Any) -> Any:
        errors.append(env.info["errors"])
        return next(remaining)

    row, _ = trial.play_trial(env, lambda: None, decide, scenario)
    return row, [*errors, env.info["errors"]]


def brought_to_the_bound(env: Any, scenario: int, log: list[Any]) -> int:
    """Turns the base the wrong way, and ends in the step in which the tilt meets its bound."""
    bound = env.spec.tolerances["tilt_error_deg"]
    log[scenario] = log[scenario].copy()
    log[scenario][:, 0] *= -1

    def tilts() -> list[float]:
        return [errors["tilt_error_deg"] for errors in play(env, scenario, log[scenario])[1]]

    step = next(k for k, (a, b) in enumerate(itertools.pairwise(tilts())) if a > bound >= b)
    log[scenario][step + 1 :] = 0.0
    whole, low, high = log[scenario][step].copy(), 0.0, 1.0
    for _ in range(24):
        middle = (low + high) / 2
        log[scenario][step] = (middle * whole).astype(np.float32)
        low, high = (middle, high) if tilts()[step + 1] > bound else (low, middle)
    assert abs(tilts()[step + 1] - bound) < verification.NEAR["deg"]
    return step + 1


def claimed(row: EpisodeRow, steps: int) -> EpisodeRow:
    """The same settled figures, after a success that never was."""
    assert row.truncated
    assert row.errors["position_error_mm"] > 50.0
    success = {"success": True, "success_once": True, "truncated": False, "n_clipped": 0}
    return row.model_copy(update=success | {"steps": steps, "steps_to_goal": steps})


def flattered(folder: Path, forged: Collection[int]) -> Path:
    """A result of 1,000 scenarios, some of whose errors are made up."""
    path = folder / "results" / "mine" / "align-thesis.json"
    path.parent.mkdir(parents=True)
    # One whose log holds them all.
    for name in ("align-thesis.json", "align-thesis.actions.npz"):
        shutil.copy(RESULTS / "act" / name, path.with_name(name))
    rewrite(path, lambda r: with_errors(r, 1.0) if r.scenario in forged else r)
    return path


def with_errors(row: EpisodeRow, error: float) -> EpisodeRow:
    """A row whose metrics are all the same, where it was scored and where it settled."""
    errors = {"errors": dict.fromkeys(row.errors, error)}
    return row.model_copy(update=errors | {"settled": row.settled.model_copy(update=errors)})


def ground_sample(folder: Path) -> Path:
    """400 forged rows, and blanks after the seal until a draw by the file's hash misses them."""
    path = flattered(folder, range(400))
    begun = hashlib.sha256(path.read_bytes())
    for n in itertools.count():
        ended = begun.copy()
        ended.update(b" " * n)
        key = int.from_bytes(ended.digest()[:16], "little")
        drawn = np.random.Generator(np.random.Philox(key=key)).choice(1000, SAMPLE, replace=False)
        if drawn.min() >= 400:
            break
    with path.open("ab") as file:
        file.write(b" " * n)
    return path


def forged_ledger(folder: Path) -> Path:
    """A result that is made up from end to end, and a note that all of it was played again."""
    path = flattered(folder, range(1000))
    note = {"sha256": hashlib.sha256(path.read_bytes()).hexdigest(), "n_played": 1000}
    (folder / "out").mkdir()
    (folder / "out" / "verified.json").write_text(json.dumps({"mine/align-thesis": note}))
    return path
