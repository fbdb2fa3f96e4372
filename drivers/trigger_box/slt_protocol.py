"""Lines of SLT/1, as the host writes and reads them; `SLT1.md` is the specification."""

from __future__ import annotations

import re
from dataclasses import dataclass

PROTOCOL = "1"
LAST_NUMBER = 65_535

_NUMBERED = re.compile(r"(?:#([0-9]{1,5}) )?(OK|ERR) (.+)")
_REFUSAL = re.compile(r"([0-9]{1,3}) (.+)")
_STATUS = re.compile(
    r"(RESET|IDLE|ARMED|RUNNING|DONE),sent=(\d+)/(\d+),in=(\d+|-),edges=(\d+),missed=(\d+),t=(\d+)", re.ASCII
)
_RANGE = re.compile(r"(\w+)=(\d+)-(\d+)", re.ASCII)
_CRC8 = []
for _byte in range(256):
    for _ in range(8):
        _byte = (_byte << 1) ^ (0x107 if _byte & 0x80 else 0)
    _CRC8.append(_byte)


@dataclass(frozen=True)
class Reply:
    """What a box answered.

    Parameters
    ----------
    number
        That of the command; None where the box could not read it.
    error
        Number of the error; None for success.
    text
        The rest of the line.
    """

    number: int | None
    error: int | None
    text: str


@dataclass(frozen=True)
class Event:
    """What a box said unasked: ``BOOT``, ``EDGE``, ``PULSE``, ``DONE`` or ``LOST``, and the rest of the line."""

    kind: str
    text: str


@dataclass(frozen=True)
class Identity:
    """Who a box is."""

    board: str
    serial: str
    firmware: str
    protocol: str


@dataclass(frozen=True)
class Status:
    """Where a box is in its run; counts since ``ARM``, ``exposed`` None while IN0 is not used."""

    state: str
    sent: int
    owed: int
    exposed: int | None
    edges: int
    missed: int
    t_us: int


def crc8(characters: bytes) -> int:
    """Checksum of a line: CRC-8 with the polynomial 0x07, begun with 0 (SLT1.md, section 2)."""
    rest = 0
    for character in characters:
        rest = _CRC8[rest ^ character]
    return rest


def command(number: int, body: str) -> bytes:
    """Line that asks for ``body`` under a number from 0 to `LAST_NUMBER`."""
    line = f"#{number} {body}".encode("ascii")
    return line + b"*%02X\n" % crc8(line)


def parse(line: bytes) -> Reply | Event:
    """Read a line of a box, without its line feed.

    Raises
    ------
    ValueError
        It is no line of SLT/1, or its checksum is wrong.
    """
    body, star, checksum = line.rpartition(b"*")
    if star != b"*" or checksum != b"%02X" % crc8(body):
        raise ValueError("the checksum is wrong")
    text = body.decode("ascii")
    if text.startswith("!"):
        kind, _, rest = text[1:].partition(" ")
        return Event(kind, rest)
    if not (match := _NUMBERED.fullmatch(text)):
        raise ValueError("neither an answer nor an event")
    number = None if match[1] is None else int(match[1])
    if match[2] == "OK":
        return Reply(number, None, match[3])
    if not (refusal := _REFUSAL.fullmatch(match[3])):
        raise ValueError("an error without a number")
    return Reply(number, int(refusal[1]), refusal[2])


def identity(text: str) -> Identity:
    """Read the answer to ``*IDN?``.

    Raises
    ------
    ValueError
        It is not that of an SLT box.
    """
    family, *parts = text.split(",")
    if family != "SLT" or len(parts) != 4:
        raise ValueError(f"{text!r} is not the identity of an SLT box")
    return Identity(*parts)


def status(text: str) -> Status:
    """Read the answer to ``STAT?``.

    Raises
    ------
    ValueError
        It is none.
    """
    if not (match := _STATUS.fullmatch(text)):
        raise ValueError(f"{text!r} is not a status")
    exposed = None if match[4] == "-" else int(match[4])
    return Status(match[1], int(match[2]), int(match[3]), exposed, int(match[5]), int(match[6]), int(match[7]))


def limits(text: str) -> dict[str, tuple[int, int]]:
    """Read the answer to ``CAP?``: least and most of ``n``, ``period``, ``width`` and ``delay``.

    Raises
    ------
    ValueError
        It is none.
    """
    ranges = {name: (int(least), int(most)) for name, least, most in _RANGE.findall(text)}
    if not {"n", "period", "width", "delay"} <= ranges.keys():
        raise ValueError(f"{text!r} does not give all limits")
    return ranges
