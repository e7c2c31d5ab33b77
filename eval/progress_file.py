"""What an interrupted evaluation leaves behind, so that the same command goes on.

``<file>.partial`` beside the result holds one JSON line that says what is being evaluated, then a
line for each scenario as it ends. Each line is appended by a single write, so a kill can tear at
most the last one, which is then played again.
"""

import base64
import binascii
import contextlib
import json
import os
from collections.abc import Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, Self

import numpy as np
import pydantic

from hvs_suite.errors import OutputError
from hvs_suite.eval.result_file import EpisodeRow
from hvs_suite.eval.trial import Trial

SUFFIX = ".partial"


class ProgressFile:
    """The trials of one evaluation, kept as they come.

    Args:
        path: The file; made, or read if it is there. None keeps the trials in memory alone.
        identity: All that decides what the trials are; plain JSON values.

    Attributes:
        trials: Those found in the file, by scenario.
        elapsed_s: Wall time that they took, over all sittings (s).

    Raises:
        OutputError: The file cannot be written, or belongs to another evaluation.
    """

    def __init__(self, path: Path | None, identity: Mapping[str, Any]) -> None:
        self.trials: dict[int, Trial] = {}
        self.elapsed_s = 0.0
        self._path = path
        self._descriptor: int | None = None
        if path is None:
            return
        try:
            self._descriptor = os.open(path, os.O_RDWR | os.O_APPEND | os.O_CREAT, 0o666)
        except OSError as error:
            raise OutputError(f"cannot write {path}: {error.strerror}") from error
        try:
            self._read(self._descriptor, identity)
        except BaseException:
            os.close(self._descriptor)
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._descriptor is not None:
            os.close(self._descriptor)

    def add(self, trial: Trial, elapsed_s: float) -> None:
        """Keeps a trial.

        Args:
            trial: The trial.
            elapsed_s: Wall time up to now, over all sittings (s).

        Raises:
            OutputError: The disk is full, say.
        """
        self.trials[trial.row.scenario] = trial
        if self._descriptor is None:
            return
        self._append(
            self._descriptor,
            {
                "row": trial.row.model_dump(mode="json"),
                "actions": base64.b64encode(trial.actions.tobytes()).decode(),
                "shape": trial.actions.shape,
                "decision_s": trial.decision_s,
                "slowest_s": trial.slowest_s,
                "play_s": trial.play_s,
                "elapsed_s": elapsed_s,
            },
        )

    def remove(self) -> None:
        """Removes the file, now that the result is written."""
        if self._path is not None:
            self._path.unlink(missing_ok=True)

    def _read(self, descriptor: int, identity: Mapping[str, Any]) -> None:
        content = os.pread(descriptor, os.fstat(descriptor).st_size, 0)
        whole = content[: content.rfind(b"\n") + 1]
        # What a kill tore is cut off, so that the next line starts on its own.
        os.ftruncate(descriptor, len(whole))
        head, *lines = whole.splitlines() or [b""]
        if not head:
            self._append(descriptor, identity)
            return
        with contextlib.suppress(ValueError):
            found = json.loads(head)
            if found == json.loads(json.dumps(identity)):
                for line in lines:
                    self._take(line)
                return
            if isinstance(found, dict):
                differs = [key for key in identity if found.get(key) != identity[key]]
                raise OutputError(
                    f"{self._path} is the beginning of another evaluation "
                    f"({', '.join(differs) or 'format'} differs); remove it to start anew"
                )
        raise OutputError(f"{self._path} is damaged; remove it to start anew")

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

    def _append(self, descriptor: int, content: Mapping[str, Any]) -> None:
        line = json.dumps(content, allow_nan=False).encode() + b"\n"
        try:
            written = os.write(descriptor, line)
        except OSError as error:
            raise OutputError(f"cannot write {self._path}: {error.strerror}") from error
        if written != len(line):
            raise OutputError(f"cannot write {self._path}: the disk is full")
