"""Camera frames of a LeRobot dataset, decoded once into memory-mapped arrays on disk.

Forty thousand frames at 336 px are 13.5 GB: they stay on disk as uint8, and the operating system
keeps in memory what training reads. Decoding a PNG costs ten times what reading the cache does.
"""

import contextlib
import hashlib
import json
import mmap
import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt

from hvs_suite.cell.cameras import to_grey
from hvs_suite.datasets import reader
from hvs_suite.errors import DatasetError, OutputError, first_line
from hvs_suite.files import replacing
from hvs_suite.reading import check_regular, read_json

Frames = npt.NDArray[np.uint8]
OnFrames = Callable[[int], None]
ROWS_AT_ONCE = 256


def fingerprint(root: Path) -> str:
    """Short digest of a dataset's files by name, size and time of change."""
    parts = []
    for path in [root / "meta" / "info.json", *reader.data_files(root)]:
        stat = path.stat()
        parts.append(f"{path.relative_to(root)} {stat.st_size} {stat.st_mtime_ns}")
    return hashlib.sha256("\n".join(parts).encode()).hexdigest()[:16]


def cached_frames(
    root: Path,
    key: str,
    shape: tuple[int, int, int],
    n_frames: int,
    folder: Path,
    on_frames: OnFrames | None = None,
    *,
    first: int | None = None,
) -> Frames:
    """Open the frames of one camera, decoding them first if the cache is not of this dataset.

    Args:
        root: The dataset.
        key: Feature of dtype ``image``, e.g. ``observation.images.eih``.
        shape: (H, W, C) of its frames; C 1 turns colour into grey.
        n_frames: Frames in the dataset.
        folder: Where the cache lives; made if missing.
        on_frames: Called with the number of frames just decoded.
        first: Open the first so many alone; None for all.

    Returns:
        (n, H, W, C) uint8, memory-mapped and read-only.

    Raises:
        DatasetError: A frame is missing, cannot be decoded, or has another size.
        OutputError: The cache cannot be written, or the disk has no room for it.
    """
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{key}.npy"
    made_from = folder / f"{key}.json"
    wanted = n_frames if first is None else first
    stamp = {"dataset": fingerprint(root), "shape": [wanted, *shape]}
    # A half-written cache has no stamp, because the stamp is written last.
    with contextlib.suppress(DatasetError):
        if read_json(made_from, error=DatasetError, within=folder) == stamp:
            kept = open_frames(path)
            if [*kept.shape] == stamp["shape"] and kept.dtype == np.uint8:
                return kept
    try:
        made_from.unlink(missing_ok=True)
    except OSError as error:
        raise OutputError(f"cannot replace {made_from}: {error.strerror}") from error
    frames: Any = new_frames(path, (wanted, *shape))
    done = 0
    for stored in _stored(root, key):
        if done == wanted < n_frames:
            break
        if done >= n_frames:
            raise DatasetError(f"{root} holds more than the {n_frames} frames that it declares")
        try:
            picture = reader.decode(stored, (*shape[:2], 3))
            frames[done] = picture if shape[2] == 3 else to_grey(picture)
        except DatasetError as error:
            raise DatasetError(f"{root}: frame {done}: {key} {error}; see 'hvs check'") from None
        done += 1
        if on_frames is not None and done % ROWS_AT_ONCE == 0:
            on_frames(ROWS_AT_ONCE)
    if done != wanted:
        raise DatasetError(f"{root} declares {n_frames} frames but holds {done}; record it again")
    frames.flush()
    del frames
    with replacing(made_from) as temporary:
        temporary.write_text(json.dumps(stamp))
    if on_frames is not None and done % ROWS_AT_ONCE:
        on_frames(done % ROWS_AT_ONCE)
    return open_frames(path)


def new_frames(path: Path, shape: Sequence[int]) -> Frames:
    """Make an array file of frames, all its room on the disk taken at once.

    Without that, the first frame for which no room is left would end the process (SIGBUS).

    Args:
        path: The file; replaced if it is there.
        shape: (n, H, W, C).

    Returns:
        Zeros of that shape, uint8, memory-mapped; `flush` them in the end.

    Raises:
        OutputError: It cannot be written, or the disk has no room for it.
    """
    open_memmap: Any = np.lib.format.open_memmap  # untyped in NumPy's stubs
    try:
        path.unlink(missing_ok=True)
        frames: Frames = open_memmap(path, mode="w+", dtype=np.uint8, shape=tuple(shape))
        # macOS has no such call.
        if hasattr(os, "posix_fallocate"):
            with path.open("r+b") as file:
                os.posix_fallocate(file.fileno(), 0, path.stat().st_size)
    except OSError as error:
        with contextlib.suppress(OSError):
            path.unlink()
        size = int(np.prod(shape, dtype=np.int64)) / 1e6
        raise OutputError(
            f"cannot write {path}: {error.strerror or error}; it takes {size:.1f} MB"
        ) from error
    return frames


def open_frames(path: Path) -> Frames:
    """Memory-map an array file of frames for `read_rows`, read-only.

    Args:
        path: The file, as NumPy writes it.

    Returns:
        (n, H, W, C) uint8.

    Raises:
        DatasetError: It is no such file.
    """
    check_regular(path, error=DatasetError, within=path.parent)
    try:
        frames: Frames = np.load(path, mmap_mode="r", allow_pickle=False)
    except (OSError, ValueError, EOFError) as error:
        raise DatasetError(f"{path} cannot be read ({first_line(error)})") from error
    mapping = _mapping(frames)
    if mapping is not None:
        # Rows are drawn at random. Where disks read some megabytes ahead, for each of them, the
        # frames of a batch would push those of the next out of memory.
        mapping.madvise(mmap.MADV_RANDOM)
    return frames


def _mapping(frames: Frames) -> mmap.mmap | None:
    """The mapping behind an array, where the system can be told how it will be read."""
    advisable = isinstance(frames, np.memmap) and hasattr(mmap, "MADV_WILLNEED")
    return frames.base if advisable and isinstance(frames.base, mmap.mmap) else None


def read_rows(frames: Frames, rows: npt.NDArray[np.int64], out: Frames) -> None:
    """Copy some frames.

    Args:
        frames: As `open_frames` opens them, or any array, (n, H, W, C).
        rows: Which, (m,), in ascending order.
        out: Gets them, (m, H, W, C).
    """
    mapping = _mapping(frames)
    if mapping is not None:
        # The array ends where its file does, and begins after NumPy's header.
        begin = len(mapping) - frames.nbytes
        for row in rows.tolist():
            start = begin + row * frames.strides[0]
            page = start - start % mmap.PAGESIZE
            # All of them are on their way before the first is waited for.
            mapping.madvise(mmap.MADV_WILLNEED, page, start + frames.strides[0] - page)
    # Clipping copies straight into place, where checking would take a buffer.
    np.take(frames, rows, axis=0, out=out, mode="clip")


def _stored(root: Path, key: str) -> Iterator[Any]:
    """The images of a camera as parquet holds them."""
    for path in reader.data_files(root):
        table = reader.read_table(root, path.relative_to(root).as_posix(), [key])
        for stored in table.column(key):
            yield stored.as_py()
