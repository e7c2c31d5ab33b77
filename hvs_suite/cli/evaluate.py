"""``hvs evaluate``: score a policy on the first scenarios of a split."""

import dataclasses
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hvs_suite.cli import console
from hvs_suite.cli.players import Players
from hvs_suite.errors import OptionError

if TYPE_CHECKING:
    from hvs_suite.eval.scoring.contender import Contender
    from hvs_suite.eval.scoring.result_file import Result
    from hvs_suite.eval.scoring.trial import Trial

# The first few say what is wrong; a thousand of the same hide it.
MAX_COMPLAINTS = 3


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluate(Players):
    """Score a policy on scenarios 0 to N-1 of a split and write every episode to a result file.

    If it was interrupted, the same command continues. A policy loses an episode in which it raises,
    gives an invalid action, is too slow, or its server disconnects; the reason is counted.

    Attributes:
        task: Named task, such as align-thesis; give it several times for several tasks.
        out: Result file to write (JSON), replaced if it exists; for several tasks, the folder to
            write <task>.json into.
        policy: expert, servo, push, zero, random, pretrained, finetuned, a checkpoint folder or Hub
            id, or module:factory, which imports and runs that code. With --server, a name for the
            result.
        split: Scenarios to play; test holds 1000, any other name has no end.
        episodes: Number of scenarios.
        decision_limit: Time after which a decision loses its episode (s).
        server: Address of a policy server, such as ws://127.0.0.1:8765; 'hvs serve' starts one.
        option: Parameter of the task to change for a study, such as target_diameter_m=0.03; give it
            several times for several. The result then records this and is not a score.
    """

    task: tuple[str, ...]
    out: Path
    policy: str
    split: str = "test"
    episodes: int = 100
    decision_limit: float = 10.0
    server: str | None = None
    option: tuple[str, ...] = ()

    def run(self) -> int:
        """Evaluate, write the results, print their summaries."""
        from hvs_suite import files, registry
        from hvs_suite.eval.scoring import trial

        if not self.task:
            raise OptionError("name a --task; 'hvs tasks' lists them")
        if len(set(self.task)) < len(self.task):
            raise OptionError("a task is named twice; name each --task once")
        paths = (
            [self.out] if len(self.task) == 1 else [self.out / f"{task}.json" for task in self.task]
        )
        options = [registry.find(task).options_from_text(self.option) for task in self.task]
        for path in paths:
            files.check_writable(path)
        trial.check_decision_limit(self.decision_limit)
        # Every policy is found before the first is played.
        contenders = list(map(self._find, self.task, options))
        for task, path, contender, changed in zip(
            self.task, paths, contenders, options, strict=True
        ):
            _print_summary(self._evaluate(task, path, contender, changed))
            print(f"Written to {path}")
        return 0

    def _find(self, task: str, options: Mapping[str, Any]) -> "Contender":
        from hvs_suite.eval.scoring import contender

        if self.server is None:
            return contender.find(self.policy, task, options)
        from hvs_suite.eval.serving import remote_policy

        return remote_policy.find(self.server, self.policy, task, self.decision_limit, options)

    def _evaluate(
        self, task: str, path: Path, contender: "Contender", options: Mapping[str, Any]
    ) -> "Result":
        from hvs_suite.eval import protocol

        n_played = n_success = n_failure = 0
        with console.progress(f"{contender.name} on {task}", self.episodes) as advance:

            def note(trial: "Trial") -> None:
                nonlocal n_played, n_success, n_failure
                n_played += 1
                n_success += trial.row.success
                if trial.detail:
                    n_failure += 1
                    if n_failure <= MAX_COMPLAINTS:
                        words = " ".join(trial.detail.split())
                        print(f"scenario {trial.row.scenario} lost: {words}", file=sys.stderr)
                advance(f"{n_success} of {n_played} solved")

            return protocol.evaluate(
                contender,
                task,
                path,
                split=self.split,
                episodes=self.episodes,
                options=options,
                workers=self.players(),
                decision_limit_s=self.decision_limit,
                progress=note,
            )


def _print_summary(result: "Result") -> None:
    """Print the numbers of a result as a table."""
    from hvs_suite.registry import find
    from hvs_suite.tasks.shared.option_types import listed

    summary = result.summary
    low, high = summary.pc_success_ci95
    to_goal = summary.steps_to_goal_mean
    options = result.metadata.options
    spec, errors, settled = find(summary.task), summary.errors, summary.settled
    sharpest = settled.sharpest_95.scale
    console.print_table(
        ("", "value"),
        [
            (
                "success",
                f"{summary.n_success} of {summary.n_episodes} ({summary.pc_success:.1f} %)",
            ),
            ("95 % interval", f"{low:.1f} to {high:.1f} %"),
            ("collisions", str(summary.n_collision)),
            *((f"lost: {reason}", str(n)) for reason, n in summary.failures.items()),
            ("clipped actions", str(summary.n_clipped)),
            ("steps to goal, mean", "-" if to_goal is None else f"{to_goal:.1f}"),
            *(
                (
                    f"{metric.label}: p50, p95",
                    f"{errors[metric.name].p50:.3f}, {errors[metric.name].p95:.3f}",
                )
                for metric in spec.metrics
            ),
            *(
                (
                    f"settled {metric.label}: iqm, p99",
                    f"{settled.errors[metric.name].iqm:.3f}, {settled.errors[metric.name].p99:.3f}",
                )
                for metric in spec.metrics
                if spec.plays_on and metric.name in spec.headline
            ),
            (
                "sharpest tolerance met in 95 %",
                "-" if sharpest is None else f"{sharpest:.3g} of the task's",
            ),
            ("control steps a second", f"{result.timings.steps_per_s:.0f}"),
        ],
        title=f"{summary.policy} on {summary.task}, split {summary.split}"
        + (f", with {listed(options)}: no score" if options else ""),
    )
