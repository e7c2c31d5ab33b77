"""``hvs serve``: let evaluations in other processes or on other machines play a policy."""

import contextlib
import dataclasses
import signal
from types import FrameType

from hvs_suite.errors import OptionError, PolicyError


@dataclasses.dataclass(frozen=True, kw_only=True)
class Serve:
    """Serve a policy over WebSocket for 'hvs evaluate --server', until Ctrl-C.

    Anyone who can reach the port can use the policy; there is no password.

    Attributes:
        policy: servo, zero, pretrained, finetuned, a checkpoint folder or Hub id, or
            module:factory, which imports and runs that code.
        host: Address to listen at; 127.0.0.1 is this machine alone, 0.0.0.0 its whole network.
        port: TCP port to listen at; 0 takes a free one.
    """

    policy: str
    host: str = "127.0.0.1"
    port: int = 8765

    def run(self) -> int:
        """Serve; prints the address on a line of its own once it listens."""
        if not 0 <= self.port < 2**16:
            raise OptionError(f"--port is {self.port}; use 0 to 65535")
        from hvs_suite.eval.serving import policy_server

        tasks = _tasks(self.policy)
        signal.signal(signal.SIGTERM, _interrupt)
        with (
            contextlib.suppress(KeyboardInterrupt),
            policy_server.listening(self.policy, self.host, self.port) as (server, url),
        ):
            print(f"{self.policy} plays {', '.join(tasks)}; Ctrl-C ends it")
            print(url, flush=True)
            server.serve_forever()
        return 0


def _tasks(policy: str) -> list[str]:
    """The tasks that a policy can be served for.

    Raises:
        PolicyError: There are none.
    """
    from hvs_suite.eval.scoring import contender
    from hvs_suite.registry import TASKS

    contender.check_public(policy)
    found: list[str] = []
    refusal: PolicyError | None = None
    for task in TASKS:
        try:
            contender.find(policy, task)
            found.append(task)
        except PolicyError as error:
            refusal = refusal or error
    if refusal is not None and not found:
        raise refusal
    return found


def _interrupt(signal_number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt
