"""``hvs reproduce``: the shipped policy of a task, made again from nothing."""

import dataclasses
import json
import shlex
from collections.abc import Sequence
from pathlib import Path

from hvs_suite.cli import console
from hvs_suite.errors import OptionError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reproduce:
    """Record, pretrain, fine-tune and evaluate as the shipped weights of a task were made.

    Runs the commands of datasets/recipes and policies/recipes below the current folder, in runs/,
    and prints the hours of each stage. If it was interrupted, the same command continues.

    Attributes:
        task: Named task.
        episodes: Test scenarios to score the policy on; as many as the board asks for by default.
    """

    task: str
    episodes: int | None = None

    def run(self) -> None:
        """Run the stages, and print what they came to and what they took."""
        from hvs_suite.cli.main import parse
        from hvs_suite.eval.board.submission import EPISODES
        from hvs_suite.policies.recipe import recipe
        from hvs_suite.tasks.shared.scenario import TEST_SCENARIOS

        if self.episodes is not None and self.episodes < 1:
            raise OptionError(f"--episodes must be at least 1, not {self.episodes}")
        plan = recipe(self.task)
        episodes = self.episodes or EPISODES.get(self.task, TEST_SCENARIOS)
        stages = {"record": _going_on(plan.record)}
        stages |= {f"{words[0]} {_out(words).name}": _going_on(words) for words in plan.earlier}
        results: dict[str, Path] = {}
        for name, train in (("pretrained", plan.pretrain), ("fine-tuned", plan.finetune)):
            if train is None:
                continue
            results[name] = Path("runs/results") / f"{_out(train).name}-on-{self.task}.json"
            score = f"evaluate --task {self.task} --episodes {episodes} --workers 2"
            files = ["--policy", str(_out(train)), "--out", str(results[name])]
            stages[train[0]] = [*train]
            stages[f"evaluate, {name}"] = [*score.split(), *files]
        times_s: dict[str, float] = {}
        lines = {stage: shlex.join(["hvs", *words]) for stage, words in stages.items()}
        for stage, words in stages.items():
            with console.stage(lines[stage], times_s):
                parse(words).run()
        console.print_times({stage: times_s[line] for stage, line in lines.items()})
        for name, result in results.items():
            summary = json.loads(result.read_text(encoding="utf-8"))["summary"]
            low, high = summary["pc_success_ci95"]
            print(
                f"{self.task}, {name}: {summary['n_success']} of {summary['n_episodes']} solved, "
                f"{summary['pc_success']:.1f} % (95 % interval {low:.1f} to {high:.1f} %), "
                f"{summary['n_collision']} collisions"
            )


def _going_on(words: Sequence[str]) -> list[str]:
    """A command; a recording that was begun has to be told to go on, a training does by itself."""
    begun = words[0] == "record" and (_out(words) / "hvs.json").exists()
    return [*words, "--resume"] if begun else [*words]


def _out(words: Sequence[str]) -> Path:
    """The folder that a command writes."""
    return Path(words[words.index("--out") + 1])
