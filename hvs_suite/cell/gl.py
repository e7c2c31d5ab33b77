"""Choosing an OpenGL backend that works here, before anything imports it.

MuJoCo and dm_control read ``MUJOCO_GL`` when they are imported and fail late and obscurely when it
does not fit the machine. ``choose_backend`` respects the variable where the user has set it and
otherwise takes the first backend whose library is installed.

Mesa's software rasteriser starts threads that do not survive ``fork``: a process that rendered and
then forked (Gymnasium's ``AsyncVectorEnv`` does) would wait for them forever. With
``LP_NUM_THREADS=0`` it draws in the calling thread, which is as fast on one core, and safe.
"""

import atexit
import ctypes.util
import importlib
import os
import sys
import threading
import weakref
from typing import Any, Protocol

from hvs_suite.errors import RenderError

BACKENDS = ("egl", "osmesa", "glfw")
_LIBRARIES = {"egl": "EGL", "osmesa": "OSMesa", "glfw": "GL"}
PACKAGES = {"egl": "libegl1", "osmesa": "libosmesa6", "glfw": "libgl1 and a display"}


_exit_calls: list["weakref.finalize[..., Any]"] = []


class _MujocoContext(Protocol):
    """What MuJoCo's context classes for EGL, OSMesa and GLFW have in common."""

    def make_current(self) -> None: ...

    def free(self) -> None: ...


class GLContext:
    """An OpenGL context that shares its thread with dm_control's own.

    dm_control keeps a record of the context that it made current in each thread, and leaves out
    the call where the record says that it still is. Its pictures would come from ours, grey or of
    another scene, so we strike its record off whenever we change what is current.

    Args:
        context: MuJoCo's context.
    """

    def __init__(self, context: _MujocoContext) -> None:
        self._context = context

    def make_current(self) -> None:
        """Direct the calling thread's OpenGL calls to this context."""
        strike_dm_control_off()
        self._context.make_current()

    def free(self) -> None:
        """Give the context back; none is current in the calling thread after that."""
        strike_dm_control_off()
        self._context.free()


def choose_backend() -> str:
    """Return the OpenGL backend to use and export it as ``MUJOCO_GL``.

    Returns:
        ``egl``, ``osmesa`` or ``glfw``; ``off`` where none is installed (states still work).

    Raises:
        RenderError: ``MUJOCO_GL`` names something that is not a backend, or is not installed.
    """
    if os.environ.get("LP_NUM_THREADS", "1") == "1":
        os.environ["LP_NUM_THREADS"] = "0"
    wanted = os.environ.get("MUJOCO_GL", "").lower().strip()
    if wanted:
        if wanted not in (*BACKENDS, "off", "disable", "disabled", "0", "false"):
            raise RenderError(
                f"MUJOCO_GL={wanted!r} is not a backend; use one of {', '.join(BACKENDS)}, "
                "or unset it to let hvs_suite choose"
            )
        if wanted in ("egl", "osmesa") and not ctypes.util.find_library(_LIBRARIES[wanted]):
            # MuJoCo itself would fail at import, with an AttributeError.
            raise RenderError(
                f"MUJOCO_GL={wanted}, but lib{_LIBRARIES[wanted]} is missing; install "
                f"{PACKAGES[wanted]}, or unset MUJOCO_GL to let hvs_suite choose"
            )
        return wanted if wanted in BACKENDS else "off"
    for backend in BACKENDS:
        if backend == "glfw" and not os.environ.get("DISPLAY"):
            continue
        if ctypes.util.find_library(_LIBRARIES[backend]):
            os.environ["MUJOCO_GL"] = backend
            return backend
    # dm_control would otherwise try GLFW and print its warnings; states need no renderer.
    os.environ["MUJOCO_GL"] = "off"
    return "off"


def create_context(width: int, height: int) -> GLContext:
    """Create an offscreen OpenGL context with the chosen backend.

    Args:
        width: Largest picture width that will be asked for (px).
        height: Largest picture height (px).

    Raises:
        RenderError: No backend is available, or the chosen one fails; says what to install.
    """
    backend = choose_backend()
    if backend == "off":
        raise RenderError(
            "no OpenGL library was found, so cameras cannot render; install one "
            "(Debian: apt-get install libegl1 libgl1-mesa-dri) and run 'hvs doctor'"
        )
    if backend in ("egl", "osmesa") and os.environ.get("PYOPENGL_PLATFORM", backend) != backend:
        os.environ["PYOPENGL_PLATFORM"] = backend
        for name in [n for n in sys.modules if n == "OpenGL" or n.startswith("OpenGL.")]:
            del sys.modules[name]
    try:
        module: Any = importlib.import_module(f"mujoco.{backend}")
        context = GLContext(module.GLContext(width, height))
        context.make_current()
    except Exception as error:  # each backend fails with its own exception types
        raise RenderError(
            f"OpenGL backend {backend!r} does not work here ({type(error).__name__}: "
            f"{str(error).splitlines()[0] if str(error) else 'no reason given'}); install "
            f"{PACKAGES[backend]} and libgl1-mesa-dri, or set MUJOCO_GL to another of "
            f"{', '.join(BACKENDS)}; 'hvs doctor' tells which work"
        ) from error
    return context


def strike_dm_control_off() -> None:
    """Have dm_control make its context current again before it next draws in this thread."""
    # Only now: importing it fixes the backend, which a context of ours has chosen.
    from dm_control._render import base

    current = base._CURRENT_CONTEXT_FOR_THREAD.pop(threading.current_thread(), None)
    if current is not None:
        del base._CURRENT_THREAD_FOR_CONTEXT[current]


def free_at_exit(free: "weakref.finalize[..., Any]") -> None:
    """Have a context freed before the interpreter's exit takes the graphics library down.

    Exit handlers run in reverse: MuJoCo registers its own while a context is first created, so one
    that is registered after that runs in time. Contexts that are left alive print errors on the
    terminal.

    Args:
        free: Frees the context when it is called or its owner is collected.
    """
    if not _exit_calls:
        atexit.register(_free_all)
    _exit_calls[:] = [*(call for call in _exit_calls if call.alive), free]


def _free_all() -> None:
    for free in _exit_calls:
        free()
