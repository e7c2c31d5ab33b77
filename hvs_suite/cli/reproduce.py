"""``hvs reproduce``: the shipped policy of a task, made again from nothing."""

import dataclasses
import json
import shlex
from pathlib import Path

from hvs_suite.cli import console
from hvs_suite.errors import OptionError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Record, pretrain and evaluate as the shipped weights of a task were made.

    Runs the commands of datasets/recipes and policies/recipes below the current folder, in runs/,
    and prints the hours of each stage. Interrupted, the same command goes on.

    Attributes:
        task: Named task.
        episodes: Test scenarios to score the policy on; as many as the board asks for by default.
    """

    task: str
    episodes: int | None = None

    def run(self) -> None:
        """Run the stages, and print what they came to and what they took."""
        from hvs_suite.cli.main import parse
        from hvs_suite.eval.submission import EPISODES
        from hvs_suite.policies.recipe import recipe
        from hvs_suite.tasks.scenario import TEST_SCENARIOS

        if self.episodes is not None and self.episodes < 1:
            raise OptionError(f"--episodes must be at least 1, not {self.episodes}")
        plan = recipe(self.task)
        result = Path("runs/results") / f"{self.task}.json"
        record = list(plan.record)
        out = Path(record[record.index("--out") + 1])
        if (out / "hvs.json").exists():
            record.append("--resume")
        policy = plan.pretrain[plan.pretrain.index("--out") + 1]
        episodes = self.episodes or EPISODES.get(self.task, TEST_SCENARIOS)
        score = f"evaluate --policy {policy} --task {self.task} --episodes {episodes}"
        times_s: dict[str, float] = {}
        for words in (record, plan.pretrain, [*score.split(), "--workers", "2", "--out", result]):
            line = shlex.join(["hvs", *map(str, words)])
            with console.stage(line, times_s):
                parse([*map(str, words)]).run()
        summary = json.loads(result.read_text(encoding="utf-8"))["summary"]
        low, high = summary["pc_success_ci95"]
        console.print_times({line.split()[1]: taken for line, taken in times_s.items()})
        print(
            f"{self.task}: {summary['n_success']} of {summary['n_episodes']} solved, "
            f"{summary['pc_success']:.1f} % (95 % interval {low:.1f} to {high:.1f} %), "
            f"{summary['n_collision']} collisions"
        )
