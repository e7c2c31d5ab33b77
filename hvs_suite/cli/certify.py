"""``hvs certify``: prove that tasks can be solved, and lock what their names mean."""

import dataclasses
import functools
from collections.abc import Callable, Iterable, Iterator, Mapping
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from hvs_suite.cli import console
from hvs_suite.cli.show import title, verdict
from hvs_suite.errors import OptionError

if TYPE_CHECKING:
    from hvs_suite.tasks.shared.certificate import Certificate

FAILED = 1


@dataclasses.dataclass(frozen=True, kw_only=True)
class Certify:
    """Certify named tasks over all their test scenarios, and write them into the version lock.

    For maintainers, after changing the meaning of a task and raising its version. Refuses a task
    whose meaning differs from the lock at the same version. If a check does not hold, nothing is
    written for that task, and the exit code is 1. For tasks of other packages, and for tasks
    changed by options, the certificate is only printed.

    Attributes:
        tasks: Named tasks; all of the suite's own by default. Entries of other tasks stay as they
            are.
        workers: Processes that play the expert.
        option: Parameter of the tasks to change for a study, such as target_diameter_m=0.03; give
            it several times for several.
    """

    tasks: Annotated[
        tyro.conf.Positional[tuple[str, ...]], tyro.conf.arg(metavar="[TASK ...]")
    ] = ()
    workers: int = 1
    option: tuple[str, ...] = ()

    def run(self) -> int:
        """Certify the tasks one after the other, and print what was found."""
        import hvs_suite
        from hvs_suite.registry import family_of, find
        from hvs_suite.tasks.shared import certificate, lock
        from hvs_suite.tasks.shared.option_types import listed
        from hvs_suite.tasks.shared.scenario import TEST_SCENARIOS, TEST_SPLIT

        if self.workers < 1:
            raise OptionError(f"--workers must be at least 1, not {self.workers}")
        asked = self.tasks or filter(lock.is_own, hvs_suite.TASKS)
        options = {task: find(task).options_from_text(self.option) for task in asked}
        # All are compared with the lock first, because certifying takes minutes a task.
        entries: dict[str, lock.LockEntry | None] = {}
        for task in options:
            entries[task] = None
            if lock.is_own(task) and not options[task]:
                with hvs_suite.load(task, split=TEST_SPLIT) as env:
                    entries[task] = lock.agreed_entry(env)
        failed = False
        for task, entry in entries.items():
            n = (family_of(task).certificate_passes + 1) * TEST_SCENARIOS
            digest = lock.digest(task) if entry is None else entry.digest
            with console.progress(f"certify {task}", n) as advance:
                found = certify(task, options[task], digest, TEST_SCENARIOS, self.workers, advance)
            changed = listed(options[task])
            console.print_table(
                (title(found) + (f", with {changed}" if changed else ""), "found", "needed", ""),
                [(c.what, c.found, c.needed, verdict(c)) for c in found.checks],
            )
            if not found.holds:
                failed = True
                print(f"{task}: a check fails; certificate and lock are left as they were")
            elif entry is not None:
                certificate.store(found)
                lock.store(task, entry)
        return FAILED if failed else 0


@dataclasses.dataclass(frozen=True)
class _Counted:
    """Indices that can be gone over again and again; tells of each one that is done."""

    indices: Iterable[int]
    done: Callable[[], None]

    def __iter__(self) -> Iterator[int]:
        for index in self.indices:
            yield index
            self.done()


def certify(
    task: str,
    options: Mapping[str, Any],
    digest: str,
    scenarios: int,
    workers: int,
    on_scenario: Callable[[], None],
) -> "Certificate":
    """Answer all four questions for a task.

    Args:
        task: Registered name.
        options: Options that change it; empty for what is to be locked.
        digest: What it means now, as it will stand in the lock.
        scenarios: How many test scenarios, from 0 up.
        workers: Processes that play the expert.
        on_scenario: Called for each scenario of each pass over them, the expert's the last.

    Returns:
        The certificate, whether it holds or not.
    """
    import numpy as np

    import hvs_suite
    from hvs_suite.datasets.expert import make_expert
    from hvs_suite.registry import family_of, find
    from hvs_suite.rollout import rollout
    from hvs_suite.tasks.shared import certificate
    from hvs_suite.tasks.shared.scenario import TEST_SPLIT

    indices = range(scenarios)
    counted = _Counted(indices, on_scenario)
    with hvs_suite.load(task, split=TEST_SPLIT, **options) as env:
        checks = family_of(task).certify(env, counted)
    episodes = rollout(
        functools.partial(
            hvs_suite.load, task, split=TEST_SPLIT, **{**options, "observations": "state"}
        ),
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
    checks += [
        certificate.limit_check(metric, [episode.errors[metric.name] for episode in episodes])
        for metric in find(task).with_options(options).metrics
        if metric.is_limit
    ]
    return certificate.Certificate(task, digest, scenarios, tuple(checks))
