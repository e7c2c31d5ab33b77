"""Certify the named tasks and write the version lock: ``python -m hvs_suite.certify``.

For maintainers, after changing what a task means (raise its version first). Stands on top of the
rooms, because the last question, whether the expert solves every test scenario, needs rollouts.
"""

import argparse
import dataclasses
import functools
import json
import sys
from pathlib import Path

import numpy as np

import hvs_suite
from hvs_suite.datasets.expert import make_expert
from hvs_suite.files import replacing
from hvs_suite.registry import family_of, make_task
from hvs_suite.rollout import rollout
from hvs_suite.tasks.shared import certificate, lock
from hvs_suite.tasks.shared.scenario import TEST_SCENARIOS, TEST_SPLIT

TASKS_FOLDER = Path(lock.__file__).resolve().parent


def certify(task: str, scenarios: int, workers: int) -> certificate.Certificate:
    """Answer all four questions for a task.

    Args:
        task: Registered name.
        scenarios: How many test scenarios, from 0 up.
        workers: Processes that play the expert.
    """
    indices = range(scenarios)
    with hvs_suite.load(task, split=TEST_SPLIT) as env:
        checks = family_of(task).certify(env, indices)
    episodes = rollout(
        functools.partial(hvs_suite.load, task, split=TEST_SPLIT, observations="state"),
        make_expert,
        indices,
        workers=workers,
    )
    steps = [e.steps_to_goal for e in episodes if e.steps_to_goal is not None]
    checks.append(
        certificate.solved_check(
            n_success=sum(e.success for e in episodes),
            n_collision=sum(e.collision for e in episodes),
            n=scenarios,
            mean_steps=float(np.mean(steps)) if steps else float("nan"),
        )
    )
    return certificate.Certificate(task, lock.digest(task), scenarios, tuple(checks))


def main() -> int:
    """Write lock and certificates; 1 where a check does not hold."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("tasks", nargs="*", help="named tasks; all of them by default")
    parser.add_argument("--workers", type=int, default=2)
    arguments = parser.parse_args()
    names = arguments.tasks or list(hvs_suite.TASKS)
    entries = {
        name: dataclasses.asdict(lock.compute_entry(variant, make_task(variant, TEST_SPLIT).source))
        for name, variant in hvs_suite.TASKS.items()
    }
    with replacing(TASKS_FOLDER / "lock.json") as path:
        path.write_text(json.dumps(entries, indent=2) + "\n", encoding="utf-8")
    lock.lock.cache_clear()
    holds = True
    for name in names:
        result = certify(name, TEST_SCENARIOS, arguments.workers)
        with replacing(TASKS_FOLDER / "certificates" / f"{name}.json") as path:
            path.write_text(result.to_json(), encoding="utf-8")
        for check in result.checks:
            mark = "ok   " if check.holds else "FAILS"
            print(f"{name}: {mark} {check.what}: {check.found} (needed {check.needed})")
        holds = holds and result.holds
    return 0 if holds else 1


if __name__ == "__main__":
    sys.exit(main())
