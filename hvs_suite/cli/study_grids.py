"""The thesis's questions as studies, each a grid of trainings."""

import abc
import dataclasses
from pathlib import Path
from typing import TYPE_CHECKING, Literal

from hvs_suite.cli import console, study_files
from hvs_suite.cli.players import players
from hvs_suite.errors import OptionError

if TYPE_CHECKING:
    from hvs_suite.eval.studies.grid import Plan, Study


@dataclasses.dataclass(frozen=True, kw_only=True)
class Grid(abc.ABC):
    """Options of all studies that train in several ways and compare.

    Attributes:
        out: Folder of the study: study.json, study.md, study.png; cells/, a JSON file for each
            setting and seed; data/ and runs/.
        cell: Setting to make, such as "no joints"; give it several times; all by default. What it
            is compared with is made as well.
        seeds: Runs of every setting, if not as many as fit into six hours on two cores.
        quick: Try everything out in minutes: next to no training, two scenes.
        processes: Processes that make cells side by side, each on one core; without it 2, or with
            --ray one for each core of the cluster.
        ray: Make cells on a Ray cluster, whose machines see OUT under the same name
            (docs/many-machines.md): auto, an address such as 10.0.0.1:6379, or local.
    """

    out: Path
    cell: tuple[str, ...] = ()
    seeds: int | None = None
    quick: bool = False
    processes: int | None = None
    ray: str | None = None

    @abc.abstractmethod
    def plan(self) -> "Plan":
        """What the study makes."""

    def run(self) -> None:
        """Make it, showing how it goes; write and print what was found."""
        from hvs_suite.eval.studies import grid, grid_report
        from hvs_suite.files import check_writable

        plan = self.plan()
        if self.seeds is not None:
            plan = dataclasses.replace(plan, seeds=self.seeds)
        check_writable(self.out / "study.json")

        def write(study: "Study") -> str:
            text = grid_report.markdown(study)
            study_files.write_json(self.out, study)
            study_files.write_report(self.out, text, grid_report.draw(study))
            return text

        with console.meter() as update:
            study = grid.run_grid(
                plan,
                self.out,
                update,
                names=self.cell,
                workers=players(self.processes, self.ray, local=2),
                on_finished=write,
            )
        study_files.say(self.out, write(study))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inputs(Grid):
    """Measure which inputs a policy needs: each camera, joint positions, joint velocities.

    The thesis's twelve combinations (its study D.1), by imitation, on a still target and on a
    moving one. Interrupted, the same command goes on.
    """

    def plan(self) -> "Plan":
        """The twelve combinations."""
        from hvs_suite.eval.studies import inputs

        return inputs.plan(quick=self.quick)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Resolution(Grid):
    """Measure how small the picture of each camera may be, and whether it needs colour.

    The thesis's study D.2, by imitation, on a level and on a tilted surface. Interrupted, the same
    command goes on.

    """

    def plan(self) -> "Plan":
        """Its cells."""
        from hvs_suite.eval.studies import resolution

        return resolution.plan(quick=self.quick)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Randomisation(Grid):
    """Measure what training with disturbances costs without them, and gives with them.

    The thesis's study D.3, by imitation, on align-hard: trained with nothing, with each and with
    everything, and played with each. Interrupted, the same command goes on.

    """

    def plan(self) -> "Plan":
        """Its cells."""
        from hvs_suite.eval.studies import randomisation

        return randomisation.plan(quick=self.quick)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rewards(Grid):
    """Measure which rewards help RL that begins with a few demonstrations.

    The thesis's six sets (its study D.4), and the shapings that it wished for, on align-thesis.
    Interrupted, the same command goes on.

    """

    def plan(self) -> "Plan":
        """Its cells."""
        from hvs_suite.eval.studies import rewards

        return rewards.plan(quick=self.quick)


@dataclasses.dataclass(frozen=True, kw_only=True)
class StartGoal(Grid):
    """Measure what a fixed start or a fixed goal in training changes.

    The thesis's study D.5, by imitation and by RL, on align-thesis; each policy plays all four
    combinations. Interrupted, the same command goes on.

    """

    def plan(self) -> "Plan":
        """Its cells."""
        from hvs_suite.eval.studies import start_goal

        return start_goal.plan(quick=self.quick)


