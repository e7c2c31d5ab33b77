"""What can be wrong with a dataset: a table of small functions that damage a copy of one.

Most name a file, what is done to it, and with what; none needs the simulator.
"""

import io
import json
import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

DATA = "data/chunk-000/file-000.parquet"
LISTED = "meta/episodes/chunk-000/file-000.parquet"
INFO, STATS, TASKS, ORIGIN = "meta/info.json", "meta/stats.json", "meta/tasks.parquet", "hvs.json"
EIH = "observation.images.eih"
Damage = Callable[[Path], object]


def json_with(name: str, *path: str, value: Any = None, drop: bool = False) -> Damage:
    """Sets or drops what is found along a path of keys; the whole of it without one."""

    def damage(root: Path) -> None:
        content = json.loads((root / name).read_text())
        inner = content
        for key in path[:-1]:
            inner = inner[key]
        if drop:
            del inner[path[-1]]
        elif path:
            inner[path[-1]] = value
        (root / name).write_text(json.dumps(content if path else value))

    return damage


def text(name: str, content: str | bytes) -> Damage:
    raw = content.encode() if isinstance(content, str) else content
    return lambda root: (root / name).write_bytes(raw)


def cut(name: str, share: float) -> Damage:
    def damage(root: Path) -> None:
        content = (root / name).read_bytes()
        (root / name).write_bytes(content[: int(len(content) * share)])

    return damage


def replaced(name: str, make: Callable[[Path], object]) -> Damage:
    def damage(root: Path) -> None:
        (root / name).unlink()
        make(root / name)

    return damage


def elsewhere(name: str) -> Damage:
    """The file itself, but outside the dataset, behind a link."""

    def damage(root: Path) -> None:
        outside = root.with_name("outside")
        (root / name).rename(outside)
        (root / name).symlink_to(outside)

    return damage


def table_with(name: str, change: Callable[[pa.Table], pa.Table]) -> Damage:
    def damage(root: Path) -> None:
        pq.write_table(change(pq.read_table(root / name)), root / name)

    return damage


def column(file: str, name: str, values: Callable[[list[Any]], Any]) -> Damage:
    """Other values of a column, of whatever type PyArrow makes of them."""

    def change(table: pa.Table) -> pa.Table:
        made = values(table.column(name).to_pylist())
        made = made if isinstance(made, pa.Array) else pa.array(made)
        return table.set_column(table.schema.get_field_index(name), name, made)

    return table_with(file, change)


def pictures(content: bytes | None, path: str | None = None) -> Damage:
    kind = pa.struct([("bytes", pa.binary()), ("path", pa.string())])
    cell = {"bytes": content, "path": path}
    return column(DATA, EIH, lambda rows: pa.array([cell, *rows[1:]], kind))


def png(width: int, height: int, depth: int = 8, colour: int = 2, rows: bytes = b"") -> bytes:
    """A PNG whose header says anything; its checksums are right."""

    def chunk(kind: bytes, content: bytes) -> bytes:
        checksum = zlib.crc32(kind + content)
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", checksum)

    header = struct.pack(">IIBBBBB", width, height, depth, colour, 0, 0, 0)
    content = zlib.compress(rows)
    parts = (chunk(b"IHDR", header), chunk(b"IDAT", content), chunk(b"IEND", b""))
    return b"\x89PNG\r\n\x1a\n" + b"".join(parts)


def jpeg(side: int = 112) -> bytes:
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(np.zeros((side, side, 3), np.uint8)).save(stream, "jpeg")
    return stream.getvalue()


def feature(name: str, part: str, value: Any) -> Damage:
    return json_with(INFO, "features", name, part, value=value)


def doubled(table: pa.Table) -> pa.Table:
    return pa.concat_tables([table, table])


def deep(root: Path) -> None:
    (root / INFO).write_text('{"features": ' + "[" * 100_000 + "]" * 100_000 + "}")


def all_but_one_value(rows: list[Any]) -> list[Any]:
    return [rows[0][:-1], *rows[1:]]


