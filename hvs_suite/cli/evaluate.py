"""``hvs evaluate``: score a policy on the first scenarios of a split."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING

from hvs_suite.cli import console

if TYPE_CHECKING:
    from hvs_suite.eval.result_file import Result
    from hvs_suite.rollout import Episode


@dataclasses.dataclass(frozen=True, kw_only=True)
class Evaluate:
    """Score a policy on scenarios 0 to N-1 of a split and write every episode to a result file.

    Attributes:
        policy: expert, zero, random, servo, pretrained, finetuned, or a checkpoint folder.
        task: Named task, such as align-thesis; 'hvs tasks' lists them.
        out: Result file to write (JSON), replaced if it exists.
        split: Scenarios to play; test holds 1000, any other name has no end.
        episodes: Number of scenarios.
        workers: Processes that share the work; the result is the same for any number.
    """

    policy: str
    task: str
    out: Path
    split: str = "test"
    episodes: int = 100
    workers: int = 1

    def run(self) -> int:
        """Evaluate, write the result, print its summary."""
        from hvs_suite import files
        from hvs_suite.eval import protocol, result_file

        files.check_writable(self.out)
        n_played = n_success = 0
        with console.progress(f"{self.policy} on {self.task}", self.episodes) as advance:

            def note(episode: "Episode") -> None:
                nonlocal n_played, n_success
                n_played += 1
                n_success += episode.success
                advance(f"{n_success} of {n_played} solved")

            result = protocol.evaluate(
                self.policy, self.task, self.split, self.episodes, self.workers, progress=note
            )
        result_file.write(result, self.out)
        _print_summary(result)
        print(f"Written to {self.out}")
        return 0


def _print_summary(result: "Result") -> None:
    """Print the numbers of a result as a table."""
    summary = result.summary
    low, high = summary.pc_success_ci95
    to_goal = summary.steps_to_goal_mean
    console.print_table(
        ("", "value"),
        [
            (
                "success",
                f"{summary.n_success} of {summary.n_episodes} ({summary.pc_success:.1f} %)",
            ),
            ("95 % interval", f"{low:.1f} to {high:.1f} %"),
            ("collisions", str(summary.n_collision)),
            ("clipped actions", str(summary.n_clipped)),
            ("steps to goal, mean", "-" if to_goal is None else f"{to_goal:.1f}"),
            *(
                (
                    f"{name.replace('_', ' ')}, {unit}: p50, p95",
                    f"{errors.p50:.3f}, {errors.p95:.3f}",
                )
                for name, unit, errors in (
                    ("position_error", "mm", summary.position_error_mm),
                    ("lateral_error", "mm", summary.lateral_error_mm),
                    ("height_error", "mm", summary.height_error_mm),
                    ("tilt_error", "deg", summary.tilt_error_deg),
                )
            ),
            ("control steps a second", f"{result.timings.steps_per_s:.0f}"),
        ],
        title=f"{summary.policy} on {summary.task}, split {summary.split}",
    )
