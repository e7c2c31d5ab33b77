"""What an interrupted evaluation leaves, so that the same command can continue.

``<file>.partial`` beside the result holds one JSON line that says what is being evaluated, then a
line for each scenario as it ends. Each line is appended by a single write, so a kill or a full disk
can tear at most the last one, which is then played again. The writer holds the file's lock.
"""

import base64
import binascii
import json
import os
import secrets
import stat
from collections.abc import Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pydantic

from hvs_suite import files
from hvs_suite.errors import OutputError
from hvs_suite.eval.scoring.result_file import EpisodeRow
from hvs_suite.eval.scoring.trial import Trial

SUFFIX = ".partial"
_SALT_BYTES = 16


class ProgressFile:
    """The trials of one evaluation, kept as they come.

    Args:
        path: The file; made, or read if it is there. None keeps the trials in memory alone.
        identity: All that decides what the trials are; plain JSON values.

    Attributes:
        trials: Those found in the file, by scenario.
        salt: 128 random bits in hexadecimal digits, drawn once for all sittings.
        elapsed_s: Wall time that they took, over all sittings (s).

    Raises:
        OutputError: The file cannot be written, or belongs to another evaluation.
    """

    def __init__(self, path: Path | None, identity: Mapping[str, Any]) -> None:
        self.trials: dict[int, Trial] = {}
        self.salt = secrets.token_hex(_SALT_BYTES)
        self.elapsed_s = 0.0
        self._identity = dict(identity)
        self._path = path
        self._descriptor: int | None = None
        if path is None:
            return
        descriptor = _locked(path)
        try:
            self._read(descriptor)
        except BaseException:
            os.close(descriptor)
            raise
        self._descriptor = descriptor

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._descriptor is None:
            return
        # A start that failed leaves nothing behind which the next one would have to ask about.
        if not self.trials:
            self.remove()
        os.close(self._descriptor)

    def add(self, trial: Trial, elapsed_s: float) -> None:
        """Keeps a trial.

        Args:
            trial: The trial.
            elapsed_s: Wall time up to now, over all sittings (s).

        Raises:
            OutputError: The file cannot be written, such as when the disk is full.
        """
        if self._descriptor is not None:
            lines: list[dict[str, Any]] = [] if self.trials else [self._head()]
            lines.append(
                {
                    "row": trial.row.model_dump(mode="json"),
                    "actions": base64.b64encode(trial.actions.tobytes()).decode(),
                    "shape": trial.actions.shape,
                    "decision_s": trial.decision_s,
                    "slowest_s": trial.slowest_s,
                    "play_s": trial.play_s,
                    "elapsed_s": elapsed_s,
                }
            )
            self._append(self._descriptor, lines)
        self.trials[trial.row.scenario] = trial

    def remove(self) -> None:
        """Removes the file, now that the result is written."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    def _head(self) -> dict[str, Any]:
        return {**self._identity, "salt": self.salt}

    def _read(self, descriptor: int) -> None:
        if not stat.S_ISREG(os.fstat(descriptor).st_mode):
            raise OutputError(f"{self._path} is no regular file; remove it")
        content = os.pread(descriptor, os.fstat(descriptor).st_size, 0)
        head, *lines = content[: content.rfind(b"\n") + 1].splitlines() or [b""]
        if head:
            self._check(head, has_trials=bool(lines))
        for line in lines:
            self._take(line)
        # What was torn is cut off, so that the next line starts on its own; so is a head without
        # trials, which comes anew with the first of them.
        whole = content.rfind(b"\n") + 1 if lines else 0
        os.ftruncate(descriptor, whole)

    def _check(self, head: bytes, *, has_trials: bool) -> None:
        damaged = OutputError(f"{self._path} is damaged; remove it to start anew")
        try:
            found = json.loads(head)
        except ValueError as error:
            raise damaged from error
        if not isinstance(found, dict):
            raise damaged
        ours = json.loads(json.dumps(self._head()))
        differs = [key for key in self._identity if found.get(key) != ours[key]]
        if found.keys() != ours.keys() or (differs and has_trials):
            raise OutputError(
                f"{self._path} is the beginning of another evaluation "
                f"({', '.join(differs) or 'format'} differs); remove it to start anew"
            )
        if has_trials:
            if not isinstance(found["salt"], str) or len(found["salt"]) != 2 * _SALT_BYTES:
                raise damaged
            self.salt = found["salt"]

    def _take(self, line: bytes) -> None:
        try:
            kept = json.loads(line)
            row = EpisodeRow.model_validate(kept["row"])
            actions = np.frombuffer(base64.b64decode(kept["actions"]), np.float32)
            self.trials[row.scenario] = Trial(
                row=row,
                actions=actions.reshape(kept["shape"]),
                decision_s=float(kept["decision_s"]),
                slowest_s=float(kept["slowest_s"]),
                play_s=float(kept["play_s"]),
                detail="",
            )
            self.elapsed_s = max(self.elapsed_s, float(kept["elapsed_s"]))
        except (ValueError, KeyError, TypeError, binascii.Error, pydantic.ValidationError) as error:
            raise OutputError(f"{self._path} is damaged; remove it to start anew") from error

    def _append(self, descriptor: int, lines: Sequence[Mapping[str, Any]]) -> None:
        content = b"".join(json.dumps(line, allow_nan=False).encode() + b"\n" for line in lines)
        try:
            written = os.write(descriptor, content)
        except OSError as error:
            raise self._full(error.strerror or "error") from error
        if written != len(content):
            raise self._full("no space left")

    def _full(self, reason: str) -> OutputError:
        return OutputError(
            f"cannot write {self._path}: {reason}; make room, then give the same command again: "
            "what it holds is not lost"
        )


def _locked(path: Path) -> int:
    """Opens and locks a file that others may be about to remove; returns its descriptor."""
    while True:
        try:
            descriptor = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT | os.O_NONBLOCK, 0o666)
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror}") from error
        try:
            files.lock(descriptor, path)
            if path.exists() and os.path.samestat(os.fstat(descriptor), path.stat()):
                return descriptor
        except BaseException:
            os.close(descriptor)
            raise
        os.close(descriptor)
