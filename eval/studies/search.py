"""A Bayesian search of a learner's settings, and which of them mattered.

Optuna's TPE proposes settings, a policy is trained with them and judged, and its success decides
what is proposed next. Proposals and outcomes stand in a journal beside the cells, so that a killed
search goes on: trials that had begun are made first, from where they were.

Budget: on one core 4,000 optimiser steps on ``align-thesis`` took 9 minutes (metadata of the
shipped weights' result), so a trial of imitation, 1,000 steps of the default size and 200 scenes,
takes some 5, and 80 trials 7 hours on one core, 3.5 on two; trials with large batches take longer.
RL takes 5 to 6 minutes a trial with 8,000 environment steps (docs/answers.md), and 40 trials 4
hours on one core, 2 on two.
"""

import contextlib
import dataclasses
import warnings
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import pydantic

from hvs_suite.errors import OptionError, OutputError, TrainingError
from hvs_suite.eval.studies.grid import Cell, Finished, Maker, make_all
from hvs_suite.eval.studies.training import Report, Scenes
from hvs_suite.eval.studies.ways import TRIAL, Effort, Way, from_few, imitation, tuned
from hvs_suite.executor import Workers, check_workers, size

if TYPE_CHECKING:
    import optuna

TASK = "align-thesis"
IMITATION = Effort(demonstrations=400, steps=1000)
STUDY_NAME = "hvs"
JOURNAL = "search.journal"
TRIALS = {"imitation": 80, "rl": 40}
QUICK_TRIALS = 4
FEWEST = 10
"""Trials without which nothing is said of what mattered: the best tenth is one of them."""

type Learner = Literal["imitation", "rl"]


@dataclasses.dataclass(frozen=True)
class Range:
    """Numbers to choose from.

    Attributes:
        low: The least.
        high: The largest.
        log: Whether factors count rather than differences.
    """

    low: float
    high: float
    log: bool = False


SPACES: Mapping[str, Mapping[str, Range | Sequence[float]]] = {
    "imitation": {
        "learning_rate": Range(3e-4, 1e-2, log=True),
        "batch_size": (16, 32, 64, 128),
        "windows": (12, 24, 48, 96),
        "window_steps": (4, 8, 16),
        "error_scale": Range(1e-3, 0.5, log=True),
    },
    "rl": {
        "actor_rate": Range(3e-5, 3e-3, log=True),
        "noise": Range(0.05, 0.8),
        "noise_along": Range(0.02, 0.5),
        "penalty": Range(1e-3, 1.0, log=True),
        "gamma": (0.9, 0.95, 0.98, 0.99),
        "shaping": Range(0.0, 0.2),
        "warm_up_steps": (500, 1000, 2000, 4000),
        "updates": (1, 2),
    },
}
"""What is searched, by learner: options of ``hvs pretrain`` and ``hvs finetune``."""


class Tried(pydantic.BaseModel):
    """A trial.

    Attributes:
        number: In the order of the proposals, from 0.
        settings: What was proposed.
        n: Scenes of split ``dev``.
        n_success: Solved; 0 where the training came apart.
        commands: What makes and judges the same policy, line by line.
    """

    number: int
    settings: dict[str, int | float]
    n: int
    n_success: int
    commands: list[str]


class Search(pydantic.BaseModel):
    """All trials so far.

    Attributes:
        task: Named task.
        learner: What was searched.
        trials: In the order of the proposals.
        importances: Share that each setting had in what sets the best tenth of trials apart from
            the others, in sum 1, by PED-ANOVA (Watanabe, Bansal and Hutter, 2023:
            https://arxiv.org/abs/2304.10255); empty where the trials are too few to say, or alike.
    """

    task: str
    learner: Learner
    trials: list[Tried]
    importances: dict[str, float]


def run_search(
    learner: Learner,
    out: Path,
    report: Report,
    *,
    trials: int,
    episodes: int = 200,
    quick: bool = False,
    workers: Workers = 2,
    on_finished: Callable[[Search], object] | None = None,
) -> Search:
    """Search, or go on where an earlier call was interrupted.

    Args:
        learner: Whose settings to search.
        out: Folder of the study.
        report: Called as the work goes on.
        trials: How many to make in all.
        episodes: Scenes that each policy is judged on.
        quick: Make everything in minutes, of next to no training.
        workers: Processes that make trials side by side; or others elsewhere that see the same
            folder. Each batch of so many is proposed knowing all batches before it.
        on_finished: Called with all trials so far, each time that there are more.

    Raises:
        OptionError: A number makes no sense.
        OutputError: ``out`` cannot be written, or holds another search.
    """
    import optuna

    check_workers(workers)
    for name, number in (("trials", trials), ("episodes", episodes)):
        if number < 1:
            raise OptionError(f"{name} must be at least 1, not {number}")
    out.mkdir(parents=True, exist_ok=True)
    study = _study(out / JOURNAL, learner, quick, episodes)
    make = _Trials(out, out.resolve(), episodes)

    def found() -> Search:
        done = [each for each in study.trials if each.value is not None]
        return Search(
            task=TASK,
            learner=learner,
            trials=[
                Tried(
                    number=each.number,
                    settings=each.params,
                    n=episodes,
                    n_success=round(episodes * (each.value or 0.0)),
                    commands=make.commands(_cell(learner, each.number, each.params, quick), 0),
                )
                for each in done
            ],
            importances=_importances(study),
        )

    while True:
        begun = study.get_trials(states=[optuna.trial.TrialState.RUNNING])
        # Killed amid a proposal, a trial keeps what was proposed and is proposed the rest.
        settings = {
            each.number: _propose(optuna.Trial(study, each._trial_id), learner) for each in begun
        }
        left = trials - len(study.trials)
        for _ in range(max(0, min(size(workers), left) - len(settings))):
            # The state of a sampler is not kept; a seed a trial proposes the same after a kill.
            study.sampler = _sampler(len(study.trials))
            trial = study.ask()
            settings[trial.number] = _propose(trial, learner)
        if not settings:
            return found()
        cells = [_cell(learner, number, chosen, quick) for number, chosen in settings.items()]
        kept = {cell.name: make.read(cell, 0) for cell in cells}
        missing = [(cell, 0) for cell in cells if kept[cell.name] is None]
        for each in make_all(make, missing, workers, report):
            kept[each.name] = each
        for number, cell in zip(settings, cells, strict=True):
            finished = kept[cell.name]
            # Not as a failure, from which the sampler would learn nothing.
            solved = finished.judged[0].solved if finished is not None else "0"
            study.tell(number, solved.count("1") / len(solved))
        if on_finished is not None:
            on_finished(found())


class _Trials(Maker):
    """Makes trials; of one whose training comes apart, nothing."""

    def _cell(self, cell: Cell, seed: int, report: Report) -> Finished | None:
        with contextlib.suppress(TrainingError):
            return super()._cell(cell, seed, report)
        return None


def _study(journal: Path, learner: Learner, quick: bool, episodes: int) -> "optuna.Study":
    """The search that a journal keeps, or a new one."""
    import optuna
    from optuna.storages import JournalStorage
    from optuna.storages.journal import JournalFileBackend

    optuna.logging.set_verbosity(optuna.logging.WARNING)
    try:
        storage = JournalStorage(JournalFileBackend(str(journal)))
        study = optuna.create_study(
            storage=storage, study_name=STUDY_NAME, direction="maximize", load_if_exists=True
        )
    except (OSError, ValueError, KeyError) as error:
        raise OutputError(f"{journal} is no search; choose another folder") from error
    wanted = {"learner": learner, "quick": quick, "episodes": episodes}
    kept = study.user_attrs
    if kept and kept != wanted:
        raise OutputError(
            f"{journal} is of another search ({kept}); give the same again, or choose another "
            "folder"
        )
    for name, value in wanted.items():
        if name not in kept:
            study.set_user_attr(name, value)
    return study


def _sampler(seed: int) -> "optuna.samplers.BaseSampler":
    import optuna

    with warnings.catch_warnings():
        # Experimental in name since 2020.
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        return optuna.samplers.TPESampler(seed=seed, constant_liar=True)


def _propose(trial: "optuna.Trial", learner: Learner) -> dict[str, float]:
    chosen: dict[str, float] = {}
    for name, space in SPACES[learner].items():
        if isinstance(space, Range):
            chosen[name] = trial.suggest_float(name, space.low, space.high, log=space.log)
        else:
            chosen[name] = trial.suggest_categorical(name, list(space))
    return chosen


def _cell(learner: Learner, number: int, settings: Mapping[str, Any], quick: bool) -> Cell:
    way: Way
    if learner == "imitation":
        effort = TRIAL if quick else IMITATION
        way = imitation(TASK, effort, **settings)
    else:
        way = tuned(from_few(TASK, quick=quick), TASK, quick=quick, settings=settings)
    return Cell(group=TASK, name=f"trial {number}", way=way, on=[Scenes(task=TASK)])


def _importances(study: "optuna.Study") -> dict[str, float]:
    import optuna

    values = [each.value for each in study.trials if each.value is not None]
    if len(values) < FEWEST or len(set(values)) == 1:
        return {}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", optuna.exceptions.ExperimentalWarning)
        evaluator = optuna.importance.PedAnovaImportanceEvaluator()
        return dict(optuna.importance.get_param_importances(study, evaluator=evaluator))
