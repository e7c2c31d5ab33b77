"""A policy in a process of its own on this machine, without a simulator in it.

Python cannot hide anything from code in the same process: the garbage collector lists every
environment, and a frame's caller knows which scenario it plays. So code of one's own gets a process
that holds neither. It speaks the protocol of a policy server, over a socket.
"""

import contextlib
import dataclasses
import os
import signal
import socket
import subprocess
import sys
import weakref
from multiprocessing.connection import Connection
from typing import Any

from hvs_suite.errors import HvsError, PolicyError
from hvs_suite.eval.serving import policy_session, wire
from hvs_suite.eval.serving.remote_policy import RemotePolicy, hello
from hvs_suite.executor import WORKER_ENVIRONMENT

ENDED = "process ended"
_EXIT_LIMIT_S = 1.0
_STDERR = 2


class PolicyProcess:
    """A process that has a `policy_session.Session`; a `remote_policy.Line` to it.

    It and all that it started end when this object goes, or the process that holds it.

    Args:
        policy: What `hvs_suite.policies.catalogue.policy_factory` takes.
        place: Its working folder.
    """

    def __init__(self, policy: str, place: str) -> None:
        ours, theirs = socket.socketpair()
        with theirs:
            self._process = subprocess.Popen(
                # -P: the working folder comes first only after all modules of the suite are
                # imported.
                [
                    *(sys.executable, "-P", "-u", "-m", policy_session.__name__),
                    *(policy, str(theirs.fileno())),
                ],
                stdin=subprocess.DEVNULL,
                # What a policy prints is not output of the command.
                stdout=_STDERR,
                pass_fds=[theirs.fileno()],
                cwd=place,
                env={**os.environ, **WORKER_ENVIRONMENT, "PYTHONPATH": os.pathsep.join(sys.path)},
                # Ctrl-C is for the evaluating process; processes that the policy starts end with
                # it.
                start_new_session=True,
            )
        self._connection = Connection(ours.detach())
        self.close = weakref.finalize(self, _end, self._process, self._connection)

    def send(self, content: bytes, /) -> None:
        """Sends a message.

        Raises:
            ConnectionError: The process has ended.
        """
        try:
            self._connection.send_bytes(content)
        except OSError as error:
            raise self._ended() from error

    def recv(self, timeout: float, /) -> bytes:
        """Returns the next answer.

        Args:
            timeout: How long to wait (s).

        Raises:
            TimeoutError: None came.
            ConnectionError: The process has ended, or its answer is too long.
        """
        try:
            if self._connection.poll(timeout):
                return self._connection.recv_bytes(wire.MAX_ANSWER_BYTES)
        except (EOFError, OSError) as error:
            raise self._ended() from error
        raise TimeoutError

    def _ended(self) -> ConnectionError:
        with contextlib.suppress(subprocess.TimeoutExpired):
            self._process.wait(_EXIT_LIMIT_S)
        code = self._process.returncode
        self.close()
        return ConnectionError(
            "the policy's process broke off"
            if code is None
            else f"the policy's process ended with exit code {code}"
        )


@dataclasses.dataclass(frozen=True)
class ProcessFactory:
    """Starts processes for a policy; travels to workers as texts.

    Attributes:
        policy: What `hvs_suite.policies.catalogue.policy_factory` takes.
        place: Working folder of the processes.
        task: Named task.
        decision_limit_s: Time after which a decision loses the episode (s).
    """

    policy: str
    place: str
    task: str
    decision_limit_s: float

    def __call__(self, env: Any) -> "ProcessPolicy":
        """Starts the process and builds the policy there.

        Raises:
            PolicyError: It cannot be built.
        """
        policy = ProcessPolicy(self, env)
        policy.connect(seed=0)
        return policy


class ProcessPolicy(RemotePolicy):
    """A policy in a process of its own; after that has ended, the next episode gets another.

    Args:
        address: Which policy, and for which task.
        env: Where it acts; only what it shows travels.
    """

    broken = ENDED

    def __init__(self, address: ProcessFactory, env: Any) -> None:
        super().__init__(hello(address.task, env), address.decision_limit_s)
        self._address = address

    def _open(self) -> PolicyProcess:
        return PolicyProcess(self._address.policy, self._address.place)

    def _refusal(self, reason: str) -> HvsError:
        return PolicyError(f"{self._address.policy} does not play: {reason}")


def _end(process: "subprocess.Popen[bytes]", connection: Connection) -> None:
    connection.close()
    with contextlib.suppress(OSError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
