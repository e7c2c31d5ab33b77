"""A policy served by another process or machine, as an evaluation plays it.

What goes wrong at the other end loses the episode in which it does, and is counted: no answer in
time, no action, a connection that breaks. Before the next episode the connection is made anew;
where nobody is there any more, the run stops, and resumes when the server is back.
"""

import contextlib
import dataclasses
import re
import time
import weakref
from collections.abc import Mapping
from typing import Any

import numpy as np
from websockets.exceptions import ConnectionClosed, InvalidURI, WebSocketException
from websockets.sync.client import ClientConnection, connect
from websockets.uri import parse_uri

from hvs_suite import registry
from hvs_suite.errors import OptionError, ServerError
from hvs_suite.eval import wire
from hvs_suite.eval.protocol import DECISION_LIMIT_S, Contender
from hvs_suite.eval.provenance import suite_version
from hvs_suite.eval.trial import (
    TOO_SLOW,
    WRONG_SHAPE,
    Connected,
    EpisodeLostError,
    episode_seed,
)
from hvs_suite.rollout import Action, Observation
from hvs_suite.tasks.shared import lock

CONNECT_LIMIT_S = 10.0
WELCOME_LIMIT_S = 120.0
"""The server may have to load a large policy first."""
_CLOSE_LIMIT_S = 0.5

DISCONNECTED = "disconnected"
BAD_ANSWER = "bad answer"
_REASON = re.compile(r"raised [A-Za-z_]\w{0,80}")


@dataclasses.dataclass(frozen=True)
class RemoteFactory:
    """Connects to a policy server; travels to workers as an address.

    Attributes:
        url: Of the server, ``ws://host:port``.
        task: Named task.
        decision_limit_s: Time after which a decision loses the episode (s).
    """

    url: str
    task: str
    decision_limit_s: float

    def __call__(self, env: Any) -> "RemotePolicy":
        """Connects.

        Raises:
            ServerError: There is no such server, or it refuses.
        """
        policy = RemotePolicy(self, env)
        policy.connect()
        return policy


class RemotePolicy(Connected):
    """Follows `hvs_suite.rollout.Policy`; each decision is a message and its answer.

    Args:
        address: Where the policy is served, and for which task.
        env: Where it acts. Only what it shows and the seed of its scenario travel.
    """

    def __init__(self, address: RemoteFactory, env: Any) -> None:
        self._address = address
        self._env = env
        self._connection: ClientConnection | None = None
        self.welcome: Mapping[str, Any] = {}

    def connect(self) -> None:
        """Connects, if there is no connection, and says which task is to be played.

        Raises:
            ServerError: There is no such server, or it refuses.
        """
        if self._connection is not None:
            return
        url = self._address.url
        closing = contextlib.ExitStack()
        try:
            connection = closing.enter_context(
                connect(
                    url,
                    compression=None,
                    proxy=None,
                    open_timeout=CONNECT_LIMIT_S,
                    close_timeout=_CLOSE_LIMIT_S,
                    # Servers may be too busy deciding to answer a ping; decisions have a limit.
                    ping_interval=None,
                    max_size=wire.MAX_MESSAGE_BYTES,
                )
            )
        except (OSError, WebSocketException) as error:
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ServerError(
                f"no policy server answers at {url} ({reason}); start one ('hvs serve'), then give "
                "the same command again"
            ) from error
        # The connection's own thread would keep it open when nobody plays it any more.
        weakref.finalize(self, closing.close)
        try:
            connection.send(wire.encode(hello(self._address.task, self._env)))
            answer = wire.decode(connection.recv(WELCOME_LIMIT_S))
        except (OSError, WebSocketException, wire.WireError) as error:
            _close(connection)
            reason = " ".join(str(error).split()) or type(error).__name__
            raise ServerError(f"the server at {url} does not greet back: {reason}") from error
        if answer["type"] != "welcome" or answer.get("protocol") != wire.PROTOCOL:
            _close(connection)
            reason = answer.get("reason", f"it answers {answer['type']!r}")
            raise ServerError(f"the server at {url} refuses: {reason}")
        self._connection, self.welcome = connection, answer

    def reset(self) -> None:
        """Forgets the last episode.

        Raises:
            EpisodeLostError: The server did not do so.
        """
        info = self._env.info
        seed = episode_seed(info["split"], info["scenario"])
        self._ask({"type": "reset", "seed": seed}, "done")

    def select_action(self, observation: Observation) -> Action:
        """Asks the server.

        Args:
            observation: Arrays by name.

        Returns:
            Whatever numbers it answers, float32.

        Raises:
            EpisodeLostError: It answers none.
        """
        shown = {name: np.asarray(value) for name, value in observation.items()}
        answer = self._ask({"type": "observe", "observation": shown}, "action")
        action = answer.get("action")
        try:
            values = np.array(action) if isinstance(action, list) else wire.array(action)
            return values.astype(np.float32)
        except (ValueError, TypeError) as error:
            raise EpisodeLostError(WRONG_SHAPE, f"no array: {error}") from error

    def _ask(self, message: wire.Message, expected: str) -> wire.Message:
        """Sends a message and returns its answer; breaks the connection off if none comes.

        Otherwise the answer might come later and be taken for another one's.
        """
        if self._connection is None:
            raise EpisodeLostError(DISCONNECTED, "the connection broke in this episode")
        connection, self._connection = self._connection, None
        limit_s = self._address.decision_limit_s
        end = time.monotonic() + limit_s
        try:
            connection.send(wire.encode(message))
            answer = wire.decode(connection.recv(max(end - time.monotonic(), 0.0)))
        except TimeoutError as error:
            _close(connection)
            raise EpisodeLostError(TOO_SLOW, f"no answer within {limit_s:g} s") from error
        except (ConnectionClosed, OSError) as error:
            _close(connection)
            raise EpisodeLostError(DISCONNECTED, str(error)) from error
        except wire.WireError as error:
            _close(connection)
            raise EpisodeLostError(BAD_ANSWER, str(error)) from error
        except BaseException:
            _close(connection)
            raise
        if answer["type"] == "error":
            self._connection = connection
            reason = str(answer.get("reason"))
            known = reason == WRONG_SHAPE or _REASON.fullmatch(reason)
            raise EpisodeLostError(reason if known else BAD_ANSWER, str(answer.get("detail", "")))
        if answer["type"] != expected:
            _close(connection)
            detail = str(answer.get("reason", f"{answer['type']!r} instead of {expected!r}"))
            raise EpisodeLostError(BAD_ANSWER, detail)
        self._connection = connection
        return answer


