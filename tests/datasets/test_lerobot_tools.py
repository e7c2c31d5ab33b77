"""LeRobot's own commands take our datasets unchanged: look, edit, train, push, convert.

Each command is a process that imports LeRobot, which takes some 20 s; hence few of them.
"""

import json
import os
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from frames import columns
from hub_server import running_hub

from hvs_suite.cli.main import run
from hvs_suite.datasets.archive import unpack
from hvs_suite.datasets.check import check_dataset
from hvs_suite.policies.checkpoints.loading import CheckpointPolicy
from hvs_suite.registry import TASKS

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "align-thesis"
BIN = Path(sys.executable).parent
TOKEN = "hf_" + "NeverToBeSeen" * 2
# Whatever the endpoint, huggingface_hub has the public Hub look at a card's front matter.
HVS = (
    "from huggingface_hub import repocard\n"
    "repocard.RepoCard.validate = lambda self, repo_type=None: None\n"
    "from hvs_suite.cli.main import main\n"
    "main()"
)
pytestmark = pytest.mark.timeout(600)


def call(folder, *words, **variables):
    """Runs a command with a home of its own; returns what came of it."""
    environment = {
        **os.environ,
        "HOME": str(folder / "home"),
        "HF_HOME": str(folder / "home" / "hf"),
        "HF_HUB_OFFLINE": "1",
        "OMP_NUM_THREADS": "1",
        **variables,
    }
    return subprocess.run(
        [BIN / words[0], *map(str, words[1:])],
        cwd=folder,
        env=environment,
        capture_output=True,
        text=True,
        check=False,
    )


def assert_done(done):
    assert done.returncode == 0, (done.stdout + done.stderr)[-3000:]


def info_of(root):
    return json.loads((root / "meta" / "info.json").read_text())


def test_dataset_viz_writes_an_episode(tmp_path):
    done = call(
        tmp_path, "lerobot-dataset-viz", "--repo-id", "local/sample", "--root", SAMPLE,
        "--episode-index", "1", "--save", "1", "--output-dir", tmp_path / "viz",
        "--num-workers", "0", "--batch-size", "4",
    )  # fmt: skip
    assert_done(done)
    [recording] = (tmp_path / "viz").glob("*.rrd")
    assert recording.stat().st_size > 50_000


@pytest.mark.slow
def test_what_edit_dataset_splits_merges_and_trims_stays_a_dataset_of_ours(tmp_path):
    edit = ("lerobot-edit-dataset", "--repo_id", "local/sample", "--root", SAMPLE)
    done = call(tmp_path, *edit, "--operation.type", "info")
    assert_done(done)
    assert "Total episode: 5" in done.stdout
    halves = '{"first": [0, 1, 2], "second": [3, 4]}'
    split = ("--operation.type", "split", "--operation.splits", halves)
    assert_done(call(tmp_path, *edit, *split, "--new_root", tmp_path / "halves"))
    first, second = tmp_path / "halves" / "first", tmp_path / "halves" / "second"
    assert (info_of(first)["total_episodes"], info_of(second)["total_episodes"]) == (3, 2)
    done = call(
        tmp_path, "lerobot-edit-dataset", "--new_repo_id", "local/merged",
        "--new_root", tmp_path / "merged", "--operation.type", "merge",
        "--operation.repo_ids", '["local/first", "local/second"]',
        "--operation.roots", json.dumps([str(first), str(second)]),
    )  # fmt: skip
    assert_done(done)
    before, after = columns(SAMPLE), columns(tmp_path / "merged")
    for name in ("action", "observation.state", "index", "episode_index", "privileged.scenario"):
        assert before[name] == after[name], name
    trim = ("--operation.type", "delete_episodes", "--operation.episode_indices", "[0, 2]")
    edit = ("lerobot-edit-dataset", "--repo_id", "local/merged", "--root", tmp_path / "merged")
    trimmed = tmp_path / "trimmed"
    assert_done(call(tmp_path, *edit, *trim, "--new_repo_id", "local/t", "--new_root", trimmed))
    for edited in (first, tmp_path / "merged", trimmed):
        assert run(["attach", str(edited), "--origin", str(SAMPLE)]) == 0
        assert run(["check", str(edited)]) == 0
    words = ["pretrain", "--data", str(trimmed), "--out", str(tmp_path / "p"), "--steps", "1"]
    assert run(words) == 0
    assert run(["share", str(trimmed), "--to-archive", str(tmp_path / "t.tar")]) == 0


@pytest.mark.slow
def test_act_trains_for_a_few_steps_and_is_scored(tmp_path):
    done = call(
        tmp_path, "lerobot-train", "--dataset.repo_id=local/sample", f"--dataset.root={SAMPLE}",
        "--policy.type=act", "--policy.device=cpu", "--policy.push_to_hub=false",
        "--policy.pretrained_backbone_weights=null", "--policy.dim_model=64", "--policy.n_heads=2",
        "--policy.dim_feedforward=64", "--policy.latent_dim=8", "--policy.chunk_size=4",
        "--policy.n_action_steps=4", "--policy.n_encoder_layers=1",
        "--num_workers=0", "--batch_size=2", "--steps=2", "--log_freq=1", "--env_eval_freq=0",
        "--wandb.enable=false", f"--output_dir={tmp_path / 'act'}",
    )  # fmt: skip
    assert_done(done)
    [model] = (tmp_path / "act").rglob("model.safetensors")
    assert model.stat().st_size > 100_000
    # As docs/baselines.md says: what stock training leaves is scored like any policy.
    checkpoint, result = tmp_path / "act/checkpoints/last/pretrained_model", tmp_path / "act.json"
    done = call(
        tmp_path, "hvs", "evaluate", "--policy", checkpoint, "--task", "align-thesis",
        "--episodes", "1", "--decision-limit", "60", "--out", result,
    )  # fmt: skip
    assert_done(done)
    scored = json.loads(result.read_text())
    assert scored["summary"]["failures"] == {}
    assert (scored["metadata"]["policy_kind"], scored["metadata"]["training_steps"]) == (
        "checkpoint",
        2,
    )


