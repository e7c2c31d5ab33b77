"""The process that trains: its threads, and memory that one step frees and the next takes again."""

import ctypes
import sys

import torch

from hvs_suite.errors import OptionError

# Numbers of glibc's malloc.h.
_M_TRIM_THRESHOLD = -1
_M_MMAP_MAX = -4
_KEPT_BYTES = 2**31 - 1


def prepare_process() -> None:
    """Settle what holds for every training run on a processor: two threads, memory that is kept."""
    _keep_freed_memory()
    torch.set_num_threads(min(2, torch.get_num_threads()))


def check_device(name: str) -> None:
    """Refuse a device that cannot be used.

    Args:
        name: As torch calls it: ``cpu``, ``cuda``, ``cuda:1``.

    Raises:
        OptionError: It is unknown or not there.
    """
    try:
        # Back again: torch also has devices that hold no numbers.
        torch.zeros(1, device=name).cpu()
    except (RuntimeError, AssertionError) as error:
        reason = str(error).splitlines()[0]
        raise OptionError(f"device {name!r} cannot be used: {reason}; use cpu") from error


def _keep_freed_memory() -> None:
    """Ask the C library to keep large blocks instead of handing them back to the system.

    A batch of images and its features are hundreds of megabytes. Taken from the system anew at
    every step, their pages have to be cleared and mapped again, which took a third of a step on
    images of 512 px. Without glibc nothing happens.
    """
    if not sys.platform.startswith("linux"):
        return
    set_option = getattr(ctypes.CDLL(None), "mallopt", None)
    if set_option is not None:
        set_option(_M_MMAP_MAX, 0)
        set_option(_M_TRIM_THRESHOLD, _KEPT_BYTES)
