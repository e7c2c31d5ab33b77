"""Reading files that may come from other people: one bounded reader for each format.

Before reading, each refuses anything that is not a regular file, is larger than its caller allows,
or would unpack to more than that. Each raises the caller's own typed error, with one line. Nothing
here loads pickles.
"""

import io
import json
import math
import os
import stat
import struct
import zipfile
import zlib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import numpy.typing as npt
import pydantic

from hvs_suite.errors import HvsError

if TYPE_CHECKING:
    import pyarrow as pa
    import pyarrow.parquet as pq

MOST_JSON_BYTES = 64 * 2**20
"""Larger than any JSON file of ours: a result of 1,000 scenarios takes 1 MB."""
# Far deeper than any file of ours; Python's own parser fails at about a thousand.
_MOST_JSON_DEPTH = 64
_NPZ_METHODS = (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED)
_ENCRYPTED = 0x1
MOST_PARQUET_BYTES = 2 * 2**30
"""Of a parquet file, packed and unpacked: LeRobot begins a new one at 100 MB."""
# Pictures are compressed already: parquet makes next to nothing of them.
_PARQUET_EXPANSION = 20
_PARQUET_ALLOWANCE_BYTES = 64 * 2**20
_MOST_ROWS_AT_ONCE = 4096
_PARQUET_TEXTS = ("BYTE_ARRAY", "FIXED_LEN_BYTE_ARRAY")
# An Arrow value is 8 bytes at most, but for bytes, which count as what they unpack to.
_ARROW_BYTES = 8
# Magic and the header's own first bytes, then width, height, bits a channel and kind of colour.
_PNG_HEADER = struct.Struct(">16sIIBB")
_PNG_MAGIC = b"\x89PNG\r\n\x1a\n\x00\x00\x00\rIHDR"
_PNG_DEPTH = 8
_PNG_CHANNELS = {0: 1, 2: 3}


def check_regular(
    path: Path, *, error: type[HvsError], within: Path | None = None, most: int | None = None
) -> int:
    """Check that a path names an ordinary file.

    Args:
        path: The file; symbolic links are followed.
        error: Raised where it is not.
        within: Folder that the file has to lie in once links and ``..`` are resolved.
        most: Largest size allowed (bytes); None for any.

    Returns:
        Its size (bytes).

    Raises:
        HvsError: As `error`: it is missing, a folder, a FIFO, a device, outside, or too large.
    """
    try:
        inside = within is None or path.resolve().is_relative_to(within.resolve())
        found = path.stat()
    except (OSError, ValueError, RuntimeError) as reason:
        raise error(f"{path}: cannot be read ({_why(reason)})") from reason
    if not inside:
        raise error(f"{path}: leads out of {within}; only files inside it are read")
    if not stat.S_ISREG(found.st_mode):
        kind = "a folder" if stat.S_ISDIR(found.st_mode) else "no regular file"
        raise error(f"{path}: is {kind}; a file is expected")
    if most is not None and found.st_size > most:
        raise error(f"{path}: holds {found.st_size:,} bytes; at most {most:,} are read")
    return found.st_size


def read_bytes(
    path: Path, *, most: int, error: type[HvsError], within: Path | None = None
) -> bytes:
    """Read an ordinary file of bounded size.

    Args:
        path: The file.
        most: Largest size allowed (bytes).
        error: Raised where it cannot be read.
        within: As in `check_regular`.

    Raises:
        HvsError: As `error`.
    """
    check_regular(path, error=error, within=within, most=most)
    try:
        # A FIFO put there after the check would block for ever without O_NONBLOCK.
        descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
        with os.fdopen(descriptor, "rb") as file:
            content = file.read(most + 1)
    except OSError as reason:
        raise error(f"{path}: cannot be read ({_why(reason)})") from reason
    if len(content) > most:
        raise error(f"{path}: holds more than {most:,} bytes")
    return content


def parse_json(content: bytes, what: object, *, error: type[HvsError]) -> Any:
    """Parse JSON of bounded depth, without NaN and infinity.

    Args:
        content: UTF-8 text.
        what: Where it comes from, for the message.
        error: Raised where it is not such JSON.

    Raises:
        HvsError: As `error`.
    """
    try:
        parsed = json.loads(content, parse_constant=_refuse_constant)
    except (ValueError, RecursionError) as reason:
        raise error(f"{what}: is not JSON ({_why(reason)})") from reason
    if _depth_exceeds(parsed, _MOST_JSON_DEPTH):
        raise error(f"{what}: is nested more than {_MOST_JSON_DEPTH} deep")
    return parsed


