"""The one executor: gives indices to workers and passes on their results as they come.

A worker is made once a process and called once an index. Workers are this process, local processes,
or whatever else has a `spread`, such as `hvs_suite.on_ray.RayCluster` with actors on many machines.
Results do not depend on which of them it is, as long as a call depends on nothing but its index.
"""

import contextlib
import multiprocessing
import os
import signal
import threading
import traceback
from collections.abc import Callable, Generator, Iterable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from multiprocessing.connection import Connection, wait
from multiprocessing.context import SpawnProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any, Protocol, cast

from hvs_suite.errors import HvsError, OptionError

# One core a worker: llvmpipe's and OpenMP's own threads would compete for the same cores. The
# libraries read both variables when they load, so they are set before a worker starts.
WORKER_ENVIRONMENT = {"LP_NUM_THREADS": "1", "OMP_NUM_THREADS": "1"}
WORKER_EXIT_TIMEOUT_S = 10.0
TOLD_AHEAD = 3
"""Indices that a worker holds, the one it works on included."""

type Note = Callable[[Any], None]
"""Tells the reader of the results how a long call goes."""
type Make[T] = Callable[[Note], AbstractContextManager[Callable[[int], T]]]
"""Makes and ends a worker's function; module-level function or dataclass, so that it pickles."""


class Elsewhere(Protocol):
    """Workers that are no processes of this machine."""

    def spread[T](
        self, make: Make[T], indices: Sequence[int], *, ahead: int, on_note: Note | None
    ) -> Generator[T, None, None]:
        """Does what :func:`spread` does."""

    def size(self) -> int:
        """How many workers there are now."""


type Workers = int | Elsewhere
"""How many local processes, 1 being this one; or others elsewhere."""


def check_workers(workers: Workers) -> None:
    """Checks a number of workers before anything is made for them.

    Raises:
        OptionError: It is below 1.
    """
    if isinstance(workers, int) and workers < 1:
        raise OptionError(f"workers must be at least 1, not {workers}")


def size(workers: Workers) -> int:
    """How many workers there are."""
    return workers if isinstance(workers, int) else workers.size()


def spread[T](
    make: Make[T],
    indices: Iterable[int],
    *,
    workers: Workers = 1,
    ahead: int = TOLD_AHEAD,
    on_note: Note | None = None,
) -> Generator[T, None, None]:
    """Calls workers with indices and yields results as they come.

    Workers take the next index whenever they are free and run a few results ahead of the reader at
    most, so memory stays flat. Closing the iterator (or an error, or Ctrl-C) ends them.

    Args:
        make: Makes a worker's function, once a worker.
        indices: Handed out in this order.
        workers: Processes, 1 being this one, in order; or others elsewhere.
        ahead: Indices that a worker holds, the one it works on included; 1 where a call takes long.
        on_note: Called here with what workers say meanwhile.

    Yields:
        One result an index, in the order in which calls end.

    Raises:
        OptionError: `workers` is below 1, or something cannot be sent to another process.
        ClusterError: Workers elsewhere cannot be had.
        HvsError: Whatever typed error a worker raised, in whichever process.
        RuntimeError: Any other failure of a worker, its traceback as a note.
    """
    check_workers(workers)
    indices = [int(index) for index in indices]
    if not indices:
        return
    note = on_note or _unheard
    if not isinstance(workers, int):
        yield from workers.spread(make, indices, ahead=ahead, on_note=on_note)
    elif workers > 1 and len(indices) > 1:
        yield from _in_processes(make, indices, min(workers, len(indices)), ahead, note)
    else:
        with make(note) as call:
            for index in indices:
                yield call(index)


def _unheard(words: Any) -> None:
    """Ignores what workers say."""


