"""Workers on the machines of a Ray cluster (https://docs.ray.io), one actor for each core.

They give the same results as local processes. An actor builds its environment and its policy once
and is told a few indices ahead, so that neither it nor the reader waits for the other, and at most
these few results of each actor wait to be read. Actors without a free core wait for one, because
machines may join later. If a machine dies, other actors do its work again.

No other module imports Ray, and this one imports it only when actors are needed.
"""

import collections
import contextlib
import dataclasses
import functools
import hashlib
import heapq
import importlib.metadata
import logging
import os
import platform
import socket
import sys
import time
from collections.abc import Callable, Generator, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from hvs_suite.errors import ClusterError, OptionError, first_line
from hvs_suite.executor import (
    WORKER_ENVIRONMENT,
    WORKER_EXIT_TIMEOUT_S,
    Make,
    Note,
    failure,
    opened,
)

LOCAL = "local"
LIVES = 3
"""Workers that one index may end, one after the other, before it is taken to be the reason."""
OUT_OF_TURN = 30
"""Indices that each actor, on average, may be ahead of the oldest that is not done: a reader who
sorts results has to keep them until that comes, up to half a minute after a machine fell silent."""
LOOK_ROUND_S = 1.0
"""Time after which the cluster is looked at again, in case it has grown (s)."""
KNOCK_S = 5.0
# Packages that can change a physics state, a picture, or a policy's action.
PACKAGES = ("mujoco", "dm-control", "numpy", "opencv-python-headless", "pin", "ruckig", "torch")


@dataclasses.dataclass(frozen=True)
class RayCluster:
    """Actors of a Ray cluster, to be given as ``workers``.

    Attributes:
        address: ``auto`` for the cluster that this machine belongs to, an address such as
            ``10.0.0.1:6379``, or ``local`` for one that begins and ends with this process and
            listens to this machine alone.
        workers: Actors to ask for, whether there is room for them now or later; None is one for
            each core that the cluster has, and will have.
    """

    address: str
    workers: int | None = None

    def __post_init__(self) -> None:
        if self.workers is not None and self.workers < 1:
            raise OptionError(f"workers must be at least 1, not {self.workers}")

    def size(self) -> int:
        """How many actors there are to be, as the cluster is now.

        Raises:
            ClusterError: It cannot be joined.
        """
        cores = int(join(self.address).cluster_resources().get("CPU", 0))
        # Where there is no core yet, one actor that waits tells an autoscaler that it is needed.
        return self.workers or max(1, cores)

    def spread[T](
        self, make: Make[T], indices: Sequence[int], *, ahead: int, on_note: Note | None
    ) -> Generator[T, None, None]:
        """Does what :func:`hvs_suite.executor.spread` does.

        Args:
            make: Makes an actor's function; Ray pickles it.
            indices: Handed out in this order; those of a machine that died come again, first.
            ahead: Indices that an actor holds.
            on_note: Called here with what actors say meanwhile.

        Yields:
            One result an index, in the order in which they come.

        Raises:
            ClusterError: It cannot be joined, or an actor's machine has other packages.
            HvsError: Whatever typed error an actor raised.
            RuntimeError: Any other failure, or an index that ends every actor.
        """
        with contextlib.closing(_Crew(self, make, indices, ahead, on_note)) as crew:
            yield from crew.results()


def join(address: str) -> Any:
    """Joins a cluster, unless this process has joined one already; returns the ``ray`` module.

    Args:
        address: As in `RayCluster`.

    Raises:
        ClusterError: Ray is not installed, or there is no such cluster.
    """
    if address == LOCAL:
        # Ray's heads listen to every network otherwise. Read when Ray is imported.
        os.environ["RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER"] = "0"
        os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    try:
        import ray
    except ImportError as error:
        raise ClusterError("playing on Ray needs it installed: hvs-suite[ray]") from error
    if ray.is_initialized():
        return ray
    _check_reachable(os.environ.get("RAY_ADDRESS", address) if address == "auto" else address)
    dashboard = False if address == LOCAL else None
    try:
        ray.init(
            address,
            include_dashboard=dashboard,
            log_to_driver=False,
            logging_level=logging.ERROR,
        )
    except (OSError, RuntimeError, ValueError, ray.exceptions.RayError) as error:
        raise ClusterError(
            f"cannot join a Ray cluster at {address}: {first_line(error)}; 'ray start' makes one "
            "(docs/many-machines.md)"
        ) from error
    return ray