def read_json(
    path: Path,
    *,
    error: type[HvsError],
    within: Path | None = None,
    most: int = MOST_JSON_BYTES,
) -> Any:
    """Read a JSON file; see `read_bytes` and `parse_json`."""
    return parse_json(read_bytes(path, most=most, error=error, within=within), path, error=error)


def read_object(
    path: Path,
    *,
    error: type[HvsError],
    within: Path | None = None,
    most: int = MOST_JSON_BYTES,
) -> dict[str, Any]:
    """Read a JSON file that holds one object; see `read_json`."""
    content = read_json(path, error=error, within=within, most=most)
    if not isinstance(content, dict):
        raise error(f"{path}: holds {type(content).__name__}, not an object")
    return content


def validated[Model: pydantic.BaseModel](
    model: type[Model], content: Any, what: object, *, error: type[HvsError]
) -> Model:
    """Validate parsed JSON with a model.

    Args:
        model: What it should be.
        content: Parsed JSON.
        what: Where it comes from, for the message.
        error: Raised with the first thing that is wrong.

    Raises:
        HvsError: As `error`.
    """
    try:
        return model.model_validate(content)
    except pydantic.ValidationError as reason:
        first = reason.errors()[0]
        where = ".".join(str(part) for part in first["loc"])
        message = first["msg"].removeprefix("Value error, ")
        raise error(f"{what}: {where + ': ' if where else ''}{message}") from reason


def read_npz(
    path: Path,
    arrays: Mapping[str, tuple[npt.DTypeLike, int]],
    *,
    or_else: Mapping[str, tuple[npt.DTypeLike, int]] | None = None,
    most: int,
    error: type[HvsError],
) -> dict[str, npt.NDArray[Any]]:
    """Read named arrays of an ``npz`` file whose unpacked size is bounded.

    Args:
        path: The file.
        arrays: Type and number of dimensions of each array that must be in it; others are refused.
        or_else: The same of another form that the file may have.
        most: Largest size allowed, packed and unpacked (bytes).
        error: Raised where it is not such a file.

    Raises:
        HvsError: As `error`: not a zip, encrypted, of another compression, damaged, too large, or
            with other arrays.
    """
    content = read_bytes(path, most=most, error=error)
    try:
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            members = {
                member.filename.removesuffix(".npy"): member for member in archive.infolist()
            }
            if or_else is not None and sorted(members) == sorted(or_else):
                arrays = or_else
            if sorted(members) != sorted(arrays) or len(archive.infolist()) != len(arrays):
                raise error(f"{path}: holds {_names(members)}, not {_names(arrays)}")
            if sum(member.file_size for member in members.values()) > most:
                raise error(f"{path}: would unpack to more than {most:,} bytes")
            return {
                name: _read_member(path, archive, members[name], dtype, ndim, error)
                for name, (dtype, ndim) in arrays.items()
            }
    except (
        OSError,
        ValueError,
        EOFError,
        RuntimeError,
        NotImplementedError,
        zlib.error,
        zipfile.BadZipFile,
    ) as reason:
        if isinstance(reason, HvsError):
            raise
        raise error(f"{path}: cannot be read ({_why(reason)})") from reason


def _read_member(
    path: Path,
    archive: zipfile.ZipFile,
    member: zipfile.ZipInfo,
    dtype: npt.DTypeLike,
    ndim: int,
    error: type[HvsError],
) -> npt.NDArray[Any]:
    if member.flag_bits & _ENCRYPTED or member.compress_type not in _NPZ_METHODS:
        raise error(f"{path}: {member.filename} is encrypted or of an unknown compression")
    with archive.open(member) as file:
        # Never more than the directory says, which the caller has bounded; the CRC is checked.
        content = file.read(member.file_size + 1)
    stream = io.BytesIO(content)
    version = np.lib.format.read_magic(stream)  # type: ignore[no-untyped-call]
    if version not in ((1, 0), (2, 0)):
        raise error(f"{path}: {member.filename} has an unknown npy version")
    read_header = (
        np.lib.format.read_array_header_1_0
        if version == (1, 0)
        else np.lib.format.read_array_header_2_0
    )
    shape, fortran, found = read_header(stream)  # type: ignore[no-untyped-call]
    if found != np.dtype(dtype) or len(shape) != ndim or fortran:
        raise error(
            f"{path}: {member.filename} holds {found} of shape {shape}, not {np.dtype(dtype)} "
            f"with {ndim} dimensions"
        )
    values = content[stream.tell() :]
    if min(shape, default=0) < 0 or math.prod(shape) * found.itemsize != len(values):
        raise error(f"{path}: {member.filename} is not as long as its shape {shape} says")
    return np.frombuffer(values, found).reshape(shape).copy()


