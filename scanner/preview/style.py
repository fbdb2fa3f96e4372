"""Colours and letters that all pictures on the operator's screen have in common."""

from __future__ import annotations

from functools import cache
from importlib.util import find_spec
from pathlib import Path

from PIL import ImageFont

Colour = tuple[int, int, int]
"""Red, green, blue."""

INK, DIM, GROUND, TRACK = (235, 235, 235), (150, 150, 150), (24, 26, 30), (52, 55, 62)
GOOD, CAUTION, BAD = (80, 200, 120), (230, 180, 60), (255, 90, 80)
ZONE = (250, 200, 60)
"""What the operator is asked to look at or to aim at."""


@cache
def font(points: int, *, bold: bool = False) -> ImageFont.FreeTypeFont:
    """The font that Matplotlib brings, ``points`` px high: the same on every machine, and it knows × and µ."""
    spec = find_spec("matplotlib")
    assert spec is not None
    assert spec.origin is not None
    name = "DejaVuSans-Bold.ttf" if bold else "DejaVuSans.ttf"
    return ImageFont.truetype(Path(spec.origin).parent / "mpl-data" / "fonts" / "ttf" / name, points)


def wrapped(text: str, letters: ImageFont.FreeTypeFont, wide: int) -> list[str]:
    """Lines of ``text`` that are at most ``wide`` px long; only a longer word is cut within."""
    lines = [""]
    for word in text.split(" "):
        longer = f"{lines[-1]} {word}" if lines[-1] else word
        if letters.getlength(longer) <= wide:
            lines[-1] = longer
            continue
        if lines[-1]:
            lines.append("")
        for letter in word:
            if lines[-1] and letters.getlength(lines[-1] + letter) > wide:
                lines.append("")
            lines[-1] += letter
    return lines
