"""``hvs study``: experiments about the suite itself, each by one command."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from hvs_suite.cli import console, study_files, study_grids, study_search
from hvs_suite.cli.players import Players
from hvs_suite.errors import OptionError

# As `hvs demo` records: without disturbance and starts near the goal nothing is learnt.
NOISE_RAD = 0.02


@dataclasses.dataclass(frozen=True, kw_only=True)
class Compression(Players):
    """Measure what video compression costs against lossless PNG.

    Each setting's videos are made with LeRobot's own conversion and decoded again. Reported are
    their size, how far a classical detector's answers move, and the success of a policy that
    learned from the decoded pictures, on live scenarios of split dev. Interrupted, the same
    command goes on; settings may be added later.

    Attributes:
        out: Folder of the study: study.json, study.md, study.png, and a sub-folder a setting.
        data: Lossless dataset to take; without it, one is recorded into the folder.
        task: Named task to record.
        demonstrations: Episodes to record.
        setting: codec:crf or codec:crf:pixel_format, such as h264:23:yuv444p; codecs are av1 and
            h264. Give it several times; a dozen by default, LeRobot's own av1:30 among them.
        steps: Optimiser steps of each setting's policy; 0 trains none.
        episodes: Scenarios that each policy is judged on.
        seed: Of every policy's weights and order.
    """

    out: Path
    data: Path | None = None
    task: str = "align-thesis"
    demonstrations: int = 1000
    setting: tuple[str, ...] = ()
    steps: int = 1500
    episodes: int = 200
    seed: int = 0

    def run(self) -> None:
        """Measure, showing how it goes; write and print what was found."""
        from hvs_suite.eval.studies import compression, compression_report
        from hvs_suite.files import check_writable

        check_writable(self.out / "study.json")
        settings = self.setting or compression.DEFAULT_SETTINGS
        encodings = [compression.parse_setting(text) for text in settings]
        training = compression.Training(self.steps, self.seed, self.episodes, self.players(local=2))
        compression.check(encodings, training)
        data = self._recorded() if self.data is None else self.data
        with console.meter() as update:
            study = compression.run_study(data, self.out, encodings, training, update)
        study_files.write_json(self.out, study)
        text = compression_report.markdown(study)
        study_files.write_report(self.out, text, compression_report.draw(study))
        study_files.say(self.out, text)

    def _recorded(self) -> Path:
        """The study's own recording, gone on with where it was interrupted."""
        from hvs_suite.cli.record import Record

        data = self.out / "dataset"
        Record(
            task=self.task,
            episodes=self.demonstrations,
            out=data,
            start="mixed",
            noise=NOISE_RAD,
            workers=self.workers or (2 if self.ray is None else None),
            ray=self.ray,
            resume=True,
        ).run()
        return data


@dataclasses.dataclass(frozen=True, kw_only=True)
class Robustness(Players):
    """Measure where a policy fails when one thing at a time differs from the task.

    Light, colours, texture, camera poses, noise, blur, latency, joint offsets, distractors, target
    and all of them together come unannounced: the policy is told of the task as named. Each scene
    is paired with the undisturbed one. Interrupted, the same command goes on.

    Attributes:
        task: Named task.
        out: Folder of the study: study.json, study.md, study.png, and a result file a cell.
        policy: As 'hvs evaluate' takes it.
        axis: What to disturb, such as light; give it several times; everything by default.
        split: Split whose first scenes are played.
        episodes: Scenes a cell; undisturbed ones are played as well.
        beside: Another study.json of the same task, to draw beside this one; give it several times.
    """

    task: str
    out: Path
    policy: str
    axis: tuple[str, ...] = ()
    split: str = "test"
    episodes: int = 200
    beside: tuple[Path, ...] = ()

    def run(self) -> None:
        """Play, showing how it goes; write and print what was found."""
        from hvs_suite.eval.scoring import robustness_file
        from hvs_suite.eval.studies import robustness, robustness_report
        from hvs_suite.files import check_writable

        check_writable(self.out / "study.json")
        others = [robustness_file.load(path) for path in self.beside]
        for path, other in zip(self.beside, others, strict=True):
            if other.task != self.task:
                raise OptionError(f"{path} is a study of {other.task}, not of {self.task}")
        plan = robustness.Plan(
            policy=self.policy,
            task=self.task,
            axes=self.axis,
            split=self.split,
            episodes=self.episodes,
            workers=self.players(),
        )
        with console.meter() as update:
            study = robustness.run_study(
                plan, self.out, update, lambda found: study_files.write_json(self.out, found)
            )
        text = robustness_report.markdown(study)
        study_files.write_report(self.out, text, robustness_report.draw([study, *others]))
        console.print_table(
            robustness_report.COLUMNS,
            robustness_report.rows(study),
            robustness_report.title(study),
        )
        print(f"wrote {self.out / 'study.json'}, study.md and study.png")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Attention:
    """Draw where an hvs policy looks in both cameras, through one episode.

    Yellow is its attention; the cross is where it takes the target to be, the circle where it is.

    Attributes:
        policy: Checkpoint folder, or pretrained for the weights shipped for the task.
        task: Named task.
        out: Picture to write (.png).
        split: Split of the scenario.
        scenario: Which one.
    """

    policy: str
    task: str
    out: Path
    split: str = "dev"
    scenario: int = 0

    def run(self) -> None:
        """Play, draw and write."""
        import hvs_suite
        from hvs_suite.eval.studies.attention import draw_attention
        from hvs_suite.files import check_writable, replacing
        from hvs_suite.policies.catalogue import policy_factory

        check_writable(self.out)
        make = policy_factory(self.policy, self.task)
        folder = getattr(make, "folder", None)
        if folder is None:
            raise OptionError(f"{self.policy} has no network to look into; name a checkpoint")
        with hvs_suite.load(self.task, split=self.split) as env:
            sheet = draw_attention(Path(folder), env, make(env), self.scenario)
        with replacing(self.out) as temporary:
            sheet.save(temporary, "PNG")
        print(f"wrote {self.out}")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Study:
    """Run an experiment about the suite itself.

    Attributes:
        study: Which one.
    """

    study: Annotated[
        Annotated[Compression, tyro.conf.subcommand("compression")]
        | Annotated[study_grids.Ablation, tyro.conf.subcommand("ablation")]
        | Annotated[study_grids.Inputs, tyro.conf.subcommand("inputs")]
        | Annotated[study_grids.Resolution, tyro.conf.subcommand("resolution")]
        | Annotated[study_grids.Randomisation, tyro.conf.subcommand("randomisation")]
        | Annotated[study_grids.Rewards, tyro.conf.subcommand("rewards")]
        | Annotated[study_grids.StartGoal, tyro.conf.subcommand("start-goal")]
        | Annotated[study_grids.CurriculumStudy, tyro.conf.subcommand("curriculum")]
        | Annotated[study_search.SearchStudy, tyro.conf.subcommand("search")]
        | Annotated[study_grids.ThesisRuns, tyro.conf.subcommand("thesis-runs")]
        | Annotated[study_grids.FewDemonstrations, tyro.conf.subcommand("few-demonstrations")]
        | Annotated[Robustness, tyro.conf.subcommand("robustness")]
        | Annotated[Attention, tyro.conf.subcommand("attention")],
        tyro.conf.OmitSubcommandPrefixes,
        tyro.conf.OmitArgPrefixes,
    ]

    def run(self) -> None:
        """Run it."""
        if self.study is not None:
            self.study.run()