def _check_reachable(address: str) -> None:
    """Checks that something answers at an address; Ray itself would try for many minutes.

    Raises:
        ClusterError: Nothing answers.
    """
    if address in ("auto", LOCAL) or "://" in address:
        return
    host, _, port = address.rpartition(":")
    try:
        socket.create_connection((host, int(port)), KNOCK_S).close()
    except (OSError, ValueError) as error:
        raise ClusterError(
            f"no Ray cluster answers at {address!r}: {first_line(error)}; 'ray start --head' makes "
            "one, whose address is such as 10.0.0.1:6379 (docs/many-machines.md)"
        ) from error


def remote(ray: Any, kind: type) -> Callable[..., Any]:
    """A factory of actors of a class: on a core each, under the conditions of a local worker.

    Args:
        ray: As `join` returns it.
        kind: The class.
    """
    return ray.remote(num_cpus=1, runtime_env={"env_vars": _environment()})(kind).remote


@dataclasses.dataclass(eq=False)
class _Actor:
    """An actor and the answers that are expected of it.

    Attributes:
        handle: Ray's handle of it.
        made: Answers once it is made, with its machine and what is installed there.
        machine: Ray's name of its machine; None until it is made.
        told: What it was told and has not answered, oldest first: place and answer.
    """

    handle: Any
    made: Any
    machine: str | None = None
    told: collections.deque[tuple[int, Any]] = dataclasses.field(default_factory=collections.deque)

    @property
    def answer(self) -> Any:
        """What it answers next; None if it has nothing to do."""
        if self.machine is None:
            return self.made
        return self.told[0][1] if self.told else None


class _Crew:
    """The actors of one `RayCluster.spread`, and the work of each.

    An index goes by its place in the order in which they are to be handed out.
    """

    def __init__(
        self,
        cluster: RayCluster,
        make: Make[Any],
        indices: Sequence[int],
        ahead: int,
        on_note: Note | None,
    ) -> None:
        self._ray = join(cluster.address)
        self._cluster = cluster
        self._indices = indices
        self._ahead = ahead
        # A heap: lost work is the oldest, and is done first.
        self._waiting = list(range(len(indices)))
        self._actors: list[_Actor] = []
        self._ended: collections.Counter[int | None] = collections.Counter()
        self._next_look = 0.0
        self._here = installed()
        self._on_note = on_note
        self._notes: Any = None
        if on_note is not None:
            from ray.util import queue

            self._notes = queue.Queue(actor_options={"num_cpus": 0})
        try:
            # Once for all; in a list, because what cannot be read there is to be told by the actor.
            job = [self._ray.put((make, self._notes))]
        except TypeError as error:
            raise OptionError(
                f"factories travel to other machines, and this one cannot ({first_line(error)})"
            ) from error
        self._new = functools.partial(remote(self._ray, _Worker), job)

    def results(self) -> Iterator[Any]:
        """Yields results as they come."""
        gone = (self._ray.exceptions.RayActorError, self._ray.exceptions.ObjectLostError)
        while heads := [*(a.told[0][0] for a in self._actors if a.told), *self._waiting[:1]]:
            self._grow()
            horizon = min(heads) + OUT_OF_TURN * len(self._actors)
            for actor in self._actors:
                self._tell(actor, horizon)
            for actor in self._answered():
                try:
                    _, content = opened(self._ray.get(actor.answer))
                except gone as error:
                    self._lose(actor, error)
                    continue
                if actor.machine is None:
                    actor.machine, there = content
                    self._check(there)
                    del self._ended[None]
                    self._tell(actor, horizon)
                else:
                    actor.told.popleft()
                    self._tell(actor, horizon)
                    yield content
            self._hear()

    def _hear(self) -> None:
        """Passes on what actors have said."""
        if self._on_note is not None:
            for words in self._notes.get_nowait_batch(self._notes.qsize()):
                self._on_note(words)

    def close(self) -> None:
        """Ends all actors: those that have nothing to do by their own closing."""
        idle = [actor for actor in self._actors if actor.machine is not None and not actor.told]
        closed = [actor.handle.close.remote() for actor in idle]
        if closed:
            self._ray.wait(closed, num_returns=len(closed), timeout=WORKER_EXIT_TIMEOUT_S)
        for actor in self._actors:
            self._ray.kill(actor.handle)
        if self._notes is not None:
            self._notes.shutdown(force=True)

    def _grow(self) -> None:
        """Asks for actors as long as there is work for more of them."""
        now = time.monotonic()
        if now < self._next_look and self._actors:
            return
        self._next_look = now + LOOK_ROUND_S
        left = len(self._waiting) + sum(len(actor.told) for actor in self._actors)
        for _ in range(len(self._actors), min(self._cluster.size(), left)):
            handle = self._new()
            self._actors.append(_Actor(handle, handle.make.remote()))

    def _answered(self) -> list[_Actor]:
        """Actors whose next answer is there; waits for one, but not for long."""
        owing = {actor.answer: actor for actor in self._actors if actor.answer is not None}
        some, _ = self._ray.wait([*owing], timeout=LOOK_ROUND_S)
        if not some:
            return []
        every, _ = self._ray.wait([*owing], num_returns=len(owing), timeout=0)
        return [owing[answer] for answer in every]

    def _tell(self, actor: _Actor, horizon: int) -> None:
        """Tells an actor as much ahead as it may hold, of what lies before the horizon."""
        if actor.machine is None:
            return
        while self._waiting and self._waiting[0] < horizon and len(actor.told) < self._ahead:
            place = heapq.heappop(self._waiting)
            actor.told.append((place, actor.handle.call.remote(self._indices[place])))

    def _lose(self, actor: _Actor, error: Exception) -> None:
        """Removes an actor that is gone, and puts its work back.

        Raises:
            RuntimeError: Its work ended this actor and others before, or no actor can be made.
        """
        self._actors.remove(actor)
        self._next_look = 0.0
        # The actor may be alive, and only its answer lost.
        self._ray.kill(actor.handle)
        for place, _ in actor.told:
            heapq.heappush(self._waiting, place)
        if actor.machine is not None and not self._is_alive(actor.machine):
            return
        blamed = actor.told[0][0] if actor.told else None
        self._ended[blamed] += 1
        lives = LIVES if blamed is not None else LIVES * self._cluster.size()
        if self._ended[blamed] >= lives:
            what = "making it" if blamed is None else f"number {self._indices[blamed]}"
            raise RuntimeError(
                f"A rollout worker on Ray ended {lives} times at {what}: {first_line(error)}"
            ) from error

    def _is_alive(self, machine: str) -> bool:
        return any(node["NodeID"] == machine and node["Alive"] for node in self._ray.nodes())

    def _check(self, there: Mapping[str, str]) -> None:
        """Refuses a machine whose results may differ.

        Raises:
            ClusterError: It has other packages, or another state of the suite.
        """
        for name, version in self._here.items():
            if there[name] != version:
                raise ClusterError(
                    f"machine {there['machine']} of the cluster has {name} {there[name]}, and this "
                    f"one {version}; install the same everywhere"
                )


