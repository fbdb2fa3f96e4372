"""The conversations of SLT1.md, section 8: read from the text, held with any implementation of a box."""

from __future__ import annotations

import re
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

SPECIFICATION = Path(__file__).parents[1] / "drivers" / "trigger_box" / "SLT1.md"
_CHECKED = re.compile(r".*\*[0-9A-F]{2}", re.DOTALL)


class BoxUnderTest(Protocol):
    """`said` takes (line without its end), `moved` (time µs, level) of what the box does."""

    said: list[str]
    moved: list[tuple[int, str]]

    @property
    def wake_at_us(self) -> int | None: ...
    def reset(self, t_us: int) -> None: ...
    def receive(self, data: bytes, t_us: int) -> None: ...
    def edge(self, rising: bool, t_us: int) -> None: ...
    def exposure(self, level: Any, t_us: int) -> None: ...
    def wake(self, t_us: int) -> None: ...


@dataclass
class Step:
    """One thing done to a box, and what it is to answer."""

    action: str
    argument: str
    lines: list[str] = field(default_factory=list)
    moves: list[tuple[int, str]] = field(default_factory=list)


def conversations() -> dict[str, list[Step]]:
    """Heading → steps."""
    found = {}
    for title, body in re.findall(r"^### (.+?)\n.*?^```slt\n(.*?)^```", SPECIFICATION.read_text(), re.M | re.S):
        steps: list[Step] = []
        for line in body.splitlines():
            sign, argument = line[0], line[2:]
            if sign == "<":
                steps[-1].lines.append(argument)
            elif sign == "=":
                time, level = argument.split()
                steps[-1].moves.append((int(time), level))
            else:
                assert sign in "@>~%", line
                steps.append(Step(sign, argument))
        found[title] = steps
    return found


def crc8_bit_by_bit(text: bytes) -> int:
    """CRC-8, polynomial 0x07, as a division of polynomials over GF(2): independent of all implementations."""
    remainder = int.from_bytes(text, "big") << 8
    for bit in range(remainder.bit_length() - 1, 7, -1):
        if remainder >> bit & 1:
            remainder ^= 0x107 << (bit - 8)
    return remainder


def checked(line: str) -> str:
    return line if _CHECKED.fullmatch(line) else f"{line}*{crc8_bit_by_bit(line.encode()):02X}"


def hold(box: BoxUnderTest, steps: list[Step], *, host_checks: bool) -> None:
    """Hold a conversation with a box and compare all that it says and does.

    host_checks: put checksums on the commands that show none and are short enough.
    """
    now = 0
    box.reset(0)
    box.said.clear()
    box.moved.clear()
    for step in steps:
        if step.action == "@":
            then = int(step.argument) % (1 << 32)
            while (due := box.wake_at_us) is not None and (then - due) % (1 << 32) < 1 << 31:
                box.wake(due)
            box.wake(then)
            now = then
        elif step.action == ">":
            line = checked(step.argument) if host_checks and len(step.argument) < 90 else step.argument
            box.receive(line.encode() + (b"\r\n" if host_checks else b"\n"), now)
        elif step.action == "~":
            name, level = step.argument.split()
            if name == "EXT0":
                box.edge(level == "HIGH", now)
            else:
                assert name == "IN0"
                box.exposure(level, now)
        else:
            assert step.argument == "reset"
            now = 0
            box.reset(0)
        where = f"{step.action} {step.argument}"
        assert box.said == [checked(line) if line else "" for line in step.lines], where
        assert box.moved == step.moves, where
        box.said.clear()
        box.moved.clear()
