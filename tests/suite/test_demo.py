"""``hvs demo``: what a newcomer gets is real, and plain LeRobot reads it."""

import json
import re
import sys
from pathlib import Path

import pytest

from hvs_suite.cli.demo import busy
from hvs_suite.cli.main import run
from hvs_suite.eval.scoring import result_file

EPISODES, EVALUATIONS = 3, 2


@pytest.fixture(scope="module")
def demo(tmp_path_factory):
    """The demo's folder, after the smallest demo there is."""
    out = tmp_path_factory.mktemp("demo") / "runs"
    words = ["--episodes", EPISODES, "--minutes", 0.02, "--evaluations", EVALUATIONS]
    words += ["--dagger-frames", 20]
    assert run(["demo", "--out", str(out), *map(str, words)]) == 0
    return out


def test_demo_records_a_dataset_that_plain_lerobot_reads(demo):
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    dataset = LeRobotDataset("local/demo", root=demo / "dataset")
    assert dataset.num_episodes == EPISODES
    assert dataset[0]["observation.images.eih"].shape == (3, 112, 112)


def test_demo_trains_a_policy_that_plain_from_pretrained_loads(demo):
    from lerobot.policies.factory import get_policy_class

    import hvs_suite.policies.hvs  # noqa: F401  (registers the policy, as discovery would)

    policy = get_policy_class("hvs").from_pretrained(demo / "policy")
    assert sum(p.numel() for p in policy.parameters()) > 0


def test_demo_scores_that_policy_as_it_is(demo):
    result = result_file.load(demo / "results" / "demo" / "align-easy.json")
    assert result.summary.task == "align-easy"
    assert len(result.episodes) == EVALUATIONS


@pytest.mark.timeout(300)
def test_lerobot_eval_plays_the_policy_with_the_words_of_the_readme(demo, tmp_path, monkeypatch):
    from lerobot.scripts import lerobot_eval

    text = (Path(__file__).parents[2] / "README.md").read_text(encoding="utf-8")
    [words] = re.findall(r"^OMP_NUM_THREADS=1 lerobot-eval ((?:.*\\\n)*.*)$", text, re.MULTILINE)
    words = words.replace("runs/demo/policy", str(demo / "policy")).replace("\\\n", " ")
    monkeypatch.setattr("sys.argv", ["lerobot-eval", *words.split(), f"--output_dir={tmp_path}"])
    # The same line again, short: the parser takes the last word on a subject.
    sys.argv += ["--eval.n_episodes=1", "--env.episode_length=4"]
    lerobot_eval.main()
    result = json.loads((tmp_path / "eval_info.json").read_text())
    assert result["overall"]["n_episodes"] == 1


def test_demo_builds_a_board_with_a_row_for_its_policy(demo):
    assert "demo" in (demo / "board" / "LEADERBOARD.md").read_text()


def test_demo_films_an_episode_with_both_cameras_beside_the_cell(demo):
    import imageio.v3 as iio
    import numpy as np

    from hvs_suite.pictures import CELL_SIDE, PANEL_WIDTH

    frames = iio.imread(demo / "episode.gif")
    assert frames.shape[1:] == (CELL_SIDE, CELL_SIDE + PANEL_WIDTH, 3)
    assert np.abs(frames[0].astype(int) - frames[-1]).max() > 50


def test_demo_replaces_only_its_own_files(demo, capsys):
    assert run(["demo", "--out", str(demo)]) == 2
    assert "--overwrite" in capsys.readouterr().err


def test_demo_says_what_to_do_where_it_could_hardly_learn():
    assert busy(2269, minutes=4.0) == ""
    assert "130 steps only" in busy(130, minutes=4.0)
    assert "OMP_WAIT_POLICY=PASSIVE" in busy(130, minutes=4.0)
