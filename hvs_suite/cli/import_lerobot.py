"""``hvs import-lerobot``: take an evaluation by lerobot-eval in, as unverified."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from hvs_suite.names import shown


@dataclasses.dataclass(frozen=True, kw_only=True)
class ImportLerobot:
    """Import an eval_info.json of lerobot-eval, unverified: for comparing, not for the board.

    Attributes:
        file: The eval_info.json.
        task: Named task that was evaluated; one of them if the file has several.
        policy: Name for the policy, because the file does not contain it.
        out: File to write (JSON), replaced if it exists.
        split: Split that was played.
        seed: First seed that lerobot-eval was given; 1000 is its default.
    """

    file: Annotated[tyro.conf.Positional[Path], tyro.conf.arg(metavar="FILE")]
    task: str
    policy: str
    out: Path
    split: str = "test"
    seed: int = 1000

    def run(self) -> int:
        """Import the file and print what it claims."""
        from hvs_suite.eval.scoring import lerobot_import

        result = lerobot_import.read(
            self.file, task=self.task, policy=self.policy, split=self.split, seed=self.seed
        )
        lerobot_import.write(result, self.out)
        summary = result.summary
        low, high = summary.pc_success_ci95
        print(
            f"{shown(summary.policy)} on {summary.task}, unverified: {summary.n_success} of "
            f"{summary.n_episodes} ({low:.1f} to {high:.1f} %)"
        )
        print(f"Written to {self.out}")
        return 0