def find(url: str, name: str, task: str, decision_limit_s: float = DECISION_LIMIT_S) -> Contender:
    """Asks a server who it is.

    Args:
        url: Of the server, ``ws://host:port``.
        name: What the result shall call the policy.
        task: Named task.
        decision_limit_s: Time after which a decision loses the episode (s).

    Returns:
        The policy; hash, parameters and training are the server's own word.

    Raises:
        OptionError: The address makes no sense.
        UnknownTaskError: There is no such task.
        ServerError: There is no such server, or it refuses.
    """
    try:
        parse_uri(url)
    except InvalidURI as error:
        raise OptionError(
            f"--server takes an address such as ws://127.0.0.1:8765, not {url!r}"
        ) from error
    registry.find(task)
    make = RemoteFactory(url, task, decision_limit_s)
    with contextlib.closing(registry.load(task)) as env:
        welcome = make(env).welcome
    return Contender(
        name=name,
        kind="server",
        make=make,
        hash=_word(welcome, "policy_hash", str),
        parameters=_word(welcome, "policy_parameters", int),
        training_steps=_word(welcome, "training_steps", int),
        training_hours=_word(welcome, "training_hours", float),
    )


def hello(task: str, env: Any) -> wire.Message:
    """Returns the first message: which task is to be played, and what of it is public."""
    variant = env.variant
    return {
        "type": "hello",
        "protocol": wire.PROTOCOL,
        "suite_version": suite_version(),
        "task": task,
        "task_version": variant.version,
        "task_digest": lock.digest(task),
        "instruction": variant.instruction(),
        "period_s": variant.control_period_s,
        "parameters": dataclasses.asdict(variant),
        "observations": {name: _describe(spec) for name, spec in env.observation_spec().items()},
        "action": _describe(env.action_spec()),
    }


def _describe(spec: Any) -> dict[str, Any]:
    """A `dm_env` spec as plain values."""
    return {
        "dtype": spec.dtype.name,
        "shape": list(spec.shape),
        "minimum": np.asarray(spec.minimum).tolist(),
        "maximum": np.asarray(spec.maximum).tolist(),
    }


def _word[T](welcome: Mapping[str, Any], key: str, kind: type[T]) -> T | None:
    """What a server says of its policy, if it says so in the right type."""
    value = welcome.get(key)
    return value if type(value) is kind else None


def _close(connection: ClientConnection) -> None:
    with contextlib.suppress(Exception):
        connection.close()
