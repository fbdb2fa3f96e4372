"""The firmware's protocol core, compiled for this machine, with the calls of `sim_backend.trigger_box.SltBox`."""

from __future__ import annotations

import ctypes
import shutil
import subprocess
import tempfile
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from requirements import require

FIRMWARE = Path(__file__).parents[1] / "drivers" / "trigger_box" / "firmware"
_LEVELS: tuple[Any, ...] = ("LOW", "HIGH", None)


class _Range(ctypes.Structure):
    _fields_ = [("least", ctypes.c_uint32), ("most", ctypes.c_uint32)]


class _Facts(ctypes.Structure):
    _fields_ = [("identity", ctypes.c_char_p), *((name, _Range) for name in ("pulses", "period", "width", "delay"))]


_SEND = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.POINTER(ctypes.c_char), ctypes.c_uint8)
_DRIVE = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, ctypes.c_uint32)
_WAKE_AT = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_uint32)
_NOW = ctypes.CFUNCTYPE(ctypes.c_uint32, ctypes.c_void_p)
_LOCK = ctypes.CFUNCTYPE(None, ctypes.c_void_p)


class _Calls(ctypes.Structure):
    _fields_ = [
        ("send", _SEND),
        ("drive", _DRIVE),
        ("wake_at", _WAKE_AT),
        ("now_us", _NOW),
        ("lock", _LOCK),
        ("unlock", _LOCK),
    ]


@cache
def _library() -> ctypes.CDLL:
    compiler = shutil.which("cc")
    require(compiler, "needs a C compiler: apt install gcc")
    source = FIRMWARE / "slt_core" / "src" / "slt_core.c"
    flags = ["-std=c99", "-O1", "-Wall", "-Wextra", "-Wpedantic", "-Wconversion", "-Werror", "-fPIC", "-shared"]
    with tempfile.TemporaryDirectory() as folder:
        # How large the struct is knows the compiler alone.
        size, library = Path(folder) / "size.c", Path(folder) / "slt_core.so"
        size.write_text('#include "slt_core.h"\nunsigned slt_box_size(void) { return sizeof(slt_box); }\n')
        subprocess.run([str(compiler), *flags, f"-I{source.parent}", source, size, "-o", library], check=True)
        return ctypes.CDLL(str(library))


class SltCoreInC:
    """See `SltBox`."""

    def __init__(self, send: Callable[[bytes], None], drive: Callable[[Any, int], None]) -> None:
        self._library = _library()
        # The banner of the first start is for nobody: whoever takes the lines may not be ready.
        self._send: Callable[[bytes], None] = lambda data: None
        self._drive: Callable[[Any, int], None] = lambda level, t_us: None
        self._now = 0
        self._due: int | None = None
        self._locked = 0
        limits = (_Range(1, 65535), _Range(20, 10_000_000), _Range(1, 1_000_000), _Range(0, 1_000_000))
        self._facts = _Facts(b"SLT,emulator,EMU1,1.0.0,1", *limits)
        self._calls = _Calls(
            _SEND(lambda board, text, length: self._said(text[:length])),
            _DRIVE(lambda board, level, t_us: self._drive(_LEVELS[level], t_us)),
            _WAKE_AT(lambda board, t_us: self._wake_at(t_us)),
            _NOW(lambda board: self._now),
            _LOCK(lambda board: self._lock(1)),
            _LOCK(lambda board: self._lock(-1)),
        )
        self._box = ctypes.create_string_buffer(self._library.slt_box_size())
        self.reset(0)
        self._send, self._drive = send, drive

    @property
    def wake_at_us(self) -> int | None:
        return self._due

    def reset(self, t_us: int) -> None:
        self._now, self._due = t_us, None
        self._library.slt_begin(self._box, ctypes.byref(self._facts), ctypes.byref(self._calls), None)

    def receive(self, data: bytes, t_us: int) -> None:
        self._now = t_us
        for byte in data:
            self._library.slt_receive(self._box, ctypes.c_char(byte))
            self._library.slt_poll(self._box)

    def edge(self, rising: bool, t_us: int) -> None:
        self._now, self._due = t_us, None
        self._library.slt_edge(self._box, ctypes.c_bool(rising), ctypes.c_uint32(t_us))
        self._library.slt_poll(self._box)

    def exposure(self, level: str, t_us: int) -> None:
        self._now, self._due = t_us, None
        self._library.slt_exposure(self._box, _LEVELS.index(level), ctypes.c_uint32(t_us))
        self._library.slt_poll(self._box)

    def wake(self, t_us: int) -> None:
        self._now, self._due = t_us, None
        self._library.slt_wake(self._box, ctypes.c_uint32(t_us))
        self._library.slt_poll(self._box)

    def _said(self, data: bytes) -> None:
        assert not self._locked, "a board sends from the main loop, with interrupts on"
        self._send(data)

    def _wake_at(self, t_us: int) -> None:
        self._due = t_us

    def _lock(self, step: int) -> None:
        self._locked += step
        assert self._locked in (0, 1), "locks do not nest"
