"""The reference policy server: plays a policy of ours for evaluations elsewhere.

Each connection gets a process of its own with a policy of its own, as a worker of an evaluation
does: connections cannot disturb one another, and a policy that hangs ends with its connection.
"""

import contextlib
import dataclasses
import multiprocessing
import signal
from collections.abc import Callable, Iterator
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from dm_env import specs
from websockets.exceptions import ConnectionClosed
from websockets.protocol import State
from websockets.sync.server import Server, ServerConnection, serve

from hvs_suite.errors import HvsError, OptionError, PolicyError, ServerError
from hvs_suite.eval import protocol, wire
from hvs_suite.policies.context import PolicyContext
from hvs_suite.registry import TASKS
from hvs_suite.rollout import Policy, library_seeds, one_torch_thread
from hvs_suite.tasks.shared import lock

# How often a server that waits for its policy looks whether anybody still wants the answer.
_LOOK_PERIOD_S = 0.2


class Session:
    """One connection's conversation: takes messages, returns answers, never raises.

    Args:
        policy: What `hvs_suite.policies.catalogue.policy_factory` takes.
    """

    def __init__(self, policy: str) -> None:
        self._name = policy
        self._policy: Policy | None = None
        self._seeds = contextlib.ExitStack()

    def answer(self, content: Any) -> bytes:
        """Returns the answer (bytes) to a message (bytes)."""
        try:
            message = wire.decode(content)
            match message["type"]:
                case "hello":
                    return wire.encode(self._hello(message))
                case "reset" if self._policy is not None:
                    return wire.encode(self._reset(self._policy, message))
                case "observe" if self._policy is not None:
                    return wire.encode(self._observe(self._policy, message))
            raise wire.WireError(f"message {message['type']!r} makes no sense here")
        except (HvsError, wire.WireError) as error:
            return wire.encode({"type": "refused", "reason": " ".join(str(error).split())})

    def _hello(self, message: wire.Message) -> wire.Message:
        if message.get("protocol") != wire.PROTOCOL:
            raise ServerError(
                f"this server speaks version {wire.PROTOCOL} of the protocol, "
                f"not {message.get('protocol')!r}"
            )
        contender, context = served(self._name, message.get("task"), message)
        try:
            self._policy = contender.make(context)
        except HvsError:
            raise
        except Exception as error:  # other people's code raises anything
            raise PolicyError(f"{self._name} cannot be built: {error}") from error
        return {
            "type": "welcome",
            "protocol": wire.PROTOCOL,
            "policy": contender.name,
            "policy_hash": contender.hash,
            "policy_parameters": contender.parameters,
            "training_steps": contender.training_steps,
            "training_hours": contender.training_hours,
        }

    def _reset(self, policy: Policy, message: wire.Message) -> wire.Message:
        seed = message.get("seed")
        if type(seed) is not int or not 0 <= seed < 2**32:
            raise wire.WireError("a reset has a seed from 0 to 2^32 - 1")
        self._seeds.close()
        self._seeds.enter_context(library_seeds(seed))
        return _guarded(policy.reset, lambda _: {"type": "done"})

    def _observe(self, policy: Policy, message: wire.Message) -> wire.Message:
        shown = message.get("observation")
        if not isinstance(shown, dict):
            raise wire.WireError("observe has an observation, a map")
        observation = {name: wire.array(value) for name, value in shown.items()}
        return _guarded(lambda: policy.select_action(observation), _action)


def served(name: str, task: Any, message: wire.Message) -> tuple[protocol.Contender, PolicyContext]:
    """Finds the policy to serve, and what it may know of the task.

    Args:
        name: Of the policy.
        task: Named task, as the evaluation calls it.
        message: The evaluation's ``hello``.

    Raises:
        PolicyError: There is no such policy, it does not fit the task, or it cannot be served.
        ServerError: The evaluation means another version of the task.
        UnknownTaskError: There is no such task here.
        WireError: The message lacks something.
    """
    protocol.check_public(name)
    if not isinstance(task, str):
        raise wire.WireError("hello names a task")
    contender = protocol.find(name, task)
    if message.get("task_digest") != lock.digest(task):
        raise ServerError(f"the evaluation means another version of {task} than this server has")
    try:
        observations = {
            key: spec(key, value) for key, value in dict(message["observations"]).items()
        }
        action = spec("action", message["action"])
    except (KeyError, TypeError, ValueError) as error:
        raise wire.WireError("hello describes observations and action") from error
    variant = TASKS[task]
    return contender, PolicyContext(variant, observations, action, variant.control_period_s)


