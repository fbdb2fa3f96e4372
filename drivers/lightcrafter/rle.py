"""Run-length encoding of 24-bit images for the DLPC900, all lines at once.

Source: DLPU018J §2.4.3; where lines begin: TI, e2e thread 1117715.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

_REPEAT_FROM = 3
_LONGEST = 255
_END_OF_LINE = 2


def wire_bytes(pixels: NDArray[np.uint32]) -> NDArray[np.uint8]:
    """Give the three bytes of each of n pixels, (n, 3): bit planes 16..23 first, 0..7 last."""
    return pixels.astype(">u4").view(np.uint8).reshape(-1, 4)[:, 1:]


def padded(data: bytes) -> bytes:
    """Fill up to a multiple of 4 bytes."""
    return data + bytes(-len(data) % 4)


def rle(image: NDArray[np.uint32]) -> bytes:
    """Encode with RLE: runs ``n colour`` of up to 255 pixels, lines end with ``00 00``, the image with ``00 01``.

    Every run takes 4 bytes, single pixels too; so each line begins at a multiple of 4 bytes, as it must, when two
    bytes follow its end.

    Parameters
    ----------
    image
        (height, width), 24-bit.
    """
    pixels, width = image.ravel(), image.shape[1]
    start = _starts(pixels[1:] != pixels[:-1], width)
    length = np.diff(start, append=pixels.size)
    # Runs of more than 255 pixels go on in further ones.
    parts = -(-length // _LONGEST)
    part = np.arange(parts.sum()) - np.repeat(np.cumsum(parts) - parts, parts)
    start = np.repeat(start, parts) + _LONGEST * part
    records = np.zeros((start.size + image.shape[0], 4), np.uint8)
    row = np.arange(start.size) + start // width  # one more for each line that has ended
    records[row, 0] = np.diff(start, append=pixels.size)
    records[row, 1:] = wire_bytes(pixels[start])
    return padded(records.tobytes() + b"\x00\x01")


def enhanced_rle(image: NDArray[np.uint32]) -> bytes:
    """Encode with enhanced RLE.

    Runs are ``00 01 n`` (n pixels as in the line above), ``n colour`` (n times the same) and ``00 n colours``
    (verbatim); n takes one byte up to 127 and two above. Lines end with ``00 00``, the image with ``00 01 00``.

    Parameters
    ----------
    image
        (height, width), 24-bit; less than 32 768 px wide.
    """
    pixels, width = image.ravel(), image.shape[1]
    start, copied = _cut(image)
    length = np.diff(start, append=pixels.size)
    # Neighbouring runs too short to be repeated go together into one verbatim run.
    short = ~copied & (length < _REPEAT_FROM)
    begins = np.ones(start.size, bool)
    begins[1:] = ~(short[1:] & short[:-1]) | (start[1:] % width == 0)
    start, copied, short = start[begins], copied[begins], short[begins]
    length = np.diff(start, append=pixels.size)
    # A single pixel is repeated once: "00 01" would be read as a copy.
    verbatim = short & (length > 1)
    repeated = ~copied & ~verbatim

    before_count = np.where(copied, 2, np.where(verbatim, 1, 0))
    count = 1 + (length >= 128)
    colours = np.where(copied, 0, np.where(verbatim, 3 * length, 3))
    last_of_line = (start + length) % width == 0
    size = before_count + count + colours + _END_OF_LINE * last_of_line
    place = np.cumsum(size) - size

    out = np.zeros(int(size.sum()), np.uint8)
    out[place[copied] + 1] = 1
    _put_counts(out, place + before_count, length)
    data = place + before_count + count
    wire = wire_bytes(pixels)
    # Pixel i of a verbatim run goes to data + 3 (i - start).
    source = _spans(start[verbatim], length[verbatim])
    target = np.repeat(data[verbatim] - 3 * start[verbatim], length[verbatim]) + 3 * source
    for byte in range(3):
        out[data[repeated] + byte] = wire[start[repeated], byte]
        out[target + byte] = wire[source, byte]
    return padded(out.tobytes() + b"\x00\x01\x00")


def _cut(image: NDArray[np.uint32]) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Cut all lines into runs that equal the line above or are of one colour: their beginnings, and which are which."""
    width, pixels = image.shape[1], image.ravel()
    same = np.zeros(image.shape, bool)
    same[1:] = image[1:] == image[:-1]
    above = same.ravel()
    changes = pixels[1:] != pixels[:-1]
    # Where both would do, the longer run wins; to copy a single pixel would only break a verbatim run.
    equal = _lengths(above[1:] != above[:-1], width)
    copied = above & (equal > 1) & (equal >= _lengths(changes, width))
    start = _starts((copied[1:] != copied[:-1]) | (~copied[1:] & changes), width)
    return start, copied[start]


def _starts(differs: NDArray[np.bool_], width: int) -> NDArray[np.intp]:
    """Where runs begin, given which pixels differ from the one before; each line begins a run."""
    edge = np.ones(differs.size + 1, bool)
    edge[1:] = differs
    edge[::width] = True
    return np.flatnonzero(edge)


def _lengths(differs: NDArray[np.bool_], width: int) -> NDArray[np.intp]:
    """Length of the run that each pixel is in."""
    length = np.diff(_starts(differs, width), append=differs.size + 1)
    return np.repeat(length, length)


def _put_counts(out: NDArray[np.uint8], place: NDArray[np.intp], count: NDArray[np.intp]) -> None:
    long = count >= 128
    out[place] = np.where(long, count & 0x7F | 0x80, count)
    out[place[long] + 1] = count[long] >> 7


def _spans(start: NDArray[np.intp], length: NDArray[np.intp]) -> NDArray[np.intp]:
    """All numbers from each ``start`` on, ``length`` of them."""
    ends = np.cumsum(length)
    return np.arange(ends[-1] if ends.size else 0) + np.repeat(start - ends + length, length)
