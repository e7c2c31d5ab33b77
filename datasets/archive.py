"""Datasets as one file: a plain tar that names the checksum of everything in it.

The same dataset gives the same bytes: members are sorted and carry neither times nor owners. An
archive is not trusted: it may hold only plain files below the target, all of them listed with
checksums, none twice, and together no larger than a packed dataset unpacks to.
"""

import gzip
import hashlib
import io
import os
import re
import shutil
import stat
import tarfile
import tempfile
import zlib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO

from hvs_suite.datasets.metadata import DatasetMetadata, read_metadata
from hvs_suite.datasets.writer import STAGE
from hvs_suite.errors import DatasetError, OutputError
from hvs_suite.files import replacing
from hvs_suite.reading import check_regular

CHECKSUMS = "SHA256SUMS"
SUFFIXES = (".tar", ".tar.gz", ".tgz")
_MAX_CHECKSUMS_BYTES = 8 * 2**20
# Pictures and parquet are already compressed, so gzip gains almost nothing.
_MOST_EXPANSION = 20
_ALWAYS_ALLOWED_BYTES = 64 * 2**20
_GZIP_MAGIC = b"\x1f\x8b"
_CHUNK = 2**20
_MOST_AT_ONCE = 16 * 2**20
_LINE = re.compile(r"([0-9a-f]{64})  (\S.*)")


def pack(root: Path, archive: Path) -> str:
    """Packs a dataset.

    Args:
        root: The dataset.
        archive: File to write; ``.tar``, or ``.tar.gz`` for a compressed one.

    Returns:
        SHA-256 of the archive, hexadecimal.

    Raises:
        OutputError: Another suffix, or the archive cannot be written.
        DatasetError: The dataset holds links or other things than files.
    """
    check_suffix(archive)
    if archive.resolve().is_relative_to(root.resolve()):
        raise OutputError(f"{archive} lies inside the dataset; choose another place")
    files = _files(root)
    lines = [f"{_sha256(root / name)}  {name}" for name in files]
    with replacing(archive) as temporary, _tar_to(temporary) as tar:
        listing = ("\n".join(lines) + "\n").encode()
        _add(tar, CHECKSUMS, len(listing), io.BytesIO(listing))
        for name in files:
            path = root / name
            with path.open("rb") as content:
                _add(tar, name, path.stat().st_size, content)
    return _sha256(archive)


def unpack(archive: Path, out: Path, sha256: str | None = None) -> tuple[int, DatasetMetadata]:
    """Unpacks a dataset into a new folder and checks every file.

    Args:
        archive: As ``pack`` wrote it.
        out: Folder to make; missing or empty.
        sha256: What the archive's own checksum must be, where it is known.

    Returns:
        Number of files, and the dataset's origin.

    Raises:
        OutputError: ``out`` is not empty or cannot be written.
        DatasetError: The archive is damaged, or not one of ours; nothing is left of it.
    """
    check_regular(archive, error=DatasetError)
    if out.exists() and not (out.is_dir() and not any(out.iterdir())):
        raise OutputError(f"{out} is not empty; choose another folder")
    if sha256 is not None and _sha256(archive) != sha256.strip().lower():
        raise DatasetError(f"{archive} is not the archive of checksum {sha256}; fetch it again")
    try:
        out.parent.mkdir(parents=True, exist_ok=True)
        stage = Path(tempfile.mkdtemp(dir=out.parent, prefix=f".{out.name}-"))
    except OSError as error:
        raise OutputError(f"cannot write {out}: {error.strerror or error}") from error
    try:
        count = _unpack_into(archive, stage)
        metadata = read_metadata(stage)
        stage.chmod(0o755)
        if out.exists():
            out.rmdir()
        stage.replace(out)
    except OutputError:
        raise
    except DatasetError as error:
        raise DatasetError(str(error).replace(str(stage), str(archive))) from None
    except _NO_TAR as error:
        raise DatasetError(f"{archive} is damaged or no tar archive ({error})") from None
    except OSError as error:
        raise OutputError(f"cannot unpack {archive}: {error.strerror or error}") from error
    finally:
        shutil.rmtree(stage, ignore_errors=True)
    return count, metadata


def check_suffix(archive: Path) -> None:
    """Refuses a file name whose suffix is not that of an archive.

    Raises:
        OutputError: It is not.
    """
    if not archive.name.lower().endswith(SUFFIXES):
        raise OutputError(f"{archive} must end in {', '.join(SUFFIXES)}")


def _unpack_into(archive: Path, stage: Path) -> int:
    """Writes the members below ``stage``; the checksums come first."""
    with _unpacked(archive) as file, tarfile.open(fileobj=file, mode="r:") as tar:
        members = iter(tar)
        first = next(members, None)
        if first is None or first.name != CHECKSUMS or not _is_plain(first):
            raise DatasetError(
                f"{archive} does not begin with {CHECKSUMS}; not made by 'hvs share'"
            )
        if first.size > _MAX_CHECKSUMS_BYTES:
            raise DatasetError(f"{archive}: {CHECKSUMS} is too long")
        listed = _listed(archive, _content(tar, first).read().decode("utf-8", "replace"))
        waiting = dict(listed)
        for member in members:
            if not _is_plain(member):
                raise DatasetError(f"{archive} holds {member.name!r}, which is no plain file")
            if member.name not in waiting:
                raise DatasetError(
                    f"{archive} holds {member.name!r}, which {CHECKSUMS} lists not or only once"
                )
            _write(_content(tar, member), stage / member.name, waiting.pop(member.name), archive)
        if waiting:
            raise DatasetError(f"{archive} lacks {', '.join(sorted(waiting)[:3])}")
    return len(listed)


