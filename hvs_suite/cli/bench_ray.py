"""What ``hvs bench --ray`` measures: playing on Ray against local processes, in the same run."""

import functools
import itertools
import time
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

from hvs_suite.cli import console

if TYPE_CHECKING:
    from hvs_suite.executor import Workers

WORKERS = 2
TURNS = 4
WARM_UP_EPISODES = 10
"""Of each turn; by then all workers have started."""

LABELS = {
    "local_episodes_per_s": "episodes/s of the expert in two local processes, both cameras drawn",
    "ray_episodes_per_s": "episodes/s in two actors of a Ray cluster of this machine alone",
    "ray_ratio": "ratio of the two",
}


def ray_figures(task: str, options: Mapping[str, Any], episodes: int) -> dict[str, float]:
    """Lets the expert play in local processes and on Ray, in turns.

    Args:
        task: A named task.
        options: Options of it.
        episodes: How many each kind plays, over all turns.

    Returns:
        Figures by the names of ``LABELS``; the time in which workers start and end does not count.

    Raises:
        ClusterError: Ray is not installed.
    """
    from hvs_suite.on_ray import LOCAL, RayCluster

    kinds: dict[str, Workers] = {"local": WORKERS, "ray": RayCluster(LOCAL, WORKERS)}
    taken_s = dict.fromkeys(kinds, 0.0)
    counted = dict.fromkeys(kinds, 0)
    share = max(2, episodes // TURNS)
    with console.progress("playing", len(kinds) * TURNS * share) as advance:
        for _, (kind, workers) in itertools.product(range(TURNS), kinds.items()):
            times = _times(task, options, share, workers, advance)
            times = times[min(WARM_UP_EPISODES, share - 2) :]
            taken_s[kind] += times[-1] - times[0]
            counted[kind] += len(times) - 1
    local, on_ray = (counted[kind] / taken_s[kind] for kind in kinds)
    return {
        "local_episodes_per_s": local,
        "ray_episodes_per_s": on_ray,
        "ray_ratio": on_ray / local,
    }


def _times(
    task: str, options: Mapping[str, Any], episodes: int, workers: "Workers", advance: Any
) -> list[float]:
    """When each episode came (s)."""
    import hvs_suite
    from hvs_suite.datasets.expert import make_expert
    from hvs_suite.rollout import rollout

    times: list[float] = []

    def note(_: object) -> None:
        times.append(time.perf_counter())
        advance()

    make = functools.partial(hvs_suite.load, task, **options)
    rollout(make, make_expert, range(episodes), workers=workers, on_episode=note)
    return times
