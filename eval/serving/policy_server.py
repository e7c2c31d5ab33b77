"""The reference policy server: plays a policy of ours for evaluations elsewhere.

Each connection gets a process of its own with a policy of its own, as a worker of an evaluation
does: connections cannot disturb one another, and a policy that hangs ends with its connection.
"""

import contextlib
import dataclasses
import http
import ipaddress
import socket
import threading
from collections.abc import Iterator
from pathlib import Path
from urllib.parse import urlsplit

from websockets.exceptions import ConnectionClosed
from websockets.frames import CloseCode
from websockets.http11 import Request, Response
from websockets.protocol import State
from websockets.sync.server import Server, ServerConnection, serve

from hvs_suite.errors import OptionError
from hvs_suite.eval.serving import wire
from hvs_suite.eval.serving.policy_process import PolicyProcess

MAX_CONNECTIONS = 32
"""Each has a process with a policy of its own."""
HANDSHAKE_LIMIT_S = 10.0
"""For the WebSocket's opening, and again for the first message, which starts a process (s)."""
# How often a server that waits for its policy checks that the connection still exists.
_LOOK_PERIOD_S = 0.2


@dataclasses.dataclass(frozen=True)
class _Handler:
    """Plays a connection in a process of its own.

    Attributes:
        policy: Its name.
        place: Working folder of the processes.
        free: Connections that may still come.
    """

    policy: str
    place: str
    free: threading.BoundedSemaphore

    def __call__(self, websocket: ServerConnection) -> None:
        """Carries messages to and fro until either end closes."""
        if not self.free.acquire(blocking=False):
            websocket.close(CloseCode.TRY_AGAIN_LATER, f"{MAX_CONNECTIONS} others are playing")
            return
        try:
            # Whichever side is at fault, the connection ends, and the evaluation sees that.
            with contextlib.suppress(ConnectionClosed, OSError):
                self._play(websocket)
        finally:
            self.free.release()

    def _play(self, websocket: ServerConnection) -> None:
        message = websocket.recv(HANDSHAKE_LIMIT_S)
        with contextlib.closing(PolicyProcess(self.policy, self.place)) as process:
            while True:
                process.send(message if isinstance(message, bytes) else message.encode())
                while (answer := _look(process)) is None:
                    if websocket.protocol.state is not State.OPEN:
                        return
                websocket.send(answer)
                message = websocket.recv()


def _look(process: PolicyProcess) -> bytes | None:
    """The process's answer, if it comes soon."""
    with contextlib.suppress(TimeoutError):
        return process.recv(_LOOK_PERIOD_S)
    return None


@dataclasses.dataclass(frozen=True)
class _Doorkeeper:
    """Refuses requests that a web page sent.

    A browser lets any page connect to any address, and says so in ``Origin``; a name that points to
    this machine only for a while shows in ``Host``. Evaluations send no ``Origin``.

    Attributes:
        host: Where the server listens.
    """

    host: str

    def __call__(self, websocket: ServerConnection, request: Request) -> Response | None:
        """Returns what to answer instead of a connection, if any."""
        if "Origin" in request.headers:
            return websocket.respond(http.HTTPStatus.FORBIDDEN, "no web page may connect\n")
        hosts = request.headers.get_all("Host")
        if len(hosts) != 1 or not self._is_mine(hosts[0]):
            return websocket.respond(http.HTTPStatus.FORBIDDEN, "no name of this server\n")
        return None

    def _is_mine(self, host: str) -> bool:
        try:
            name = urlsplit(f"//{host}").hostname or ""
        except ValueError:
            return False
        with contextlib.suppress(ValueError):
            ipaddress.ip_address(name)
            return True
        names = {"localhost", self.host, socket.gethostname(), socket.getfqdn()}
        return name in {each.lower() for each in names}


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
            _Handler(policy, str(Path.cwd()), threading.BoundedSemaphore(MAX_CONNECTIONS)),
            host,
            port,
            compression=None,
            process_request=_Doorkeeper(host),
            open_timeout=HANDSHAKE_LIMIT_S,
            max_size=wire.MAX_MESSAGE_BYTES,
            # One message, one answer: a client that sends more has to wait.
            max_queue=1,
            close_timeout=1.0,
        )
    except (OSError, OverflowError, TypeError, UnicodeError) as error:
        raise OptionError(
            f"cannot listen at {host}, port {port}: {error}; choose another --port or --host"
        ) from error
    with server:
        bound = server.socket.getsockname()[1]
        yield server, f"ws://{f'[{host}]' if ':' in host else host}:{bound}"
