"""Generators that run in a process of their own, for so long and no longer."""

from __future__ import annotations

import contextlib
import os
import pickle
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.connection import Connection
from typing import Any

from drivers import OperatorError

_ORDERLY_S = 3.0


class CutShortError(Exception):
    """A process did not come to its end; what it had given before was given."""


def bounded(limit_s: float, function: Callable[..., Iterable[Any]], *args: Any) -> Iterator[Any]:
    """Give what ``function(*args)`` gives, from a new process that is killed with all its children after ``limit_s``.

    Parameters
    ----------
    limit_s
        s, all items together.
    function
        Importable by its name; what it takes and gives must be picklable. What it prints is dropped.

    Raises
    ------
    CutShortError
        It took too long, raised, or its process died; the text says which.
    OperatorError
        It raised that.
    """
    deadline = time.monotonic() + limit_s
    readable, writable = os.pipe()
    answers = Connection(readable, writable=False)
    # Not multiprocessing: that would wait at exit for a process that waits for a dead disk.
    code = f"import sys; sys.path[:] = {sys.path!r}; from scanner.doctor.bounded import serve; serve({writable})"
    process = subprocess.Popen(
        [sys.executable, "-P", "-c", code],
        stdin=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        pass_fds=[writable],
        start_new_session=True,
    )
    os.close(writable)
    try:
        assert process.stdin is not None
        with contextlib.suppress(BrokenPipeError), process.stdin as task:
            pickle.dump((function, args), task)
        while True:
            if not answers.poll(max(deadline - time.monotonic(), 0.0)):
                raise CutShortError(f"gave no answer within {limit_s:g} s")
            try:
                kind, value = answers.recv()
            except EOFError:
                raise CutShortError(_how_it_ended(process)) from None
            if kind == "end":
                with contextlib.suppress(subprocess.TimeoutExpired):
                    process.wait(_ORDERLY_S)
                return
            if kind == "error":
                raise value
            yield value
    finally:
        answers.close()
        _end(process)


def _how_it_ended(process: subprocess.Popen[bytes]) -> str:
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(1.0)
    code = process.returncode
    if code is not None and code < 0:
        return f"crashed ({signal.Signals(-code).name})"
    return f"ended without an answer (exit code {code})"


def _end(process: subprocess.Popen[bytes]) -> None:
    # By its group: what it has started must not outlive it.
    with contextlib.suppress(ProcessLookupError, PermissionError):
        os.killpg(process.pid, signal.SIGKILL)
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(1.0)


def serve(descriptor: int) -> None:
    """What runs in the process: read the task from standard input, send its items to ``descriptor``."""
    answers = Connection(descriptor, readable=False)
    try:
        function, args = pickle.load(sys.stdin.buffer)
        for item in function(*args):
            answers.send(("item", item))
        answers.send(("end", None))
    except OperatorError as error:
        answers.send(("error", error))
    except Exception as error:
        answers.send(("error", CutShortError(f"failed: {type(error).__name__}: {error}")))
