"""What compression costs: frames come back in order, errors grow, nothing is done twice."""

import itertools
import json
import os
import shutil
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from hvs_suite.cli.main import run
from hvs_suite.datasets import publication, reader
from hvs_suite.datasets.recompression import VideoCopy
from hvs_suite.errors import DatasetError, OptionError, OutputError
from hvs_suite.eval import protocol
from hvs_suite.eval.studies import compression, compression_report
from hvs_suite.eval.studies.compression import Training, parse_setting, run_study
from hvs_suite.eval.studies.compression_figures import Row, Study, Success

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "align-thesis"
EIH, ETH = "observation.images.eih", "observation.images.eth"
SETTINGS = ("h264:5", "h264:30", "h264:23:yuv444p")
UNTRAINED = Training(steps=0)


def silent(_stage: str, _share: float, _words: str) -> None:
    """Takes reports and says nothing."""


def study_of(out: Path, *settings: str, training: Training = UNTRAINED) -> Study:
    return run_study(SAMPLE, out, [parse_setting(each) for each in settings], training, silent)


@pytest.fixture(scope="module")
def studied(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Study]:
    """A study of the sample's five real episodes, its folder first."""
    out = tmp_path_factory.mktemp("study")
    return out, study_of(out, *SETTINGS)


@pytest.fixture(scope="module")
def copy(studied: tuple[Path, Study]) -> VideoCopy:
    """The sample and its best video copy."""
    return VideoCopy(SAMPLE, studied[0] / "h264-crf5-yuv420p" / "video")


def test_frames_come_back_all_and_in_order(copy: VideoCopy) -> None:
    seen, info = 0, reader.read_info(SAMPLE)
    for place, table, pictures in copy.episodes():
        for key in (EIH, ETH):
            before = np.array(reader.read_pictures(SAMPLE, info, place, table, key), np.float32)
            after = np.array(pictures[key], np.float32)
            assert after.shape == before.shape
            distance = np.abs(after[:, None] - before[None]).mean(axis=(2, 3, 4))
            # Towards the goal the arm hardly moves: a frame's own picture is as near as any.
            assert (distance.diagonal() <= distance.min(axis=1) + 0.05).all()
            assert distance.max() > 2.0
        seen += place.length
    assert seen == sum(place.length for place in reader.read_places(SAMPLE))


def test_frames_are_those_that_lerobot_decodes(copy: VideoCopy) -> None:
    from lerobot.datasets.video_utils import decode_video_frames

    place = reader.read_places(copy.video)[-1]
    *_, (_, _, pictures) = copy.episodes()
    file, start_s = place.videos[ETH]
    times = [start_s + frame / 10 for frame in range(place.length)]
    frames = decode_video_frames(copy.video / file, times, 1e-4, backend="pyav", return_uint8=True)
    np.testing.assert_array_equal(frames.permute(0, 2, 3, 1).numpy(), np.array(pictures[ETH]))


def test_videos_are_made_with_what_was_asked_for(studied: tuple[Path, Study]) -> None:
    out, _ = studied
    for folder, pixel_format in (("crf30-yuv420p", "yuv420p"), ("crf23-yuv444p", "yuv444p")):
        [path] = (out / f"h264-{folder}" / "video" / "videos" / ETH).rglob("*.mp4")
        with av.open(str(path)) as container:
            [stream] = container.streams.video
            whole = [frame.key_frame for frame in container.decode(stream)]
            assert (stream.codec_context.name, stream.pix_fmt) == ("h264", pixel_format)
        # LeRobot's interval: of two frames in a row one is kept whole.
        assert whole[0]
        assert all(one or other for one, other in itertools.pairwise(whole))
        assert not all(whole)


@pytest.mark.skipif(not hasattr(os, "sched_getscheduler"), reason="scheduling is Linux's")
def test_encoding_leaves_the_process_as_it_was_scheduled(tmp_path: Path) -> None:
    # As root, SVT-AV1 makes its caller a real-time thread.
    before = os.sched_getscheduler(0)
    publication.convert_to_video(SAMPLE, tmp_path / "video", publication.Encoding(crf=50))
    assert os.sched_getscheduler(0) == before