def _refuse_constant(name: str) -> Any:
    raise ValueError(f"{name} is no number")


def _depth_exceeds(value: Any, most: int) -> bool:
    level = [value]
    for _ in range(most):
        level = [
            item
            for holder in level
            if isinstance(holder, dict | list)
            for item in (holder.values() if isinstance(holder, dict) else holder)
        ]
        if not level:
            return False
    return True


def _names(names: Mapping[str, object]) -> str:
    listed = sorted(names)
    return ", ".join(listed[:6]) + (", ..." if len(listed) > 6 else "") or "nothing"


def _why(reason: BaseException) -> str:
    text = getattr(reason, "strerror", None) or str(reason) or type(reason).__name__
    return str(text).splitlines()[0][:200]


def decode_png(
    content: object, shape: tuple[int, int, int], *, error: type[HvsError]
) -> npt.NDArray[np.uint8]:
    """Decode a PNG whose header says that it is what it should be.

    Args:
        content: The file's bytes; anything else is refused as no picture.
        shape: (H, W, C) that it must have, with C 3 for RGB and 1 for grey.
        error: Raised where it is no such picture.

    Returns:
        uint8 (H, W, C).

    Raises:
        HvsError: As `error`: nothing, no PNG, of another size or kind, or damaged. Nothing is
            unpacked of a picture of another size.
    """
    if not isinstance(content, bytes) or not content:
        raise error("holds no image")
    if len(content) < _PNG_HEADER.size:
        raise error(f"cannot be decoded ({len(content)} bytes are no PNG)")
    magic, width, height, depth, colour = _PNG_HEADER.unpack_from(content)
    if magic != _PNG_MAGIC:
        raise error("cannot be decoded (it is no PNG)")
    if depth != _PNG_DEPTH or colour not in _PNG_CHANNELS:
        raise error(f"is a PNG of {depth} bits and colour type {colour}, not 8-bit RGB or grey")
    if (height, width, _PNG_CHANNELS[colour]) != tuple(shape):
        raise error(f"has shape {(height, width, _PNG_CHANNELS[colour])}, not {tuple(shape)}")
    from PIL import Image

    try:
        with Image.open(io.BytesIO(content), formats=("PNG",)) as image:
            return np.asarray(image).reshape(shape)
    except (OSError, SyntaxError, ValueError, EOFError, struct.error, zlib.error) as reason:
        raise error(f"cannot be decoded ({_why(reason)})") from reason


