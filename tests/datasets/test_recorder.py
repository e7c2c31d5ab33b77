"""Recording: LeRobot reads what was recorded, and nothing but the scenarios shapes it."""

import json
import os
import shutil
import signal
import subprocess
import sys

import numpy as np
import pyarrow.parquet as pq
import pytest
from frames import assert_same_frames, columns

import hvs_suite
from hvs_suite.datasets.demonstration import MakeEnvironment
from hvs_suite.datasets.looking import Demonstrator
from hvs_suite.datasets.metadata import METADATA_FILE, read_metadata
from hvs_suite.datasets.recorder import record
from hvs_suite.datasets.writer import STAGE
from hvs_suite.errors import DatasetError, OptionError, OutputError, RenderError, ScenarioError
from hvs_suite.files import only_writer

TASK = "align-fixed"
N = 5
# Importing LeRobot's dataset package takes some 20 s.
pytestmark = pytest.mark.timeout(300)


@pytest.fixture(scope="module")
def dataset(tmp_path_factory):
    root = tmp_path_factory.mktemp("recorded") / "clean"
    record(TASK, N, "train", root, block=2)
    return root


def test_plain_lerobot_reads_the_dataset_offline(dataset, monkeypatch):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    loaded = LeRobotDataset("local/any", root=dataset)
    assert loaded.num_episodes == N
    assert loaded.meta.robot_type == "kuka_lbr_iiwa"
    assert loaded.fps == 10
    frame = loaded[0]
    assert frame["observation.images.eih"].shape == (3, 112, 112)
    assert frame["observation.images.eth"].shape == (3, 112, 112)
    assert frame["observation.state"].shape == (14,)
    assert frame["action"].shape == (7,)
    assert frame["task"] == hvs_suite.TASKS[TASK].instruction()
    assert loaded.meta.features["observation.state"]["names"][:8] == [
        *(f"A{i}.pos" for i in range(1, 8)),
        "A1.vel",
    ]
    assert len(loaded) == loaded.meta.total_frames
    assert loaded.meta.stats["action"]["mean"].shape == (7,)


def test_only_observations_reach_policies(dataset):
    info = json.loads((dataset / "meta" / "info.json").read_text())
    inputs = {name for name in info["features"] if name.startswith("observation")}
    assert inputs == {"observation.images.eih", "observation.images.eth", "observation.state"}


def test_episode_i_is_scenario_i_and_ends_in_success(dataset):
    frames = columns(dataset)
    assert frames["privileged.scenario"] == frames["episode_index"]
    last = np.flatnonzero(frames["next.done"])
    assert len(last) == N
    assert all(frames["next.success"][i] for i in last)
    assert frames["index"] == list(range(len(frames["index"])))


def test_playing_the_executed_actions_again_reproduces_the_states(dataset):
    frames = columns(dataset)
    with hvs_suite.load(TASK, observations="vision") as env:
        for episode in range(2):
            rows = [i for i, e in enumerate(frames["episode_index"]) if e == episode]
            time_step = env.reset(scenario=episode)
            for i in rows:
                seen = time_step.observation
                state = np.concatenate([seen["joint_positions"], seen["joint_velocities"]])
                np.testing.assert_array_equal(
                    np.float32(frames["observation.state"][i]), np.float32(state)
                )
                action = np.float32(frames["privileged.action_executed"][i])
                time_step = env.step(action)
            assert env.info["is_success"]


def test_images_are_lossless(dataset):
    import io

    from PIL import Image

    stored = columns(dataset)["observation.images.eth"][0]["bytes"]
    with hvs_suite.load(TASK) as env:
        seen = env.reset(scenario=0).observation["eth"]
    difference = np.array(Image.open(io.BytesIO(stored))).astype(int) - seen
    # Another process may round a pixel otherwise; compression would change thousands.
    assert np.count_nonzero(difference) <= 5


