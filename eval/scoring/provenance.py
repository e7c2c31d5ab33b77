"""What a number was made with: versions, renderer, processor, policy weights; no host, no user."""

import dataclasses
import hashlib
import importlib.metadata
import math
import os
import platform
from pathlib import Path
from typing import Annotated

import pydantic

from hvs_suite.cell import gl
from hvs_suite.errors import PolicyError
from hvs_suite.policies.checkpoints.files import MOST_SETTINGS_BYTES, home, read_shapes
from hvs_suite.reading import read_bytes

# Packages that can change a physics state, a picture, or a policy's action.
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
# JSON readers elsewhere keep whole numbers up to here.
_MOST_STEPS = 2**53


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
        # Only now: PyOpenGL fixes its platform when it is imported, and the context chooses it.
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


def parameters(folder: Path) -> int:
    """Returns how many numbers a checkpoint's ``model.safetensors`` holds.

    Args:
        folder: The checkpoint.

    Raises:
        PolicyError: The file is missing or damaged.
    """
    return sum(math.prod(shape) for shape in read_shapes(folder).values())


class _Outcome(pydantic.BaseModel):
    step: Annotated[int, pydantic.Field(strict=True, ge=0, le=_MOST_STEPS)]
    train_s: Annotated[float, pydantic.Field(ge=0.0, allow_inf_nan=False)]


class _TrainingStep(pydantic.BaseModel):
    step: Annotated[int, pydantic.Field(strict=True, ge=0, le=_MOST_STEPS)]


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

    Args:
        folder: The checkpoint.

    Raises:
        PolicyError: There is such a file, but damaged: numbers missing, negative or not finite. A
            result that says so would be refused once everything was played.
    """
    outcome = _read(_Outcome, folder, "training/outcome.json")
    if outcome is not None:
        return Training(outcome.step, outcome.train_s / 3600.0)
    state = _read(_TrainingStep, folder.parent, "training_state/training_step.json")
    return Training(None if state is None else state.step, None)


def _read[Model: pydantic.BaseModel](model: type[Model], folder: Path, name: str) -> Model | None:
    """A file of a folder, of which a model says what matters; None if there is none."""
    path = folder / name
    if not os.path.lexists(path):
        return None
    content = read_bytes(
        path, most=MOST_SETTINGS_BYTES, error=PolicyError, within=home(folder, name)
    )
    try:
        # Pydantic's own parser takes NaN, which stands for a loss that was not measured.
        return model.model_validate_json(content)
    except pydantic.ValidationError as error:
        first = error.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        raise PolicyError(
            f"{path}: {where + ': ' if where else ''}{first['msg']}; mend or remove the file"
        ) from error