def test_error_grows_as_size_and_fidelity_fall(studied: tuple[Path, Study]) -> None:
    lossless, fine, coarse, _ = studied[1].rows
    for camera in ("eih", "eth"):
        none, little, much = (row.cameras[camera] for row in (lossless, fine, coarse))
        assert none.moved_px is None
        assert little.moved_px is not None
        assert much.moved_px is not None
        assert little.moved_px.median < much.moved_px.median
        assert little.moved_px.p95 < much.moved_px.p95
        assert none.megabytes > little.megabytes > much.megabytes > 0
        assert (little.psnr_db or 0) > (much.psnr_db or 0) + 1
        assert none.n == little.n == much.n > 4
    assert lossless.cameras["eih"].pc_found == 100.0
    assert lossless.cameras["eih"].error_px is not None
    assert lossless.cameras["eih"].error_px.median < 0.5


def test_what_is_finished_is_not_done_again(
    studied: tuple[Path, Study], monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: Any) -> None:
        raise AssertionError("encoded again")

    monkeypatch.setattr(compression, "convert_to_video", refuse)
    monkeypatch.setattr(compression, "located", refuse)
    assert study_of(studied[0], *SETTINGS) == studied[1]
    # A setting may be added, and only that one is work.
    with pytest.raises(AssertionError):
        study_of(studied[0], *SETTINGS, "h264:40")


