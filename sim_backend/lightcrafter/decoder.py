"""How the DLPC900 reads images: header and run-length code, byte by byte, refusing what it cannot make sense of."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

HEADER_BYTES = 48


class BadImageError(ValueError):
    """The bytes are no image."""


def decode(data: bytes) -> NDArray[np.uint32]:
    """Read an image.

    Parameters
    ----------
    data
        With its 48-byte header.

    Returns
    -------
    NDArray
        (height, width), 24 bit planes.

    Raises
    ------
    BadImageError
        The bytes are no image.
    """
    if len(data) < HEADER_BYTES or data[:4] != b"Spld" or data[12:20] != b"\xff" * 8 or any(data[20:24]):
        raise BadImageError("no header")
    width, height = int.from_bytes(data[4:6], "little"), int.from_bytes(data[6:8], "little")
    if int.from_bytes(data[8:12], "little") != len(data) - HEADER_BYTES or len(data) % 4:
        raise BadImageError("size in the header")
    body = data[HEADER_BYTES:]
    match data[25]:
        case 0:
            lines = _uncompressed(body, width, height)
        case 1:
            lines = _rle(body, width, height)
        case 2:
            lines = _enhanced_rle(body, width, height)
        case other:
            raise BadImageError(f"compression {other}")
    # The last byte of a pixel holds planes 0 to 7.
    wide = lines.astype(np.uint32)
    image: NDArray[np.uint32] = wide[..., 0] << np.uint32(16) | wide[..., 1] << np.uint32(8) | wide[..., 2]
    return image


def _uncompressed(body: bytes, width: int, height: int) -> NDArray[np.uint8]:
    if len(body) < 3 * width * height:
        raise BadImageError("too short")
    return np.frombuffer(body, np.uint8, 3 * width * height).reshape(height, width, 3)


def _rle(body: bytes, width: int, height: int) -> NDArray[np.uint8]:
    image = bytearray()
    at = lines = 0
    while True:
        if at + 1 >= len(body):
            raise BadImageError("no end of image")
        n, second = body[at], body[at + 1]
        if n:
            image += body[at + 1 : at + 4] * n
            at += 4
        elif second == 0:
            lines += 1
            if len(image) != 3 * width * lines:
                raise BadImageError("line length")
            at = -(-(at + 2) // 4) * 4
        elif second == 1:
            break
        else:
            image += body[at + 2 : at + 2 + 3 * second]
            at += 2 + 3 * second
    return _whole(image, width, height)


def _enhanced_rle(body: bytes, width: int, height: int) -> NDArray[np.uint8]:
    image = bytearray()
    at = 0

    def count() -> int:
        nonlocal at
        n = body[at]
        at += 1
        if n & 0x80:
            n = (n & 0x7F) + (body[at] << 7)
            at += 1
        return n

    try:
        while True:
            n = count()
            if n:
                image += body[at : at + 3] * n
                at += 3
                continue
            second = count()
            if second == 0:
                if len(image) % (3 * width):
                    raise BadImageError("line length")
            elif second == 1:
                n = count()
                if n == 0:
                    break
                above = len(image) - 3 * width
                if above < 0:
                    raise BadImageError("nothing above")
                image += image[above : above + 3 * n]
            else:
                image += body[at : at + 3 * second]
                at += 3 * second
    except IndexError:
        raise BadImageError("no end of image") from None
    return _whole(image, width, height)


def _whole(image: bytearray, width: int, height: int) -> NDArray[np.uint8]:
    if len(image) != 3 * width * height:
        raise BadImageError("number of pixels")
    return np.frombuffer(image, np.uint8).reshape(height, width, 3)
