"""Runs recorders that are killed, or whose disk fills up, and prints what became of their datasets.

A script of its own: it imports LeRobot once (20 s) and forks a child for each recording, which no
process may do that has already drawn a picture. Prints one JSON object.
"""

import json
import os
import random
import resource
import signal
import sys
import time
import traceback
from pathlib import Path

from lerobot.datasets.lerobot_dataset import LeRobotDataset

from hvs_suite.datasets.recorder import record
from hvs_suite.errors import OutputError

TASK, EPISODES, BLOCK = "align-fixed", 7, 2
# Bytes a file may have: images fit, a block of two episodes does not.
FILE_SIZE_LIMIT = 40_000


def in_child(function, *arguments):
    """Starts a function in a forked process; returns its id."""
    child = os.fork()
    if child:
        return child
    try:
        function(*arguments)
        status = 0
    except BaseException:
        traceback.print_exc()
        status = 1
    os._exit(status)


def ended(child):
    """Waits for a process; its exit code, negative for a signal."""
    return os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])


def play(root):
    record(TASK, EPISODES, "train", root, resume=True, block=BLOCK)


def load(root):
    """LeRobot opens the dataset and gives its first and last frame."""
    dataset = LeRobotDataset("local/any", root=root)
    assert dataset.num_episodes % BLOCK == 0 or dataset.num_episodes == EPISODES
    assert len(dataset) == dataset.meta.total_frames
    assert dataset[0]["task"] == dataset[len(dataset) - 1]["task"]


def fill_the_disk(root, said):
    resource.setrlimit(resource.RLIMIT_FSIZE, (FILE_SIZE_LIMIT, resource.RLIM_INFINITY))
    try:
        play(root)
    except OutputError as error:
        resource.setrlimit(resource.RLIMIT_FSIZE, (resource.RLIM_INFINITY,) * 2)
        said.write_text(str(error))


def main(folder, kills, seed):
    chance = random.Random(seed)
    began = time.monotonic()
    assert ended(in_child(play, folder / "whole")) == 0
    whole_s = time.monotonic() - began
    outcomes = []
    for number in range(kills):
        root = folder / f"killed-{number}"
        after_s = chance.uniform(0.2, 0.98) * whole_s
        child = in_child(play, root)
        time.sleep(after_s)
        os.kill(child, signal.SIGKILL)
        outcome = {"after_s": after_s, "killed": ended(child) == -signal.SIGKILL, "published": 0}
        info = root / "meta" / "info.json"
        if info.exists():
            outcome["published"] = json.loads(info.read_text())["total_episodes"]
            outcome["loads"] = ended(in_child(load, root)) == 0
        outcome["resumes"] = ended(in_child(play, root)) == 0
        outcomes.append(outcome)
    said = folder / "said"
    assert ended(in_child(fill_the_disk, folder / "full", said)) == 0
    full = said.read_text() if said.exists() else ""
    resumed = ended(in_child(play, folder / "full")) == 0
    print(json.dumps({"kills": outcomes, "full": full, "full_resumes": resumed}))


if __name__ == "__main__":
    main(Path(sys.argv[1]), int(sys.argv[2]), int(sys.argv[3]))
