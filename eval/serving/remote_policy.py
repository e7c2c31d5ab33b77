"""A policy in another process or on another machine, as an evaluation plays it.

A fault at the other end loses the episode in which it happens, and is counted: no answer in time,
no valid action, a broken connection. Before the next episode the connection is made again; if the
server is gone, the run stops, and can be resumed when the server is back.
"""

import abc
import contextlib
import dataclasses
import re
import time
import weakref
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Protocol

import numpy as np
import pydantic
from websockets.exceptions import InvalidURI, WebSocketException
from websockets.sync.client import ClientConnection, connect
from websockets.uri import parse_uri

from hvs_suite import registry
from hvs_suite.errors import HvsError, OptionError, ServerError
from hvs_suite.eval.scoring.contender import Contender
from hvs_suite.eval.scoring.provenance import suite_version
from hvs_suite.eval.scoring.result_file import Count, Seconds
from hvs_suite.eval.scoring.trial import (
    DECISION_LIMIT_S,
    TOO_SLOW,
    WRONG_SHAPE,
    Connected,
    EpisodeLostError,
    check_decision_limit,
)
from hvs_suite.eval.serving import wire
from hvs_suite.policies.catalogue import AS_NAMED
from hvs_suite.rollout import Action, Observation
from hvs_suite.tasks.shared import lock

CONNECT_LIMIT_S = 10.0
WELCOME_LIMIT_S = 120.0
"""The other end may have to load a large policy first."""
_CLOSE_LIMIT_S = 0.5

DISCONNECTED = "disconnected"
BAD_ANSWER = "bad answer"
_REASON = re.compile(r"raised [A-Za-z_]\w{0,80}")
_LONGEST_NAME = 100
_LONGEST_WORDS = 500


class Line(Protocol):
    """Carries messages to the other end and back."""

    def send(self, content: bytes, /) -> None:
        """Sends a message; raises `OSError` or `WebSocketException` where the line is broken."""

    def recv(self, timeout: float, /) -> Any:
        """Returns the next message; raises as `send` does, or `TimeoutError` after seconds."""

    def close(self) -> object:
        """Closes the line; calling it again does nothing."""


def _printable(text: str) -> str:
    if not text.isprintable():
        raise ValueError("holds characters that cannot be printed")
    return text


Name = Annotated[
    str,
    pydantic.Field(min_length=1, max_length=_LONGEST_NAME),
    pydantic.AfterValidator(_printable),
]


class Welcome(pydantic.BaseModel):
    """What the other end says of its policy; other keys do not matter.

    Attributes:
        protocol: Version of the protocol.
        policy: Its own name for the policy.
        policy_hash: As in a result.
        policy_parameters: As in a result.
        training_steps: As in a result.
        training_hours: As in a result.
    """

    model_config = pydantic.ConfigDict(strict=True, frozen=True)

    type: Literal["welcome"]
    protocol: Literal[1]
    policy: Name | None = None
    policy_hash: Name | None = None
    policy_parameters: Count | None = None
    training_steps: Count | None = None
    training_hours: Seconds | None = None


