"""Writing files so that a reader never sees half of one, and two writers never mix."""

import contextlib
import fcntl
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path

from hvs_suite.errors import OutputError


@contextlib.contextmanager
def replacing(path: str | os.PathLike[str]) -> Iterator[Path]:
    """Write a file under a temporary name and rename it once it is whole.

    After an error or an interrupt inside the block, ``path`` is as it was before.

    Args:
        path: The file to write; missing parent folders are made.

    Yields:
        A path beside it with the same suffix, to write to.

    Raises:
        OutputError: The folder or the file cannot be written.
    """
    target = Path(path)
    check_writable(target)
    try:
        descriptor, name = tempfile.mkstemp(
            dir=target.parent, prefix=f".{target.stem}-", suffix=target.suffix
        )
        os.close(descriptor)
    except OSError as error:
        raise OutputError(f"cannot write {target}: {error.strerror or error}") from error
    temporary = Path(name)
    try:
        yield temporary
        # mkstemp makes files that only their owner may read.
        temporary.chmod(0o666 & ~_umask())
        temporary.replace(target)
    except OSError as error:
        raise OutputError(f"cannot write {target}: {error.strerror or error}") from error
    finally:
        temporary.unlink(missing_ok=True)


def check_writable(path: str | os.PathLike[str]) -> None:
    """Check before long work that its result can be written.

    Args:
        path: A file to be written later; missing parent folders are made now.

    Raises:
        OutputError: The folder cannot be made or written, or what stands at ``path`` is no file.
    """
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot make the folder {target.parent}: {error.strerror}; choose another path"
        ) from error
    # Unlike pathlib's, these are just False for a name that cannot be.
    if os.path.isdir(target):
        raise OutputError(f"{target} is a folder; name a file")
    if os.path.exists(target) and not os.path.isfile(target):
        # Other programs would lose a FIFO or a device that is replaced.
        raise OutputError(f"{target} is no regular file; choose another path")
    try:
        # Permissions are not enough: root has all of them, and some file systems accept no files.
        with tempfile.NamedTemporaryFile(
            dir=target.parent, prefix=f".{target.stem}-", suffix=target.suffix
        ):
            pass
    except OSError as error:
        raise OutputError(
            f"cannot write {target}: {error.strerror}; choose another path"
        ) from error


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Lock a folder for this writer alone; the lock ends with the process, however that ends.

    Args:
        folder: An existing folder.

    Raises:
        OutputError: Another process is.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        lock(descriptor, folder)
        yield
    finally:
        os.close(descriptor)


def lock(descriptor: int, place: Path) -> None:
    """Take the writer's lock of an open file or folder; it ends when the descriptor is closed.

    Args:
        descriptor: Of the file or folder.
        place: Its path, for the message.

    Raises:
        OutputError: Another process has the lock.
    """
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        raise OutputError(
            f"another process is writing into {place}; wait for it, or name another place"
        ) from None


def _umask() -> int:
    """The process's file mode mask, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