@pytest.mark.parametrize("workers", [2, 3])
def test_several_workers_record_what_one_does(dataset, workers, tmp_path):
    record(TASK, N, "train", tmp_path / "more", workers=workers, block=3)
    assert_same_frames(dataset, tmp_path / "more")


def test_noise_changes_what_is_done_and_not_what_is_taught(tmp_path):
    record("align-easy", 2, "train", tmp_path / "noisy", noise=0.05)
    frames = columns(tmp_path / "noisy")
    taught, done = np.array(frames["action"]), np.array(frames["privileged.action_executed"])
    assert np.abs(taught - done).max() > 1e-3
    with hvs_suite.load("align-easy", observations="state") as env:
        demonstrator = Demonstrator(env)
        env.reset(scenario=0)
        for i in range(3):
            np.testing.assert_allclose(demonstrator.label(), taught[i], atol=1e-6)
            env.step(np.float32(done[i]))
    assert read_metadata(tmp_path / "noisy").noise == 0.05


def test_failures_are_kept_and_marked(tmp_path):
    progress = record(TASK, 2, "train", tmp_path / "short", options={"time_limit_steps": 3})
    frames = columns(tmp_path / "short")
    assert (progress.episodes, progress.successes) == (2, 0)
    assert len(frames["next.done"]) == 6
    assert not any(frames["next.success"])
    assert read_metadata(tmp_path / "short").options == {"time_limit_steps": 3}


def test_resuming_after_a_kill_gives_the_same_dataset(dataset, tmp_path):
    root = tmp_path / "killed"
    script = (
        "import os, signal\n"
        "from hvs_suite.datasets import writer\n"
        "from hvs_suite.datasets.recorder import record\n"
        "writer._WAITING_BYTES = 0\n"
        f"def stop(p):\n    if p.episodes == 3: os.kill(os.getpid(), signal.SIGKILL)\n"
        f"record({TASK!r}, {N}, 'train', {str(root)!r}, block=2, progress=stop)\n"
    )
    ended = subprocess.run([sys.executable, "-c", script], check=False, env=dict(os.environ))
    assert ended.returncode == -signal.SIGKILL
    # Three were written, the third one's block was open.
    assert (root / STAGE).exists()
    assert set(columns(root)["episode_index"]) == {0, 1}
    progress = record(TASK, N, "train", root, resume=True, block=2)
    assert (progress.episodes, progress.successes) == (N, N)
    assert not (root / STAGE).exists()
    assert_same_frames(dataset, root)


def test_files_of_a_half_published_block_are_dropped_on_resume(dataset, tmp_path):
    root = tmp_path / "half"
    shutil.copytree(dataset, root)
    info = json.loads((root / "meta" / "info.json").read_text())
    first = pq.read_table(root / "data" / "chunk-000" / "file-000.parquet")
    info["total_episodes"], info["total_frames"] = 2, first.num_rows
    (root / "meta" / "info.json").write_text(json.dumps(info))
    record(TASK, N, "train", root, resume=True, block=2)
    assert columns(root)["index"] == columns(dataset)["index"]
    assert columns(root)["action"] == columns(dataset)["action"]


def test_a_complete_dataset_is_left_alone_by_resume(dataset):
    before = columns(dataset)["action"]
    progress = record(TASK, N, "train", dataset, resume=True)
    assert progress.episodes == N
    assert columns(dataset)["action"] == before


def test_progress_is_told_after_each_episode(tmp_path):
    told = []
    record(TASK, 3, "train", tmp_path / "told", progress=told.append)
    assert [p.episodes for p in told] == [1, 2, 3]
    assert told[-1].successes == 3
    assert told[-1].episodes_per_s > 0


def test_another_recording_is_not_resumed(dataset):
    with pytest.raises(DatasetError, match="another split"):
        record(TASK, N, "test", dataset, resume=True)


