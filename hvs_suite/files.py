"""Writing files so that a reader never sees half of one, and no second writer comes between."""

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

    An error or an interrupt inside the block leaves whatever stood at ``path`` before.

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
    """Find out before long work that its result could not be written.

    Args:
        path: A file to be written later; missing parent folders are made now.

    Raises:
        OutputError: The folder cannot be made or written, or a folder stands at ``path``.
    """
    target = Path(path)
    try:
        target.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"cannot make the folder {target.parent}: {error.strerror}; choose another path"
        ) from error
    if target.is_dir():
        raise OutputError(f"{target} is a folder; name a file")
    if not os.access(target.parent, os.W_OK):
        raise OutputError(f"cannot write into {target.parent}; choose another path")


@contextlib.contextmanager
def only_writer(folder: Path) -> Iterator[None]:
    """Be the only one that writes into a folder; ends with the process, however that ends.

    Args:
        folder: An existing folder.

    Raises:
        OutputError: Another process is.
    """
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        try:
            fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            raise OutputError(
                f"another process is writing into {folder}; wait for it, or name another folder"
            ) from None
        yield
    finally:
        os.close(descriptor)


def _umask() -> int:
    """The process's file mode mask, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask
