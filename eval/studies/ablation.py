"""What each choice of the `hvs` policy contributes: trained without it, on the same scenarios.

Every policy has the same data, seed and number of optimiser steps as the whole one, but for the one
thing that its row names. All lie in one folder, a sub-folder each; what is finished there is not
done again.
"""

import dataclasses
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import pydantic

from hvs_suite.errors import OptionError
from hvs_suite.eval.scoring.comparison import Tally
from hvs_suite.eval.scoring.result_file import Result
from hvs_suite.eval.studies.training import SPLIT, Note, Report, train_and_judge
from hvs_suite.executor import Workers
from hvs_suite.policies.imitation.settings import Settings
from hvs_suite.policies.training.dataset import read_manifest
from hvs_suite.registry import find

WHOLE = "everything"
NO_DAGGER = "no DAgger"
# A joint's step is seldom above this (rad), so errors weigh the same all over.
LINEAR_SCALE = 0.5


@dataclasses.dataclass(frozen=True)
class Ablation:
    """One thing left out.

    Attributes:
        options: Of `pretrain`, other than the whole policy's.
        data_share: Of the demonstrations.
        against: The row it is compared with.
    """

    options: Mapping[str, Any] = MappingProxyType({})
    data_share: float = 1.0
    against: str = WHOLE


_ALONE: Mapping[str, Any] = MappingProxyType({"dagger_rounds": 0})
_FRAMES = Settings.windows * Settings.window_steps
ABLATIONS: Mapping[str, Ablation] = MappingProxyType(
    {
        WHOLE: Ablation(),
        "windows of one frame": Ablation({"window_steps": 1, "windows": _FRAMES}),
        "linear joint steps": Ablation({"error_scale": LINEAR_SCALE}),
        NO_DAGGER: Ablation(_ALONE),
        "no eye in hand": Ablation({"inputs": ("eth",)}),
        "no eye to hand": Ablation({"inputs": ("eih",)}),
        "no DAgger, 1/4 of the data": Ablation(_ALONE, 1 / 4, NO_DAGGER),
        "no DAgger, 1/16 of the data": Ablation(_ALONE, 1 / 16, NO_DAGGER),
    }
)
"""What is left out, by name; every row comes after the one it is compared with."""


class Row(pydantic.BaseModel):
    """One policy.

    Attributes:
        name: What it lacks.
        against: The row it is compared with; None for the first.
        n: Scenarios played.
        n_success: Solved.
        ci95: Wilson's 95 % interval (%).
        n_collision: Ended in a forbidden contact.
        n_only_other: Solved by the other row alone.
        n_only_this: Solved by this row alone.
        p: Of McNemar's exact test between them.
        steps_to_goal: Mean control steps to the goal; None if none was solved.
        settled_error: Interquartile mean of the task's first headline metric where it settles.
        demonstrations: Episodes recorded for it.
        hours: Training time, rounds of DAgger not counted (h).
    """

    name: str
    against: str | None
    n: int
    n_success: int
    ci95: tuple[float, float]
    n_collision: int
    n_only_other: int
    n_only_this: int
    p: float
    steps_to_goal: float | None
    settled_error: float
    demonstrations: int
    hours: float


class Study(pydantic.BaseModel):
    """All rows, and what they have in common.

    Attributes:
        task: Named task.
        steps: Optimiser steps of every policy.
        dagger_rounds: Rounds of DAgger, where not left out.
        dagger_frames: Frames a round.
        rows: The whole policy first.
    """

    task: str
    steps: int
    dagger_rounds: int
    dagger_frames: int
    rows: list[Row]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Budget:
    """What every policy gets.

    Attributes:
        steps: Optimiser steps.
        dagger_rounds: Rounds of DAgger.
        dagger_frames: Frames a round.
        seed: Of every training.
        episodes: Scenarios of split ``dev`` that each is judged on.
        workers: Processes that play, or others elsewhere.
    """

    steps: int
    dagger_rounds: int
    dagger_frames: int
    seed: int
    episodes: int
    workers: Workers


def run_study(data: Path, out: Path, names: Sequence[str], budget: Budget, report: Report) -> Study:
    """Train and judge every row, or go on where an earlier call was interrupted.

    Args:
        data: Recorded dataset, whose task is played.
        out: Folder of the study.
        names: Rows of `ABLATIONS` to make; what they are compared with is made as well.
        budget: What every policy gets.
        report: Called as the work goes on.

    Raises:
        OptionError: A name or a number makes no sense.
        DatasetError: The dataset cannot be trained on.
        OutputError: ``out`` cannot be written, or holds another study.
    """
    if unknown := sorted(set(names) - set(ABLATIONS)):
        raise OptionError(f"unknown ablation {unknown[0]!r}; choose from {', '.join(ABLATIONS)}")
    if budget.episodes < 1:
        raise OptionError(f"episodes must be at least 1, not {budget.episodes}")
    wanted = {WHOLE, *names, *(ABLATIONS[name].against for name in names)}
    task = read_manifest(data).task
    results: dict[str, Result] = {}
    rows = []
    for name in (name for name in ABLATIONS if name in wanted):
        results[name], demonstrations, hours = _judged(data, out, name, budget, report)
        rows.append(_row(name, results, demonstrations, hours))
    return Study(
        task=task,
        steps=budget.steps,
        dagger_rounds=budget.dagger_rounds,
        dagger_frames=budget.dagger_frames,
        rows=rows,
    )


