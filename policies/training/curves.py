"""TensorBoard curves, written when a point is added, so that a full disk is noticed at once.

TensorBoard's own writer does so in a thread, and its errors are lost.
"""

import os
import time
from collections.abc import Mapping
from pathlib import Path

from tensorboard.compat.proto.event_pb2 import Event, SessionLog
from tensorboard.compat.proto.summary_pb2 import Summary
from tensorboard.summary.writer.record_writer import RecordWriter

from hvs_suite.errors import OutputError


class Curves:
    """The event file of one sitting.

    Args:
        folder: Of the event files; made if missing.
        first_step: Points of earlier sittings from here on are not drawn: they were killed after
            the checkpoint with which this one goes on.

    Raises:
        OutputError: The file cannot be written; also by the methods.
    """

    def __init__(self, folder: Path, first_step: int) -> None:
        # TensorBoard reads the files of a folder in the order of their names.
        self._path = folder / f"events.out.tfevents.{time.time():.6f}.{os.getpid()}"
        try:
            folder.mkdir(parents=True, exist_ok=True)
            self._file = self._path.open("wb")
        except OSError as error:
            raise self._complaint(error) from error
        self._records = RecordWriter(self._file)
        self._write(
            Event(wall_time=time.time(), step=first_step, file_version="brain.Event:2"),
            Event(step=first_step, session_log=SessionLog(status=SessionLog.START)),
        )

    def add(self, figures: Mapping[str, float], step: int) -> None:
        """Add a point to each curve.

        Args:
            figures: By name.
            step: Where.
        """
        values = [
            Summary.Value(tag=name, simple_value=float(value)) for name, value in figures.items()
        ]
        self._write(Event(wall_time=time.time(), step=step, summary=Summary(value=values)))

    def close(self) -> None:
        """Close the file."""
        try:
            self._file.close()
        except OSError as error:
            raise self._complaint(error) from error

    def _write(self, *events: Event) -> None:
        try:
            for event in events:
                self._records.write(event.SerializeToString())
            self._file.flush()
        except OSError as error:
            raise self._complaint(error) from error

    def _complaint(self, error: OSError) -> OutputError:
        return OutputError(f"cannot write {self._path}: {error.strerror or error}")
