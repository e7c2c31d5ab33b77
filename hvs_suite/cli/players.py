"""The workers that play: local processes, or a Ray cluster."""

import dataclasses
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hvs_suite.executor import Workers
    from hvs_suite.on_ray import RayCluster


@dataclasses.dataclass(frozen=True, kw_only=True)
class Players:
    """Options of all commands that can play episodes in several processes.

    Attributes:
        workers: Processes that play; the results are the same for any number. By default 1 (2 for
            pretrain, finetune-way and study), or with --ray one for each core of the cluster, also
            for cores that join it later.
        ray: Play on a Ray cluster (docs/many-machines.md): auto for the one that this machine
            belongs to, an address such as 10.0.0.1:6379, or local for one of this machine alone.
    """

    workers: int | None = None
    ray: str | None = None

    def players(self, local: int = 1) -> "Workers":
        """The workers that play.

        Args:
            local: Processes where neither is said.
        """
        return players(self.workers, self.ray, local)


def players(workers: int | None, ray: str | None, local: int) -> "Workers":
    """The workers that play, as the command line names them.

    Args:
        workers: How many, if that is said.
        ray: Address of a Ray cluster, if one is to play.
        local: Local processes where neither is said.

    Raises:
        OptionError: `workers` is below 1.
        ClusterError: The cluster cannot be joined.
    """
    if ray is None:
        return local if workers is None else workers
    return on_ray(ray, workers)


def on_ray(address: str, workers: int | None) -> "RayCluster":
    """Joins a Ray cluster, before anything else is made.

    Raises:
        OptionError: `workers` is below 1.
        ClusterError: It cannot be joined.
    """
    from hvs_suite.on_ray import RayCluster, join

    cluster = RayCluster(address, workers)
    join(address)
    return cluster
