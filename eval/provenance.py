"""What a number was made with: versions, renderer, processor, policy weights; no host, no user."""

import hashlib
import importlib.metadata
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
