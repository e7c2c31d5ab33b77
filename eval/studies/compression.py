"""What compression costs: a dataset through each codec and back, measured three ways.

For each setting: the videos' size; how well the suite's classical detector still finds the target
in the decoded pictures; and how well a policy succeeds that learned from them, judged on live,
uncompressed scenarios. Everything lies in one folder, a sub-folder a setting; what is finished
there is not done again.
"""

import contextlib
import dataclasses
import io
import math
import shutil
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pydantic

from hvs_suite.datasets import reader
from hvs_suite.datasets.features import CAMERAS, image_key
from hvs_suite.datasets.metadata import read_metadata
from hvs_suite.datasets.publication import Encoding, check_encoding, convert_to_video
from hvs_suite.datasets.reader import Picture
from hvs_suite.datasets.recompression import VideoCopy
from hvs_suite.errors import DatasetError, OptionError, OutputError
from hvs_suite.eval.scoring.comparison import Tally
from hvs_suite.eval.scoring.result_file import Result
from hvs_suite.eval.studies.compression_figures import (
    Answers,
    CameraFigures,
    FloatArray,
    Row,
    Study,
    Success,
    located,
)
from hvs_suite.eval.studies.training import Note, Report, Scenes, train_and_judge
from hvs_suite.executor import Workers, check_workers
from hvs_suite.files import check_writable, replacing
from hvs_suite.policies.imitation.frame_cache import fingerprint
from hvs_suite.policies.training.dataset import read_manifest, refuse_test_split
from hvs_suite.registry import find

LOSSLESS = "PNG"
CODECS = {"av1": ("libsvtav1", "AV1", 63), "h264": ("h264", "H.264", 51)}
"""Name on the command line: LeRobot's name, name to show, worst constant rate factor."""
DEFAULT_SETTINGS = (
    *("av1:15", "av1:23", "av1:30", "av1:40", "av1:50"),
    *("h264:15", "h264:23", "h264:30", "h264:40"),
    *("h264:15:yuv444p", "h264:23:yuv444p", "h264:30:yuv444p"),
)
LEROBOT_DEFAULT = Encoding()


@dataclasses.dataclass(frozen=True)
class Training:
    """How a policy is trained on each setting's pictures, and judged.

    Attributes:
        steps: Optimiser steps; 0 trains none.
        seed: Of initial weights, held-out episodes and order; the same for every setting.
        episodes: Scenarios of the split ``dev`` to play.
        workers: Processes that play them, or others elsewhere.
    """

    steps: int
    seed: int = 0
    episodes: int = 200
    workers: Workers = 1


def parse_setting(text: str) -> Encoding:
    """Reads ``codec:crf`` or ``codec:crf:pixel_format``, such as ``h264:23:yuv444p``.

    Raises:
        OptionError: It is malformed, or this machine's FFmpeg cannot encode it.
    """
    codec, *rest = text.split(":")
    if codec not in CODECS:
        raise OptionError(f"unknown codec in {text!r}; choose from {', '.join(CODECS)}")
    encoder, _, worst = CODECS[codec]
    crf = rest[0] if rest else ""
    if not (crf.isascii() and crf.isdecimal() and int(crf) <= worst and len(rest) <= 2):
        raise OptionError(
            f"{text!r} is no setting; write {codec}:crf with a crf from 0 to {worst}, and if need "
            "be a pixel format behind it, as in h264:23:yuv444p"
        )
    pixel_format = rest[1] if len(rest) == 2 else LEROBOT_DEFAULT.pixel_format
    encoding = Encoding(encoder, int(crf), pixel_format)
    check_encoding(encoding)
    return encoding


def check(encodings: Sequence[Encoding], training: Training) -> None:
    """Refuses numbers that make no sense, before anything is recorded.

    Raises:
        OptionError: One does not, or a setting is named twice or none at all.
    """
    if not encodings:
        raise OptionError("name at least one setting, such as av1:30")
    if len(set(encodings)) < len(encodings):
        raise OptionError("a setting is named twice; name each once")
    if training.steps < 0:
        raise OptionError(f"steps must be 0 (no training) or more, not {training.steps}")
    check_workers(training.workers)
    if training.episodes < 1:
        raise OptionError(f"episodes must be at least 1, not {training.episodes}")


def run_study(
    data: Path,
    out: Path,
    encodings: Sequence[Encoding],
    training: Training,
    report: Report,
) -> Study:
    """Measures a dataset through each encoding, or goes on with a study that was interrupted.

    Args:
        data: The lossless dataset.
        out: Folder of the study.
        encodings: What to measure.
        training: Whether and how to train on each.
        report: Called as the work goes on.

    Raises:
        DatasetError: There is no such dataset, or it is damaged, holds no lossless pictures, or
            must not be learned from.
        OptionError: A number makes no sense, or a setting is named twice.
        OutputError: ``out`` cannot be written, or holds a study of another dataset.
    """
    check(encodings, training)
    original = _Original(data)
    if training.steps:
        refuse_test_split(read_manifest(data))
    _claim(out, data)
    figures = [original.figures(out / _folder(None), report)]
    for encoding in encodings:
        figures.append(_measured(original, out / _folder(encoding), encoding, report))
    outcomes = _outcomes(original, out, encodings, training, report)
    rows = [
        Row(
            codec=_shown(encoding),
            crf=None if encoding is None else encoding.crf,
            pixel_format=None if encoding is None else encoding.pixel_format,
            cameras=cameras,
            success=success,
        )
        for encoding, cameras, success in zip((None, *encodings), figures, outcomes, strict=True)
    ]
    return Study(
        task=original.task,
        frames=original.frames,
        episodes=original.episodes,
        resolutions=original.sides,
        steps=training.steps,
        rows=rows,
    )


