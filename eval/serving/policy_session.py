"""A policy's side of the conversation, and the life of the process that has it.

The process is told the policy's name and an end of a socket, and learns the rest by messages: what
the task shows, and seeds. It imports nothing of the simulator.
"""

import contextlib
import os
import queue
import sys
import threading
from collections.abc import Callable
from multiprocessing.connection import Connection
from typing import Any

import numpy as np
from dm_env import specs

from hvs_suite.errors import HvsError, PolicyError, ServerError, describe
from hvs_suite.eval.scoring import contender
from hvs_suite.eval.scoring.contender import Contender
from hvs_suite.eval.serving import wire
from hvs_suite.policies.context import PolicyContext
from hvs_suite.registry import find
from hvs_suite.rollout import Instructed, Policy, library_seeds, one_torch_thread
from hvs_suite.tasks.shared import lock

# Well below what an answer may hold, and longer than a reader needs.
_LONGEST_WORDS = 1000
_LONGEST_NAME = 100


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
            return wire.encode({"type": "refused", "reason": _line(str(error))})

    def _hello(self, message: wire.Message) -> wire.Message:
        if message.get("protocol") != wire.PROTOCOL:
            raise ServerError(
                f"this server speaks version {wire.PROTOCOL} of the protocol, "
                f"not {message.get('protocol')!r}"
            )
        player, context = served(self._name, message.get("task"), message)
        try:
            self._policy = player.make(context)
        except HvsError:
            raise
        except BaseException as error:  # code outside the suite may raise anything
            raise PolicyError(f"{self._name} cannot be built: {describe(error)}") from error
        return {
            "type": "welcome",
            "protocol": wire.PROTOCOL,
            "policy": player.name[:_LONGEST_NAME],
            "policy_hash": player.hash,
            "policy_parameters": player.parameters,
            "training_steps": player.training_steps,
            "training_hours": player.training_hours,
        }

    def _reset(self, policy: Policy, message: wire.Message) -> wire.Message:
        seed = message.get("seed")
        if type(seed) is not int or not 0 <= seed < 2**32:
            raise wire.WireError("a reset has a seed from 0 to 2^32 - 1")
        self._seeds.close()
        self._seeds.enter_context(library_seeds(seed))
        sentence = message.get("instruction")
        if isinstance(policy, Instructed) and isinstance(sentence, str):
            told = _guarded(lambda: policy.instruct(sentence), lambda _: {"type": "done"})
            if told["type"] != "done":
                return told
        return _guarded(policy.reset, lambda _: {"type": "done"})

    def _observe(self, policy: Policy, message: wire.Message) -> wire.Message:
        shown = message.get("observation")
        if not isinstance(shown, dict):
            raise wire.WireError("observe has an observation, a map")
        observation = {name: wire.array(value) for name, value in shown.items()}
        return _guarded(lambda: policy.select_action(observation), _action)


def served(name: str, task: Any, message: wire.Message) -> tuple[Contender, PolicyContext]:
    """Finds the policy to serve, and what it may know of the task.

    Args:
        name: Of the policy.
        task: Named task, as the evaluation calls it.
        message: The evaluation's ``hello``.

    Raises:
        OptionError: An option of the task does not exist or makes no sense.
        PolicyError: There is no such policy, it does not fit the task, or it cannot be served.
        ServerError: The evaluation means another version of the task.
        UnknownTaskError: There is no such task here.
        WireError: The message lacks something.
    """
    contender.check_public(name)
    if not isinstance(task, str):
        raise wire.WireError("hello names a task")
    options = message.get("options", {})
    if not isinstance(options, dict):
        raise wire.WireError("hello has options, a map")
    played = find(task).with_options(options)
    player = contender.find(name, task, options)
    if message.get("task_digest") != lock.digest(task):
        raise ServerError(f"the evaluation means another version of {task} than this server has")
    try:
        observations = {
            key: spec(key, value) for key, value in dict(message["observations"]).items()
        }
        action = spec("action", message["action"])
    except (KeyError, TypeError, ValueError) as error:
        raise wire.WireError("hello describes observations and action") from error
    return player, PolicyContext(played, observations, action, played.control_period_s)


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
    except BaseException as error:  # a policy raises anything
        return {
            "type": "error",
            "reason": f"raised {type(error).__name__}",
            "detail": _line(describe(error)),
        }
    return report(answer)


def _action(answer: Any) -> wire.Message:
    """The message that carries a policy's answer; whether it is valid is checked elsewhere."""
    try:
        return {"type": "action", "action": np.array(answer, dtype=np.float32)}
    except Exception:  # the array may be one of the policy's own making
        detail = f"{type(answer).__name__} is no array"
        return {"type": "error", "reason": "wrong shape", "detail": detail}


def _line(text: str) -> str:
    return " ".join(text.split())[:_LONGEST_WORDS]


def main() -> None:
    """Answers what comes over the socket, until the other end is closed."""
    policy, descriptor = sys.argv[1:]
    del sys.argv[1:]
    connection = Connection(int(descriptor))
    messages: queue.SimpleQueue[bytes] = queue.SimpleQueue()
    threading.Thread(target=_listen, args=(connection, messages), daemon=True).start()
    session = Session(policy)
    with contextlib.suppress(OSError):
        while True:
            connection.send_bytes(session.answer(messages.get()))


def _listen(connection: Connection, messages: "queue.SimpleQueue[bytes]") -> None:
    """Ends the process when the other end closes, whatever the policy is doing."""
    try:
        while True:
            messages.put(connection.recv_bytes(wire.MAX_MESSAGE_BYTES))
    finally:
        os._exit(0)


if __name__ == "__main__":
    main()
