"""``hvs study search``: settings of a learner, proposed by Optuna."""

import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from hvs_suite.cli import console, study_files
from hvs_suite.cli.players import players

if TYPE_CHECKING:
    from hvs_suite.eval.studies import search


@dataclasses.dataclass(frozen=True, kw_only=True)
class SearchStudy:
    """Search the settings of a learner by Bayesian optimisation, and say which of them matter.

    Trains policies of align-thesis with settings that Optuna proposes from what the trials before
    reached on split dev. Interrupted, the same command goes on; with more trials it searches on.

    Attributes:
        out: Folder of the study: study.json, study.md, study.png; search.journal, Optuna's own
            file; cells/, data/ and runs/.
        learner: What to search: imitation, or rl for fine-tuning after a few demonstrations.
        trials: Trials in all; by default 80 of imitation or 40 of RL, which two cores make in six
            hours.
        quick: Try everything out in minutes: next to no training, two scenes, four trials.
        processes: Processes that make trials side by side, each on one core; without it 2, or with
            --ray one for each core of the cluster.
        ray: Make trials on a Ray cluster, whose machines see OUT under the same name
            (docs/many-machines.md): auto, an address such as 10.0.0.1:6379, or local.
    """

    out: Path
    learner: Literal["imitation", "rl"] = "imitation"
    trials: int | None = None
    quick: bool = False
    processes: int | None = None
    ray: str | None = None

    def run(self) -> None:
        """Search, showing how it goes; write and print what was found."""
        from hvs_suite.eval.studies import search, search_report
        from hvs_suite.files import check_writable

        check_writable(self.out / "study.json")
        trials = self.trials
        if trials is None:
            trials = search.QUICK_TRIALS if self.quick else search.TRIALS[self.learner]

        def write(found: "search.Search") -> str:
            text = search_report.markdown(found)
            study_files.write_json(self.out, found)
            study_files.write_report(self.out, text, search_report.draw(found))
            return text

        with console.meter() as update:
            found = search.run_search(
                self.learner,
                self.out,
                update,
                trials=trials,
                episodes=2 if self.quick else 200,
                quick=self.quick,
                workers=players(self.processes, self.ray, local=2),
                on_finished=write,
            )
        study_files.say(self.out, write(found))