class RemotePolicy(Connected):
    """Follows `hvs_suite.rollout.Policy`; each decision is a message and its answer.

    Args:
        hello: The first message.
        decision_limit_s: Time after which a decision loses the episode (s).
    """

    broken: ClassVar[str] = DISCONNECTED
    """Why an episode is lost in which the line breaks."""

    def __init__(self, hello: wire.Message, decision_limit_s: float) -> None:
        self._hello = hello
        self._limit_s = decision_limit_s
        self._line: Line | None = None
        self._seed = 0
        self._sentence = str(hello["instruction"])
        self.welcome: Welcome | None = None

    @abc.abstractmethod
    def _open(self) -> Line:
        """Makes a line to the other end.

        Raises:
            ServerError: Nothing answers.
        """

    @abc.abstractmethod
    def _refusal(self, reason: str) -> HvsError:
        """What to raise where the other end does not let this evaluation play."""

    def connect(self, seed: int) -> None:
        """Connects, if there is no connection, and says which task is to be played.

        Args:
            seed: Told at the next reset.

        Raises:
            ServerError: There is no such server, or it refuses.
            PolicyError: The policy cannot be built in a process of its own.
        """
        self._seed = seed
        if self._line is not None:
            return
        line = self._open()
        # A line's own thread or process would keep it open when the policy is no longer used.
        closing = weakref.finalize(self, _close, line)
        try:
            self.welcome = self._greet(line)
        except BaseException:
            closing()
            raise
        self._line = line

    def _greet(self, line: Line) -> Welcome:
        try:
            line.send(wire.encode(self._hello))
            answer = wire.decode(line.recv(WELCOME_LIMIT_S))
        except TimeoutError as error:
            raise self._refusal(f"it does not greet back within {WELCOME_LIMIT_S:g} s") from error
        except (OSError, WebSocketException, wire.WireError) as error:
            raise self._refusal(f"it does not greet back: {_words(error)}") from error
        if answer["type"] == "refused":
            raise self._refusal(_words(answer.get("reason")))
        try:
            return Welcome.model_validate(answer)
        except pydantic.ValidationError as error:
            first = error.errors(include_url=False)[0]
            where = ".".join(map(str, first["loc"]))
            raise self._refusal(f"its welcome makes no sense ({where}: {first['msg']})") from error

    def instruct(self, sentence: str) -> None:
        """Takes in the task of the coming episode as a sentence, to be passed on."""
        self._sentence = sentence

    def reset(self) -> None:
        """Forgets the last episode.

        Raises:
            EpisodeLostError: The other end did not do so.
        """
        message = {"type": "reset", "seed": self._seed, "instruction": self._sentence}
        self._ask(message, "done")

    def select_action(self, observation: Observation) -> Action:
        """Asks the other end.

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
        except (ValueError, TypeError, OverflowError) as error:
            raise EpisodeLostError(WRONG_SHAPE, f"no array: {error}") from error

    def _ask(self, message: wire.Message, expected: str) -> wire.Message:
        """Sends a message and returns its answer; breaks the connection off if none comes.

        Otherwise the answer might come later and be taken for another one's.
        """
        if self._line is None:
            raise EpisodeLostError(self.broken, "the connection broke in this episode")
        line, self._line = self._line, None
        end = time.monotonic() + self._limit_s
        try:
            line.send(wire.encode(message))
            answer = wire.decode(line.recv(max(end - time.monotonic(), 0.0)))
        except TimeoutError as error:
            _close(line)
            raise EpisodeLostError(TOO_SLOW, f"no answer within {self._limit_s:g} s") from error
        except (WebSocketException, OSError) as error:
            _close(line)
            raise EpisodeLostError(self.broken, _words(error)) from error
        except wire.WireError as error:
            _close(line)
            raise EpisodeLostError(BAD_ANSWER, _words(error)) from error
        except BaseException:
            _close(line)
            raise
        if answer["type"] == "error":
            self._line = line
            reason = str(answer.get("reason"))
            known = reason == WRONG_SHAPE or _REASON.fullmatch(reason)
            raise EpisodeLostError(reason if known else BAD_ANSWER, _words(answer.get("detail")))
        if answer["type"] != expected:
            _close(line)
            reason = f"{answer['type']!r} instead of {expected!r}"
            raise EpisodeLostError(BAD_ANSWER, _words(answer.get("reason", reason)))
        self._line = line
        return answer


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

    def __call__(self, env: Any) -> "ServedPolicy":
        """Connects.

        Raises:
            ServerError: There is no such server, or it refuses.
        """
        policy = ServedPolicy(self, env)
        policy.connect(seed=0)
        return policy


class ServedPolicy(RemotePolicy):
    """A policy behind a server.

    Args:
        address: Where the policy is served, and for which task.
        env: Where it acts; only what it shows travels.
    """

    def __init__(self, address: RemoteFactory, env: Any) -> None:
        super().__init__(hello(address.task, env), address.decision_limit_s)
        self._url = address.url

    def _open(self) -> "_WebSocket":
        return _WebSocket(self._url)

    def _refusal(self, reason: str) -> HvsError:
        return ServerError(f"the server at {self._url} refuses: {reason}")


class _WebSocket:
    """A `Line` to a policy server."""

    def __init__(self, url: str) -> None:
        self._closing = contextlib.ExitStack()
        try:
            opening = connect(
                url,
                compression=None,
                proxy=None,
                open_timeout=CONNECT_LIMIT_S,
                close_timeout=_CLOSE_LIMIT_S,
                # Servers may be too busy deciding to answer a ping; decisions have a limit.
                ping_interval=None,
                max_size=wire.MAX_ANSWER_BYTES,
                # One answer to each message; a server that sends more has to wait until it is
                # asked.
                max_queue=1,
            )
            self._connection: ClientConnection = self._closing.enter_context(opening)
        except (OSError, WebSocketException) as error:
            raise ServerError(
                f"no policy server answers at {url} ({_words(error)}); start one "
                "('hvs serve'), then give the same command again"
            ) from error

    def send(self, content: bytes, /) -> None:
        self._connection.send(content)

    def recv(self, timeout: float, /) -> bytes | str:
        return self._connection.recv(timeout)

    def close(self) -> None:
        self._closing.close()


def find(
    url: str,
    name: str,
    task: str,
    decision_limit_s: float = DECISION_LIMIT_S,
    options: Mapping[str, Any] = AS_NAMED,
) -> Contender:
    """Asks a server for its name.

    Args:
        url: Of the server, ``ws://host:port``.
        name: What the result shall call the policy.
        task: Named task.
        decision_limit_s: Time after which a decision loses the episode (s).
        options: Options that it is played with, where they differ from it.

    Returns:
        The policy; hash, parameters and training are the server's own word.

    Raises:
        OptionError: The address, the time limit or an option makes no sense.
        UnknownTaskError: There is no such task.
        ServerError: There is no such server, or it refuses, or what it says of its policy makes no
            sense.
    """
    check_decision_limit(decision_limit_s)
    try:
        parse_uri(url)
    except (InvalidURI, ValueError) as error:
        raise OptionError(
            f"--server takes an address such as ws://127.0.0.1:8765, not {url!r}"
        ) from error
    make = RemoteFactory(url, task, decision_limit_s)
    with contextlib.closing(registry.load(task, **options)) as env:
        welcome = make(env).welcome
    assert welcome is not None
    return Contender(
        name=name,
        kind="server",
        make=make,
        hash=welcome.policy_hash,
        parameters=welcome.policy_parameters,
        training_steps=welcome.training_steps,
        training_hours=welcome.training_hours,
    )


def hello(task: str, env: Any) -> wire.Message:
    """Returns the first message: which task is to be played, and what of it is public."""
    spec = registry.announced(env.spec)
    return {
        "type": "hello",
        "protocol": wire.PROTOCOL,
        "suite_version": suite_version(),
        "task": task,
        "task_version": spec.version,
        "task_digest": lock.digest(task),
        "options": registry.options_of(spec),
        "instruction": spec.instruction(),
        "period_s": spec.control_period_s,
        "parameters": dataclasses.asdict(spec),
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


def _words(said: object) -> str:
    """A line of what the other end said, or of an error, shortened for a reader."""
    return " ".join(str(said).split())[:_LONGEST_WORDS] or type(said).__name__


def _close(line: Line) -> None:
    with contextlib.suppress(Exception):
        line.close()
