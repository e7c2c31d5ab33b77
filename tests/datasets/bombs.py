"""Small files that claim to be huge, and a script that opens them in processes of their own.

Prints one JSON object: bomb to door to the line that the door said, and by how much memory grew
(bytes). A script, because it imports everything once and forks a child for each, which no process
may do that has already drawn a picture.
"""

import contextlib
import gzip
import hashlib
import json
import os
import resource
import shutil
import sys
import tarfile
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
from damages import DATA, EIH, INFO, LISTED, TASKS, json_with, pictures, png, text

from hvs_suite.datasets.archive import CHECKSUMS, unpack
from hvs_suite.datasets.check import check_dataset
from hvs_suite.datasets.replay import read_recorded
from hvs_suite.errors import HvsError
from hvs_suite.policies.imitation.demonstrations import Demonstrations
from hvs_suite.policies.training.dataset import read_manifest

SAMPLE = Path(__file__).parents[2] / "datasets" / "samples" / "align-thesis"
# Should a bound not hold, the child falls, and not the machine.
LIMIT_BYTES = 3 * 2**30


def rows_of(name: str, values: pa.Array, times: int) -> Callable[[Path], None]:
    """Few bytes for many rows: zeros compress to nothing, and missing values are not even there."""

    def build(root: Path) -> None:
        table = pa.table({"episode_index": values})
        with pq.ParquetWriter(root / name, table.schema, compression="zstd") as file:
            for _ in range(times):
                file.write_table(table, row_group_size=len(values))

    return build


def long_values(name: str, column: str, value: str | bytes, *, picture: bool) -> object:
    """One value of 10 MB, named by each of a thousand rows."""

    def build(root: Path) -> None:
        rows = np.zeros(1000, np.int64)
        long: pa.Array = pa.DictionaryArray.from_arrays(rows.astype(np.int32), pa.array([value]))
        if picture:
            long = pa.StructArray.from_arrays([long], names=["bytes"])
        index = "episode_index" if picture else "task_index"
        pq.write_table(pa.table({column: long, index: rows}), root / name, compression="zstd")

    return build


def endless(name: str) -> Callable[[Path], None]:
    def build(root: Path) -> None:
        (root / name).unlink()
        (root / name).symlink_to("/dev/zero")

    return build


def sparse_file(name: str) -> Callable[[Path], None]:
    return lambda root: os.truncate(root / name, 2**40)


def huge_picture_as_declared(root: Path) -> None:
    json_with(INFO, "features", EIH, "shape", value=[50_000, 50_000, 3])(root)
    pictures(png(50_000, 50_000))(root)


DATASETS = {
    "a picture of 50,000 px a side": pictures(png(50_000, 50_000, rows=bytes(2**24))),
    "such a picture, as declared": huge_picture_as_declared,
    "200 million rows": rows_of(DATA, pa.nulls(10**8, pa.int64()), 2),
    "200 million episodes": rows_of(LISTED, pa.nulls(10**8, pa.int64()), 2),
    "gigabytes of zeros": rows_of(DATA, pa.array(np.zeros(2**22, np.int64)), 100),
    "a long picture for many rows": long_values(DATA, EIH, bytes(10 * 2**20), picture=True),
    "a long sentence for many rows": long_values(TASKS, "task", "x" * 10 * 2**20, picture=False),
    "JSON a million deep": text(INFO, "[" * 10**6 + "]" * 10**6),
    "JSON without end": endless(INFO),
    "parquet without end": endless(DATA),
    "JSON of a terabyte": sparse_file(INFO),
    "parquet of a terabyte": sparse_file(DATA),
    "frames without end": json_with(INFO, "total_frames", value=2**50),
    "episodes without end": json_with(INFO, "total_episodes", value=2**50),
}


def listing(*names: str) -> bytes:
    return "".join(f"{hashlib.sha256(b'').hexdigest()}  {name}\n" for name in names).encode()


def member(name: str, content: bytes = b"", **attributes: object) -> bytes:
    """The bytes of a tar's member, whose header says what it is told to."""
    info = tarfile.TarInfo(name)
    info.size = len(content)
    for key, value in attributes.items():
        setattr(info, key, value)
    return info.tobuf(tarfile.GNU_FORMAT) + content + bytes(-len(content) % 512)


def sparse_member() -> bytes:
    """A file of which only one block is in the archive, and which is a terabyte."""
    header = bytearray(member("a", type=tarfile.GNUTYPE_SPARSE, size=512))
    for place, number in ((386, 2**40 - 512), (398, 512), (483, 2**40)):
        header[place : place + 12] = b"\x80" + number.to_bytes(11)
    header[148:156] = b" " * 8
    header[148:156] = f"{sum(header[:512]):06o}\0 ".encode()
    return bytes(header) + bytes(512)