class _Worker:
    """An actor: made by `make`, so that what it raises can be told, then called."""

    def __init__(self, job: list[Any]) -> None:
        self._job = job
        self._stack = contextlib.ExitStack()

    def make(self) -> tuple[Any, ...]:
        """Makes the worker's function; its machine, and what is installed there."""
        import ray

        try:
            make, notes = ray.get(self._job[0])
            note: Note = (lambda words: None) if notes is None else notes.put
            self._call = self._stack.enter_context(make(note))
        except Exception as error:
            return failure(error)
        there = installed() | {"machine": ray.util.get_node_ip_address()}
        return "result", (ray.get_runtime_context().get_node_id(), there)

    def call(self, index: int) -> tuple[Any, ...]:
        """Calls it."""
        try:
            return "result", self._call(index)
        except Exception as error:
            return failure(error)

    def close(self) -> None:
        """Ends it."""
        self._stack.close()


def installed() -> dict[str, str]:
    """What results depend on: versions of Python and packages, and a digest of the suite's code."""
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = "not installed"
    digest = hashlib.sha256()
    root = Path(__file__).parent
    for folder, folders, names in os.walk(root, followlinks=True):
        folders.sort()
        for name in sorted(names):
            if name.endswith(".py"):
                path = Path(folder) / name
                digest.update(f"{path.relative_to(root)}\0".encode() + path.read_bytes())
    return versions | {"hvs-suite": f"code {digest.hexdigest()[:12]}"}


def _environment() -> dict[str, str]:
    """Environment variables of an actor: those of a local worker, and where modules are found."""
    ours = (sys.prefix, sys.base_prefix)
    places = [str(Path(place).resolve()) for place in sys.path if not place.startswith(ours)]
    asked = {k: v for k, v in os.environ.items() if k == "MUJOCO_GL" or k.startswith("HVS_")}
    return {**asked, **WORKER_ENVIRONMENT, "PYTHONPATH": os.pathsep.join(places)}
