"""``hvs doctor``: what works on this machine, what does not, and which package is missing."""

import concurrent.futures
import ctypes.util
import dataclasses
import importlib.metadata
import json
import os
import platform
import subprocess
import sys

from hvs_suite.cli import console
from hvs_suite.errors import RenderError

PROBE_TIMEOUT_S = 120.0
FAILED = 1

VERSIONS_OF = (
    "hvs-suite",
    "mujoco",
    "dm-control",
    "pin",
    "numpy",
    "gymnasium",
    "torch",
    "lerobot",
    "stable-baselines3",
)
# Backend -> (the shared library it loads, the Debian packages that bring it).
LIBRARIES = {
    "egl": ("EGL", "libegl1 libgl1-mesa-dri"),
    "osmesa": ("OSMesa", "libosmesa6"),
    "glfw": ("GL", "libgl1 libgl1-mesa-dri"),
}
DECODERS = {
    "av": "import av; print(av.__version__)",
    "torchcodec": (
        "import importlib.metadata, torchcodec.decoders; "
        "print(importlib.metadata.version('torchcodec'))"
    ),
}
DECODER_REMEDIES = {
    "av": "reinstall the project's requirements",
    "torchcodec": "apt-get install ffmpeg (optional: LeRobot falls back to av)",
}


@dataclasses.dataclass(frozen=True)
class Probe:
    """What was found out about one backend or decoder.

    Attributes:
        works: It did its job in a process of its own.
        detail: The driver or version where it works, the reason where it does not.
        remedy: How to fix it; empty if it works.
    """

    works: bool
    detail: str
    remedy: str = ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Doctor:
    """Check rendering, versions and video decoders on this machine.

    Exits with 1 if the backend in use cannot render.

    Attributes:
        json: Print the findings as JSON.
    """

    json: bool = False

    def run(self) -> int:
        """Probe everything, print the findings, and judge them."""
        named = os.environ.get("MUJOCO_GL")
        with concurrent.futures.ThreadPoolExecutor() as pool:
            renderers = dict(zip(LIBRARIES, pool.map(probe_renderer, LIBRARIES), strict=True))
            decoders = dict(zip(DECODERS, pool.map(probe_decoder, DECODERS), strict=True))
        in_use = backend_in_use()
        renders = in_use in renderers and renderers[in_use].works
        if self.json:
            console.print_json(
                {
                    "backend_in_use": in_use,
                    "renders": renders,
                    "renderers": {k: dataclasses.asdict(v) for k, v in renderers.items()},
                    "decoders": {k: dataclasses.asdict(v) for k, v in decoders.items()},
                    "versions": versions(),
                    "python": platform.python_version(),
                    "machine": machine(),
                }
            )
            return 0 if renders else FAILED
        print(f"Python {platform.python_version()} on {machine()}")
        console.print_table(("package", "version"), list(versions().items()))
        _print_probes("renderer", renderers, in_use)
        _print_probes("video decoder", decoders)
        why = "named by MUJOCO_GL" if named else "chosen; set MUJOCO_GL to name another"
        if renders:
            print(f"Cameras render with {in_use} ({why}).")
            return 0
        working = [name for name, probe in renderers.items() if probe.works]
        if working:
            print(f"{in_use} ({why}) cannot render here, but MUJOCO_GL={working[0]} can.")
        else:
            print("Nothing renders here. Fix: apt-get install libegl1 libgl1-mesa-dri")
        return FAILED


def backend_in_use() -> str:
    """The backend that the suite would render with; ``off`` where there is none."""
    try:
        from hvs_suite.cell.gl import choose_backend

        return choose_backend()
    except RenderError:
        return os.environ.get("MUJOCO_GL", "off")


def probe_renderer(backend: str) -> Probe:
    """Render a small picture with one backend, in a process of its own.

    Args:
        backend: ``egl``, ``osmesa`` or ``glfw``.
    """
    library, packages = LIBRARIES[backend]
    if ctypes.util.find_library(library) is None:
        return Probe(False, f"lib{library} is missing", f"apt-get install {packages}")
    if backend == "glfw" and sys.platform == "linux":
        if not (os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY")):
            return Probe(False, "no display", "a desktop session, or xvfb-run (package xvfb)")
    # EGL devices have no name for a display; PyOpenGL must follow the backend, not the caller.
    environment = {k: v for k, v in os.environ.items() if k != "PYOPENGL_PLATFORM"}
    answer = _run_python(["-m", "hvs_suite.cli.probe_gl"], environment | {"MUJOCO_GL": backend})
    if answer.works:
        found = json.loads(answer.detail)
        if found["colours"] > 1:
            return Probe(True, found["renderer"])
        return Probe(False, "draws empty pictures", f"apt-get install {packages}")
    return dataclasses.replace(answer, remedy=f"apt-get install {packages}")


def probe_decoder(name: str) -> Probe:
    """Import one video decoder, in a process of its own.

    Args:
        name: ``av`` or ``torchcodec``.
    """
    try:
        version = importlib.metadata.version(name)
    except importlib.metadata.PackageNotFoundError:
        return Probe(False, "not installed", "pip install 'hvs-suite[learn]'")
    answer = _run_python(["-c", DECODERS[name]], dict(os.environ))
    if answer.works:
        return answer
    return Probe(False, f"{version} cannot load its libraries", DECODER_REMEDIES[name])


def versions() -> dict[str, str]:
    """Installed versions of the packages that decide what an episode looks like."""
    found = {}
    for package in VERSIONS_OF:
        try:
            found[package] = importlib.metadata.version(package)
        except importlib.metadata.PackageNotFoundError:
            found[package] = "not installed"
    return found


def machine() -> str:
    """Operating system, architecture and cores, in words."""
    return f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores"


def _run_python(arguments: list[str], environment: dict[str, str]) -> Probe:
    """Run the interpreter; its last line of stdout, or of stderr where it failed."""
    try:
        done = subprocess.run(
            [sys.executable, *arguments],
            env=environment,
            capture_output=True,
            text=True,
            timeout=PROBE_TIMEOUT_S,
            check=False,
        )
    except subprocess.TimeoutExpired:
        return Probe(False, f"no answer within {PROBE_TIMEOUT_S:.0f} s")
    said = (done.stdout if done.returncode == 0 else done.stderr).strip().splitlines()
    return Probe(done.returncode == 0, said[-1] if said else f"exit code {done.returncode}")


def _print_probes(what: str, probes: dict[str, Probe], in_use: str = "") -> None:
    """Print one table of findings."""
    from rich import box
    from rich.table import Table

    table = Table(box=box.SIMPLE_HEAD, pad_edge=False)
    for column in (what, "", "found", "fix"):
        table.add_column(column)
    for name, probe in probes.items():
        state = "works" if probe.works else "no"
        table.add_row(
            name, f"{state}, in use" if name == in_use else state, probe.detail, probe.remedy
        )
    console.console().print(table)
