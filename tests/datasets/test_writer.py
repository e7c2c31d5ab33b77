"""Files that are written without LeRobot are those that LeRobot would have written."""

import io
import json
import shutil
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest
from frames import columns
from PIL import Image

from hvs_suite.datasets import lerobot_files, writer
from hvs_suite.datasets.demonstration import packed
from hvs_suite.datasets.episode_stats import column_stats, merge_stats
from hvs_suite.datasets.features import ROBOT_TYPE, dataset_features, image_key
from hvs_suite.datasets.writer import STAGE, DatasetWriter
from hvs_suite.errors import DatasetError
from hvs_suite.registry import TASKS

OUTCOME = {"is_success": True, "collision": False}
FPS, SENTENCE = 10, "Place the flange – centred – over the target."
LENGTHS = (12, 1, 104, 7)
# Importing LeRobot's dataset package takes some 20 s.
pytestmark = pytest.mark.timeout(1800)


def frames_of(features, length, random):
    """Frames of an invented episode: a shaded picture that drifts, and numbers."""
    frames = []
    for step in range(length):
        frame = {}
        for name, feature in features.items():
            shape, dtype = tuple(feature["shape"]), feature["dtype"]
            if dtype == "image":
                ramp = np.add.outer(np.arange(shape[0]), np.arange(shape[1]))[..., None]
                noise = random.integers(0, 3, shape) * (np.arange(shape[0])[:, None, None] < 20)
                frame[name] = (ramp // 2 + step + noise + [0, 30, 60]).clip(0, 255).astype(np.uint8)
            elif dtype == "bool":
                frame[name] = np.array([step == length - 1])
            elif dtype == "int64":
                frame[name] = np.array([length], np.int64)
            else:
                # Constant, nearly constant and spread out by turns: histograms care.
                spread = [0.0, 1e-5, 1.0][len(name) % 3]
                frame[name] = (1.0 + spread * random.normal(size=shape)).astype(np.float32)
        frames.append(frame)
    return frames


@pytest.fixture(scope="module")
def features():
    """Those of align-thesis; one camera so large that LeRobot's statistics take every other px."""
    features = dataset_features(TASKS["align-thesis"])
    features[image_key("eth")] = {**features[image_key("eth")], "shape": (300, 300, 3)}
    return features


@pytest.fixture(scope="module")
def episodes(features):
    random = np.random.default_rng(0)
    return [frames_of(features, length, random) for length in LENGTHS]


def write(root, features, episodes, block):
    """Writes episodes with our writer."""
    files = DatasetWriter(root, features, FPS, block)
    for scenario, frames in enumerate(episodes):
        files.save(packed(scenario, frames, features, OUTCOME, SENTENCE))
    files.publish()


@pytest.fixture(scope="module")
def both(features, episodes, tmp_path_factory):
    """The same episodes, written by LeRobot and by us."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    folder = tmp_path_factory.mktemp("written")
    theirs, ours = folder / "theirs", folder / "ours"
    dataset = LeRobotDataset.create(
        "local/theirs",
        FPS,
        features,
        root=theirs,
        robot_type=ROBOT_TYPE,
        use_videos=False,
        video_backend="pyav",
    )
    for frames in episodes:
        for frame in frames:
            dataset.add_frame({**frame, "task": SENTENCE})
        dataset.save_episode()
    dataset.finalize()
    write(ours, features, episodes, block=50)
    return theirs, ours


def listing(root):
    return sorted(str(path.relative_to(root)) for path in Path(root).rglob("*") if path.is_file())


def decoded(cell):
    return np.array(Image.open(io.BytesIO(cell["bytes"])))


def assert_same_statistic(ours, theirs, feature, name):
    """Equal, but for means and deviations of pictures, which LeRobot sums in float32."""
    rounded = feature.startswith("observation.images") and name in ("mean", "std")
    assert np.shape(ours) == np.shape(theirs), (feature, name)
    relative = 0.1 if rounded else 2e-6
    np.testing.assert_allclose(ours, theirs, relative, 1e-9, err_msg=f"{feature} {name}")


def test_files_are_the_same_and_info_is_equal(both):
    theirs, ours = both
    assert listing(ours) == listing(theirs)
    read = [(root / lerobot_files.INFO).read_text() for root in both]
    assert read[0] == read[1]


def test_data_have_the_same_schema_and_values(both):
    name = lerobot_files.numbered("data", 0)
    theirs, ours = (pq.ParquetFile(root / name) for root in both)
    assert ours.schema_arrow.equals(theirs.schema_arrow, check_metadata=False)
    notes = [json.loads(f.schema_arrow.metadata[b"huggingface"])["info"] for f in (theirs, ours)]
    assert notes[0] == notes[1]
    assert ours.num_row_groups == theirs.num_row_groups == len(LENGTHS)
    for column in theirs.schema_arrow.names:
        left, right = (f.read([column])[column].to_pylist() for f in (theirs, ours))
        if column.startswith("observation.images"):
            assert [cell["path"] for cell in left] == [cell["path"] for cell in right]
            for one, two in zip(left, right, strict=True):
                np.testing.assert_array_equal(decoded(one), decoded(two))
        else:
            assert left == right, column


def test_tasks_are_equal(both):
    import pandas as pd

    theirs, ours = (root / lerobot_files.TASKS for root in both)
    pd.testing.assert_frame_equal(pd.read_parquet(theirs), pd.read_parquet(ours))
    assert pq.read_schema(ours).equals(pq.read_schema(theirs), check_metadata=False)


def test_episodes_and_their_statistics_are_equal(both):
    name = lerobot_files.numbered("meta/episodes", 0)
    theirs, ours = (pq.read_table(root / name) for root in both)
    assert ours.schema.names == theirs.schema.names
    for left, right in zip(theirs.to_pylist(), ours.to_pylist(), strict=True):
        for column in left:
            if column.startswith("stats/"):
                _, feature, name = column.split("/")
                assert_same_statistic(right[column], left[column], feature, name)
            else:
                assert left[column] == right[column], column


def test_statistics_of_the_dataset_are_equal(both):
    theirs, ours = (json.loads((root / lerobot_files.STATS).read_text()) for root in both)
    assert theirs.keys() == ours.keys()
    for feature, names in theirs.items():
        assert list(names) == list(ours[feature])
        for name, value in names.items():
            assert_same_statistic(ours[feature][name], value, feature, name)


def test_means_and_deviations_of_pictures_are_those_of_all_their_pixels(both, episodes):
    ours = pq.read_table(both[1] / lerobot_files.numbered("meta/episodes", 0)).to_pylist()
    key = "observation.images.eih"
    for row, frames in zip(ours, episodes, strict=True):
        pixels = np.stack([frame[key] for frame in frames]).reshape(-1, 3) / 255.0
        if len(frames) <= 100:  # of more, LeRobot looks at a sample
            for name, value in (("mean", pixels.mean(axis=0)), ("std", pixels.std(axis=0))):
                np.testing.assert_allclose(np.ravel(row[f"stats/{key}/{name}"]), value, 1e-9)


def test_lerobot_reads_them_and_goes_on_with_them(both, episodes, tmp_path, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path / "ours"
    shutil.copytree(both[1], root)
    loaded = LeRobotDataset("local/any", root=root)
    assert loaded.num_episodes == len(LENGTHS)
    for index, frame in ((0, episodes[0][0]), (12, episodes[1][0]), (13, episodes[2][0])):
        item = loaded[index]
        assert item["task"] == SENTENCE
        np.testing.assert_array_equal(item["action"], frame["action"])
        shown = (item["observation.images.eih"].permute(1, 2, 0) * 255).round().numpy()
        np.testing.assert_array_equal(shown, frame["observation.images.eih"])
    continued = LeRobotDataset.resume("local/any", root=root, video_backend="pyav")
    for frame in episodes[3]:
        continued.add_frame({**frame, "task": SENTENCE})
    continued.save_episode()
    continued.finalize()
    again = LeRobotDataset("local/any", root=root)
    assert len(again) == sum(LENGTHS) + LENGTHS[3]
    np.testing.assert_array_equal(again[-1]["action"], episodes[3][-1]["action"])


def test_a_kill_between_the_last_two_files_costs_no_more_than_the_block(
    features, episodes, tmp_path
):
    whole, torn = tmp_path / "whole", tmp_path / "torn"
    write(whole, features, episodes, 50)
    write(torn, features, episodes[:3], 1)
    # As if the statistics of the third block had arrived, and its counts had not.
    lerobot_files.write_info(torn, features, FPS, ROBOT_TYPE, 2, sum(LENGTHS[:2]), 1)
    with writer.taken(torn, resume=True):
        pass
    assert len(list((torn / "data").rglob("*.parquet"))) == 2
    files = DatasetWriter(torn, features, FPS, 2)
    for scenario in (2, 3):
        files.save(packed(scenario, episodes[scenario], features, OUTCOME, SENTENCE))
    assert columns(torn)["action"] == columns(whole)["action"]
    one, two = (json.loads((root / lerobot_files.STATS).read_text()) for root in (whole, torn))
    for feature, names in one.items():
        for name, value in names.items():
            np.testing.assert_allclose(two[feature][name], value, 1e-9, 1e-12, err_msg=feature)


def test_a_data_file_ends_where_lerobot_would_end_it(features, episodes, tmp_path, monkeypatch):
    monkeypatch.setattr(lerobot_files, "DATA_FILE_MB", 0.5)
    write(tmp_path / "split", features, episodes, 50)
    [listed] = (tmp_path / "split" / "meta" / "episodes").rglob("*.parquet")
    places = pq.read_table(listed)["data/file_index"].to_pylist()
    assert places[0] == 0
    assert places[-1] >= 1
    assert places == sorted(places)
    held = {}
    for path in (tmp_path / "split" / "data").rglob("*.parquet"):
        for episode in pq.read_table(path, columns=["episode_index"])["episode_index"].to_pylist():
            held[episode] = int(path.stem.removeprefix("file-"))
    assert [held[i] for i in range(len(LENGTHS))] == places


def test_what_was_torn_by_an_interrupt_is_dropped(features, episodes, tmp_path, monkeypatch):
    root = tmp_path / "interrupted"
    files = DatasetWriter(root, features, FPS, 2)
    files.save(packed(0, episodes[0], features, OUTCOME, SENTENCE))
    rows = pq.ParquetWriter.write_table

    def interrupt(*arguments):
        rows(*arguments)
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(pq.ParquetWriter, "write_table", interrupt)
        with pytest.raises(KeyboardInterrupt):
            files.save(packed(1, episodes[1], features, OUTCOME, SENTENCE))
    files.publish()
    assert not (root / STAGE).exists()
    assert listing(root) == []


def test_damaged_statistics_are_named_on_resume(features, episodes, tmp_path):
    root = tmp_path / "damaged"
    write(root, features, episodes[:1], 1)
    (root / lerobot_files.STATS).write_text("{")
    with pytest.raises(DatasetError, match=r"stats\.json: is not JSON"):
        write(root, features, episodes[1:2], 1)


def test_merging_weighs_by_frames():
    random = np.random.default_rng(3)
    values = random.normal(size=(30, 4))
    parts = [column_stats({"x": values[a:b]})["x"] for a, b in ((0, 5), (5, 30))]
    merged, whole = merge_stats(parts), column_stats({"x": values})["x"]
    assert merged.count == 30
    np.testing.assert_allclose(merged.values[:4], whole.values[:4], 1e-9)
