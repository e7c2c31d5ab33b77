"""A recorder that is killed at any moment, or whose disk fills up, loses no more than a block."""

import json
import random
import subprocess
import sys
from pathlib import Path

import pytest
from frames import assert_same_frames, columns

from hvs_suite.datasets.check import check_dataset

SCRIPT = Path(__file__).with_name("interrupted_recorder.py")
EPISODES, BLOCK = 7, 2


@pytest.fixture(scope="module", params=[2, pytest.param(20, marks=pytest.mark.slow)])
def interrupted(request, tmp_path_factory):
    """Folder of all datasets, and what the script says of them."""
    folder = tmp_path_factory.mktemp("interrupted")
    seed = random.SystemRandom().randrange(1000)
    print(f"seed {seed}")
    done = subprocess.run(
        [sys.executable, SCRIPT, folder, str(request.param), str(seed)],
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stderr[-3000:]
    return folder, json.loads(done.stdout.splitlines()[-1])


@pytest.mark.timeout(1800)
def test_what_a_killed_recorder_leaves_loads_and_resumes_to_the_same_dataset(interrupted):
    folder, said = interrupted
    assert len(set(columns(folder / "whole")["episode_index"])) == EPISODES
    for number, kill in enumerate(said["kills"]):
        assert kill.get("loads", True), kill
        assert kill["published"] % BLOCK == 0 or kill["published"] == EPISODES
        assert kill["resumes"], kill
        assert_same_frames(folder / "whole", folder / f"killed-{number}")
        # Two episodes and a publication before its end, it cannot have finished.
        assert kill["killed"] or kill["episodes"] > EPISODES - 2, kill
    assert any(kill["killed"] for kill in said["kills"])


@pytest.mark.timeout(1800)
def test_a_resumed_dataset_passes_the_check(interrupted):
    folder, _ = interrupted
    assert [str(each) for each in check_dataset(folder / "killed-0", pictures=False).damage] == []


@pytest.mark.timeout(1800)
def test_a_full_disk_is_one_line_that_says_what_is_saved(interrupted):
    folder, said = interrupted
    assert "cannot write" in said["full"]
    assert "of 7 episodes are saved" in said["full"]
    assert "--resume" in said["full"]
    assert "\n" not in said["full"]
    assert said["full_resumes"]
    assert_same_frames(folder / "whole", folder / "full")
