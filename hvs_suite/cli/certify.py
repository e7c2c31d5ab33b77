"""``hvs certify``: prove that tasks can be solved, and lock what their names mean."""

import dataclasses
import functools
from collections.abc import Callable
from typing import TYPE_CHECKING, Annotated

import tyro

from hvs_suite.cli import console
from hvs_suite.cli.show import title, verdict
from hvs_suite.errors import OptionError

if TYPE_CHECKING:
    from hvs_suite.tasks.certificate import Certificate

FAILED = 1
# Three go over the scenes (geometry, visibility, accuracy); the expert plays them in the last.
PASSES = 4


@dataclasses.dataclass(frozen=True, kw_only=True)
class Certify:
    """Certify named tasks over all their test scenarios, and write them into the version lock.

    For maintainers, after changing what a task means and raising its version. Refuses a task that
    means something else than the lock says at the same version. Where a check does not hold,
    nothing of that task is written, and the exit code is 1.

    Attributes:
        tasks: Named tasks; all of them by default. Entries of other tasks stay as they are.
        workers: Processes that play the expert.
    """

    tasks: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[TASK ...]")
    ] = ()
    workers: int = 1

    def run(self) -> int:
        """Certify the tasks one after the other, and print what was found."""
        import hvs_suite
        from hvs_suite.registry import find
        from hvs_suite.tasks import certificate, lock
        from hvs_suite.tasks.scenario import TEST_SCENARIOS

        if self.workers < 1:
            raise OptionError(f"--workers must be at least 1, not {self.workers}")
        variants = [find(task) for task in dict.fromkeys(self.tasks or hvs_suite.TASKS)]
        # All are held against the lock first: certifying takes minutes a task.
        entries = {variant.name: lock.agreed_entry(variant) for variant in variants}
        failed = False
        for task, entry in entries.items():
            with console.progress(f"certify {task}", PASSES * TEST_SCENARIOS) as advance:
                found = certify(task, entry.digest, TEST_SCENARIOS, self.workers, advance)
            console.print_table(
                (title(found), "found", "needed", ""),
                [(c.what, c.found, c.needed, verdict(c)) for c in found.checks],
            )
            if not found.holds:
                failed = True
                print(f"{task}: a check fails; certificate and lock are left as they were")
                continue
            certificate.store(found)
            lock.store(task, entry)
        return FAILED if failed else 0


def certify(
    task: str, digest: str, scenarios: int, workers: int, on_scenario: Callable[[], None]
) -> "Certificate":
    """Answer all four questions for a task.

    Args:
        task: Registered name.
        digest: What it means now, as it will stand in the lock.
        scenarios: How many test scenarios, from 0 up.
        workers: Processes that play the expert.
        on_scenario: Called for each scenario of each of the ``PASSES``.

    Returns:
        The certificate, whether it holds or not.
    """
    import numpy as np

    import hvs_suite
    from hvs_suite.datasets.expert import make_expert
    from hvs_suite.rollout import rollout
    from hvs_suite.tasks import certificate
    from hvs_suite.tasks.scenario import TEST_SPLIT

    indices = range(scenarios)
    with hvs_suite.load(task, split=TEST_SPLIT) as env:
        checks = certificate.certify(env, indices, on_scenario)
    episodes = rollout(
        functools.partial(hvs_suite.load, task, split=TEST_SPLIT, observations="state"),
        make_expert,
        indices,
        workers=workers,
        on_episode=lambda _: on_scenario(),
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
    return certificate.Certificate(task, digest, scenarios, tuple(checks))
