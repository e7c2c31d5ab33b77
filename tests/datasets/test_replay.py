"""``hvs replay``: an episode of a dataset as a film."""

import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from hvs_suite.cli.main import run
from hvs_suite.datasets import replay as film
from hvs_suite.datasets.reader import decode, read_info, shape_of
from hvs_suite.pictures import resize

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "align-thesis"
DATA = "data/chunk-000/file-000.parquet"
CURVE_COLOUR = (0xE9, 0x62, 0x0A)


@pytest.fixture(scope="module")
def played():
    return film.replay(SAMPLE, 1)


def rows():
    table = pq.read_table(SAMPLE / DATA)
    return [row for row in table.to_pylist() if row["episode_index"] == 1]


def test_has_a_frame_for_each_step_and_one_for_the_end(played):
    assert len(played.frames) == len(rows()) + 1
    assert {frame.shape for frame in played.frames} == {(film.HEIGHT, film.WIDTH, 3)}
    assert (played.scenario, played.success, played.fps) == (1, True, 10.0)


def test_shows_the_pictures_of_the_dataset(played):
    left = film.MARGIN + film.CELL_SIDE + film.MARGIN
    top = film.HEAD + 2 * film.CAMERA_TITLE + film.CAMERA_SIDE
    side = film.CAMERA_SIDE
    for step in (0, 4):
        shown = played.frames[step][top : top + side, left : left + side]
        key = "observation.images.eth"
        stored = decode(rows()[step][key], shape_of(read_info(SAMPLE), key))
        np.testing.assert_array_equal(shown, resize(stored, side))


@pytest.mark.parametrize(("half", "error"), [(0, 0), (1, 3)], ids=["position", "tilt"])
def test_the_dot_of_now_stands_at_the_recorded_error(half, error, played):
    columns = slice(half * film.WIDTH // 2, (half + 1) * film.WIDTH // 2)
    dots = []
    # The end's error is in no row of the dataset.
    for frame in played.frames[:-1]:
        curves = frame[film.HEAD + film.CELL_SIDE + film.MARGIN :, columns]
        rows_px, columns_px = np.nonzero((curves == CURVE_COLOUR).all(axis=-1))
        right = columns_px.max()
        dots.append((right, rows_px[columns_px > right - 4].mean()))
    across, down = np.array(dots).T
    assert np.ptp(np.diff(across)) <= 1
    assert np.diff(across).min() > 5
    # The axis is logarithmic.
    logs = np.log10([row["privileged.errors"][error] for row in rows()])
    slope, offset = np.polyfit(logs, down, 1)
    assert slope < -10
    np.testing.assert_allclose(np.polyval((slope, offset), logs), down, atol=2.5)


@pytest.mark.parametrize("suffix", ["gif", "mp4"])
def test_command_writes_a_film(suffix, tmp_path, monkeypatch, played, capsys):
    import imageio.v3 as iio

    monkeypatch.setattr(film, "replay", lambda *_: played)
    out = tmp_path / f"episode.{suffix}"
    assert run(["replay", str(SAMPLE), "--episode", "1", "--out", str(out)]) == 0
    assert "success" in capsys.readouterr().out
    frames = iio.imread(out, plugin="pyav" if suffix == "mp4" else "pillow")
    assert len(frames) == len(played.frames)


@pytest.mark.parametrize(
    ("words", "reason"),
    [
        (["{sample}", "--episode", "5", "--out", "{folder}/a.gif"], "episodes 0 to 4"),
        (["{folder}", "--episode", "0", "--out", "{folder}/a.gif"], "hvs.json"),
        (["{sample}", "--episode", "0", "--out", "{folder}/a.avi"], ".mp4"),
        (["{cut}", "--episode", "0", "--out", "{folder}/a.gif"], "cannot be read"),
    ],
)
def test_what_cannot_be_filmed_is_refused_in_one_line(words, reason, tmp_path, capsys):
    cut = tmp_path / "cut"
    shutil.copytree(SAMPLE, cut)
    (cut / DATA).write_bytes((cut / DATA).read_bytes()[:1000])
    places = {"sample": SAMPLE, "folder": tmp_path, "cut": cut}
    assert run(["replay", *(word.format(**places) for word in words)]) == 2
    err = capsys.readouterr().err
    assert reason in err
    assert err.count("\n") == 1