def _in_processes[T](
    make: Make[T], indices: Sequence[int], workers: int, ahead: int, note: Note
) -> Generator[T, None, None]:
    """Gives indices to spawned workers one by one, and ends every worker in any case."""
    try:
        ForkingPickler.dumps(make)
    except Exception as error:
        raise OptionError(
            f"with several workers, factories travel to other processes, and this one cannot "
            f"({error}): define it at module level, or use workers=1"
        ) from error
    started: list[tuple[SpawnProcess, Connection]] = []
    try:
        with worker_conditions():
            for _ in range(workers):
                started.append(_start_worker(make))
        processes = {connection: process for process, connection in started}
        waiting = iter(indices)
        # What each worker was told and has not answered: always some, so that it continues while
        # the caller uses the results before.
        told = dict.fromkeys(processes, 0)
        for connection in [*processes] * ahead:
            told[connection] += _send_next(connection, waiting)
        while busy := [connection for connection, count in told.items() if count]:
            for ready in wait(busy):
                connection = cast("Connection", ready)
                kind, *content = _receive(connection, processes)
                if kind == "note":
                    note(content[0])
                    continue
                told[connection] += _send_next(connection, waiting) - 1
                yield content[0]
        for process, _ in started:
            process.join(WORKER_EXIT_TIMEOUT_S)
    finally:
        for process, connection in started:
            connection.close()
            if process.is_alive():
                process.terminate()
        for process, _ in started:
            process.join(WORKER_EXIT_TIMEOUT_S)
            if process.is_alive():
                process.kill()
                process.join()
            process.close()


@contextlib.contextmanager
def worker_conditions() -> Iterator[None]:
    """Sets environment variables and signals for new workers to inherit.

    A worker ignores Ctrl-C from its first instruction on: the terminal sends it to the whole
    group, and only the process that asked for the work should answer.
    """
    before = {name: os.environ.get(name) for name in WORKER_ENVIRONMENT}
    in_main_thread = threading.current_thread() is threading.main_thread()
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if in_main_thread else None
    os.environ.update(WORKER_ENVIRONMENT)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value
        if in_main_thread:
            signal.signal(signal.SIGINT, handler)


def _start_worker(make: Make[Any]) -> tuple[SpawnProcess, Connection]:
    """Starts one worker; returns it and our end of its pipe."""
    context = multiprocessing.get_context("spawn")
    ours, theirs = context.Pipe()
    process = context.Process(target=_work, args=(theirs, make), daemon=True)
    process.start()
    # With our copy closed, a worker that dies is seen as the end of the stream.
    theirs.close()
    return process, ours


def _send_next(connection: Connection, waiting: Iterator[int]) -> bool:
    """Sends the next index, or the end; False at the end. A dead worker is found on receiving."""
    index = next(waiting, None)
    with contextlib.suppress(OSError):
        connection.send(index)
    return index is not None


def _receive(connection: Connection, processes: Mapping[Connection, SpawnProcess]) -> Any:
    """Returns what a worker says, or raises what it raised."""
    try:
        said = connection.recv()
    except (EOFError, OSError):
        process = processes[connection]
        process.join(WORKER_EXIT_TIMEOUT_S)
        raise RuntimeError(
            f"A rollout worker ended with exit code {process.exitcode} before its result came; "
            "a negative code is the signal that ended it (-9: most likely out of memory)."
        ) from None
    return opened(said)


def _work(connection: Connection, make: Make[Any]) -> None:
    """Runs a worker: builds it, calls it until the end is told, and closes it."""
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        with make(lambda words: connection.send(("note", words))) as call:
            while (index := connection.recv()) is not None:
                connection.send(("result", call(index)))
    except Exception as error:
        # If the pipe is closed, no process is left to be told.
        with contextlib.suppress(OSError):
            connection.send(failure(error))


def _end_with_parent() -> None:
    """Ends this process once its parent has ended, however that was killed.

    A call may take an hour, and would keep its folder locked for the next command.
    """
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os._exit(1)


def failure(error: Exception) -> tuple[Any, ...]:
    """An error that a worker sends in place of a result; :func:`opened` raises it again."""
    if isinstance(error, HvsError):
        return "error", type(error), str(error), ""
    return "error", None, f"{type(error).__name__}: {error}", traceback.format_exc()


def opened(said: tuple[Any, ...]) -> tuple[Any, ...]:
    """Returns what a worker said.

    Raises:
        HvsError: The typed error that it raised.
        RuntimeError: Any other, its traceback as a note.
    """
    if said[0] != "error":
        return said
    _, error_type, text, trace = said
    if error_type is not None:
        raise error_type(text)
    error = RuntimeError(f"A rollout worker failed: {text}")
    error.add_note(f"In the worker:\n{trace}")
    raise error
