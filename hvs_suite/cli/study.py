"""``hvs study``: experiments about the suite itself, each by one command."""

import dataclasses
from pathlib import Path
from typing import Annotated

import tyro

from hvs_suite.cli import console

# As `hvs demo` records: without disturbance and starts near the goal nothing is learnt.
NOISE_RAD = 0.02


@dataclasses.dataclass(frozen=True, kw_only=True)
class Compression:
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
        workers: Processes that record and judge.
    """

    out: Path
    data: Path | None = None
    task: str = "align-thesis"
    demonstrations: int = 1000
    setting: tuple[str, ...] = ()
    steps: int = 1500
    episodes: int = 200
    seed: int = 0
    workers: int = 2

    def run(self) -> None:
        """Measure, showing how it goes; write and print what was found."""
        from hvs_suite.eval import compression_report, compression_study
        from hvs_suite.files import check_writable, replacing

        check_writable(self.out / "study.json")
        settings = self.setting or compression_study.DEFAULT_SETTINGS
        encodings = [compression_study.parse_setting(text) for text in settings]
        training = compression_study.Training(self.steps, self.seed, self.episodes, self.workers)
        compression_study.check(encodings, training)
        data = self._recorded() if self.data is None else self.data
        with console.meter() as update:
            study = compression_study.run_study(data, self.out, encodings, training, update)
        text = compression_report.markdown(study)
        for name, content in (
            ("study.json", study.model_dump_json(indent=2) + "\n"),
            ("study.md", text),
        ):
            with replacing(self.out / name) as temporary:
                temporary.write_text(content, encoding="utf-8")
        with replacing(self.out / "study.png") as temporary:
            compression_report.draw(study).savefig(temporary)
        print(text, end="")
        print(f"wrote {self.out / 'study.json'}, study.md and study.png")

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
            workers=self.workers,
            resume=True,
        ).run()
        return data


@dataclasses.dataclass(frozen=True, kw_only=True)
class Study:
    """Run an experiment about the suite itself: what compression costs.

    Attributes:
        study: Which one.
    """

    study: Annotated[
        # A union needs two members to become a choice of words, even while there is one study.
        Annotated[Compression, tyro.conf.subcommand("compression")]
        | Annotated[None, tyro.conf.Suppress],
        tyro.conf.OmitSubcommandPrefixes,
        tyro.conf.OmitArgPrefixes,
    ]

    def run(self) -> None:
        """Run it."""
        if self.study is not None:
            self.study.run()
