"""What a number was made with: versions, renderer, processor, policy weights; no host, no user."""

import dataclasses
import hashlib
import importlib.metadata
import json
import math
import platform
from pathlib import Path

from hvs_suite.cell import gl

# Whatever can change a physics state, a picture, or a policy's answer to it.
PACKAGES = (
    "mujoco",
    "dm-control",
    "numpy",
    "pin",
    "ruckig",
    "opencv-python-headless",
    "torch",
    "lerobot",
)
CHECKPOINT_SUFFIXES = (".json", ".safetensors")


def suite_version() -> str:
    """Returns the version of the installed hvs_suite."""
    return importlib.metadata.version("hvs-suite")


def package_versions() -> dict[str, str]:
    """Returns the version of Python and of each of `PACKAGES` that is installed; imports none."""
    versions = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return versions


def gl_renderer() -> str:
    """Returns what draws the images here, as OpenGL names itself.

    Raises:
        RenderError: No OpenGL backend works on this machine.
    """
    context = gl.create_context(8, 8)
    try:
        # Only now: PyOpenGL settles on a platform when it is imported, the context chooses it.
        import OpenGL.GL

        name: bytes = OpenGL.GL.glGetString(OpenGL.GL.GL_RENDERER)
        version: bytes = OpenGL.GL.glGetString(OpenGL.GL.GL_VERSION)
    finally:
        context.free()
    return f"{name.decode()}, {version.decode()}"


def cpu() -> str:
    """Returns the processor's model name."""
    try:
        lines = Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines()
    except OSError:
        lines = []
    names = [line.partition(":")[2].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def operating_system() -> str:
    """Returns operating system and architecture, such as ``Linux-x86_64``."""
    return f"{platform.system()}-{platform.machine()}"


def checkpoint_hash(folder: Path) -> str:
    """Returns the SHA-256 over a checkpoint's files: names and contents, sub-folders left out.

    Args:
        folder: Holds ``config.json``, ``model.safetensors`` and the processors' files.
    """
    digest = hashlib.sha256()
    for path in sorted(folder.iterdir()):
        if path.suffix in CHECKPOINT_SUFFIXES and path.is_file():
            with path.open("rb") as file:
                content = hashlib.file_digest(file, "sha256").hexdigest()
            digest.update(f"{path.name}\0{content}\n".encode())
    return digest.hexdigest()


def file_hash(path: Path) -> str:
    """Returns the SHA-256 of a file."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def parameters(folder: Path) -> int | None:
    """Returns how many numbers a checkpoint's ``model.safetensors`` holds; None without one."""
    try:
        with (folder / "model.safetensors").open("rb") as file:
            # The format's own header: eight bytes of length, then JSON with every tensor's shape.
            header = json.loads(file.read(int.from_bytes(file.read(8), "little")))
        return sum(
            math.prod(tensor["shape"]) for name, tensor in header.items() if name != "__metadata__"
        )
    except (OSError, ValueError, KeyError, TypeError):
        return None


@dataclasses.dataclass(frozen=True)
class Training:
    """What a checkpoint tells of its training.

    Attributes:
        steps: Optimiser steps; None if it does not say.
        hours: Training time (h); None if it does not say.
    """

    steps: int | None
    hours: float | None


def training(folder: Path) -> Training:
    """Reads ``training/outcome.json``, which our training commands leave in a checkpoint.

    ``lerobot-train`` keeps its steps beside the checkpoint, and no hours.
    """
    try:
        outcome = json.loads((folder / "training" / "outcome.json").read_bytes())
        return Training(int(outcome["step"]), float(outcome["train_s"]) / 3600.0)
    except (OSError, ValueError, KeyError, TypeError):
        pass
    try:
        state = json.loads((folder.parent / "training_state" / "training_step.json").read_bytes())
        return Training(int(state["step"]), None)
    except (OSError, ValueError, KeyError, TypeError):
        return Training(None, None)