class _Original:
    """The lossless dataset, and where the detector finds the target in it."""

    def __init__(self, root: Path) -> None:
        read_manifest(root)
        info = reader.read_info(root)
        self.root = root
        self.task = read_metadata(root).task
        self.places = sorted(reader.read_places(root), key=lambda each: each.episode)
        self.episodes = len(self.places)
        self.frames = sum(place.length for place in self.places)
        self.sides: dict[str, int] = {}
        self._info = info
        for camera in CAMERAS:
            feature = info["features"].get(image_key(camera))
            if feature is not None and feature["dtype"] != "image":
                raise DatasetError(f"{root} holds videos; the study starts from a lossless dataset")
            if feature is not None:
                self.sides[camera] = int(feature["shape"][0])
        if not self.sides or not self.frames:
            raise DatasetError(f"{root} holds no camera pictures; record it from a vision task")
        self._answers: dict[str, Answers] = {}

    def pictures(self, place: reader.Place, camera: str) -> list[Picture]:
        """An episode's lossless pictures, uint8 (H, W, 3) each."""
        table = reader.read_episode(self.root, place)
        return reader.read_pictures(self.root, self._info, place, table, image_key(camera))

    def figures(self, folder: Path, report: Report) -> dict[str, CameraFigures]:
        """Size and localisation of the lossless pictures; the others are compared with these."""
        # What an earlier sitting found, (cameras, frames, 2) px.
        file = folder / "centres.npy"
        kept = np.load(file) if file.exists() else None
        n_bytes = dict.fromkeys(self.sides, 0)
        truths: dict[str, list[FloatArray]] = {camera: [] for camera in self.sides}
        centres: dict[str, list[FloatArray]] = {camera: [] for camera in self.sides}
        for count, place in enumerate(self.places, 1):
            table = reader.read_episode(self.root, place)
            for camera in self.sides:
                stored = table.column(image_key(camera)).to_pylist()
                n_bytes[camera] += sum(len(each["bytes"]) for each in stored)
                if kept is None:
                    centres[camera].append(located(self.pictures(place, camera)))
                truths[camera].append(reader.column(table, f"privileged.target_{camera}"))
            report(f"lossless {LOSSLESS}", count / self.episodes, f"{count} episodes")
        if kept is None:
            kept = np.stack([np.concatenate(each) for each in centres.values()])
            with replacing(file) as temporary:
                np.save(temporary, kept)
        figures = {}
        for (camera, side), found in zip(self.sides.items(), kept, strict=True):
            truth = np.concatenate(truths[camera]).astype(np.float64)
            answers = Answers(truth, found, side)
            self._answers[camera] = answers
            figures[camera] = answers.figures(n_bytes[camera] / self.frames / 1e3, None, None)
        return figures

    def compared(
        self, camera: str, centres: FloatArray, megabytes: float, psnr_db: float
    ) -> CameraFigures:
        """Localisation in decoded pictures; ``centres`` (frames, 2) px, NaN where none."""
        reference = self._answers[camera]
        answers = Answers(reference.truth, centres, self.sides[camera])
        return answers.figures(megabytes, psnr_db, reference)


def _measured(
    original: _Original, folder: Path, encoding: Encoding, report: Report
) -> dict[str, CameraFigures]:
    """Figures of a setting, from an earlier sitting if it came so far."""
    kept = pydantic.TypeAdapter(dict[str, CameraFigures])
    file = folder / "figures.json"
    if file.exists():
        with contextlib.suppress(pydantic.ValidationError):
            return kept.validate_json(file.read_bytes())
    copy = _video(original, folder, encoding, report)
    stage = f"{_words(encoding)}, looking"
    squares = dict.fromkeys(original.sides, 0.0)
    centres: dict[str, list[FloatArray]] = {camera: [] for camera in original.sides}
    for count, (place, _, pictures) in enumerate(copy.episodes(), 1):
        for camera in original.sides:
            decoded = pictures[image_key(camera)]
            for before, after in zip(original.pictures(place, camera), decoded, strict=True):
                squares[camera] += float(np.square(before.astype(np.float32) - after).mean())
            centres[camera].append(located(decoded))
        report(stage, count / original.episodes, f"{count} episodes")
    figures = {}
    for camera in original.sides:
        videos = (copy.video / "videos" / image_key(camera)).rglob("*.mp4")
        megabytes = sum(video.stat().st_size for video in videos) / original.frames / 1e3
        psnr_db = 10.0 * math.log10(255.0**2 / max(squares[camera] / original.frames, 1e-9))
        found = np.concatenate(centres[camera])
        figures[camera] = original.compared(camera, found, megabytes, psnr_db)
    with replacing(file) as temporary:
        temporary.write_bytes(kept.dump_json(figures, indent=2))
    return figures


