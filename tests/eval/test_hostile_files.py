"""Files that strangers hand in may be anything; each ends in one line, and in no harm."""

import hashlib
import io
import json
import os
import shutil
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hvs_suite.cli import main
from hvs_suite.eval.scoring import result_file

RESULTS = Path(__file__).parents[2] / "eval" / "results"


@pytest.fixture
def result(tmp_path: Path) -> Path:
    for name in ("align-fixed.json", "align-fixed.actions.npz"):
        shutil.copy(RESULTS / "zero" / name, tmp_path / name)
    return tmp_path / "align-fixed.json"


def complaint(words: list[str], capsys: pytest.CaptureFixture[str], code: int) -> str:
    capsys.readouterr()
    assert main.run(words) == code
    [line] = capsys.readouterr().err.splitlines()
    assert line.isprintable()
    return line


def altered(change: Callable[[dict[str, Any]], None]) -> Callable[[Path], None]:
    def alter(path: Path) -> None:
        content = json.loads(path.read_bytes())
        change(content)
        content["sha256"] = result_file.seal(content)
        path.write_text(json.dumps(content))

    return alter


def written(content: bytes) -> Callable[[Path], None]:
    return lambda path: path.write_bytes(content) and None


def pipe(path: Path) -> None:
    path.unlink()
    os.mkfifo(path)


def folder(path: Path) -> None:
    path.unlink()
    path.mkdir()


def without_end(path: Path) -> None:
    """An infinite number, which no seal can be computed over."""
    text = path.read_text()
    path.write_text(text.replace('"options": {}', '"options": {"a": 1e999}'))


def huge(path: Path) -> None:
    with path.open("ab") as file:
        file.truncate(2**40)


def many_of_the_same(content: dict[str, Any]) -> None:
    """Columns of one value each, for as many rows as anybody likes."""
    columns, content["summary"]["n_episodes"] = content["episodes"], 100_000
    columns["errors"] = columns["settled"]["errors"] = {f"m{n}": 1.0 for n in range(40)}


RESULT_FILES: dict[str, tuple[Callable[[Path], None], str]] = {
    "a pipe": (pipe, "no regular file"),
    "a terabyte": (huge, "at most"),
    "a file of many brackets": (written(b"[" * 100_000), "is not JSON"),
    "deep JSON": (written(b'{"a":' + b"[" * 500 + b"]" * 500 + b"}"), "nested more than"),
    "a list": (written(b"[]"), "not an object"),
    "no text": (written(b"\xff\xfe\x00"), "is not JSON"),
    "a number of a million digits": (written(b'{"a": ' + b"1" * 10**6 + b"}"), "is not JSON"),
    "not a number": (written(b'{"schema_version": NaN}'), "is not JSON"),
    "an infinite number": (without_end, "holds a number without bounds"),
    "a schema of escapes": (written(b'{"schema_version": "\\u001b[31m"}'), r"\x1b"),
    "rows out of nothing": (altered(many_of_the_same), "more than 500,000 values"),
    "a key of escapes": (altered(lambda c: c["metadata"].update({"\x1b\n": 1})), r"\x1b"),
}


