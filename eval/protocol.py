"""How a policy is scored: scenarios 0..N-1 of a split, the task as named, every episode a row."""

import dataclasses
import datetime
import time
from collections.abc import Callable
from pathlib import Path

from hvs_suite import registry, rollout
from hvs_suite.errors import OptionError, ScenarioError
from hvs_suite.eval import provenance, result_file
from hvs_suite.policies.catalogue import policy_factory
from hvs_suite.tasks import lock
from hvs_suite.tasks.scenario import TEST_SCENARIOS, TEST_SPLIT


@dataclasses.dataclass(frozen=True)
class MakeTask:
    """Builds a named task in whichever process asks for it.

    Attributes:
        task: Named task.
        split: Split its scenarios come from.
    """

    task: str
    split: str

    def __call__(self) -> rollout.Environment:
        """Returns a new environment."""
        env: rollout.Environment = registry.load(self.task, split=self.split)
        return env


def evaluate(
    policy: str,
    task: str,
    split: str = TEST_SPLIT,
    episodes: int = TEST_SCENARIOS,
    workers: int = 1,
    progress: Callable[[rollout.Episode], None] | None = None,
) -> result_file.Result:
    """Scores a policy on the first scenarios of a split.

    Args:
        policy: Built-in name or checkpoint folder, as `policy_factory` takes it.
        task: Named task, played as named.
        split: Split to play; ``test`` for a score, any other name for a look.
        episodes: Scenarios to play: 0 to `episodes` - 1.
        workers: Processes; the episodes are the same for any number.
        progress: Called after each episode, in the order in which they end.

    Returns:
        The result, ready to be written.

    Raises:
        UnknownTaskError: There is no such task.
        PolicyError: There is no such policy, or it does not fit the task.
        ScenarioError: The split does not hold that many scenarios.
        OptionError: `episodes` or `workers` is below 1.
        RenderError: Nothing here can draw the images.
    """
    if episodes < 1:
        raise OptionError(f"episodes must be at least 1, not {episodes}")
    if split == TEST_SPLIT and episodes > TEST_SCENARIOS:
        raise ScenarioError(
            f"split {TEST_SPLIT!r} holds {TEST_SCENARIOS} scenarios, not {episodes}; ask for "
            f"{TEST_SCENARIOS} episodes or fewer"
        )
    variant = registry.find(task)
    make_policy = policy_factory(policy, task)
    renderer = provenance.gl_renderer()
    created = datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds")
    started = time.perf_counter()
    played = rollout.rollout(
        MakeTask(task, split), make_policy, range(episodes), workers=workers, on_episode=progress
    )
    wall_s = time.perf_counter() - started
    steps = sum(episode.steps for episode in played)
    rows = [result_file.EpisodeRow.of(episode) for episode in played]
    # A policy that comes from a checkpoint, shipped or not, knows its folder.
    checkpoint: str | None = getattr(make_policy, "folder", None)
    # An absolute path would tell who ran it and where.
    name = Path(policy).name if Path(policy).is_absolute() else policy
    return result_file.Result(
        schema_version=result_file.SCHEMA_VERSION,
        summary=result_file.Summary.of(task, name, split, rows),
        metadata=result_file.Metadata(
            created=created,
            suite_version=provenance.suite_version(),
            task_version=variant.version,
            task_digest=lock.digest(task),
            options={},
            policy_hash=provenance.checkpoint_hash(Path(checkpoint)) if checkpoint else None,
            packages=provenance.package_versions(),
            gl_renderer=renderer,
            cpu=provenance.cpu(),
            platform=provenance.operating_system(),
        ),
        timings=result_file.Timings(
            workers=workers,
            wall_s=wall_s,
            steps_per_s=steps / wall_s,
            decision_ms=1000 * sum(episode.decision_s for episode in played) / steps,
        ),
        episodes=rows,
    )
