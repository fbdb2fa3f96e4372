"""Pictures as the DLPC900 takes them over USB: packed into 24-bit images, each with a header, run-length encoded.

Source: DLPU018J §2.4.2 (header) and §2.4.3 (compression).
"""

from __future__ import annotations

from collections.abc import Sequence
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from drivers.lightcrafter.rle import enhanced_rle, padded, rle, wire_bytes

HEADER_BYTES = 48
PLANES = 24
"""Bit planes of one image."""


class Compression(IntEnum):
    """How the pixels are written, as the header names it."""

    NONE = 0
    RLE = 1
    ENHANCED_RLE = 2


def quantised(picture: NDArray[np.uint8], bits: int) -> NDArray[np.uint8]:
    """Round 8-bit grey values to ``bits`` bits, black and white kept.

    Parameters
    ----------
    picture
        (height, width), 0..255.
    bits
        1..8.

    Returns
    -------
    NDArray
        (height, width), 0..2**bits - 1.
    """
    if bits == 8:
        return picture
    levels = (1 << bits) - 1
    table = ((np.arange(256, dtype=np.uint32) * levels * 2 + 255) // 510).astype(np.uint8)
    return table[picture]


def places(pictures: int, bits: int) -> list[tuple[int, int]]:
    """Say where pictures of ``bits`` bits lie: (number of the image, first of its bit planes) of each.

    No picture spans two images.
    """
    per_image = PLANES // bits
    return [(number // per_image, number % per_image * bits) for number in range(pictures)]


def packed(pictures: Sequence[NDArray[np.uint8]], bits: int) -> list[NDArray[np.uint32]]:
    """Pack pictures (height, width; 0..255) into 24-bit images.

    Returns
    -------
    list of NDArray
        (height, width), the bit planes of picture n from the place on that `places` says.
    """
    images: list[NDArray[np.uint32]] = []
    for picture, (image, first) in zip(pictures, places(len(pictures), bits), strict=True):
        if image == len(images):
            images.append(np.zeros(picture.shape, np.uint32))
        images[image] |= quantised(picture, bits).astype(np.uint32) << np.uint32(first)
    return images


def laid_out(
    pictures: Sequence[NDArray[np.uint8]], bits: int, room: int
) -> tuple[list[NDArray[np.uint32]], list[tuple[int, int]]]:
    """Pack pictures so that the images compress well, where there is room: fringes of different axes lie apart.

    Fringes along x repeat from line to line and those along y within a line; both in one image do neither.

    Parameters
    ----------
    pictures
        (height, width), 0..255.
    bits
        1..8 of each.
    room
        How many images there may be.

    Returns
    -------
    images, spots
        (height, width) each, and (image, first bit plane) of each picture.
    """
    groups: dict[int, list[int]] = {}
    for number, picture in enumerate(pictures):
        groups.setdefault(_axis(picture), []).append(number)
    images: list[NDArray[np.uint32]] = []
    spots = [(0, 0)] * len(pictures)
    for members in groups.values():
        for number, (image, first) in zip(members, places(len(members), bits), strict=True):
            spots[number] = len(images) + image, first
        images += packed([pictures[number] for number in members], bits)
    if len(images) > room:
        return packed(pictures, bits), places(len(pictures), bits)
    return images, spots


def _axis(picture: NDArray[np.uint8]) -> int:
    if (picture[1:] == picture[:-1]).all():
        return 0
    return 1 if (picture[:, 1:] == picture[:, :-1]).all() else 2


def encoded(image: NDArray[np.uint32], compression: Compression) -> bytes:
    """Write an image with its header, uncompressed where that is shorter.

    Parameters
    ----------
    image
        (height, width), 24-bit.
    compression
        How to write the pixels.
    """
    if compression is not Compression.NONE:
        runs = (rle if compression is Compression.RLE else enhanced_rle)(image)
        if len(runs) < 3 * image.size:
            return _header(image, len(runs), compression) + runs
    body = padded(wire_bytes(image.ravel()).tobytes())
    return _header(image, len(body), Compression.NONE) + body


def _header(image: NDArray[np.uint32], size: int, compression: Compression) -> bytes:
    height, width = image.shape
    return b"".join(
        (
            b"Spld",
            width.to_bytes(2, "little"),
            height.to_bytes(2, "little"),
            # The size without the header, as TI's own program counts it; the command that announces the image counts
            # it with the header. Others write it with the header here, too: the firmware seems not to mind.
            size.to_bytes(4, "little"),
            b"\xff" * 8,
            bytes(4),  # background: black
            bytes((0, compression, 1)),
            bytes(21),
        )
    )
