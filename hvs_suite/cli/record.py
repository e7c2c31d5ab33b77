"""``hvs record``: demonstrations as a LeRobot dataset."""

import dataclasses
import shlex
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from hvs_suite.cli import console
from hvs_suite.cli.players import Players

if TYPE_CHECKING:
    from hvs_suite.datasets.recorder import Progress


@dataclasses.dataclass(frozen=True, kw_only=True)
class Record(Players):
    """Record demonstrations as a LeRobot dataset, of the expert or of any policy.

    Plays scenarios 0 to N-1 of the split; failures are kept and marked.

    Attributes:
        task: A named task, such as align-easy.
        episodes: Number of episodes to record.
        out: Root folder of the dataset; must not exist or be empty, unless --resume is given.
        split: Name of the split the scenarios come from.
        resume: Continue a recording that was interrupted.
        start: Where the arm starts, if not where the task says; mixed starts half of the episodes
            near the goal.
        noise: Standard deviation of a disturbance of the executed joint targets, far from the goal
            (rad); the demonstrator's own action stays the label. Over surfaces of unknown slope the
            expert also goes astray near the goal, for a time.
        policy: What demonstrates: expert, servo, a checkpoint folder, or code of your own as
            module:factory, whose factory gets the environment and may know what is true.
        option: Parameter of the task to change for a study, such as target_diameter_m=0.03; give it
            several times for several. The dataset then records this and does not count as one of
            the named task.
    """

    task: str
    episodes: int
    out: Path
    split: str = "train"
    resume: bool = False
    start: Literal["zero", "random", "near_goal", "mixed"] | None = None
    noise: float = 0.0
    policy: str = "expert"
    option: tuple[str, ...] = ()

    def run(self) -> None:
        """Record, showing how it goes, and say what was recorded."""
        from hvs_suite import registry
        from hvs_suite.datasets.metadata import EXPERT
        from hvs_suite.datasets.recorder import record
        from hvs_suite.policies.catalogue import demonstrator_factory

        start = () if self.start is None else (f"start={self.start}",)
        options = registry.find(self.task).options_from_text((*start, *self.option))
        # The recorder's own expert also looks for targets that no camera shows yet.
        own = self.policy == EXPERT
        make = None if own else demonstrator_factory(self.policy, self.task, options)
        with console.meter() as update:
            done = record(
                self.task,
                self.episodes,
                self.split,
                self.out,
                options,
                workers=self.players(),
                noise=self.noise,
                demonstrator=self.policy,
                make=make,
                resume=self.resume,
                progress=lambda state: update(
                    "recording", state.episodes / state.total, _words(state)
                ),
                command=shlex.join(["hvs", *sys.argv[1:]]),
            )
        print(f"{done.episodes} episodes, {done.successes} of them solved; wrote {self.out}")


def _words(state: "Progress") -> str:
    """Count, rate and time left, in words."""
    left = "" if state.remaining_s is None else f", {state.remaining_s:.0f} s left"
    return (
        f"{state.episodes}/{state.total}, {state.successes} solved, "
        f"{state.episodes_per_s:.1f} episodes/s{left}"
    )