def test_a_folder_that_is_not_empty_is_not_overwritten(dataset, tmp_path):
    with pytest.raises(OutputError, match="--resume"):
        record(TASK, N, "train", dataset)
    (tmp_path / "photo.png").touch()
    with pytest.raises(OutputError, match="no recording"):
        record(TASK, N, "train", tmp_path, resume=True)


def test_a_folder_that_another_recorder_writes_is_left_alone(dataset):
    before = sorted(dataset.rglob("*"))
    with only_writer(dataset), pytest.raises(OutputError, match="another process"):
        record(TASK, N + 1, "train", dataset, resume=True)
    assert sorted(dataset.rglob("*")) == before


def test_a_folder_that_cannot_be_made_is_one_clear_line(tmp_path):
    (tmp_path / "file").touch()
    with pytest.raises(OutputError, match="choose another"):
        record(TASK, 1, "train", tmp_path / "file" / "dataset")


def test_a_folder_that_may_not_be_written_is_one_clear_line(tmp_path, monkeypatch):
    # Permissions do not hold for an administrator, so they are not tried out.
    monkeypatch.setattr("hvs_suite.datasets.writer.os.access", lambda *_: False)
    with pytest.raises(OutputError, match="choose another folder"):
        record(TASK, 1, "train", tmp_path / "dataset")


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"episodes": 0}, OptionError),
        ({"episodes": 1001, "split": "test"}, ScenarioError),
        ({"split": " "}, ScenarioError),
        ({"split": "train\n\x1b[31m"}, ScenarioError),
        ({"noise": -0.1}, OptionError),
        ({"noise": float("nan")}, OptionError),
        ({"workers": 0}, OptionError),
        ({"options": {"eih_channels": 1}}, OptionError),
        ({"options": {"action_mode": "joint_delta"}}, OptionError),
        ({"options": {"no_such_option": 1}}, OptionError),
    ],
)
def test_nonsense_is_refused_before_anything_is_written(change, error, tmp_path):
    arguments = {"task": TASK, "episodes": 1, "split": "train", "out": tmp_path / "new", **change}
    with pytest.raises(error):
        record(**arguments)
    assert not (tmp_path / "new").exists()


def test_a_resumed_recording_drops_nothing_that_another_list_leaves_out(dataset, tmp_path):
    root = tmp_path / "relisted"
    shutil.copytree(dataset, root)
    listed = root / "meta" / "episodes" / "chunk-000" / "file-000.parquet"
    table = pq.read_table(listed)
    index = table.schema.get_field_index("data/file_index")
    moved = table.set_column(index, "data/file_index", [[7] * table.num_rows])
    pq.write_table(moved, listed)
    before = sorted(root.rglob("*"))
    with pytest.raises(DatasetError, match="file-007"):
        record(TASK, N + 1, "train", root, resume=True)
    assert sorted(root.rglob("*")) == before


def test_metadata_of_anything_else_is_refused(tmp_path):
    with pytest.raises(DatasetError, match=r"hvs\.json"):
        read_metadata(tmp_path)
    (tmp_path / "hvs.json").write_text("{")
    with pytest.raises(DatasetError, match="is not JSON"):
        read_metadata(tmp_path)
    (tmp_path / "hvs.json").write_text('{"format": 99}')
    with pytest.raises(DatasetError, match="format"):
        read_metadata(tmp_path)


def test_a_recording_that_cannot_begin_leaves_no_trace(tmp_path, monkeypatch):
    def fail(self):
        raise RenderError("no OpenGL backend works on this machine")

    monkeypatch.setattr(MakeEnvironment, "__call__", fail)
    (tmp_path / "empty").mkdir()
    for root in (tmp_path / "new" / "dataset", tmp_path / "empty"):
        with pytest.raises(RenderError):
            record(TASK, N, "train", root)
    assert [path.name for path in tmp_path.rglob("*")] == ["empty"]
    monkeypatch.undo()
    record(TASK, 1, "train", tmp_path / "empty")
    assert (tmp_path / "empty" / METADATA_FILE).exists()