def spec(name: str, description: dict[str, Any]) -> specs.BoundedArray:
    """Returns the `dm_env` spec that a description stands for."""
    dtype = description["dtype"]
    if dtype not in wire.DTYPES:
        raise wire.WireError(f"dtype {dtype!r} is none of {', '.join(wire.DTYPES)}")
    return specs.BoundedArray(
        shape=tuple(int(n) for n in description["shape"]),
        dtype=np.dtype(dtype),
        minimum=np.array(description["minimum"], dtype),
        maximum=np.array(description["maximum"], dtype),
        name=name,
    )


def _guarded(call: Callable[[], Any], report: Callable[[Any], wire.Message]) -> wire.Message:
    """Reports what a policy returns, or that it raised."""
    try:
        with one_torch_thread():
            answer = call()
    except Exception as error:  # a policy raises anything
        return {
            "type": "error",
            "reason": f"raised {type(error).__name__}",
            "detail": f"{type(error).__name__}: {error}",
        }
    return report(answer)


def _action(answer: Any) -> wire.Message:
    """The message that carries a policy's answer; whether it is any good is judged elsewhere."""
    try:
        return {"type": "action", "action": np.array(answer, dtype=np.float32)}
    except (TypeError, ValueError, RuntimeError):
        detail = f"{type(answer).__name__} is no array"
        return {"type": "error", "reason": "wrong shape", "detail": detail}


@dataclasses.dataclass(frozen=True)
class _Handler:
    """Plays a connection in a process of its own.

    Attributes:
        policy: Its name.
    """

    policy: str

    def __call__(self, websocket: ServerConnection) -> None:
        """Carries messages to and fro until either end closes."""
        context = multiprocessing.get_context("spawn")
        ours, theirs = context.Pipe()
        process = context.Process(target=_work, args=(theirs, self.policy), daemon=True)
        process.start()
        theirs.close()
        try:
            with contextlib.suppress(ConnectionClosed, EOFError, OSError):
                for message in websocket:
                    ours.send_bytes(message if isinstance(message, bytes) else message.encode())
                    while not ours.poll(_LOOK_PERIOD_S):
                        if websocket.protocol.state is not State.OPEN:
                            return
                    websocket.send(ours.recv_bytes())
        finally:
            ours.close()
            process.kill()
            process.join()


def _work(connection: Connection, policy: str) -> None:
    """Life of a connection's process: answers until the server closes the pipe."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    session = Session(policy)
    with contextlib.suppress(EOFError, OSError):
        while True:
            connection.send_bytes(session.answer(connection.recv_bytes()))


@contextlib.contextmanager
def listening(policy: str, host: str, port: int) -> Iterator[tuple[Server, str]]:
    """Opens the server's socket.

    Args:
        policy: What `hvs_suite.policies.catalogue.policy_factory` takes.
        host: Address to listen at.
        port: TCP port; 0 takes a free one.

    Yields:
        The server, whose ``serve_forever`` serves until ``shutdown``, and its address as a URL.

    Raises:
        OptionError: Nothing can listen there.
    """
    try:
        server = serve(
            _Handler(policy),
            host,
            port,
            compression=None,
            max_size=wire.MAX_MESSAGE_BYTES,
            close_timeout=1.0,
        )
    except (OSError, OverflowError) as error:
        raise OptionError(
            f"cannot listen at {host}, port {port}: {error}; choose another --port or --host"
        ) from error
    with server:
        bound = server.socket.getsockname()[1]
        yield server, f"ws://{f'[{host}]' if ':' in host else host}:{bound}"