# What tarfile and zlib say of other files: headers that are no text, no numbers, or endless.
_NO_TAR = (
    tarfile.TarError,
    gzip.BadGzipFile,
    zlib.error,
    EOFError,
    ValueError,
    OverflowError,
    LookupError,
    RecursionError,
)


class _Bounded:
    """A file that is read once, forwards, and up to a limit.

    Args:
        file: What to read.
        most: Bytes that may come of it.
        archive: For the message.
    """

    def __init__(self, file: IO[bytes], most: int, archive: Path) -> None:
        self._file = file
        self._most = most
        self._archive = archive

    def read(self, size: int) -> bytes:
        """Reads ``size`` bytes, as many as a header claims that it is long."""
        if size > _MOST_AT_ONCE:
            raise DatasetError(f"{self._archive} is no dataset: a header claims {size:,} bytes")
        self._check(size)
        return self._file.read(size)

    def seek(self, position: int) -> int:
        """Goes on to a place, as far as a header claims that a member reaches."""
        self._check(position - self.tell())
        return self._file.seek(position)

    def tell(self) -> int:
        """The place."""
        return self._file.tell()

    def _check(self, size: int) -> None:
        if self.tell() + size > self._most:
            raise DatasetError(
                f"{self._archive} would unpack to more than {self._most:,} bytes; it is no dataset"
            )


@contextmanager
def _unpacked(archive: Path) -> Iterator[IO[bytes]]:
    """The bytes of the tar in an archive."""
    most = _ALWAYS_ALLOWED_BYTES + _MOST_EXPANSION * archive.stat().st_size
    with archive.open("rb") as file:
        packed = file.read(len(_GZIP_MAGIC)) == _GZIP_MAGIC
        file.seek(0)
        with gzip.GzipFile(fileobj=file) if packed else file as content:
            yield _Bounded(content, most, archive)  # type: ignore[arg-type,misc]


def _is_plain(member: tarfile.TarInfo) -> bool:
    """Whether a member is a file whose bytes are all there: a sparse one unpacks to any size."""
    return member.isreg() and not member.issparse()


def _listed(archive: Path, text: str) -> dict[str, str]:
    """Checksums by name; every name is a plain path below the target.

    Raises:
        DatasetError: A line is malformed, a name leads elsewhere, or stands twice.
    """
    listed: dict[str, str] = {}
    for line in text.splitlines():
        match = _LINE.fullmatch(line)
        if match is None:
            raise DatasetError(f"{archive}: {CHECKSUMS} is malformed at {line[:80]!r}")
        digest, name = match.groups()
        path = PurePosixPath(name)
        if (
            path.is_absolute()
            or path.as_posix() != name
            or not path.parts
            or any(part in ("..", ".") for part in path.parts)
            or "\\" in name
            or ":" in name
            or not name.isprintable()
        ):
            raise DatasetError(f"{archive} holds {name!r}, which leads out of the dataset")
        if name in listed or name == CHECKSUMS:
            raise DatasetError(f"{archive} lists {name!r} twice")
        listed[name] = digest
    return listed


def _content(tar: tarfile.TarFile, member: tarfile.TarInfo) -> io.BufferedIOBase:
    content = tar.extractfile(member)
    if content is None:
        raise DatasetError(f"{member.name!r} is no plain file")
    return content  # type: ignore[return-value]


def _write(content: io.BufferedIOBase, path: Path, wanted: str, archive: Path) -> None:
    """Copies one file and compares its checksum."""
    path.parent.mkdir(parents=True, exist_ok=True)
    found = hashlib.sha256()
    with path.open("xb") as target:
        while chunk := content.read(_CHUNK):
            found.update(chunk)
            target.write(chunk)
    if found.hexdigest() != wanted:
        raise DatasetError(f"{archive}: {path.name} differs from its checksum; fetch it again")


def _files(root: Path) -> list[str]:
    """Names of a dataset's files, sorted; its hidden stage is left out.

    Raises:
        DatasetError: Something is no plain file, or its name cannot be listed.
    """
    names = []
    for path in root.rglob("*"):
        name = path.relative_to(root).as_posix()
        if name.split("/")[0] in (STAGE, ".cache"):
            continue
        mode = path.lstat().st_mode
        if stat.S_ISDIR(mode):
            continue
        if not stat.S_ISREG(mode):
            raise DatasetError(f"{path} is no plain file; an archive holds none but those")
        if name != CHECKSUMS:
            names.append(name)
    _listed(root, "".join(f"{'0' * 64}  {name}\n" for name in names))
    return sorted(names)


@contextmanager
def _tar_to(path: Path) -> Iterator[tarfile.TarFile]:
    """A tar to write, compressed where the name says so; no time stands in the header."""
    with path.open("wb") as file:
        if path.suffix in (".gz", ".tgz"):
            with (
                gzip.GzipFile(filename="", mode="wb", fileobj=file, mtime=0) as packed,
                tarfile.open(fileobj=packed, mode="w", format=tarfile.PAX_FORMAT) as tar,
            ):
                yield tar
        else:
            with tarfile.open(fileobj=file, mode="w", format=tarfile.PAX_FORMAT) as tar:
                yield tar


def _add(tar: tarfile.TarFile, name: str, size: int, content: io.IOBase) -> None:
    member = tarfile.TarInfo(name)
    member.size, member.mode = size, 0o644
    tar.addfile(member, content)


def _sha256(path: str | os.PathLike[str]) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()