def pax_sparse_member() -> bytes:
    records = {"GNU.sparse.map": f"{2**40},0", "GNU.sparse.size": f"{2**40}"}
    info = tarfile.TarInfo("a")
    info.pax_headers = records
    return info.tobuf(tarfile.PAX_FORMAT)


def header_of_zeros(kind: bytes) -> bytes:
    """A header that goes on for half a gigabyte."""
    return member("x", type=kind, size=2**29) + bytes(2**29)


def write_tar(*parts: bytes, packed: bool = False) -> Callable[[Path], None]:
    def build(path: Path) -> None:
        content = b"".join([member(CHECKSUMS, listing("a")), *parts, bytes(1024)])
        path.write_bytes(gzip.compress(content, 1) if packed else content)

    return build


ARCHIVES: dict[str, Callable[[], Callable[[Path], None]]] = {
    "a sparse file": lambda: write_tar(sparse_member()),
    "a sparse file of PAX": lambda: write_tar(pax_sparse_member()),
    "a file that claims a terabyte": lambda: write_tar(member("a", size=2**40)),
    "a file of zeros": lambda: write_tar(member("a", bytes(2**29)), packed=True),
    "a PAX header of zeros": lambda: write_tar(header_of_zeros(tarfile.XHDTYPE), packed=True),
    "a long name of zeros": lambda: write_tar(
        header_of_zeros(tarfile.GNUTYPE_LONGNAME), packed=True
    ),
    "headers without end": lambda: write_tar(
        *[member("x", b"11 path=aa\n", type=tarfile.XHDTYPE)] * 5000
    ),
    "checksums without end": lambda: (
        lambda path: path.write_bytes(gzip.compress(member(CHECKSUMS, size=2**33) + bytes(2**27)))
    ),
    "bytes that are no gzip": lambda: lambda path: path.write_bytes(b"\x1f\x8b\x08" + bytes(99)),
    "a device": lambda: lambda path: path.symlink_to("/dev/zero"),
}


def check(root: Path) -> str:
    return "; ".join(str(each) for each in check_dataset(root, pictures=False).damage)


def train(root: Path) -> object:
    return Demonstrations(read_manifest(root), root.parent / "cache", seed=0)


DOORS = {"check": check, "replay": lambda root: read_recorded(root, 0), "train": train}


def in_child[T](function: Callable[[], T]) -> T | None:
    """What a function returns in a process of its own; None where that fell."""
    reader, writer = os.pipe()
    child = os.fork()
    if not child:
        os.close(reader)
        with contextlib.suppress(BaseException), os.fdopen(writer, "w") as out:
            json.dump(function(), out)
            out.flush()
            os._exit(0)
        os._exit(1)
    os.close(writer)
    with os.fdopen(reader) as pipe:
        said = pipe.read()
    os.waitpid(child, 0)
    return json.loads(said) if said else None  # type: ignore[no-any-return]


def measured(door: Callable[[Path], object], path: Path) -> tuple[str, int]:
    """The line that a door says, and by how much memory grew (bytes)."""
    used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    resource.setrlimit(resource.RLIMIT_AS, (used + LIMIT_BYTES, resource.RLIM_INFINITY))
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    try:
        found = door(path)
        line = found if isinstance(found, str) else ""
    except HvsError as error:
        line = str(error)
    except BaseException as error:
        line = f"traceback: {error!r}"
    return line, (resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before) * 1024


def main(folder: Path) -> None:
    said: dict[str, dict[str, object]] = {}
    # What loads at first use must not count for one door.
    check_dataset(SAMPLE, pictures=False)
    for name, build in DATASETS.items():
        root = folder / "dataset"
        shutil.copytree(SAMPLE, root)
        in_child(lambda build=build, root=root: build(root) and None)  # type: ignore[misc]
        said[name] = {
            door: in_child(lambda each=each, root=root: measured(each, root))  # type: ignore[misc]
            for door, each in DOORS.items()
        }
        shutil.rmtree(root)
    for name, make in ARCHIVES.items():
        path = folder / "archive.tar"
        path.unlink(missing_ok=True)
        in_child(lambda make=make, path=path: make()(path) and None)  # type: ignore[misc]
        out = folder / "out"

        def fetch(path: Path, out: Path = out) -> object:
            return unpack(path, out)

        found = in_child(lambda fetch=fetch, path=path: measured(fetch, path))  # type: ignore[misc]
        said[name] = {"fetch": found}
        said[name]["left"] = [p.name for p in folder.iterdir() if p != path and p.name != "cache"]
    print(json.dumps(said))


if __name__ == "__main__":
    main(Path(sys.argv[1]))