@pytest.mark.parametrize("what", RESULT_FILES)
@pytest.mark.parametrize(
    ("words", "code"), [("verify {0}", 1), ("compare {0} {0}", 2), ("failures {0}", 2)]
)
def test_a_hostile_result_ends_in_one_line(
    words: str, code: int, what: str, result: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    spoil, reason = RESULT_FILES[what]
    spoil(result)
    assert reason in complaint(words.format(result).split(), capsys, code)


# --- the action log -------------------------------------------------------------------------------


def npy(dtype: str, shape: tuple[int, ...], content: bytes = b"") -> bytes:
    header = str({"descr": dtype, "fortran_order": False, "shape": shape}).encode() + b"\n"
    return b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header + content


def archive(members: dict[str, bytes], method: int = zipfile.ZIP_DEFLATED) -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", method) as file:
        for name, content in members.items():
            file.writestr(name, content)
    return buffer.getvalue()


def arrays(steps: Any, actions: Any, name: str = "actions") -> bytes:
    buffer = io.BytesIO()
    np.savez(buffer, **{"steps": steps, name: actions})
    return buffer.getvalue()


STEPS = npy("<i8", (1,), struct.pack("<q", 1))
ACTIONS = npy("<f4", (1, 7), bytes(28))


def with_flags(content: bytes, flags: int = 0, method: int | None = None) -> bytes:
    """Alters what the zip says of its members, here and in its directory."""
    changed = bytearray(content)
    for signature, at in ((b"PK\x03\x04", 6), (b"PK\x01\x02", 8)):
        start = changed.find(signature)
        while start >= 0:
            changed[start + at] |= flags
            if method is not None:
                changed[start + at + 2] = method
            start = changed.find(signature, start + 4)
    return bytes(changed)


def damaged(content: bytes) -> bytes:
    """One bit of the actions, not of the check sum over them."""
    place = content.rindex(b"\n", 0, content.index(b"PK\x01\x02")) + 8
    return content[:place] + bytes([content[place] ^ 1]) + content[place + 1 :]


WHOLE = archive({"steps.npy": STEPS, "actions.npy": ACTIONS}, zipfile.ZIP_STORED)
LOGS: dict[str, tuple[Callable[[], bytes], str]] = {
    "nothing": (lambda: b"", "cannot be read"),
    "no archive": (lambda: b"PK\x03\x04 and no more", "cannot be read"),
    "an encrypted archive": (lambda: with_flags(WHOLE, flags=1), "is encrypted or"),
    "an unknown compression": (lambda: with_flags(WHOLE, method=97), "unknown compression"),
    "another compression": (
        lambda: archive({"steps.npy": STEPS, "actions.npy": ACTIONS}, zipfile.ZIP_LZMA),
        "unknown compression",
    ),
    "a check sum that is wrong": (lambda: damaged(WHOLE), "Bad CRC-32"),
    "half an archive": (lambda: WHOLE[: len(WHOLE) // 2], "cannot be read"),
    "a thousand times as much as it looks": (
        lambda: archive({"steps.npy": STEPS, "actions.npy": npy("<f4", (1, 7), bytes(2**26))}),
        "would unpack to more",
    ),
    "a shape beyond all memory": (
        lambda: archive({"steps.npy": STEPS, "actions.npy": npy("<f4", (2**60, 7), bytes(28))}),
        "is not as long as its shape",
    ),
    "a shape below zero": (
        lambda: archive({"steps.npy": STEPS, "actions.npy": npy("<f4", (-1, 7))}),
        "actions",
    ),
    "code": (
        lambda: archive({"steps.npy": STEPS, "actions.npy": npy("|O", (1, 7), b"cos\n")}),
        "holds object",
    ),
    "another array": (lambda: archive({"steps.npy": STEPS, "a.npy": ACTIONS}), "holds a, steps"),
    "lengths that come round": (
        lambda: arrays(np.full(4, 2**62), np.zeros((0, 7), np.float32)),
        "do not fit together",
    ),
    "a length below zero": (
        lambda: arrays(np.array([2, -1]), np.zeros((1, 7), np.float32)),
        "do not fit together",
    ),
    "a million scenarios without a step": (
        lambda: arrays(np.zeros(10**6, np.int64), np.zeros((0, 7), np.float32)),
        "do not fit together",
    ),
    "actions of eight joints": (
        lambda: arrays(np.array([1]), np.zeros((1, 8), np.float32)),
        "do not fit together",
    ),
    "changes of eight joints": (
        lambda: arrays(np.array([1]), np.zeros((4, 8, 1), np.uint8), "changes"),
        "rows of 7",
    ),
    "fewer changes than steps": (
        lambda: arrays(np.array([2]), np.zeros((4, 7, 1), np.uint8), "changes"),
        "do not fit together",
    ),
    "an infinite action": (
        lambda: arrays(np.array([1]), np.full((1, 7), np.inf, np.float32)),
        "do not fit together",
    ),
    "more steps than the task has": (
        lambda: arrays(np.array([10**6] + 9 * [0]), np.zeros((10**6, 7), np.float32)),
        "settled.steps is",
    ),
}


@pytest.mark.parametrize("what", LOGS)
def test_a_hostile_action_log_ends_in_one_line(
    what: str, result: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    make, reason = LOGS[what]
    log = result_file.actions_path(result)
    log.write_bytes(make())
    vouch_for(result, log)
    assert reason in complaint(["verify", str(result)], capsys, 1)


@pytest.mark.parametrize(
    ("spoil", "reason"), [(pipe, "no regular file"), (folder, "is a folder"), (huge, "at most")]
)
def test_what_is_no_file_is_no_action_log(
    spoil: Callable[[Path], None],
    reason: str,
    result: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    spoil(result_file.actions_path(result))
    assert reason in complaint(["verify", str(result)], capsys, 1)


def vouch_for(result: Path, log: Path) -> None:
    digest = hashlib.sha256(log.read_bytes()).hexdigest()
    altered(lambda c: c["metadata"].update(actions_sha256=digest))(result)
