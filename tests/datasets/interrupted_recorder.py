"""Runs recorders that are killed, or whose disk fills up, and prints what became of their datasets.

A script of its own: it imports LeRobot once (20 s) and forks a child for each recording, which no
process may do that has already drawn a picture. Prints one JSON object.
"""

import json
import os
import random
import resource
import select
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


def play(root, progress=None):
    record(TASK, EPISODES, "train", root, resume=True, block=BLOCK, progress=progress)


def watched(root, episodes, pause_s=0.0, kill=False):
    """Runs a recorder until so many episodes are there, and then for a while, or to its end.

    Counted in episodes, because no two recordings take the same time; the while ends early with the
    next episode, or a fast recording would be over. Returns its exit code, and the seconds to its
    first episode and between the later ones.
    """
    reader, writer = os.pipe()
    moments = [time.monotonic()]
    child = in_child(play, root, lambda _: os.write(writer, b"."))
    os.close(writer)
    while len(moments) <= episodes and os.read(reader, 1):
        moments.append(time.monotonic())
    if kill:
        select.select([reader], [], [], pause_s)
        os.kill(child, signal.SIGKILL)
    code = ended(child)
    os.close(reader)
    first_s = moments[min(1, episodes)] - moments[0]
    return code, first_s, (moments[-1] - moments[0] - first_s) / max(1, episodes - 1)


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
    code, first_s, each_s = watched(folder / "whole", EPISODES)
    assert code == 0
    outcomes = []
    # Before the first episode, after the last, and everywhere between.
    order = chance.sample(range(EPISODES + 1), EPISODES + 1)
    for number in range(kills):
        root = folder / f"killed-{number}"
        episodes = order[number % len(order)]
        pause_s = chance.random() * (each_s if episodes else first_s)
        code, *_ = watched(root, episodes, pause_s, kill=True)
        outcome = {"episodes": episodes, "killed": code == -signal.SIGKILL, "published": 0}
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
