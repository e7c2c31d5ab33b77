"""Environments of fine-tuning on the machines of a Ray cluster, an actor each."""

import collections
import contextlib
import io
import queue
import threading
from collections.abc import Callable, Sequence
from typing import Any

import gymnasium
from stable_baselines3.common.vec_env import SubprocVecEnv, VecEnv
from stable_baselines3.common.vec_env.base_vec_env import CloudpickleWrapper
from stable_baselines3.common.vec_env.subproc_vec_env import _worker

from hvs_suite.errors import ClusterError, first_line
from hvs_suite.executor import failure, opened
from hvs_suite.on_ray import RayCluster, join, remote
from hvs_suite.policies.finetune.overlapped import Overlapped
from hvs_suite.rollout import carried

MakeEnv = Callable[[], gymnasium.Env[Any, Any]]


class OverlappedRayVecEnv(Overlapped, SubprocVecEnv):
    """Environments in actors, which play during what is overlapped with them.

    They are SB3's own, and so is what answers there; only the pipes between them are others.

    Args:
        cluster: Where.
        makers: Make the environments; what they read of a folder travels with them.

    Raises:
        ClusterError: The cluster cannot be joined, or (of every method) a machine is lost.
    """

    def __init__(self, cluster: RayCluster, makers: Sequence[MakeEnv]) -> None:
        ray = join(cluster.address)
        self.waiting = self.closed = False
        self.processes = []
        self.remotes = tuple(_Pipe(ray, carried(make)) for make in makers)
        self.remotes[0].send(("get_spaces", None))
        VecEnv.__init__(self, len(makers), *self.remotes[0].recv())


class _Pipe:
    """Our end of what SB3 takes for a pipe: each word sent is a call, and is answered."""

    def __init__(self, ray: Any, make: MakeEnv) -> None:
        self._ray = ray
        self._actor = remote(ray, _Answers)(ray.put(make))
        self._answers: collections.deque[Any] = collections.deque()

    def send(self, words: tuple[str, Any]) -> None:
        self._answers.append(self._actor.ask.remote(words))

    def recv(self) -> Any:
        try:
            _, content = opened(self._ray.get(self._answers.popleft()))
        except self._ray.exceptions.RayActorError as error:
            raise ClusterError(
                f"a machine that played was lost ({first_line(error)}); the same command goes on "
                "from the last checkpoint"
            ) from error
        return content

    def close(self) -> None:
        with contextlib.suppress(self._ray.exceptions.RayError):
            self._ray.get(self._answers.popleft())
        self._ray.kill(self._actor)


class _Answers:
    """An actor with the other end, which SB3's worker has in a thread of its own."""

    def __init__(self, make: MakeEnv) -> None:
        self._asked: queue.Queue[Any] = queue.Queue()
        self._answered: queue.Queue[Any] = queue.Queue()
        threading.Thread(target=self._work, args=(make,), daemon=True).start()

    def ask(self, words: tuple[str, Any]) -> Any:
        """Answers a word."""
        self._asked.put(words)
        return self._answered.get()

    def recv(self) -> Any:
        """For SB3's worker: the next word."""
        return self._asked.get()

    def send(self, content: Any) -> None:
        """For SB3's worker: its answer."""
        self._answered.put(("result", content))

    def close(self) -> None:
        """For SB3's worker: it has ended, which is an answer too."""
        self.send(None)

    def _work(self, make: MakeEnv) -> None:
        try:
            # The first is what it answers by; of the second, a parent's end, it closes its copy.
            _worker(self, io.BytesIO(), CloudpickleWrapper(make))  # type: ignore[arg-type]
        except Exception as error:
            self._answered.put(failure(error))