def nothing_first(rows: list[Any]) -> list[Any]:
    return [None, *rows[1:]]


DAMAGES: dict[str, Damage] = {
    # Files that are none, or not where they should be.
    **{f"{name} is empty": text(name, b"") for name in (INFO, STATS, TASKS, ORIGIN, DATA, LISTED)},
    **{
        f"{name} is a folder": replaced(name, Path.mkdir)
        for name in (INFO, STATS, TASKS, ORIGIN, DATA, LISTED)
    },
    **{f"{name} is a FIFO": replaced(name, os.mkfifo) for name in (INFO, STATS, ORIGIN, DATA)},
    **{
        f"{name} is a device": replaced(name, lambda path: path.symlink_to("/dev/zero"))
        for name in (INFO, TASKS, ORIGIN, DATA, LISTED)
    },
    **{f"{name} lies outside": elsewhere(name) for name in (INFO, TASKS, ORIGIN, DATA, LISTED)},
    **{f"{name} is cut": cut(name, 0.6) for name in (INFO, STATS, TASKS, ORIGIN, DATA, LISTED)},
    **{f"{name} is text": text(name, "no parquet\n" * 9) for name in (TASKS, DATA, LISTED)},
    **{f"{name} is not UTF-8": text(name, b'{"\xff": 1}') for name in (INFO, STATS, ORIGIN)},
    **{f"{name} is a list": json_with(name, value=[1]) for name in (INFO, STATS, ORIGIN)},
    "meta is a file": lambda root: [
        *((root / "meta").rename(root / "old"),), (root / "meta").write_text("")
    ],
    "no data folder": lambda root: (root / "data").rename(root / "old"),
    # info.json.
    "nested too deep": deep,
    "features are missing": json_with(INFO, "features", drop=True),
    **{
        f"features are {value!r}": json_with(INFO, "features", value=value)
        for value in (None, [], "all", 3, {})
    },
    **{
        f"a feature is {value!r}": json_with(INFO, "features", "action", value=value)
        for value in (None, [7], "float32", {})
    },
    **{f"dtype is {value!r}": feature("action", "dtype", value) for value in (None, 3, "x", [])},
    **{
        f"shape is {value!r}": feature("action", "shape", value)
        for value in (None, 7, "7", [], [-7], [0], [7.5], [None], [[7]], [8], [7, 1], [2**70])
    },
    **{
        f"a picture's shape is {value!r}": feature(EIH, "shape", value)
        for value in ([112], [112, 112], [112, 112, 4], [50_000, 50_000, 3], [8, 8, 3], None)
    },
    "pictures are numbers": feature(EIH, "dtype", "float32"),
    "pictures are videos": feature(EIH, "dtype", "video"),
    "an action is a picture": feature("action", "dtype", "image"),
    "names that are escape codes": json_with(INFO, "features", "\x1b[31m\u202e", value={
        "dtype": "float32", "shape": [1], "names": None
    }),
    **{f"fps is {v!r}": json_with(INFO, "fps", value=v) for v in (None, 0, -1, "10", 1e300, True)},
    **{
        f"{name} is {value!r}": json_with(INFO, name, value=value)
        for name in ("total_frames", "total_episodes")
        for value in (None, -1, "5", 10**15, 2.5, 10**30)
    },
    "data_path leads out": json_with(INFO, "data_path", value="../../../{chunk_index}"),
    "video_path leads out": json_with(INFO, "video_path", value="/etc/{video_key}"),
    "a version of two lines": json_with(INFO, "codebase_version", value="v3.0\n# more"),
    # stats.json.
    "statistics lack a feature": json_with(STATS, "action", drop=True),
    **{
        f"statistics are {value!r}": json_with(STATS, "action", value=value)
        for value in (None, 3, "x", [], {})
    },
    **{
        f"a mean is {value!r}": json_with(STATS, "action", "mean", value=value)
        for value in (None, "x", [], [1.0], [[1.0], [2.0, 3.0]], {}, [None] * 7, [1e308] * 7)
    },
    **{
        f"a count is {value!r}": json_with(STATS, "action", "count", value=value)
        for value in (None, [], ["x"], [1e300], 3)
    },
    # hvs.json.
    **{
        f"the task is {value!r}": json_with(ORIGIN, "task", value=value)
        for value in (None, 3, "", "no-such-task", "align\n-thesis", ["align-thesis"], "\u202e")
    },
    **{
        f"the split is {value!r}": json_with(ORIGIN, "split", value=value)
        for value in (None, 3, "", "tr\x1b[2Jain", {})
    },
    **{
        f"the options are {value!r}": json_with(ORIGIN, "options", value=value)
        for value in (
            None, [], "x", {"no_such": 1}, {"standoff_m": "x"}, {"standoff_m": None},
            {"eih_resolution": -1}, {"observations": "nothing"}, {"time_limit_steps": [1]},
        )
    },
    **{
        f"the noise is {value!r}": json_with(ORIGIN, "noise", value=value)
        for value in (None, -1.0, "loud")
    },
    "the noise is infinite": text(
        ORIGIN, '{"task": "align-thesis", "task_version": 1, "split": "train", "options": {}, '
        '"noise": 1e999, "command": "", "task_digest": "", "format": 1}'
    ),
    "the version is text": json_with(ORIGIN, "task_version", value="1"),
    "the digest is a number": json_with(ORIGIN, "task_digest", value=7),
    "the command is a list": json_with(ORIGIN, "command", value=["hvs"]),
    "the format is unknown": json_with(ORIGIN, "format", value=99),
    # Columns of the data.
    **{
        f"{name} is dropped": table_with(DATA, lambda table, name=name: table.drop_columns([name]))
        for name in ("action", EIH, "episode_index", "privileged.errors", "observation.state")
    },
    **{
        f"{name} is {kind}": column(DATA, name, change)
        for name in ("action", "observation.state", "privileged.action_executed")
        for kind, change in {
            "ragged": all_but_one_value,
            "null once": nothing_first,
            "null": lambda rows: pa.nulls(len(rows)),
            "text": lambda rows: ["x"] * len(rows),
            "a list of text": lambda rows: [["x"] * 7] * len(rows),
            "a list of nothing": lambda rows: [[None] * 7] * len(rows),
            "one number": lambda rows: [1.0] * len(rows),
            "too wide": lambda rows: [[*row, 0.0] for row in rows],
            "nested": lambda rows: [[row] for row in rows],
            "empty": lambda rows: pa.array([[]] * len(rows), pa.list_(pa.float32())),
        }.items()
    },
    **{
        f"{name} is {kind}": column(DATA, name, change)
        for name in ("episode_index", "privileged.scenario", "next.success", "index")
        for kind, change in {
            "text": lambda rows: ["x"] * len(rows),
            "null": lambda rows: pa.nulls(len(rows)),
            "lists": lambda rows: [[0, 1]] * len(rows),
        }.items()
    },
    "errors are nothing": column(
        DATA, "privileged.errors", lambda rows: [[float("nan")] * 4] * len(rows)
    ),
    "a scenario is negative": column(DATA, "privileged.scenario", lambda rows: [-5] * len(rows)),
    "a scenario is huge": column(DATA, "privileged.scenario", lambda rows: [2**62] * len(rows)),
    "frames are doubled": table_with(DATA, doubled),
    "an episode has no rows": table_with(
        DATA,
        lambda table: table.filter(pa.array(np.asarray(table.column("episode_index")) != 0)),
    ),
    "no rows": table_with(DATA, lambda table: table[:0]),
    "a column twice": table_with(
        DATA, lambda table: table.append_column("action", table.column("action"))
    ),
    # Pictures.
    "a picture is nothing": pictures(None),
    "a picture is empty": pictures(b""),
    "a picture lies outside": pictures(None, "../outside.png"),
    "a picture lies far outside": pictures(None, "/etc/passwd"),
    "a picture is text": pictures(b"no picture"),
    "a picture is a JPEG": pictures(jpeg()),
    "a picture is a huge one": pictures(png(50_000, 50_000)),
    "a picture is a large one": pictures(png(9_000, 9_000)),
    "a picture has no pixels": pictures(png(0, 0)),
    "a picture ends early": pictures(png(112, 112, rows=bytes(1000))),
    "a picture of a wrong filter": pictures(png(112, 112, rows=b"\x09" * 112 * 337)),
    "a picture of 16 bits": pictures(png(112, 112, depth=16, rows=bytes(112 * 673))),
    "a picture of a palette": pictures(png(112, 112, colour=3, rows=bytes(112 * 113))),
    "pictures are bytes": column(DATA, EIH, lambda rows: [row["bytes"] for row in rows]),
    "pictures are text": column(DATA, EIH, lambda rows: ["x"] * len(rows)),
    "pictures have text for bytes": column(DATA, EIH, lambda rows: [{"bytes": "x"}] * len(rows)),
    "pictures have no bytes": column(DATA, EIH, lambda rows: [{"path": "x"}] * len(rows)),
    # Lists of episodes and of tasks.
    "episodes are doubled": table_with(LISTED, doubled),
    "no episodes": table_with(LISTED, lambda table: table[:0]),
    **{
        f"{name} is {kind}": column(LISTED, name, change)
        for name in ("episode_index", "length", "dataset_from_index", "data/file_index")
        for kind, change in {
            "text": lambda rows: ["x"] * len(rows),
            "null once": nothing_first,
            "negative": lambda rows: [-1] * len(rows),
            "huge": lambda rows: [2**62] * len(rows),
            "a fraction": lambda rows: [0.5] * len(rows),
            "lists": lambda rows: [[0]] * len(rows),
        }.items()
    },
    **{
        f"the list lacks {name}": table_with(
            LISTED, lambda table, name=name: table.drop_columns([name])
        )
        for name in ("episode_index", "length", "data/chunk_index")
    },
    **{
        f"an episode's statistics are {kind}": column(LISTED, "stats/action/mean", change)
        for kind, change in {
            "text": lambda rows: ["x"] * len(rows),
            "null": lambda rows: pa.nulls(len(rows)),
            "short": lambda rows: [[0.0]] * len(rows),
        }.items()
    },
    "a video leads out": table_with(
        LISTED,
        lambda table: table.append_column("videos/../from_timestamp", pa.array([0.0] * len(table)))
        .append_column("videos/../chunk_index", pa.array([0] * len(table)))
        .append_column("videos/../file_index", pa.array([0] * len(table))),
    ),
    "a video is missing": table_with(
        LISTED,
        lambda table: table.append_column(
            f"videos/{EIH}/from_timestamp", pa.array([0.0] * len(table))
        )
        .append_column(f"videos/{EIH}/chunk_index", pa.array([0] * len(table)))
        .append_column(f"videos/{EIH}/file_index", pa.array([0] * len(table))),
    ),
    "a video's time is text": table_with(
        LISTED,
        lambda table: table.append_column(
            f"videos/{EIH}/from_timestamp", pa.array(["x"] * len(table))
        )
        .append_column(f"videos/{EIH}/chunk_index", pa.array([0] * len(table)))
        .append_column(f"videos/{EIH}/file_index", pa.array([0] * len(table))),
    ),
    **{
        f"{name} of the tasks is {kind}": column(TASKS, name, lambda _, value=value: [value])
        for name in ("task", "task_index")
        for kind, value in {"null": None, "another": "x\u202e\n", "a list": [1]}.items()
    },
    "the tasks lack their sentences": table_with(TASKS, lambda table: table.drop_columns(["task"])),
    "no tasks": table_with(TASKS, lambda table: table[:0]),
    "a million tasks": table_with(
        TASKS, lambda _: pa.table({"task_index": np.arange(10**6), "task": ["x"] * 10**6})
    ),
}  # fmt: skip