def read_parquet(
    path: Path,
    columns: Sequence[str] | None = None,
    *,
    error: type[HvsError],
    within: Path | None = None,
) -> "pa.Table":
    """Read a parquet file that unpacks to no more than it may.

    Numbers are bounded by what the file says of itself. Strings and bytes are read a few rows at a
    time: a file of a few bytes can name one long value for each of a million rows.

    Args:
        path: The file.
        columns: Columns to read; all by default.
        error: Raised where it cannot be read.
        within: As in `check_regular`.

    Returns:
        The columns in the order of the file.

    Raises:
        HvsError: As `error`: not parquet, damaged, too large, a column missing or named twice.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    size = check_regular(path, error=error, within=within, most=MOST_PARQUET_BYTES)
    most = _PARQUET_ALLOWANCE_BYTES + _PARQUET_EXPANSION * size
    try:
        with pq.ParquetFile(path) as file:
            names, texts = _choose_columns(path, file, columns, error)
            numbers = [name for name in names if name not in texts]
            parts = [file.read(numbers)] if numbers else []
            if texts:
                parts.append(_read_texts(path, file, texts, most, error))
        found = {name: part.column(name) for part in parts for name in part.column_names}
        return pa.table({name: found[name] for name in names})
    except (pa.ArrowException, OSError, ValueError, LookupError, MemoryError) as reason:
        if isinstance(reason, HvsError):
            raise
        raise error(f"{path}: cannot be read ({_why(reason)})") from reason


def _read_texts(
    path: Path, file: "pq.ParquetFile", names: list[str], most: int, error: type[HvsError]
) -> "pa.Table":
    """Columns of strings or bytes; `most` bounds what they unpack to (bytes)."""
    import pyarrow as pa

    # A value is no longer than what its column unpacks to: so many of them are no bomb yet.
    groups = map(file.metadata.row_group, range(file.metadata.num_row_groups))
    longest = max((group.total_byte_size for group in groups), default=0)
    rows = min(max(1, _PARQUET_ALLOWANCE_BYTES // max(1, longest)), _MOST_ROWS_AT_ONCE)
    batches = []
    for batch in file.iter_batches(rows, columns=names):
        most -= batch.nbytes
        if most < 0:
            raise error(f"{path}: unpacks to far more than its size; no recording does")
        batches.append(batch)
    if not batches:
        return pa.schema([file.schema_arrow.field(name) for name in names]).empty_table()
    return pa.Table.from_batches(batches).combine_chunks()


def _choose_columns(
    path: Path, file: "pq.ParquetFile", columns: Sequence[str] | None, error: type[HvsError]
) -> tuple[list[str], list[str]]:
    """Check the footer's description of the columns to read; return them, and the text columns."""
    names = file.schema_arrow.names
    wanted = names if columns is None else [name for name in names if name in columns]
    lacking = sorted(set(columns or ()) - set(names))
    if lacking:
        raise error(f"{path}: lacks the columns {', '.join(lacking)}")
    if len(set(names)) != len(names):
        raise error(f"{path}: names a column twice")
    leaves = [
        (leaf, index)
        for index in range(len(file.schema))
        for leaf in [file.schema.column(index)]
        if any(leaf.path == name or leaf.path.startswith(f"{name}.") for name in wanted)
    ]
    unpacked = 0
    for group in map(file.metadata.row_group, range(file.metadata.num_row_groups)):
        for _, index in leaves:
            chunk = group.column(index)
            # A run of a billion equal or missing values takes only a few bytes.
            least = _ARROW_BYTES * max(chunk.num_values, group.num_rows)
            unpacked += max(chunk.total_uncompressed_size, least)
    if unpacked > MOST_PARQUET_BYTES:
        raise error(f"{path}: would unpack to more than {MOST_PARQUET_BYTES:,} bytes")
    texts = [leaf.path for leaf, _ in leaves if leaf.physical_type in _PARQUET_TEXTS]
    return wanted, [
        name
        for name in wanted
        if any(leaf == name or leaf.startswith(f"{name}.") for leaf in texts)
    ]


# The library itself reads headers of up to 100 MB; one of ours takes 5 kB.
_MOST_HEADER_BYTES = 8 * 2**20


def tensor_shapes(
    path: Path, *, most: int, error: type[HvsError], within: Path | None = None
) -> dict[str, tuple[int, ...]]:
    """Read the names and shapes of a ``safetensors`` file's tensors, and none of their numbers.

    Args:
        path: The file.
        most: Largest size allowed (bytes).
        error: Raised where it is not such a file.
        within: As in `check_regular`.

    Returns:
        Shape by name. The library has checked that the tensors fill the file exactly, so that what
        holds these shapes is no larger than the file.

    Raises:
        HvsError: As `error`: empty, cut short, of a header that is too long, or damaged.
    """
    try:
        from safetensors import SafetensorError, safe_open
    except ImportError as reason:
        raise error(f"reading {path} needs safetensors; install hvs-suite[learn]") from reason
    size = check_regular(path, error=error, within=within, most=most)
    try:
        with path.open("rb") as file:
            length = int.from_bytes(file.read(8), "little")
        if not 0 < length <= min(_MOST_HEADER_BYTES, size - 8):
            raise error(f"{path}: is no safetensors file; its header would take {length:,} bytes")
        with safe_open(path, framework="np") as tensors:
            return {
                name: tuple(tensors.get_slice(name).get_shape())
                for name in tensors.keys()  # noqa: SIM118 - not a dict
            }
    except (OSError, ValueError, SafetensorError) as reason:
        if isinstance(reason, HvsError):
            raise
        raise error(f"{path}: is no safetensors file ({_why(reason)})") from reason
