"""``hvs failures``: why a policy fails, sorted by cause, with pictures."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Any

import tyro

from hvs_suite.cli import console
from hvs_suite.errors import OptionError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Failures:
    """Sort a policy's lost scenarios by cause: not seen, misplaced, controlled badly, and so on.

    Plays the logged actions again, and asks an hvs policy where it estimated the target.

    Attributes:
        results: Result files of hvs evaluate, with their action logs beside them.
        policy: Checkpoint folder of the hvs policy that made them, or pretrained or finetuned;
            without it nothing counts as misplaced, and no pictures are drawn.
        out: Folder for failures.md and the pictures; by default the table is only printed.
        pictures: Scenarios of each cause to draw.
    """

    results: Annotated[tuple[Path, ...], tyro.conf.Positional]
    policy: str | None = None
    out: Path | None = None
    pictures: int = 2

    def run(self) -> None:
        """Play, sort, draw and print."""
        from hvs_suite.eval.scoring import result_file
        from hvs_suite.eval.studies import failures
        from hvs_suite.files import check_writable, replacing

        if not self.results:
            raise OptionError("name at least one result file of hvs evaluate")
        if self.pictures < 0:
            raise OptionError(f"--pictures must be 0 or more, not {self.pictures}")
        if self.out is not None:
            check_writable(self.out / "failures.md")
        reports = []
        for path in self.results:
            result = result_file.load(path)
            summary = result.summary
            checkpoint = self._checkpoint(summary.task, result.metadata.options)
            lost = summary.n_episodes - summary.n_success
            with console.progress(f"{summary.policy} on {summary.task}", lost) as advance:
                report = failures.sort_failures(path, checkpoint, advance)
            reports.append(report)
            if self.out is not None and checkpoint is not None:
                self._draw(self.out, path, report, checkpoint)
        text = failures.markdown(reports)
        if self.out is not None:
            with replacing(self.out / "failures.md") as temporary:
                temporary.write_text(text, encoding="utf-8")
        print(text, end="")

    def _checkpoint(self, task: str, options: Mapping[str, Any]) -> Path | None:
        """Folder of the policy, if one is named."""
        from hvs_suite.policies.catalogue import policy_factory

        if self.policy is None:
            return None
        folder = getattr(policy_factory(self.policy, task, options), "folder", None)
        if folder is None:
            raise OptionError(f"{self.policy} has no network to ask; name a checkpoint")
        return Path(folder)

    def _draw(self, out: Path, path: Path, report: Any, checkpoint: Path) -> None:
        """What the cameras showed and where the policy looked, for the first of each cause."""
        import hvs_suite
        from hvs_suite.eval.scoring import action_log, result_file
        from hvs_suite.eval.studies import failures
        from hvs_suite.eval.studies.attention import draw_attention
        from hvs_suite.files import replacing

        result = result_file.load(path)
        log = action_log.load(result_file.actions_path(path), result.metadata.actions_sha256)
        with hvs_suite.load(report.task, split=report.split, **report.options) as env:
            for cause in failures.Cause:
                for failure in report.of(cause)[: self.pictures]:
                    player = failures.LoggedPolicy(list(log[failure.scenario][: failure.steps]))
                    sheet = draw_attention(checkpoint, env, player, failure.scenario)
                    name = f"{report.task}-{cause.replace(' ', '-')}-{failure.scenario}.png"
                    with replacing(out / name) as temporary:
                        sheet.save(temporary, "PNG")
