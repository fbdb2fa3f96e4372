"""A device in a process of its own.

A vendor's library that crashes must not take the scan along, one that holds the interpreter's lock must not stall the
projector, and a window must be served whatever the scan computes. `DeviceProcess` runs a *server*, an object whose
methods are called by name, in a spawned process; one thread there does everything, in turn: commands, then ``idle()``.
"""

from __future__ import annotations

import contextlib
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from typing import Any, Protocol

from drivers.errors import DeviceLostError, HardwareError, OperatorError

_REAPED_WITHIN_S = 5.0
"""A process that has let go of its pipes is about to end; how soon it can be asked why, a busy machine decides."""

Emit = Callable[[Any], None]
"""Sends one message (picklable) from the server to `DeviceProcess.next_event`."""


class Server(Protocol):
    """What runs in the process; its other methods are the commands."""

    def idle(self) -> float:
        """Do what is to be done between commands; returns for how long a command may be waited for, s."""
        ...

    def close(self) -> None:
        """Let go of everything; called at the end, whatever happened."""
        ...


class DeviceProcess:
    """A server in another process, called by method name.

    Parameters
    ----------
    device
        The name that errors mention.
    factory
        Importable function or class; called as ``factory(emit, *args)`` in the new process, gives the `Server`.
    args
        Picklable.

    Notes
    -----
    The process ends with `stop`, when this process ends, and when it loses the connection. It ignores Ctrl-C, which the
    terminal sends to both: this process decides. Not safe for several threads at once.
    """

    def __init__(self, device: str, factory: Callable[..., Server], *args: Any) -> None:
        self.device = device
        self._factory = factory
        self._args = args
        self._process: Any = None
        self._commands: Connection | None = None
        self._events: Connection | None = None
        self._calls = 0

    @property
    def alive(self) -> bool:
        """True from `start` until the process has ended, for whatever reason."""
        return self._process is not None and self._process.is_alive()

    @property
    def pid(self) -> int | None:
        """Number of the process, None where there is none."""
        return None if self._process is None else self._process.pid

    def start(self, timeout_s: float = 30.0) -> None:
        """Start the process and wait until its server is made.

        Raises
        ------
        OperatorError
            Whatever the factory raised.
        DeviceLostError
            The process died or said nothing within ``timeout_s``.
        """
        context = multiprocessing.get_context("spawn")
        self._calls = 0
        self._commands, commands = context.Pipe()
        self._events, events = context.Pipe(duplex=False)
        self._process = context.Process(
            target=_serve, args=(commands, events, self._factory, self._args), name=self.device, daemon=True
        )
        with _no_interruption():
            self._process.start()
        # The other ends belong to the child alone, so that its death is seen as the end of the pipe.
        commands.close()
        events.close()
        try:
            self._answer("start", timeout_s)
        except BaseException:
            self.stop(2.0)
            raise

    def call(self, method: str, *args: Any, timeout_s: float = 10.0) -> Any:
        """Call a method of the server and return what it returns.

        Raises
        ------
        OperatorError
            What the method raised; any other exception arrives as `HardwareError`.
        DeviceLostError
            The process has died, or did not answer within ``timeout_s``; then it is killed.
        """
        self._calls += 1
        self._send(method, args, self._calls)
        return self._answer(method, timeout_s)

    def post(self, method: str, *args: Any) -> None:
        """Call a method of the server and go on at once; what it raises arrives as an event.

        Raises
        ------
        DeviceLostError
            The process has died.
        """
        self._send(method, args, None)

    def next_event(self, timeout_s: float) -> Any:
        """Wait for the server's next message; None where there was none within ``timeout_s``.

        Raises
        ------
        DeviceLostError
            The process has died.
        """
        if self._events is None:
            raise self._lost("its process is not running")
        try:
            return self._events.recv() if self._events.poll(max(timeout_s, 0.0)) else None
        except (EOFError, OSError):
            raise self._died() from None

    def stop(self, timeout_s: float = 5.0) -> None:
        """End the process, by force after ``timeout_s``; allowed at any time."""
        process, self._process = self._process, None
        for connection in (self._commands, self._events):
            if connection is not None:
                connection.close()
        self._commands = self._events = None
        if process is None:
            return
        process.join(timeout_s)
        if process.is_alive():
            process.kill()
            process.join()
        process.close()

    def _send(self, method: str, args: tuple[Any, ...], number: int | None) -> None:
        if self._commands is None:
            raise self._lost(f"{method}() was called on a process that is not running")
        try:
            self._commands.send((number, method, args))
        except OSError:
            raise self._died() from None

    def _answer(self, method: str, timeout_s: float) -> Any:
        assert self._commands is not None
        deadline = time.monotonic() + timeout_s
        number: int | None = None
        try:
            # The answer to a call that was interrupted, by Ctrl-C for one, may still be on its way.
            while number != self._calls:
                if not self._commands.poll(max(deadline - time.monotonic(), 0.0)):
                    self._process.kill()
                    raise self._lost(f"no answer to {method}() within {timeout_s:g} s")
                number, error, value = self._commands.recv()
        except (EOFError, OSError):
            raise self._died() from None
        if error is not None:
            raise error
        return value

    def _died(self) -> DeviceLostError:
        code = None
        if self._process is not None:
            self._process.join(_REAPED_WITHIN_S)
            code = self._process.exitcode
        if code is not None and code < 0:
            why = f"its process was ended by {signal.Signals(-code).name}"
        else:
            why = f"its process ended (exit code {code})"
        return self._lost(why)

    def _lost(self, why: str) -> DeviceLostError:
        return DeviceLostError(
            f"{self.device}: {why}",
            "Check the device's cable and power and its vendor's library; the scan can be started again.",
        )


def _serve(commands: Connection, events: Connection, factory: Callable[..., Server], args: tuple[Any, ...]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGTERM, signal.SIG_DFL)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        server = factory(events.send, *args)
    except Exception as error:
        commands.send((0, _portable(error, "start"), None))
        return
    try:
        commands.send((0, None, None))
        _loop(commands, events.send, server)
    except (EOFError, BrokenPipeError, ConnectionResetError):
        pass  # the scan has let go
    finally:
        with contextlib.suppress(Exception):
            server.close()


def _loop(commands: Connection, emit: Emit, server: Server) -> None:
    while True:
        patience = server.idle()
        if not wait([commands], patience):
            continue
        number, method, args = commands.recv()
        failure: OperatorError | None = None
        value: Any = None
        try:
            value = getattr(server, method)(*args)
        except Exception as error:
            failure = _portable(error, method)
        if number is not None:
            commands.send((number, failure, value))
        elif failure is not None:
            emit(failure)


@contextlib.contextmanager
def _no_interruption() -> Iterator[None]:
    """Let a process that is started here never be ended by Ctrl-C, not even before its first line has run."""
    if not hasattr(signal, "pthread_sigmask"):
        yield
        return
    resource_tracker.ensure_running()  # what multiprocessing starts first, and lets Ctrl-C through again thereafter
    former = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, former)


def _portable(error: Exception, method: str) -> OperatorError:
    if isinstance(error, OperatorError):
        return error
    return HardwareError(
        f"{method}() failed: {type(error).__name__}: {error}",
        "Check the device with its vendor's own program; where that works, this is a fault of the driver to report.",
    )


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    time.sleep(2.0)  # enough for the server to see the end of its pipe and close in order
    os._exit(1)
