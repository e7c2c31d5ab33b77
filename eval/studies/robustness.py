"""Where a policy breaks: one thing at a time differs from the task as named, and all together.

The axes and their strengths are the task's own (`Spec.robustness_axes`). Every cell plays the same
scenes, so that it is paired with the undisturbed ones, and is a result file of its own with its
log: `hvs verify` plays it again, and what is finished is not played twice.
"""

import dataclasses
import difflib
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hvs_suite import files, registry
from hvs_suite.errors import OptionError, OutputError
from hvs_suite.eval import protocol
from hvs_suite.eval.scoring import contender, provenance, result_file
from hvs_suite.eval.scoring.contender import Contender
from hvs_suite.eval.scoring.result_file import Result
from hvs_suite.eval.scoring.robustness_file import (
    ALL,
    Cell,
    Played,
    Robustness,
    solved_in,
)
from hvs_suite.eval.studies.training import Report
from hvs_suite.executor import Workers
from hvs_suite.tasks.shared import lock
from hvs_suite.tasks.shared.robustness import STRENGTHS, Axis, Options
from hvs_suite.tasks.shared.scenario import TEST_SPLIT

CELLS = "cells"
"""Folder of the results, below the study's."""
UNDISTURBED = "undisturbed"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Plan:
    """What is to be played.

    Attributes:
        policy: As `hvs_suite.policies.catalogue.policy_factory` takes it.
        task: Named task.
        axes: Names of axes; all of them, and all together, by default.
        split: Split whose first scenes are played.
        episodes: Scenes a cell.
        workers: Processes that play, or others elsewhere.
    """

    policy: str
    task: str
    axes: Sequence[str] = ()
    split: str = TEST_SPLIT
    episodes: int = 200
    workers: Workers = 1


def chosen_axes(task: str, names: Sequence[str] = ()) -> list[Axis]:
    """The axes of a task that were asked for, in the task's own order.

    Args:
        task: Named task.
        names: Of axes, ``all`` among them; all by default.

    Raises:
        UnknownTaskError: There is no such task.
        OptionError: There is no such axis, or it makes no sense for the task.
    """
    spec = registry.find(task)
    axes = {axis.name: axis for axis in spec.robustness_axes()}
    axes[ALL] = _all_together(list(axes.values()))
    for name in names:
        if name not in axes:
            close = difflib.get_close_matches(name, axes, n=1)
            hint = f"did you mean {close[0]}?" if close else f"use {', '.join(axes)}"
            raise OptionError(f"there is no axis {name!r}; {hint}")
        if not axes[name].options:
            raise OptionError(f"{task} has no axis {name}: {axes[name].anchor}")
    return [axis for axis in axes.values() if not names or axis.name in names]


def run_study(
    plan: Plan,
    out: Path,
    report: Report,
    on_cell: Callable[[Robustness], object] = lambda study: None,
) -> Robustness:
    """Play every cell, or go on where an earlier call was interrupted.

    Args:
        plan: What is to be played.
        out: Folder of the study.
        report: Called as the work goes on.
        on_cell: Called with what is finished so far, after each cell.

    Raises:
        UnknownTaskError: There is no such task.
        OptionError: An axis or a number makes no sense.
        PolicyError: There is no such policy, or it does not fit the task.
        OutputError: ``out`` cannot be written, or holds another study.
    """
    axes = chosen_axes(plan.task, plan.axes)
    player = contender.find(plan.policy, plan.task)
    for name in (UNDISTURBED, *(_cell_name(axis, s) for axis in axes for s in STRENGTHS)):
        files.check_writable(_path(out, name))
    steps = 1 + sum(len(axis.options) for axis in axes)
    player_of = _Player(plan, player, out, report, steps)
    undisturbed = player_of.play(UNDISTURBED, UNDISTURBED, {}, 0)
    study = Robustness(
        schema_version=1,
        policy=player.name,
        policy_hash=player.hash,
        task=plan.task,
        task_digest=lock.digest(plan.task),
        suite_version=provenance.suite_version(),
        gl_renderer=undisturbed.metadata.gl_renderer,
        split=plan.split,
        episodes=plan.episodes,
        undisturbed=Played.of(undisturbed),
        cells=[],
        missing={axis.name: axis.anchor for axis in axes if not axis.options},
    )
    done = 0
    for axis in axes:
        for strength, level, options in zip(
            STRENGTHS[: len(axis.options)], axis.levels, axis.options, strict=True
        ):
            done += 1
            words = f"{axis.title}, {strength}"
            result = player_of.play(_cell_name(axis, strength), words, options, done)
            solved = solved_in(result)
            cell = Cell(
                axis=axis.name,
                title=axis.title,
                strength=strength,
                level=level,
                options=result.metadata.options,
                **Played.figures(solved, result.summary.n_collision),
                **Cell.paired(solved, study.undisturbed.solved),
            )
            study = study.model_copy(update={"cells": [*study.cells, cell]})
            on_cell(study)
    return study


@dataclasses.dataclass(frozen=True)
class _Player:
    """Plays the cells of one study.

    Attributes:
        plan: What is to be played.
        contender: The policy.
        out: Folder of the study.
        report: Called as the work goes on.
        cells: How many there are.
    """

    plan: Plan
    contender: Contender
    out: Path
    report: Report
    cells: int

    def play(self, name: str, words: str, options: Options, done: int) -> Result:
        """Play a cell, or read it if it is there.

        Args:
            name: Of its file.
            words: The cell in words.
            options: Options of the task.
            done: Cells that are finished.

        Raises:
            OutputError: Another study's cell is in its place.
        """
        plan, path = self.plan, _path(self.out, name)
        if path.exists():
            result = result_file.load(path)
            self._check_same(result, path, options)
            return result
        n_played = n_success = 0

        def note(trial: Any) -> None:
            nonlocal n_played, n_success
            n_played += 1
            n_success += trial.row.success
            share = (done + n_played / plan.episodes) / self.cells
            self.report(words, share, f"{n_success} of {n_played} solved")

        return protocol.evaluate(
            plan.policy,
            plan.task,
            path,
            split=plan.split,
            episodes=plan.episodes,
            options=options,
            workers=plan.workers,
            progress=note,
        )

    def _check_same(self, result: Result, path: Path, options: Options) -> None:
        plan = self.plan
        spec = registry.find(plan.task).with_options(options)
        ours = {
            "policy": (self.contender.name, result.summary.policy),
            "policy_hash": (self.contender.hash, result.metadata.policy_hash),
            "task": (plan.task, result.summary.task),
            "task_digest": (lock.digest(plan.task), result.metadata.task_digest),
            "split": (plan.split, result.summary.split),
            "episodes": (plan.episodes, result.summary.n_episodes),
            "options": (registry.options_of(spec), result.metadata.options),
        }
        if different := [name for name, (one, other) in ours.items() if one != other]:
            raise OutputError(
                f"{path} belongs to another study ({', '.join(different)} differs); name another "
                "--out, or remove it"
            )


def _all_together(axes: Sequence[Axis]) -> Axis:
    """All axes that make sense, at the same strength."""
    present = [axis for axis in axes if axis.options]
    options: list[Options] = [
        {name: value for axis in present for name, value in axis.options[number].items()}
        for number in range(len(STRENGTHS))
    ]
    return Axis(
        ALL,
        "all together",
        "all axes at this strength",
        tuple(f"all {strength}" for strength in STRENGTHS),
        tuple(options),
    )


def _cell_name(axis: Axis, strength: str) -> str:
    return f"{axis.name}-{strength}"


def _path(out: Path, name: str) -> Path:
    return out / CELLS / f"{name}.json"
