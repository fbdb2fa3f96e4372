"""harvesters and the GenICam binding below it, loaded without what they do to the process that loads them."""

from __future__ import annotations

import contextlib
import logging
import os
import re
import signal
import sys
import threading
import warnings
from collections.abc import Iterator
from types import ModuleType
from typing import Any

from drivers.errors import MissingLibraryError

_LOGGER = "harvesters.core"


def load_harvesters() -> ModuleType:
    """Import ``harvesters.core``.

    Raises
    ------
    MissingLibraryError
        harvesters or the GenICam binding is not installed, or not for this Python.
    """
    try:
        # The import calls warnings.simplefilter("once") for the whole process.
        with warnings.catch_warnings():
            from harvesters import core
    except ImportError as error:
        raise MissingLibraryError(
            f"GenICam cameras need the packages harvesters and genicam: {error}",
            "Install them with: pip install 'mfs-scanner[genicam]' (the binding comes late for a new Python: "
            "where pip finds none, use the Python version before).",
        ) from None
    # Its logger writes to the terminal; what an operator must know is in the errors of this driver.
    logger = logging.getLogger(_LOGGER)
    logger.handlers = [logging.NullHandler()]
    logger.setLevel(logging.WARNING)
    return core  # type: ignore[no-any-return]


def is_genicam_error(error: BaseException) -> bool:
    """Whether an exception comes from the binding; its two halves share no base class."""
    from genicam import genapi, gentl

    return isinstance(error, gentl.GenericException | genapi.GenericException)


def reason(error: BaseException) -> str:
    """What an exception of the binding says, without the places in its source code that it mentions."""
    text = re.sub(r" ?: \w+Exception thrown in .*$", "", " ".join(str(error).split()))
    return text.rstrip(". ") or type(error).__name__


@contextlib.contextmanager
def kept_interrupt_handler() -> Iterator[None]:
    """Undo what creating an acquirer on the main thread does: it takes Ctrl-C over, and never ends the program."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return
    former = signal.getsignal(signal.SIGINT)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, former)


@contextlib.contextmanager
def complaints() -> Iterator[list[str]]:
    """Collect what harvesters only logs; it swallows most errors of a producer while it looks for devices."""
    collected: list[str] = []

    class Collector(logging.Handler):
        def emit(self, record: logging.LogRecord) -> None:
            message: Any = record.msg
            collected.append(reason(message) if isinstance(message, BaseException) else record.getMessage())

    logger, handler = logging.getLogger(_LOGGER), Collector(logging.WARNING)
    logger.addHandler(handler)
    try:
        yield collected
    finally:
        logger.removeHandler(handler)


def silence_output() -> None:
    """Drop what vendors' libraries and the binding print as notices: a program's output belongs to the program."""
    sys.stdout.flush()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    os.close(nowhere)
