"""Pixel formats of the GenICam Pixel Format Naming Convention (PFNC), and how their bytes become grey values.

Codes and layouts: PFNC 2.4 and GigE Vision 2.0 (the two ``Packed`` formats).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.devices import Pixels

Bytes = NDArray[np.uint8]
Unpack = Callable[[Bytes, NDArray[np.uint16]], None]

_BLOCK = 1 << 14  # groups of pixels unpacked at a time: what a block needs stays in the processor's cache


@dataclass(frozen=True)
class PixelFormat:
    """How one grey value is stored.

    Parameters
    ----------
    name, code
        As in the PFNC.
    bits
        Significant bits.
    group
        (pixels, bytes) of the smallest whole number of bytes.
    unpack
        Turns the bytes of whole groups into grey values; None where the bytes are the grey values.
    """

    name: str
    code: int
    bits: int
    group: tuple[int, int]
    unpack: Unpack | None = None

    def line_bytes(self, width: int) -> int:
        """Bytes of a line of ``width`` pixels, which must be whole groups."""
        pixels, size = self.group
        if width % pixels:
            raise ValueError(f"{self.name} stores {pixels} pixels together: {width} px are no multiple of it")
        return width // pixels * size

    def read(self, buffer: Any, offset: int, padding_x: int, out: Pixels) -> None:
        """Copy a picture from a camera's buffer.

        Parameters
        ----------
        buffer
            Readable memory.
        offset
            Where the picture begins, bytes.
        padding_x
            Bytes between a line and the next.
        out
            (height, width), contiguous; uint8 for 8 bits, else uint16.

        Raises
        ------
        ValueError
            The buffer is too short.
        """
        height, width = out.shape
        line = self.line_bytes(width)
        stride = line + padding_x
        needed = stride * height - padding_x
        if len(buffer) < offset + needed:
            raise ValueError(f"the buffer holds {len(buffer) - offset} bytes, the picture {needed}")
        if padding_x:
            # The last line need not be padded.
            raw = np.lib.stride_tricks.as_strided(
                np.frombuffer(buffer, np.uint8, needed, offset), (height, line), (stride, 1), writeable=False
            )
        else:
            raw = np.frombuffer(buffer, np.uint8, needed, offset).reshape(1, -1)
        if self.unpack is None:
            np.copyto(out.reshape(raw.shape[0], -1).view(np.uint8), raw)
            return
        pixels, size = self.group
        for source, target in zip(raw, out.reshape(raw.shape[0], -1), strict=True):
            for first in range(0, source.size // size, _BLOCK):
                last = first + _BLOCK
                self.unpack(source[first * size : last * size], target[first * pixels : last * pixels])


def _words(raw: Bytes, group: int, first: int, order: str = "<") -> NDArray[np.uint16]:
    """Bytes ``first`` and ``first + 1`` of each group as one number."""
    return np.ndarray((raw.size // group,), f"{order}u2", raw, first, (group,))


def _unpack_10p(raw: Bytes, out: NDArray[np.uint16]) -> None:
    # Four values in five bytes, the lowest bits first: value i begins 2 i bits into byte i.
    for i in range(4):
        np.right_shift(_words(raw, 5, i), 2 * i, out=out[i::4])
    np.bitwise_and(out, 0x3FF, out=out)


def _unpack_12p(raw: Bytes, out: NDArray[np.uint16]) -> None:
    # Two values in three bytes, the lowest bits first.
    np.bitwise_and(_words(raw, 3, 0), 0xFFF, out=out[0::2])
    np.right_shift(_words(raw, 3, 1), 4, out=out[1::2])


def _unpack_10_packed(raw: Bytes, out: NDArray[np.uint16]) -> None:
    # GigE Vision: the high eight bits of two values around a byte with the low bits of both, in bits 1:0 and 5:4.
    middle = raw[1::3]
    out[0::2] = raw[0::3]
    out[1::2] = raw[2::3]
    np.left_shift(out, 2, out=out)
    out[0::2] |= middle & 0x03
    out[1::2] |= middle >> 4 & 0x03


def _unpack_12_packed(raw: Bytes, out: NDArray[np.uint16]) -> None:
    middle = raw[1::3]
    out[0::2] = raw[0::3]
    np.left_shift(out[0::2], 4, out=out[0::2])
    out[0::2] |= middle & 0x0F
    np.right_shift(_words(raw, 3, 1), 4, out=out[1::2])


PIXEL_FORMATS = {
    f.name: f
    for f in (
        PixelFormat("Mono8", 0x01080001, 8, (1, 1)),
        PixelFormat("Mono10", 0x01100003, 10, (1, 2)),
        PixelFormat("Mono10p", 0x010A0046, 10, (4, 5), _unpack_10p),
        PixelFormat("Mono10Packed", 0x010C0004, 10, (2, 3), _unpack_10_packed),
        PixelFormat("Mono12", 0x01100005, 12, (1, 2)),
        PixelFormat("Mono12p", 0x010C0047, 12, (2, 3), _unpack_12p),
        PixelFormat("Mono12Packed", 0x010C0006, 12, (2, 3), _unpack_12_packed),
        PixelFormat("Mono16", 0x01100007, 16, (1, 2)),
    )
}