@dataclasses.dataclass(frozen=True, kw_only=True)
class CurriculumStudy(Grid):
    """Measure what a curriculum buys RL that begins with a few demonstrations.

    The thesis's study D.6, on align-thesis: none, one of tolerances, one of starts. Interrupted,
    the same command goes on.

    """

    def plan(self) -> "Plan":
        """Its cells."""
        from hvs_suite.eval.studies import curriculum

        return curriculum.plan(quick=self.quick)


@dataclasses.dataclass(frozen=True, kw_only=True)
class ThesisRuns(Grid):
    """Train the thesis's fourteen runs of SAC from scratch, at a budget that you name.

    Recipes A to N have the values that the thesis had, on align-thesis. Interrupted, the same
    command goes on.


    Attributes:
        steps: Environment steps of each run; the thesis had up to 500,000.
    """

    steps: int = 20_000

    def plan(self) -> "Plan":
        """Its cells."""
        from hvs_suite.eval.studies import thesis_runs

        if self.seeds is not None:
            raise OptionError("the runs have the thesis's seeds; leave --seeds out")
        return thesis_runs.plan(steps=self.steps, quick=self.quick)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Ablation(Grid):
    """Measure what each design choice of the hvs policy contributes, by training without it.

    On one task a family. Every policy of a task learns from the same data with the same steps, and
    is judged on the same scenarios of split dev. Interrupted, the same command goes on.

    Attributes:
        task: Named task; give it several times; one of each family by default.
    """

    task: tuple[str, ...] = ()

    def plan(self) -> "Plan":
        """The policy as it is, and without one thing at a time."""
        from hvs_suite.eval.studies import ablation

        return ablation.plan(self.task, quick=self.quick)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FewDemonstrations(Grid):
    """Measure what RL adds where demonstrations are few, and what DAgger does.

    Bases learn from a few demonstrations by cloning alone. From each, RL fine-tuning and DAgger get
    the same number of environment steps; RL from scratch gets them without a base. Interrupted, the
    same command goes on.

    Attributes:
        task: Named task.
        demonstrations: How many to learn from; give it several times; 25, 50, 100 and 200 by
            default. The most are recorded, and the first ones are for all.
        noise: See hvs record (rad).
        teacher: Who labels the steps of DAgger; give it several times; the demonstrator by default.
        env_steps: Environment steps of each way.
        base_steps: Optimiser steps of each base.
        imitation_steps: Optimiser steps of DAgger, its base's included.
        imitation_rounds: Rounds that its environment steps are spread over.
        reach_m: How far from the goal fine-tuning moves it (m).
        curriculum: Easier levels that fine-tuning begins on: wider tolerances, or starts near the
            goal; none by default.
        eyes: Named task of whose shipped weights all eyes begin with; fresh ones by default.
        episodes: Scenes of split dev that bases and ends are judged on.
    """

    task: str
    demonstrations: tuple[int, ...] = ()
    noise: float = 0.02
    teacher: tuple[Literal["demonstrator", "expert", "servo"], ...] = ()
    env_steps: int = 16_000
    base_steps: int = 1_000
    imitation_steps: int = 2_500
    imitation_rounds: int = 4
    reach_m: float = 10.0
    curriculum: Literal["tolerance", "start"] | None = None
    eyes: str | None = None
    episodes: int = 200

    def plan(self) -> "Plan":
        """Bases, what comes of each, and RL without one."""
        from hvs_suite.eval.studies import few_demonstrations

        return few_demonstrations.plan(
            self.task,
            demonstrations=self.demonstrations or (25, 50, 100, 200),
            noise=self.noise,
            teachers=self.teacher or ("demonstrator",),
            env_steps=self.env_steps,
            base_steps=self.base_steps,
            imitation_steps=self.imitation_steps,
            imitation_rounds=self.imitation_rounds,
            reach_m=self.reach_m,
            curriculum=self.curriculum,
            eyes=self.eyes,
            episodes=self.episodes,
            quick=self.quick,
        )