def _video(original: _Original, folder: Path, encoding: Encoding, report: Report) -> VideoCopy:
    """The dataset with videos; a folder of this name is whole."""
    video = folder / "video"
    if not video.exists():
        report(f"{_words(encoding)}, encoding", 0.0, f"{original.frames} frames")
        unfinished = folder / "video.partial"
        shutil.rmtree(unfinished, ignore_errors=True)
        # LeRobot draws bars of its own across ours.
        with contextlib.redirect_stderr(io.StringIO()):
            convert_to_video(original.root, unfinished, encoding)
        unfinished.replace(video)
        report(f"{_words(encoding)}, encoding", 1.0, f"{original.frames} frames")
    return VideoCopy(original.root, video)


def _outcomes(
    original: _Original,
    out: Path,
    encodings: Sequence[Encoding],
    training: Training,
    report: Report,
) -> list[Success | None]:
    """Success of a policy for lossless pictures and each encoding; None each without training."""
    if not training.steps:
        return [None] * (1 + len(encodings))
    results = [
        _trained(original, out / _folder(encoding), encoding, training, report)
        for encoding in (None, *encodings)
    ]
    solved = [{row.scenario: row.success for row in result.episodes} for result in results]
    successes: list[Success | None] = []
    for result, own in zip(results, solved, strict=True):
        tally, summary = Tally.of(solved[0], own), result.summary
        low, high = summary.pc_success_ci95
        successes.append(
            Success(
                n=summary.n_episodes,
                n_success=summary.n_success,
                pc_success_ci95=(low, high),
                n_only_lossless=tally.n_only_a,
                n_only_this=tally.n_only_b,
                p=tally.p,
                errors={
                    name: _mean([row.errors[name] for row in result.episodes])
                    for name in find(summary.task).headline
                },
                settled_error=summary.settled.errors[find(summary.task).headline[0]].iqm,
            )
        )
    return successes


def _trained(
    original: _Original,
    folder: Path,
    encoding: Encoding | None,
    training: Training,
    report: Report,
) -> Result:
    """Result of a policy that learned from a setting's pictures; None are the lossless ones."""
    # Another training is another experiment and lies beside the first.
    run = folder / f"steps-{training.steps}-seed-{training.seed}"

    def train(policy: Path, note: Note) -> None:
        from hvs_suite.policies.imitation.pretrain import pretrain

        data = original.root
        if encoding is not None:
            data = folder / "frames"
            if not data.exists():
                _write_decoded(original, folder, encoding, data, report)
        pretrain(
            data,
            policy,
            steps=training.steps,
            seed=training.seed,
            workers=training.workers,
            on_progress=note,
        )

    [result] = train_and_judge(
        _words(encoding),
        run,
        train,
        report,
        on=[Scenes(task=original.task)],
        scenarios=training.episodes,
        workers=training.workers,
    )
    # Decoded frames are larger than the dataset; a dozen settings of them would fill the disk.
    shutil.rmtree(folder / "frames", ignore_errors=True)
    return result


def _write_decoded(
    original: _Original, folder: Path, encoding: Encoding, data: Path, report: Report
) -> None:
    """Writes the decoded frames as a lossless dataset; a folder of that name is whole."""
    copy = _video(original, folder, encoding, report)
    unfinished = data.with_name(data.name + ".partial")
    count = 0

    def note() -> None:
        nonlocal count
        count += 1
        report(f"{_words(encoding)}, decoding", count / original.episodes, f"{count} episodes")

    copy.write_decoded(unfinished, note)
    unfinished.replace(data)


def _claim(out: Path, data: Path) -> None:
    """Takes the folder, or recognises it as a study of the same dataset."""
    file = out / "dataset.txt"
    check_writable(file)
    own = fingerprint(data)
    if not file.exists():
        with replacing(file) as temporary:
            temporary.write_text(own + "\n")
    elif file.read_text().strip() != own:
        raise OutputError(f"{out} holds a study of another dataset; name another --out")


def _folder(encoding: Encoding | None) -> str:
    """Name of a setting's folder."""
    if encoding is None:
        return "lossless"
    return f"{encoding.codec}-crf{encoding.crf}-{encoding.pixel_format}"


def _shown(encoding: Encoding | None) -> str:
    """Name of a codec for people."""
    if encoding is None:
        return LOSSLESS
    return next(shown for name, shown, _ in CODECS.values() if name == encoding.codec)


def _words(encoding: Encoding | None) -> str:
    """A setting in words, for the progress."""
    if encoding is None:
        return f"lossless {LOSSLESS}"
    return f"{_shown(encoding)} crf {encoding.crf} {encoding.pixel_format}"


def _mean(values: Sequence[float]) -> float:
    return math.fsum(values) / len(values)
