"""Three hosts on one computer, for what is to be shown on many: a head and two others.

Each is a network namespace with an address of its own, and sees a /tmp of its own, so that nothing
gets from one to another but by the network between them. That is a bridge in a fourth namespace:
the computer's own network is left alone. Needs root and the ``ip`` command, see `reason_against`.
"""

import contextlib
import os
import secrets
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Self

NAMES = ("head", "one", "two")
PORT = 6379
STORE_BYTES = 80 * 2**20
START_LIMIT_S = 60.0
RAY = Path(sys.executable).with_name("ray")


def reason_against() -> str | None:
    """Why there can be no such hosts here; None if there can."""
    if os.geteuid() != 0:
        return "network namespaces need root"
    if shutil.which("ip") is None or shutil.which("unshare") is None:
        return "network namespaces need the commands ip and unshare"
    name = f"hvs-{os.getpid()}-probe"
    made = subprocess.run(["ip", "netns", "add", name], capture_output=True, text=True, check=False)
    if made.returncode:
        return f"no network namespace can be made: {made.stderr.strip()}"
    subprocess.run(["ip", "netns", "del", name], check=True)
    return None


ROOT = Path(__file__).parents[1]
OF_ITS_OWN = """
mount --bind "$0" /mnt && mount -t tmpfs tmpfs /tmp && mount -t tmpfs tmpfs /dev/shm &&
mkdir -p "$0" && mount --move /mnt "$0" && exec "$@"
"""
"""Gives a command a /tmp of its own, in which the checkout stays where it is, be it below /tmp."""


class Hosts:
    """Makes the hosts, and starts Ray on the head, which plays nothing itself.

    Attributes:
        address: Of the cluster.
        address_of: Each host's, by name.
    """

    def __init__(self) -> None:
        self._prefix = f"hvs-{os.getpid()}-"
        self._running: dict[str, subprocess.Popen[bytes]] = {}
        self._folder = tempfile.mkdtemp(prefix="hvs-hosts-")
        self.address_of = {name: f"10.77.0.{i}" for i, name in enumerate(NAMES, 1)}
        self.address = f"{self.address_of['head']}:{PORT}"
        self._environment = {
            **os.environ,
            # Who plays on this machine alone tells Ray so, and whoever comes after in this process.
            "RAY_ENABLE_WINDOWS_OR_OSX_CLUSTER": "1",
            # Ray refuses clients without the token; each cluster has its own.
            "RAY_AUTH_MODE": "token",
            "RAY_AUTH_TOKEN": secrets.token_hex(32),
            "RAY_USAGE_STATS_ENABLED": "0",
            # A host that fell silent is given up after ten seconds, not after a minute.
            "RAY_health_check_period_ms": "1000",
            "RAY_health_check_timeout_ms": "2000",
            "RAY_health_check_failure_threshold": "3",
        }

    def __enter__(self) -> Self:
        try:
            self._connect()
            own = ("--num-cpus=0", "--include-dashboard=false", f"--temp-dir={self._folder}")
            self._ray("head", "--head", f"--port={PORT}", *own)
            self.wait_for(1)
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *_: object) -> None:
        for name in [*self._running]:
            self.kill(name)
        for name in (*NAMES, "switch"):
            subprocess.run(["ip", "netns", "del", self._prefix + name], check=False)
        shutil.rmtree(self._folder, ignore_errors=True)

    def start(self, *names: str, cores: int = 1) -> None:
        """Let hosts join the cluster, and wait until they have."""
        for name in names:
            self._ip("-n", self._prefix + name, "link", "set", "eth0", "up")
            self._ray(name, f"--address={self.address}", f"--num-cpus={cores}")
        self.wait_for(len(self._running))

    def command(self, name: str, words: Sequence[str]) -> list[str]:
        """What runs a command on a host that sees the computer's own /tmp."""
        return ["ip", "netns", "exec", self._prefix + name, *words]

    def popen(
        self, words: Sequence[str], *, name: str = "head", **options: object
    ) -> subprocess.Popen[str]:
        """Run a command on a host."""
        return subprocess.Popen(  # type: ignore[call-overload, no-any-return]
            self.command(name, words), env=self._environment, text=True, **options
        )

    def kill(self, name: str) -> None:
        """End a host as the loss of its power would: everything at once, without a word."""
        # The network first, or the others would be told that its connections are closed.
        self._ip("-n", self._prefix + name, "link", "set", "eth0", "down")
        found = subprocess.run(
            ["ip", "netns", "pids", self._prefix + name], capture_output=True, text=True, check=True
        )
        for process in map(int, found.stdout.split()):
            with contextlib.suppress(ProcessLookupError):
                os.kill(process, signal.SIGKILL)
        self._running.pop(name).wait()

    def wait_for(self, count: int) -> None:
        """Wait until the cluster has so many hosts.

        Raises:
            TimeoutError: It has not.
        """
        script = f"import ray; ray.init({self.address!r}, logging_level='error'); "
        script += "print(sum(node['Alive'] for node in ray.nodes()))"
        end = time.monotonic() + START_LIMIT_S
        while time.monotonic() < end:
            for name, process in self._running.items():
                if process.poll() is not None:
                    raise RuntimeError(f"{name}: {self._output(name).read_text()}")
            with self.popen(
                [sys.executable, "-c", script], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
            ) as asked:
                assert asked.stdout is not None
                if asked.stdout.read().strip() == str(count):
                    return
        raise TimeoutError(f"the cluster has no {count} hosts after {START_LIMIT_S:g} s")

    def _connect(self) -> None:
        switch = self._prefix + "switch"
        self._ip("netns", "add", switch)
        self._ip("-n", switch, "link", "add", "bridge", "type", "bridge")
        self._ip("-n", switch, "link", "set", "bridge", "up")
        for name, address in self.address_of.items():
            host = self._prefix + name
            self._ip("netns", "add", host)
            self._ip(
                *("-n", switch, "link", "add", f"to-{name}", "type", "veth"),
                *("peer", "name", "eth0", "netns", host),
            )
            self._ip("-n", switch, "link", "set", f"to-{name}", "master", "bridge", "up")
            self._ip("-n", host, "address", "add", f"{address}/24", "dev", "eth0")
            self._ip("-n", host, "link", "set", "eth0", "up")
            self._ip("-n", host, "link", "set", "lo", "up")

    def _ray(self, name: str, *options: str) -> None:
        words = [
            str(RAY),
            "start",
            "--block",
            f"--node-ip-address={self.address_of[name]}",
            f"--object-store-memory={STORE_BYTES}",
            *options,
        ]
        apart = []
        if name != "head":
            apart = ["unshare", "--mount", "sh", "-c", OF_ITS_OWN, str(ROOT)]
        self._running[name] = subprocess.Popen(
            self.command(name, [*apart, *words]),
            env=self._environment,
            cwd="/",
            stdout=self._output(name).open("wb"),
            stderr=subprocess.STDOUT,
        )

    def _output(self, name: str) -> Path:
        return Path(self._folder) / f"{name}.txt"

    def _ip(self, *words: str) -> None:
        subprocess.run(["ip", *words], check=True)
