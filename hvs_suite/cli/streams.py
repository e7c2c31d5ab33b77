"""Standard output and error that may lose their reader while the work goes on.

``hvs evaluate ... | head -1`` closes the pipe after a line, ``>&-`` closes the stream before the
start. Neither is a reason to lose an evaluation that is half done, nor for a traceback.
"""

import io
import os
import sys
from typing import Any

_STANDARD = (0, 1, 2)


class _Outlet(io.FileIO):
    """A stream's own file; output without a reader, or without room on its device, is dropped."""

    is_full = False

    def write(self, content: Any, /) -> int:
        """Writes all that can be written; says that it was everything."""
        left = memoryview(content).cast("B")
        size = len(left)
        try:
            while left:
                left = left[super().write(left) or 0 :]
        except BrokenPipeError:
            pass
        except OSError:
            self.is_full = True
        return size


_outlets: list[_Outlet] = []


def outlive_readers() -> None:
    """Puts such streams in the place of `sys.stdout` and `sys.stderr`, for the rest of the process.

    Closed descriptors are opened to nowhere first, or the next file opened would get their numbers
    and whatever a library prints.
    """
    for number in _STANDARD:
        try:
            os.fstat(number)
        except OSError:
            os.open(os.devnull, os.O_RDWR)
    _outlets[:] = [_Outlet(number, "w", closefd=False) for number in _STANDARD[1:]]
    sys.stdout, sys.stderr = (
        io.TextIOWrapper(
            io.BufferedWriter(outlet),
            encoding=getattr(before, "encoding", None),
            errors="backslashreplace",
            line_buffering=outlet.isatty() or outlet.fileno() == 2,
        )
        for outlet, before in zip(_outlets, (sys.stdout, sys.stderr), strict=True)
    )


def flush() -> bool:
    """Writes what is buffered; False if some of the standard output found no room."""
    sys.stdout.flush()
    sys.stderr.flush()
    return not _outlets[0].is_full
