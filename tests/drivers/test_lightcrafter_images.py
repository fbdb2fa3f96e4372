"""24-bit images for the DLPC900: packing, header, run-length codes; against bytes written by hand (DLPU018J §2.4)."""

import numpy as np
import pytest

from drivers.lightcrafter.images import Compression, encoded, laid_out, packed, places, quantised
from drivers.lightcrafter.rle import enhanced_rle, rle
from sim_backend.lightcrafter.decoder import BadImageError, decode

A, B = 0x112233, 0xAABBCC


def image(*lines):
    return np.array(lines, np.uint32)


def test_the_header_is_the_manual_s():
    data = encoded(image([A, B]), Compression.NONE)
    assert data[:48].hex(" ") == (
        "53 70 6c 64 02 00 01 00 08 00 00 00 ff ff ff ff ff ff ff ff 00 00 00 00 00 00 01" + " 00" * 21
    )
    assert data[48:].hex(" ") == "11 22 33 aa bb cc 00 00"
    big = encoded(np.zeros((1080, 1920), np.uint32), Compression.ENHANCED_RLE)
    # Width, height and compression as TI's own program sent them (e2e thread 599044).
    assert big[:8].hex() == "53706c6480073804"
    assert big[24:27].hex(" ") == "00 02 01"
    assert int.from_bytes(big[8:12], "little") == len(big) - 48


def test_enhanced_runs_are_the_manual_s():
    lines = image([A, A, A, A, B, A], [A, A, A, A, B, B], [B, A, B, 0, B, 0])
    assert enhanced_rle(lines).hex(" ") == (
        "04 11 22 33 00 02 aa bb cc 11 22 33 00 00"  # four of one, two verbatim, end of line
        " 00 01 05 01 aa bb cc 00 00"  # five from above, one alone, end of line
        " 00 06 aa bb cc 11 22 33 aa bb cc 00 00 00 aa bb cc 00 00 00 00 00"  # six verbatim
        " 00 01 00"  # end of image
    )


def test_enhanced_counts_from_128_on_take_two_bytes():
    assert enhanced_rle(np.full((1, 300), A, np.uint32)).hex(" ") == "ac 02 11 22 33 00 00 00 01 00 00 00"
    assert enhanced_rle(np.full((1, 128), A, np.uint32))[:2].hex() == "8001"
    assert enhanced_rle(np.full((2, 127), A, np.uint32)).hex(" ") == ("7f 11 22 33 00 00 00 01 7f 00 00 00 01 00 00 00")


def test_plain_runs_are_cut_at_255_and_lines_begin_at_four_bytes():
    assert rle(np.full((1, 300), A, np.uint32)).hex(" ") == ("ff 11 22 33 2d 11 22 33 00 00 00 00 00 01 00 00")
    assert rle(image([A, B], [B, B])).hex(" ") == (
        "01 11 22 33 01 aa bb cc 00 00 00 00 02 aa bb cc 00 00 00 00 00 01 00 00"
    )


@pytest.mark.parametrize("compression", Compression)
@pytest.mark.parametrize("shape", [(1, 1), (2, 1), (1, 2), (5, 7), (9, 300), (40, 640)])
@pytest.mark.parametrize("kind", ["noise", "two", "stripes", "bars", "dots", "steps"])
def test_everything_comes_back(kind, shape, compression):
    random = np.random.default_rng(3)
    height, width = shape
    picture = {
        "noise": lambda: random.integers(0, 1 << 24, shape),
        "two": lambda: random.integers(0, 2, shape) * B,
        "stripes": lambda: np.broadcast_to(random.integers(0, 9, width), shape),
        "bars": lambda: np.broadcast_to(random.integers(0, 3, height)[:, None], shape),
        "dots": lambda: (random.random(shape) < 0.02) * A,
        "steps": lambda: np.repeat(random.integers(0, 99, (height, -(-width // 130))), 130, 1)[:, :width],
    }[kind]().astype(np.uint32)
    data = encoded(picture, compression)
    assert len(data) % 4 == 0
    assert len(data) <= 48 + 3 * picture.size + 3
    assert np.array_equal(decode(data), picture)


def test_fringes_along_both_axes_shrink_to_less_than_a_hundredth():
    fringe = np.rint(127.5 + 127.5 * np.cos(2 * np.pi * np.arange(1920) / 32)).astype(np.uint8)
    pictures = [np.tile(np.roll(fringe, n), (1080, 1)) for n in range(4)]
    pictures[2:2] = [np.tile(np.roll(fringe, n)[:1080, None], (1, 1920)) for n in range(4)]
    images, spots = laid_out(pictures, 8, room=18)
    for picture, (image, first) in zip(pictures, spots, strict=True):
        assert np.array_equal(images[image] >> first & 255, picture)
    assert max(len(encoded(image, Compression.ENHANCED_RLE)) for image in images) < 3 * 1920 * 1080 / 100
    # Where room is short, they share an image and cannot shrink.
    images, spots = laid_out(pictures, 8, room=3)
    assert len(images) == 3
    for picture, (image, first) in zip(pictures, spots, strict=True):
        assert np.array_equal(images[image] >> first & 255, picture)


@pytest.mark.parametrize("bits", range(1, 9))
def test_every_picture_lies_on_its_own_planes(bits):
    pictures = list(np.random.default_rng(5).integers(0, 256, (11, 4, 6), np.uint8))
    images = packed(pictures, bits)
    spots = places(11, bits)
    assert len(images) == spots[-1][0] + 1 == -(-11 // (24 // bits))
    for picture, (number, first) in zip(pictures, spots, strict=True):
        assert first + bits <= 24
        found = images[number] >> first & (1 << bits) - 1
        assert np.array_equal(found, np.rint(picture / 255 * ((1 << bits) - 1)))
        assert np.array_equal(quantised(picture, bits), found)


def test_three_pictures_of_eight_bits_are_blue_green_red_on_the_wire():
    one, two, three = (np.full((1, 1), value, np.uint8) for value in (1, 2, 3))
    assert encoded(packed([one, two, three], 8)[0], Compression.NONE)[48:51] == bytes((3, 2, 1))


@pytest.mark.parametrize(
    ("change", "why"),
    [
        (lambda data: data[:-4], "size"),
        (lambda data: b"Splc" + data[4:], "no header"),
        (lambda data: data[:25] + b"\3" + data[26:], "compression 3"),
        (lambda data: data[:-4] + bytes(4), "no end|line length"),
        (lambda data: data[:4] + b"\7" + data[5:], "line length|number of pixels"),
    ],
)
def test_the_emulator_s_decoder_refuses_what_is_no_image(change, why):
    data = encoded(image([A, A, A, A], [A, A, A, A]), Compression.ENHANCED_RLE)
    with pytest.raises(BadImageError, match=why):
        decode(change(data))