def _judged(
    data: Path, out: Path, name: str, budget: Budget, report: Report
) -> tuple[Result, int, float]:
    """Result of a row, how many demonstrations it had and how long it trained (h)."""
    ablation, manifest = ABLATIONS[name], read_manifest(data)
    demonstrations = max(2, round(ablation.data_share * manifest.n_episodes))
    # Another budget is another experiment and lies beside the first.
    folder = out / f"steps-{budget.steps}-rounds-{budget.dagger_rounds}-seed-{budget.seed}"
    folder /= name.replace(",", "").replace("/", "-").replace(" ", "-").lower()
    options: dict[str, Any] = {
        "steps": budget.steps,
        "seed": budget.seed,
        "dagger_rounds": budget.dagger_rounds,
        "dagger_frames": budget.dagger_frames,
        "episodes": demonstrations if ablation.data_share < 1.0 else None,
        **ablation.options,
    }

    def train(policy: Path, note: Note) -> None:
        from hvs_suite.policies.imitation.pretrain import pretrain

        pretrain(data, policy, workers=budget.workers, on_progress=note, **options)

    result = train_and_judge(
        name,
        manifest.task,
        folder,
        train,
        report,
        scenarios=budget.episodes,
        workers=budget.workers,
    )
    return result, demonstrations, result.metadata.training_hours or 0.0


def _row(name: str, results: Mapping[str, Result], demonstrations: int, hours: float) -> Row:
    """A row of the table, compared with another that is there already."""
    summary = results[name].summary
    against = ABLATIONS[name].against
    other, own = (
        {row.scenario: row.success for row in results[each].episodes} for each in (against, name)
    )
    tally = Tally.of(other, own)
    low, high = summary.pc_success_ci95
    return Row(
        name=name,
        against=None if name == WHOLE else against,
        n=summary.n_episodes,
        n_success=summary.n_success,
        ci95=(low, high),
        n_collision=summary.n_collision,
        n_only_other=tally.n_only_a,
        n_only_this=tally.n_only_b,
        p=tally.p,
        steps_to_goal=summary.steps_to_goal_mean,
        settled_error=summary.settled.errors[find(summary.task).headline[0]].iqm,
        demonstrations=demonstrations,
        hours=hours,
    )


def markdown(study: Study) -> str:
    """The study's table."""
    lines = [
        f"`{study.task}`, split `{SPLIT}`: every policy {study.steps:,} optimiser steps, "
        f"{study.dagger_rounds} rounds of DAgger of {study.dagger_frames:,} frames unless left "
        "out.",
        "",
        "| what is left out | demonstrations | solved | 95 % interval | collisions | steps "
        "| settled error, mm | compared with | only it, only this | p |",
        "|---|---|---|---|---|---|---|---|---|---|",
    ]
    for row in study.rows:
        steps = "-" if row.steps_to_goal is None else f"{row.steps_to_goal:.1f}"
        compared = "- | - | -"
        if row.against is not None:
            compared = f"{row.against} | {row.n_only_other}, {row.n_only_this} | {row.p:.2g}"
        lines.append(
            f"| {'nothing' if row.against is None else row.name} | {row.demonstrations:,} | "
            f"{row.n_success} of {row.n} ({100 * row.n_success / row.n:.1f} %) | "
            f"{row.ci95[0]:.1f} to {row.ci95[1]:.1f} % | {row.n_collision} | {steps} | "
            f"{row.settled_error:.2f} | {compared} |"
        )
    return "\n".join(lines) + "\n"


def draw(study: Study) -> Any:
    """Success of every row with its interval, a ``matplotlib.figure.Figure``."""
    from matplotlib.figure import Figure

    rows = study.rows[::-1]
    rates = [100.0 * row.n_success / row.n for row in rows]
    ends = (
        [max(0.0, rate - row.ci95[0]) for rate, row in zip(rates, rows, strict=True)],
        [max(0.0, row.ci95[1] - rate) for rate, row in zip(rates, rows, strict=True)],
    )
    figure = Figure(figsize=(7.0, 0.6 + 0.42 * len(rows)), dpi=130, layout="constrained")
    axes = figure.subplots()
    colours = ["#16803c" if row.against is None else "#2b6cb0" for row in rows]
    axes.barh([row.name for row in rows], rates, xerr=ends, color=colours, capsize=3)
    for place, (rate, row) in enumerate(zip(rates, rows, strict=True)):
        # Behind the interval, where there is room whatever the rate.
        axes.text(row.ci95[1] + 1.5, place, f"{rate:.1f} %", va="center", fontsize=8)
    axes.set(xlim=(0.0, 112.0), xticks=range(0, 101, 20))
    axes.set_xlabel("solved (%), with Wilson's 95 % interval")
    axes.set_title(f"{study.task}: what each choice contributes", fontsize=10, loc="left")
    axes.spines[["top", "right"]].set_visible(False)
    return figure