def test_our_policy_trains_on_windows_resumes_and_is_played_without_lerobot(tmp_path):
    discover = "--policy.discover_packages_path=hvs_suite.policies.hvs"
    out = tmp_path / "belief"
    done = call(
        tmp_path, "lerobot-train", discover, "--policy.type=hvs",
        "--dataset.repo_id=local/sample", f"--dataset.root={SAMPLE}", "--policy.device=cpu",
        "--policy.push_to_hub=false", "--policy.window=3", "--policy.channels=8",
        "--policy.hidden=32", "--num_workers=0", "--batch_size=2", "--steps=2", "--log_freq=1",
        "--env_eval_freq=0", "--wandb.enable=false", f"--output_dir={out}",
    )  # fmt: skip
    assert_done(done)
    checkpoint = out / "checkpoints/last/pretrained_model"
    before = (checkpoint / "model.safetensors").read_bytes()
    settings = f"--config_path={checkpoint / 'train_config.json'}"
    done = call(tmp_path, "lerobot-train", discover, settings, "--resume=true", "--steps=3")
    assert_done(done)
    assert (checkpoint / "model.safetensors").read_bytes() != before
    CheckpointPolicy(checkpoint, TASKS["align-thesis"])


def test_hub_gets_every_file_and_nobody_sees_the_token(tmp_path):
    root = tmp_path / "sample"
    shutil.copytree(SAMPLE, root)
    words = ("python", "-c", HVS, "share", root, "--to-hub", "somebody/align", "--private")
    with running_hub() as hub:
        done = call(
            tmp_path, *words, HF_ENDPOINT=hub.url, HF_TOKEN=TOKEN, HF_HUB_OFFLINE="0",
            HF_HUB_DISABLE_XET="1",
        )  # fmt: skip
    assert_done(done)
    assert "pushed to somebody/align" in done.stdout
    [created] = hub.created
    assert created["type"] == "dataset"
    assert created.get("private") or created.get("visibility") == "private"
    assert hub.authorizations - {None} == {f"Bearer {TOKEN}"}
    local = {p.relative_to(root).as_posix(): p for p in root.rglob("*") if p.is_file()}
    assert set(hub.files) == set(local)
    for name, path in local.items():
        if name != "README.md":
            assert hub.files[name] == path.read_bytes(), name
    card = hub.files["README.md"].decode()
    assert card.startswith("---\n")
    for words in ("5 of 5 (100.0 %)", "pictures.png", "license: apache-2.0", "task digest"):
        assert words in card
    assert TOKEN not in done.stdout + done.stderr
    seen = [p for p in tmp_path.rglob("*") if p.is_file() and TOKEN.encode() in p.read_bytes()]
    assert seen == []
    assert not any(TOKEN.encode() in content for content in hub.files.values())


def test_a_hub_that_refuses_is_one_line(tmp_path):
    root = tmp_path / "sample"
    shutil.copytree(SAMPLE, root)
    with running_hub(refuse=403) as hub:
        done = call(
            tmp_path, "hvs", "share", root, "--to-hub", "somebody/align", HF_ENDPOINT=hub.url,
            HF_TOKEN=TOKEN, HF_HUB_OFFLINE="0", HF_HUB_DISABLE_XET="1",
        )  # fmt: skip
    assert done.returncode == 2, done.stderr[-2000:]
    assert "403" in done.stderr.splitlines()[-1]
    assert done.stderr.splitlines()[-1].startswith("hvs: ")
    assert "Traceback" not in done.stderr
    assert TOKEN not in done.stdout + done.stderr


@pytest.mark.parametrize(
    ("codec", "pixel_format", "named"),
    [("libsvtav1", "yuv420p", "av1"), ("h264", "yuv444p", "h264")],
)
def test_a_shared_video_copy_is_sound_and_smaller(
    codec, pixel_format, named, tmp_path, monkeypatch
):
    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    root = tmp_path / "sample"
    shutil.copytree(SAMPLE, root)
    archive = tmp_path / "video.tar"
    how = ["--video", "--codec", codec, "--crf", "20", "--pixel-format", pixel_format]
    assert run(["share", str(root), "--to-archive", str(archive), *how]) == 0
    unpack(archive, tmp_path / "video")
    features = info_of(tmp_path / "video")["features"]
    assert features["observation.images.eih"]["dtype"] == "video"
    assert features["observation.images.eih"]["info"]["video.pix_fmt"] == pixel_format
    assert len(list((tmp_path / "video" / "videos").rglob("*.mp4"))) == 2
    assert f"{named}, lossy" in (tmp_path / "video" / "README.md").read_text()
    report = check_dataset(tmp_path / "video")
    assert [str(each) for each in report.damage] == []
    # The recording itself stays as it was.
    before, after = columns(SAMPLE), columns(root)
    assert before["observation.images.eth"] == after["observation.images.eth"]
    np.testing.assert_array_equal(before["action"], after["action"])
