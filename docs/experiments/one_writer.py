"""One writer or shards, and what one driver can read: the figures of docs/many-machines.md."""

import contextlib
import dataclasses
import pickle
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

EPISODES = 100
TASK = "align-thesis"


def writer(folder: Path) -> None:
    """Prints how many episodes a second one writer takes, the processor's time counted."""
    from hvs_suite.datasets.demonstration import Demonstrate, MakeEnvironment
    from hvs_suite.datasets.features import dataset_features
    from hvs_suite.datasets.looking import make_demonstrator
    from hvs_suite.datasets.writer import DatasetWriter
    from hvs_suite.registry import find
    from hvs_suite.rollout import play

    spec = find(TASK)
    played = play(
        MakeEnvironment(TASK, "train", {}), make_demonstrator, range(EPISODES), Demonstrate(0.0)
    )
    demonstrations = list(played)
    print(f"{np.mean([len(pickle.dumps(each)) for each in demonstrations]):.0f} bytes an episode")
    dataset = DatasetWriter(folder / "one", dataset_features(spec), spec.fps, 50)
    started = time.process_time()
    for demonstration in demonstrations:
        dataset.save(demonstration)
    dataset.publish()
    print(f"one writer: {EPISODES / (time.process_time() - started):.0f} episodes/s")


def shards(folder: Path) -> None:
    """Prints how many episodes a second LeRobot merges, from two datasets."""
    from lerobot.datasets.aggregate import aggregate_datasets

    from hvs_suite.datasets.recorder import record

    roots = [folder / "shard-0", folder / "shard-1"]
    for root in roots:
        record(TASK, EPISODES // 2, root.name, root)
    started = time.process_time()
    names = [root.name for root in roots]
    aggregate_datasets(names, "merged", roots=roots, aggr_root=folder / "merged")
    print(f"LeRobot's merge: {EPISODES / (time.process_time() - started):.0f} episodes/s")


@dataclasses.dataclass(frozen=True)
class Answer:
    """A worker that answers at once, with some bytes."""

    size: int

    @contextlib.contextmanager
    def __call__(self, note: Callable[[Any], None]) -> Iterator[Callable[[int], bytes]]:
        """Makes its bytes once."""
        content = np.random.default_rng(0).bytes(self.size)
        yield lambda index: content


def driver() -> None:
    """Prints what reading a result costs, by its size."""
    from hvs_suite.executor import spread
    from hvs_suite.on_ray import RayCluster

    for size in (2_000, 100_000, 1_000_000):
        answers = spread(Answer(size), range(1000), workers=RayCluster("local", 2))
        next(answers)
        started = time.process_time()
        count = sum(1 for _ in answers)
        cost_ms = 1000 * (time.process_time() - started) / count
        print(f"{size} bytes: {cost_ms:.2f} ms of the driver's core")


if __name__ == "__main__":
    place = Path(sys.argv[1])
    shutil.rmtree(place, ignore_errors=True)
    place.mkdir(parents=True)
    writer(place)
    shards(place)
    driver()
