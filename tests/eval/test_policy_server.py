"""A served policy scores as in-process; whatever goes wrong over there loses the episode."""

import contextlib
import itertools
import json
import pickle
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import msgpack
import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect
from websockets.sync.server import serve

import hvs_suite
from hvs_suite.cli import main
from hvs_suite.errors import OptionError, PolicyError, ServerError
from hvs_suite.eval import protocol
from hvs_suite.eval.scoring import progress_file, result_file
from hvs_suite.eval.serving import policy_server, policy_session, remote_policy, wire
from hvs_suite.rollout import run_episode

TASK = "align-thesis"


@pytest.fixture(autouse=True)
def _own_code(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(Path(__file__).parent)


@contextlib.contextmanager
def serving(talk: Callable[[Any], None], port: int = 0) -> Iterator[str]:
    """A server in a thread; ``talk`` plays a connection."""

    def quietly(websocket: Any) -> None:
        with contextlib.suppress(Exception):
            talk(websocket)

    with serve(quietly, "127.0.0.1", port, close_timeout=0.2) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield f"ws://127.0.0.1:{server.socket.getsockname()[1]}"
        finally:
            server.shutdown()
            thread.join()


@contextlib.contextmanager
def reference(policy: str) -> Iterator[str]:
    """The reference server, a process for each connection."""
    with policy_server.listening(policy, "127.0.0.1", 0) as (server, url):
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        try:
            yield url
        finally:
            server.shutdown()
            thread.join()


def conversation(policy: str) -> Callable[[Any], None]:
    """The reference server's conversation, without the process around it."""

    def talk(websocket: Any) -> None:
        session = policy_session.Session(policy)
        for message in websocket:
            websocket.send(session.answer(message))

    return talk


def welcome(**said: Any) -> dict[str, Any]:
    return {"type": "welcome", "protocol": 1, **said}


def answers(**changed: Any) -> Callable[[Any], None]:
    """A conversation of fixed answers; a callable answers by itself, None breaks off."""
    fixed = {
        "hello": welcome(),
        "reset": {"type": "done"},
        "observe": {"type": "action", "action": [0.0] * 7},
    }

    def talk(websocket: Any) -> None:
        for message in websocket:
            answer: Any = (fixed | changed)[msgpack.unpackb(message)["type"]]
            if callable(answer):
                answer = answer()
            if answer is None:
                return
            websocket.send(answer if isinstance(answer, bytes) else msgpack.packb(answer))

    return talk


def evaluate(url: str, episodes: int = 2, limit_s: float = 10.0, **options: Any) -> Any:
    contender = remote_policy.find(url, "someone", TASK, limit_s)
    return protocol.evaluate(
        contender, TASK, episodes=episodes, decision_limit_s=limit_s, **options
    )


# --- the same result ------------------------------------------------------------------------------


def test_a_served_policy_gets_the_rows_that_it_gets_in_process() -> None:
    with serving(conversation("servo")) as url:
        served = evaluate(url, split="dev")
    own = protocol.evaluate("servo", TASK, split="dev", episodes=2)
    assert served.summary.n_success == 2
    assert served.episodes == own.episodes
    assert served.metadata.actions_sha256 == own.metadata.actions_sha256
    assert served.metadata.policy_kind == "server"
    assert served.summary.policy == "someone"


def test_two_workers_do_not_disturb_each_others_random_numbers(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(progress_file.secrets, "token_hex", lambda n: "5a" * n)
    own = protocol.evaluate("broken_policies:draws", TASK, episodes=4)
    with reference("broken_policies:draws") as url:
        served = evaluate(url, 4, workers=2)
    assert served.episodes == own.episodes
    assert served.metadata.policy_hash == own.metadata.policy_hash


def test_a_served_policy_knows_of_the_task_what_it_knows_in_process() -> None:
    with serving(conversation("broken_policies:curious")) as url:
        assert evaluate(url, 1).summary.failures == {}
    with hvs_suite.load(TASK) as env:
        message = msgpack.unpackb(wire.encode(remote_policy.hello(TASK, env)))
        _, context = policy_session.served("servo", TASK, message)
        assert context.observations == dict(env.observation_spec())
        assert context.action == env.action_spec()
        assert context.spec == env.spec


def test_a_few_lines_make_a_server() -> None:
    page = Path(__file__).parents[2] / "docs" / "policy-server.md"
    code = page.read_text().split("```python\n")[1].split("```")[0]
    given: dict[str, Any] = {}
    exec(code[: code.index("with serve(")], given)
    with serving(given["talk"]) as url:
        assert evaluate(url, 1).episodes == protocol.evaluate("zero", TASK, episodes=1).episodes


# --- what goes wrong ------------------------------------------------------------------------------


@pytest.mark.parametrize("name", ["nan", "shape", "text", "raises"])
def test_a_served_policy_loses_episodes_for_the_reasons_that_it_does_in_process(name: str) -> None:
    own = protocol.evaluate(f"broken_policies:{name}", TASK, episodes=2)
    with serving(conversation(f"broken_policies:{name}")) as url:
        assert evaluate(url).episodes == own.episodes


@pytest.mark.parametrize(
    ("changed", "reason"),
    [
        ({"observe": None}, "disconnected"),
        ({"reset": None}, "disconnected"),
        ({"observe": lambda: time.sleep(0.6)}, "too slow"),
        ({"observe": {"type": "action", "action": [float("nan")] * 7}}, "not finite"),
        ({"observe": {"type": "action", "action": [0.0] * 6}}, "wrong shape"),
        ({"observe": {"type": "action", "action": "up"}}, "wrong shape"),
        ({"observe": {"type": "action"}}, "wrong shape"),
        ({"observe": {"type": "done"}}, "bad answer"),
        ({"observe": b"\xc1"}, "bad answer"),
        ({"observe": pickle.dumps([0.0] * 7)}, "bad answer"),
        (
            {"observe": {"type": "action", "action": [2**63, *[0.0] * 6], "x": "." * 2**20}},
            "disconnected",
        ),
        ({"observe": {"type": "error", "reason": "raised OSError"}}, "raised OSError"),
        ({"observe": {"type": "error", "reason": "<b>its fault</b>"}}, "bad answer"),
    ],
)
def test_whatever_a_server_does_wrong_loses_the_episode_and_the_run_goes_on(
    changed: dict[str, Any], reason: str
) -> None:
    with serving(answers(**changed)) as url:
        result = evaluate(url, limit_s=0.3)
    assert result.summary.failures == {reason: 2}


def test_one_broken_connection_costs_one_episode() -> None:
    turn = itertools.count()

    def once() -> Any:
        return None if next(turn) == 3 else {"type": "action", "action": [0.0] * 7}

    with serving(answers(observe=once)) as url:
        result = evaluate(url, 3)
    assert result.summary.failures == {"disconnected": 1}
    assert sorted(row.steps for row in result.episodes)[0] == 3


def test_a_server_that_is_gone_stops_the_run_which_resumes_when_it_is_back(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "result.json"
    decisions = itertools.count()
    gone = threading.Event()

    def command(url: str) -> list[str]:
        words = f"evaluate --server {url} --policy x --task {TASK} --episodes 4 --out {out}"
        return words.split()

    def vanish() -> Any:
        # Half-way through the second episode.
        if next(decisions) < 30:
            return {"type": "action", "action": [0.0] * 7}
        gone.set()
        return None

    def talk(websocket: Any) -> None:
        if not gone.is_set():
            answers(observe=vanish)(websocket)

    with serving(talk) as url:
        assert main.run(command(url)) == 2
    assert capsys.readouterr().err.splitlines()[-1].startswith("hvs: the server at ")
    assert not out.exists()
    with serving(answers()) as url:
        assert main.run(command(url)) == 0
    assert result_file.load(out).summary.failures == {"disconnected": 1}


@pytest.mark.parametrize(
    ("hello", "reason"),
    [
        ({"type": "refused", "reason": "not today"}, "not today"),
        ({"type": "welcome", "protocol": 2}, "refuses"),
        ({"type": "action"}, "refuses"),
        (b"hello yourself", "does not greet back"),
        (None, "does not greet back"),
        (welcome(policy_parameters=-1), "policy_parameters"),
        (welcome(policy_parameters=1.5), "policy_parameters"),
        (welcome(training_steps="many"), "training_steps"),
        (welcome(training_hours=float("nan")), "training_hours"),
        (welcome(training_hours=float("inf")), "training_hours"),
        (welcome(policy_hash="\x1b[2J"), "policy_hash"),
        (welcome(policy="x" * 101), "policy"),
    ],
)
def test_a_server_that_does_not_welcome_is_refused_in_one_line_with_2(
    hello: Any, reason: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with serving(answers(hello=hello)) as url:
        words = f"evaluate --server {url} --policy x --task {TASK} --out {tmp_path}/x.json"
        assert main.run(words.split()) == 2
    (complaint,) = capsys.readouterr().err.splitlines()
    assert reason in complaint


def test_nobody_there_and_no_address_are_told_apart() -> None:
    with serving(answers()) as url:
        pass
    with pytest.raises(ServerError, match="hvs serve"):
        remote_policy.find(url, "x", TASK)
    with pytest.raises(OptionError, match="ws://127"):
        remote_policy.find("127.0.0.1:8765", "x", TASK)


# --- the reference server -------------------------------------------------------------------------


def hello(**changed: Any) -> dict[str, Any]:
    with hvs_suite.load(TASK) as env:
        return remote_policy.hello(TASK, env) | changed


@pytest.mark.parametrize(
    ("policy", "changed", "reason"),
    [
        ("zero", {"protocol": 2}, "version 1 of the protocol"),
        ("zero", {"task": "align-eazy"}, "did you mean"),
        ("zero", {"task": 7}, "names a task"),
        ("zero", {"task_digest": "0" * 64}, "another version of align-thesis"),
        ("zero", {"observations": {"eih": {"dtype": "object"}}}, "describes observations"),
        ("zero", {"action": None}, "describes observations"),
        ("expert", {}, "needs more than the observations"),
        ("nobody", {}, "neither a policy"),
        ("broken_policies:nothing", {}, "has no reset"),
    ],
)
def test_an_evaluation_that_does_not_fit_is_refused(
    policy: str, changed: dict[str, Any], reason: str
) -> None:
    session = policy_session.Session(policy)
    answer = wire.decode(session.answer(wire.encode(hello(**changed))))
    assert answer["type"] == "refused"
    assert reason in answer["reason"]


@pytest.mark.parametrize(
    "message",
    [
        b"",
        b"\xc1",
        msgpack.packb([1, 2]),
        msgpack.packb({"type": "observe", "observation": {}}),
        msgpack.packb({"type": "reset", "seed": 1}),
        pickle.dumps({"type": "hello"}),
    ],
)
def test_senseless_messages_are_refused_and_the_conversation_goes_on(message: bytes) -> None:
    session = policy_session.Session("zero")
    assert wire.decode(session.answer(message))["type"] == "refused"
    assert wire.decode(session.answer(wire.encode(hello())))["type"] == "welcome"
    for senseless in ({"seed": -1}, {"seed": 2**32}, {"seed": True}, {}):
        answer = session.answer(wire.encode({"type": "reset", **senseless}))
        assert wire.decode(answer)["type"] == "refused"
    answer = session.answer(wire.encode({"type": "observe", "observation": {"eih": [1]}}))
    assert wire.decode(answer)["type"] == "refused"


@pytest.mark.parametrize(
    ("headers", "status"),
    [
        ({}, None),
        ({"Host": "localhost:8765"}, None),
        ({"Host": "[::1]:8765"}, None),
        ({"Origin": "http://127.0.0.1:8765"}, 403),
        ({"Origin": "null"}, 403),
        ({"Host": "rebound.example:8765"}, 403),
        ({"Host": "127.0.0.1.example"}, 403),
        ({"Host": "[::1"}, 403),
    ],
)
def test_web_pages_are_turned_away(headers: dict[str, str], status: int | None) -> None:
    with reference("zero") as url:
        address = urlsplit(url)
        asked = {
            "Host": address.netloc,
            "Upgrade": "websocket",
            "Connection": "Upgrade",
            "Sec-WebSocket-Key": "AAAAAAAAAAAAAAAAAAAAAA==",
            "Sec-WebSocket-Version": "13",
        } | headers
        lines = [f"{name}: {value}" for name, value in asked.items()]
        assert address.hostname is not None
        with socket.create_connection((address.hostname, address.port or 0), 10.0) as connection:
            connection.sendall("\r\n".join(["GET / HTTP/1.1", *lines, "", ""]).encode())
            answered = connection.recv(100).split()
        assert int(answered[1]) == (status or 101)


def test_more_connections_than_a_server_takes_are_refused_until_one_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(policy_server, "MAX_CONNECTIONS", 1)
    with hvs_suite.load(TASK) as env, reference("zero") as url:
        make = remote_policy.RemoteFactory(url, TASK, 10.0)
        first = make(env)
        with pytest.raises(ServerError, match="1 others are playing"):
            make(env)
        first.reset()
        del first
        deadline = time.monotonic() + 10.0
        while True:
            try:
                make(env).reset()
                break
            except ServerError:
                assert time.monotonic() < deadline


def test_whoever_connects_and_says_nothing_is_hung_up_on(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(policy_server, "HANDSHAKE_LIMIT_S", 0.1)
    with reference("zero") as url:
        with connect(url) as silent, pytest.raises(ConnectionClosed):
            silent.recv(10.0)
        address = urlsplit(url)
        assert address.hostname is not None
        with socket.create_connection((address.hostname, address.port or 0), 10.0) as connection:
            assert connection.recv(1) == b""


@pytest.mark.parametrize(
    ("name", "reason"), [("ends", "disconnected"), ("leaves", "raised SystemExit")]
)
def test_a_served_policy_that_leaves_loses_its_episode_alone(name: str, reason: str) -> None:
    with reference(f"broken_policies:{name}") as url:
        result = evaluate(url)
    assert result.summary.failures == {reason: 2}
    assert [row.steps for row in result.episodes] == [1, 1]


def test_the_commands_serve_and_evaluate(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "zero.json"
    code = "import sys; from hvs_suite.cli.main import main; main(sys.argv[1:])"
    words = [sys.executable, "-c", code, "serve", "--policy", "zero", "--port", "0"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as server:
        try:
            assert server.stdout is not None
            assert TASK in server.stdout.readline()
            url = server.stdout.readline().strip()
            line = f"evaluate --server {url} --policy zero --task {TASK} --episodes 2 --out {out}"
            assert main.run(line.split()) == 0
        finally:
            server.terminate()
        assert server.wait(10.0) == 0
    assert result_file.load(out).episodes == protocol.evaluate("zero", TASK, episodes=2).episodes
    assert json.loads(out.read_text())["metadata"]["policy_kind"] == "server"
    capsys.readouterr()


@pytest.mark.parametrize(
    "words",
    [
        "--policy expert",
        "--policy nobody",
        "--policy zero --port 70000",
        "--policy zero --host 9.9.9.9",
    ],
)
def test_what_cannot_be_served_is_refused_in_one_line(
    words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main.run(["serve", *words.split()]) == 2
    assert len(capsys.readouterr().err.splitlines()) == 1


# --- the bytes ------------------------------------------------------------------------------------


@pytest.mark.parametrize("dtype", ["uint8", "float32", "float64"])
def test_arrays_arrive_as_they_were_sent(dtype: str) -> None:
    sent = np.arange(24, dtype=dtype).reshape(2, 3, 4).transpose(1, 0, 2)
    message = wire.decode(wire.encode({"type": "x", "value": sent}))
    arrived = wire.array(message["value"])
    np.testing.assert_array_equal(arrived, sent)
    assert arrived.dtype == sent.dtype
    assert arrived.flags.writeable


@pytest.mark.parametrize(
    "value",
    [
        None,
        [1.0],
        {"dtype": "float32", "shape": [1]},
        {"dtype": "object", "shape": [1], "data": b"12345678"},
        {"dtype": "float32", "shape": [2], "data": b"1234"},
        {"dtype": "float32", "shape": [-1], "data": b"1234"},
        {"dtype": "float32", "shape": [True], "data": b"1234"},
        {"dtype": "float32", "shape": "1", "data": b"1234"},
        {"dtype": "float32", "shape": [1], "data": "1234"},
        {"dtype": "float32", "shape": [1] * 9, "data": b"1234"},
    ],
)
def test_what_is_no_array_is_refused(value: Any) -> None:
    with pytest.raises(wire.WireError):
        wire.array(value)


def test_objects_do_not_travel() -> None:
    for value in (np.array([object()]), object(), PolicyError("x")):
        with pytest.raises(TypeError):
            wire.encode({"type": "x", "value": value})


def test_a_remote_policy_plays_anywhere_a_policy_does() -> None:
    with (
        serving(conversation("servo")) as url,
        hvs_suite.load(TASK, split="dev") as env,
    ):
        policy = remote_policy.RemoteFactory(url, TASK, 10.0)(env)
        assert run_episode(env, policy, 0).success