def test_a_killed_setting_begins_anew_and_the_finished_stay(
    tmp_path: Path, studied: tuple[Path, Study], monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in ("dataset.txt", "h264-crf5-yuv420p"):
        source = studied[0] / name
        (shutil.copytree if source.is_dir() else shutil.copy)(source, tmp_path / name)
    convert = publication.convert_to_video
    calls = []

    def interrupt(root: Path, out: Path, encoding: publication.Encoding) -> None:
        calls.append(encoding.crf)
        convert(root, out, encoding)
        if len(calls) == 1:
            raise KeyboardInterrupt

    monkeypatch.setattr(compression, "convert_to_video", interrupt)
    with pytest.raises(KeyboardInterrupt):
        study_of(tmp_path, *SETTINGS[:2])
    again = study_of(tmp_path, *SETTINGS[:2])
    assert calls == [30, 30]
    *finished, encoded_again = again.rows
    assert finished == studied[1].rows[:2]
    # Encoders with several threads do not always give the same bytes.
    before = studied[1].rows[2]
    for camera, figures in encoded_again.cameras.items():
        assert figures.psnr_db == pytest.approx(before.cameras[camera].psnr_db, abs=1.0)
        assert figures.n == before.cameras[camera].n


def test_decoded_frames_are_a_dataset_with_the_same_numbers(
    copy: VideoCopy, tmp_path: Path
) -> None:
    out = tmp_path / "frames"
    copy.write_decoded(out)
    assert reader.read_info(out)["features"] == reader.read_info(SAMPLE)["features"]
    places = zip(reader.read_places(SAMPLE), reader.read_places(out), copy.episodes(), strict=True)
    for before, after, (_, _, pictures) in places:
        old, new = reader.read_episode(SAMPLE, before), reader.read_episode(out, after)
        assert old.drop_columns([EIH, ETH]) == new.drop_columns([EIH, ETH])
        for key in (EIH, ETH):
            stored = reader.read_pictures(out, reader.read_info(out), after, new, key)
            np.testing.assert_array_equal(stored, pictures[key])


@pytest.mark.timeout(600)
def test_a_policy_learns_from_each_setting_and_is_paired_with_the_lossless_one(
    studied: tuple[Path, Study], monkeypatch: pytest.MonkeyPatch
) -> None:
    out, _ = studied
    training = Training(steps=1, episodes=1)
    found = study_of(out, "h264:30", training=training)
    lossless, coarse = (row.success for row in found.rows)
    assert lossless is not None
    assert coarse is not None
    assert (lossless.n, coarse.n) == (1, 1)
    assert (lossless.n_only_lossless, lossless.n_only_this, lossless.p) == (0, 0, 1.0)
    policies = [
        out / name / "steps-1-seed-0" / "policy" for name in ("lossless", "h264-crf30-yuv420p")
    ]
    weights = [(policy / "model.safetensors").read_bytes() for policy in policies]
    assert weights[0] != weights[1]
    # What only training needed is gone, what was found is not sought again.
    assert not list(out.rglob("frames"))
    assert not list(out.rglob("cache"))
    monkeypatch.setattr(protocol, "evaluate", None)
    assert study_of(out, "h264:30", training=training) == found


def test_the_report_names_every_setting_and_draws_success(studied: tuple[Path, Study]) -> None:
    _, measured = studied
    success = Success(
        n=20, n_success=15, pc_success_ci95=(53.0, 88.0), n_only_lossless=2, n_only_this=1, p=1.0,
        errors={"lateral_error_mm": 3.0, "tilt_error_deg": 0.5}, settled_error=0.4,
    )  # fmt: skip
    trained = [row.model_copy(update={"success": success}) for row in measured.rows]
    for study, panels in (
        (measured, 4),
        (measured.model_copy(update={"steps": 9, "rows": trained}), 6),
    ):
        text = compression_report.markdown(study)
        assert text.count("| H.264 | 30 |") == 3
        assert text.count("| H.264 4:4:4 | 23 |") == 3
        assert ("15 of 20" in text) is bool(study.steps)
        assert len(compression_report.draw(study).axes) == panels
    assert Row.model_validate_json(trained[1].model_dump_json()) == trained[1]


def test_a_codec_that_ffmpeg_lacks_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def without(name: str, _mode: str) -> None:
        raise av.codec.codec.UnknownCodecError(name)

    monkeypatch.setattr(av.codec, "Codec", without)
    with pytest.raises(OptionError, match="no encoder libsvtav1"):
        parse_setting("av1:30")


def test_the_command_writes_table_plot_and_figures(
    studied: tuple[Path, Study], capsys: pytest.CaptureFixture[str]
) -> None:
    out, study = studied
    words = [word for each in SETTINGS for word in ("--setting", each)]
    assert run(["study", "compression", "--data", str(SAMPLE), "--out", str(out), "--steps", "0",
                *words]) == 0  # fmt: skip
    assert "| H.264 | 30 |" in capsys.readouterr().out
    assert Study.model_validate_json((out / "study.json").read_bytes()) == study
    assert (out / "study.png").stat().st_size > 10_000
    assert "| PNG | - |" in (out / "study.md").read_text()


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["--data", "{folder}/none"], "not a LeRobot dataset"),
        (["--data", "{sample}", "--setting", "vp9:30"], "choose from av1, h264"),
        (["--data", "{sample}", "--setting", "av1"], "av1:crf"),
        (["--data", "{sample}", "--setting", "h264:52"], "0 to 51"),
        (["--data", "{sample}", "--setting", "av1:30:yuv444p"], "choose from yuv420p"),
        (["--data", "{sample}", "--setting", "av1:30", "--setting", "av1:30"], "twice"),
        (["--data", "{sample}", "--steps", "-1"], "steps"),
        (["--data", "{sample}", "--episodes", "0"], "episodes"),
        (["--task", "align-thesys"], "align-thesis"),
        (["--demonstrations", "0"], "episodes"),
        (["--data", "{video}"], "lossless"),
    ],
)
def test_bad_input_is_refused_in_one_line(
    words: list[str],
    reason: str,
    copy: VideoCopy,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    places = {"folder": tmp_path, "sample": SAMPLE, "video": copy.video}
    out = ["--out", str(tmp_path / "out")]
    assert run(["study", "compression", *(w.format(**places) for w in words), *out]) == 2
    line = capsys.readouterr().err.splitlines()[-1]
    assert line.startswith("hvs: ")
    assert reason in line


def test_the_folder_of_another_dataset_or_none_is_refused(tmp_path: Path) -> None:
    (tmp_path / "dataset.txt").write_text("another\n")
    with pytest.raises(OutputError, match="another dataset"):
        study_of(tmp_path, "h264:40")
    (tmp_path / "file").touch()
    with pytest.raises(OutputError):
        study_of(tmp_path / "file", "h264:40")


def test_a_dataset_of_the_test_split_is_not_learned_from(tmp_path: Path) -> None:
    data = tmp_path / "data"
    shutil.copytree(SAMPLE, data)
    origin = json.loads((data / "hvs.json").read_text()) | {"split": "test"}
    (data / "hvs.json").write_text(json.dumps(origin))
    with pytest.raises(DatasetError, match="test split"):
        run_study(data, tmp_path / "out", [parse_setting("h264:30")], Training(steps=1), silent)
