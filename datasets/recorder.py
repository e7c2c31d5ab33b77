"""Recording: demonstrations of a task as one LeRobot dataset.

Workers play scenarios, render and encode; this process alone writes. Episode i of the
dataset is scenario i of the split, whatever the number of workers and however often the recording
was interrupted.
"""

import contextlib
import dataclasses
import math
import time
from collections.abc import Callable, Iterable, Iterator, Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hvs_suite.datasets.features import dataset_features
from hvs_suite.datasets.metadata import (
    EXPERT,
    METADATA_FILE,
    DatasetMetadata,
    read_metadata,
    write_metadata,
)
from hvs_suite.errors import DatasetError, HvsError, OptionError, OutputError, ScenarioError
from hvs_suite.executor import Workers, check_workers
from hvs_suite.names import check_name
from hvs_suite.registry import find, options_of
from hvs_suite.rollout import PolicyFactory, play
from hvs_suite.tasks.shared.lock import digest
from hvs_suite.tasks.shared.scenario import TEST_SCENARIOS, TEST_SPLIT

if TYPE_CHECKING:
    from hvs_suite.datasets.writer import DatasetWriter

BLOCK_EPISODES = 50
"""Episodes between two publications: what a kill can cost."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Progress:
    """How far a recording has come.

    Attributes:
        episodes: Episodes written, earlier sessions included.
        total: Episodes asked for.
        successes: Those of them that reached the goal.
        frames: Frames written in this session.
        episodes_per_s: Rate of this session, from its first episode on.
        remaining_s: Time left at that rate (s); None before there is one.
    """

    episodes: int
    total: int
    successes: int
    frames: int
    episodes_per_s: float
    remaining_s: float | None


def record(
    task: str,
    episodes: int,
    split: str,
    out: str | Path,
    options: Mapping[str, Any] | None = None,
    *,
    workers: Workers = 1,
    noise: float = 0.0,
    demonstrator: str = EXPERT,
    make: PolicyFactory | None = None,
    resume: bool = False,
    progress: Callable[[Progress], None] | None = None,
    command: str = "",
    block: int = BLOCK_EPISODES,
) -> Progress:
    """Records scenarios 0 to ``episodes`` - 1 of a split; failures are kept and marked.

    Args:
        task: Registered name.
        episodes: Episodes the dataset shall hold in the end.
        split: Stream of scenarios.
        out: Root of the dataset; missing or empty, unless ``resume``.
        options: Options of the task, start distributions among them.
        workers: Processes that play, 1 being this one; or others elsewhere.
        noise: Standard deviation of the temporally correlated perturbation of the executed joint
            targets, far from the goal (rad). The demonstrator's own action stays the label.
        demonstrator: Name of the policy that demonstrates, for ``hvs.json``.
        make: Builds that policy for an environment; None builds the expert.
        resume: Go on after the last published episode.
        progress: Called after each episode.
        command: What to write into ``hvs.json`` as the command that made the dataset.
        block: Episodes between two publications.

    Returns:
        The final progress.

    Raises:
        UnknownTaskError: There is no such task.
        OptionError: An option or a number makes no sense.
        ScenarioError: The split holds fewer scenarios.
        OutputError: ``out`` is not empty without ``resume``, cannot be written, or is in use.
        DatasetError: What ``resume`` found was recorded otherwise.
    """
    spec = find(task).with_options(dict(options or {}))
    features = dataset_features(spec)
    check_workers(workers)
    _check_numbers(episodes, split, noise, block)
    root = Path(out)
    metadata = DatasetMetadata(
        task=task,
        task_version=spec.version,
        split=split,
        options=options_of(spec),
        noise=float(noise),
        demonstrator=demonstrator,
        command=command,
        task_digest=digest(task),
    )
    # PyArrow and the simulator load only once the arguments have passed.
    from hvs_suite.datasets.demonstration import Demonstrate, MakeEnvironment
    from hvs_suite.datasets.looking import make_demonstrator
    from hvs_suite.datasets.writer import DatasetWriter, published_outcomes, taken

    if resume:
        _check_same_recording(root, metadata)
    missing = [folder for folder in (root, *root.parents) if not folder.exists()]
    with taken(root, resume=resume), _removed_if_empty(missing):
        outcomes = published_outcomes(root)
        tracker = _Tracker(len(outcomes), sum(outcomes), episodes, progress)
        writer = DatasetWriter(root, features, spec.fps, block)
        played = play(
            MakeEnvironment(task, split, metadata.options),
            make or make_demonstrator,
            range(len(outcomes), episodes),
            Demonstrate(noise, looks=make is not None),
            workers=workers,
        )
        with _publishing(writer, root, episodes), contextlib.closing(played):
            for demonstration in in_order(played, len(outcomes)):
                # Not before there is something to keep: see `_removed_if_empty`.
                if tracker.frames == 0:
                    write_metadata(root, metadata)
                writer.save(demonstration)
                tracker.saved(demonstration.length, demonstration.success)
    return tracker.state()


@contextlib.contextmanager
def _removed_if_empty(folders: Iterable[Path]) -> Iterator[None]:
    """Removes the folders of a recording that could not begin, such as without OpenGL."""
    try:
        yield
    finally:
        for folder in folders:
            with contextlib.suppress(OSError):
                folder.rmdir()


@contextlib.contextmanager
def _publishing(writer: "DatasetWriter", root: Path, episodes: int) -> Iterator[None]:
    """Publishes what was saved, however the recording ends.

    Raises:
        OutputError: There is no room, or no right to write.
    """
    from hvs_suite.datasets.writer import published_outcomes

    try:
        try:
            yield
        except (KeyboardInterrupt, HvsError):
            writer.publish()
            raise
        writer.publish()
    except OSError as error:
        if isinstance(error, HvsError):
            raise
        writer.discard()
        saved = len(published_outcomes(root))
        if not saved:
            # The same command begins anew, with or without --resume.
            (root / METADATA_FILE).unlink(missing_ok=True)
        raise OutputError(
            f"cannot write {root}: {error.strerror or error}; {saved} of {episodes} episodes "
            "are saved, go on with --resume"
        ) from error


def in_order[T: Any](demonstrations: Iterable[T], first: int) -> Iterator[T]:
    """Demonstrations by scenario, holding back those that ended before their turn."""
    waiting: dict[int, T] = {}
    turn = first
    for demonstration in demonstrations:
        waiting[demonstration.scenario] = demonstration
        while turn in waiting:
            yield waiting.pop(turn)
            turn += 1


class _Tracker:
    """Counts episodes and estimates the time left."""

    def __init__(
        self,
        episodes: int,
        successes: int,
        total: int,
        progress: Callable[[Progress], None] | None,
    ) -> None:
        self._before = self._episodes = episodes
        self._successes = successes
        self._total = total
        self.frames = 0
        self._progress = progress
        # Until the first episode is there, workers start: not part of the rate.
        self._since: float | None = None

    def saved(self, frames: int, success: bool) -> None:
        """Counts one episode and reports."""
        self._episodes += 1
        self._successes += success
        self.frames += frames
        if self._since is None:
            self._since = time.monotonic()
        if self._progress is not None:
            self._progress(self.state())

    def state(self) -> Progress:
        """The progress now."""
        elapsed = 0.0 if self._since is None else time.monotonic() - self._since
        counted = self._episodes - self._before - 1
        rate = counted / elapsed if counted > 0 and elapsed > 0.0 else 0.0
        return Progress(
            episodes=self._episodes,
            total=self._total,
            successes=self._successes,
            frames=self.frames,
            episodes_per_s=rate,
            remaining_s=(self._total - self._episodes) / rate if rate > 0.0 else None,
        )


def _check_numbers(episodes: int, split: str, noise: float, block: int) -> None:
    """Refuses counts and noise that make no sense."""
    if episodes < 1:
        raise OptionError(f"episodes is {episodes}; record at least 1")
    if not split.strip():
        raise ScenarioError("a split is a name such as 'train'; name one with --split")
    check_name(split, "the split", error=ScenarioError)
    if split == TEST_SPLIT and episodes > TEST_SCENARIOS:
        raise ScenarioError(
            f"split 'test' holds {TEST_SCENARIOS} scenarios, not {episodes}; record fewer, or "
            "--split train"
        )
    if not math.isfinite(noise) or noise < 0.0:
        raise OptionError(f"noise is {noise}; use a standard deviation in rad from 0 up")
    if block < 1:
        raise OptionError(f"block is {block}; publish every 1 or more episodes")


def _check_same_recording(root: Path, metadata: DatasetMetadata) -> None:
    """Refuses to go on with a dataset of other demonstrations.

    Raises:
        OutputError: The folder holds something that is no recording.
        DatasetError: It holds another recording.
    """
    # A recorder that was killed at once may leave a hidden file of its own, and nothing else.
    if not root.is_dir() or all(entry.name.startswith(".") for entry in root.iterdir()):
        return
    if not (root / METADATA_FILE).exists():
        raise OutputError(f"{root} holds no recording to resume; choose another folder")
    found = read_metadata(root)
    if not found.same_recording(metadata):
        names = [
            name
            for name in DatasetMetadata.model_fields
            if name not in ("command", "task_digest")
            and getattr(found, name) != getattr(metadata, name)
        ]
        raise DatasetError(
            f"{root} was recorded with another {', '.join(names) or 'meaning of the task'}; resume "
            "with the same, or choose another folder"
        )
