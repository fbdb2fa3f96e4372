"""Servers for the tests of `drivers.process`; in a file of their own that the new process can import."""

import ctypes
import os
import signal
import time

from drivers import DeviceNotFoundError, FrameLossError
from drivers.process import DeviceProcess


class Echo:
    """Answers, emits and fails as it is told."""

    def __init__(self, emit, greeting="hello"):
        self._emit = emit
        self._greeting = greeting
        self._ticks = 0

    def greet(self, name):
        return f"{self._greeting} {name} from {os.getpid()}"

    def interrupt_handling(self):
        return signal.getsignal(signal.SIGINT) is signal.SIG_IGN

    def emit(self, *messages):
        for message in messages:
            self._emit(message)

    def ticks(self):
        return self._ticks

    def fail_as_operator(self):
        raise FrameLossError("frames 3 to 5 are missing", "Take it again.")

    def fail_as_program(self):
        raise ZeroDivisionError("one by none")

    def crash(self):
        ctypes.string_at(0)

    def leave(self, code):
        os._exit(code)

    def hang(self, seconds=60.0):
        time.sleep(seconds)
        return "slept"

    def idle(self):
        self._ticks += 1
        return 0.005

    def close(self):
        if self._greeting.startswith("/"):
            with open(self._greeting, "a") as file:
                file.write("closed")


class Sulking(Echo):
    """Cannot be closed."""

    def close(self):
        time.sleep(60)


def nothing_there(emit):
    raise DeviceNotFoundError("there is no such thing", "Plug it in.")


def crash_at_once(emit):
    ctypes.string_at(0)


def hang_at_once(emit):
    time.sleep(60)


def main_program(note):
    """A program of its own with a device process, whose number it prints; then waits to be killed."""
    process = DeviceProcess("echo", Echo, note)
    process.start()
    print(process.pid, flush=True)
    time.sleep(60)
