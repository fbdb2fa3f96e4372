"""SLT1.md against its implementations: the emulator, the firmware's core in C, and the driver's parser."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from requirements import require
from slt_conversations import checked, conversations, crc8_bit_by_bit, hold
from slt_core_in_c import SltCoreInC

from drivers.trigger_box import slt_protocol
from sim_backend.trigger_box import SltBox
from sim_backend.trigger_box.slt import checksum

CONVERSATIONS = conversations()


class Recorded:
    """A box whose words and moves are kept."""

    def __init__(self, make: Callable[..., Any]) -> None:
        self.said: list[str] = []
        self.moved: list[tuple[int, str]] = []
        self._half = b""
        self._box = make(self._send, lambda level, t_us: self.moved.append((t_us, level or "FLOATING")))

    def __getattr__(self, name: str) -> Any:
        return getattr(self._box, name)

    def _send(self, data: bytes) -> None:
        *lines, self._half = (self._half + data).split(b"\n")
        self.said += [line.decode("ascii") for line in lines]


def test_specification_has_conversations():
    assert len(CONVERSATIONS) == 12
    assert sum(len(steps) for steps in CONVERSATIONS.values()) > 130


@pytest.mark.parametrize("host_checks", [False, True], ids=["plain", "with checksums"])
@pytest.mark.parametrize("title", CONVERSATIONS)
def test_emulator_holds_conversation(title, host_checks):
    hold(Recorded(SltBox), CONVERSATIONS[title], host_checks=host_checks)


@pytest.mark.parametrize("host_checks", [False, True], ids=["plain", "with checksums"])
@pytest.mark.parametrize("title", CONVERSATIONS)
def test_core_in_c_holds_conversation(title, host_checks):
    hold(Recorded(SltCoreInC), CONVERSATIONS[title], host_checks=host_checks)


def test_checksum_has_its_published_check_value():
    # CRC-8/SMBUS in the catalogue of parametrised CRC algorithms.
    for implementation in (crc8_bit_by_bit, slt_protocol.crc8, checksum):
        assert implementation(b"123456789") == 0xF4
        assert implementation(b"") == 0


def test_driver_reads_every_answer_of_the_specification():
    for steps in CONVERSATIONS.values():
        for step in steps:
            for line in filter(None, step.lines):
                message = slt_protocol.parse(checked(line).encode())
                words = line.split("*")[0]
                if isinstance(message, slt_protocol.Event):
                    assert f"!{message.kind} {message.text}" == words
                    continue
                assert (message.error is None) == (" OK " in f" {words}")
                number = step.argument.split()[0].lstrip("#") if step.argument.startswith("#") else None
                told = words.startswith("#")
                assert message.number == (int(number) if told else None)
                if message.error is not None:
                    assert words.endswith(f"ERR {message.error} {message.text}")
                elif "STAT?" in step.argument:
                    status = slt_protocol.status(message.text)
                    fields = dict(part.split("=") for part in message.text.split(",")[1:])
                    assert f"{status.sent}/{status.owed}" == fields["sent"]
                    assert [status.edges, status.missed, status.t_us] == [
                        int(fields[name]) for name in ("edges", "missed", "t")
                    ]
                    assert ("-" if status.exposed is None else str(status.exposed)) == fields["in"]


def test_driver_writes_commands_as_the_specification_does():
    assert slt_protocol.command(1, "*IDN?") == b"#1 *IDN?*54\n"
    for number, body in ((2, "CAP?"), (65535, "TRAIN 48 16667 100 0"), (7, "GO")):
        assert slt_protocol.command(number, body) == checked(f"#{number} {body}").encode() + b"\n"


@pytest.mark.parametrize(
    "line",
    [b"", b"OK IDLE", b"OK IDLE*F2", b"OK IDLE*f1", b"\xff\x00", b"#1 OK*50", b"HELLO*35", b"#1 ERR x*0B"],
)
def test_driver_refuses_what_is_no_line(line):
    with pytest.raises(ValueError, match=r"checksum|neither|error without"):
        slt_protocol.parse(line)


@pytest.mark.parametrize("flipped_bit", range(8))
def test_any_flipped_bit_is_seen(flipped_bit):
    line = checked("#12 OK ARMED,sent=3/4,in=3,edges=3,missed=0,t=4500").encode()
    for position in range(len(line)):
        damaged = bytearray(line)
        damaged[position] ^= 1 << flipped_bit
        with pytest.raises(ValueError, match=r"checksum|neither|decode"):
            slt_protocol.parse(bytes(damaged))


def test_events_that_do_not_fit_are_counted():
    """A board that cannot send while an interrupt storm lasts keeps 16 events and tells how many it has lost."""
    box = Recorded(SltCoreInC)
    box.reset(0)
    box.receive(b"CFG OUT0 HIGH IN0 HIGH EVENTS ON\nTRAIN 1 1000 100 0\nARM\n", 0)
    box.said.clear()
    library, raw = box._library, box._box._box
    for k in range(20):
        library.slt_exposure(raw, 1, 10 * k)
        library.slt_exposure(raw, 0, 10 * k + 5)
    library.slt_poll(raw)
    assert box.said == [checked(f"!EDGE IN0 {k + 1} {10 * k}") for k in range(16)] + [checked("!LOST 4")]


COMMANDS = st.one_of(
    st.sampled_from(
        [
            "*IDN?",
            "CAP?",
            "STAT?",
            "GO",
            "STOP",
            "ARM",
            "ARM EXT0 RISING",
            "ARM EXT0 FALLING",
            "ARM EXT0 CHANGE",
            "CFG OUT0 HIGH IN0 HIGH EVENTS ON",
            "CFG OUT0 LOW IN0 LOW",
            "CFG OUT0 HIGH EVENTS ON",
        ]
    ),
    st.builds(
        "TRAIN {} {} {} {}".format, st.integers(0, 5), st.integers(15, 400), st.integers(0, 300), st.integers(0, 500)
    ),
    st.text(alphabet="#0123 GOARMCFG*?\r\x00é", max_size=100),
)
ACTIONS = st.lists(
    st.one_of(
        st.tuples(st.just("command"), COMMANDS, st.sampled_from(["", "#1 ", "#2 "])),
        st.tuples(st.just("wait"), st.integers(1, 700)),
        st.tuples(st.just("edge"), st.booleans()),
        st.tuples(st.just("exposure"), st.sampled_from(["HIGH", "LOW"])),
    ),
    min_size=5,
    max_size=60,
)
READY = [
    ("command", "CFG OUT0 HIGH IN0 HIGH EVENTS ON", ""),
    ("command", "TRAIN 3 200 50 20", ""),
    ("command", "ARM EXT0 CHANGE", ""),
]


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(actions=ACTIONS, ready=st.booleans(), begin=st.sampled_from([0, (1 << 32) - 900]))
def test_both_implementations_do_the_same_whatever_comes(actions, ready, begin):
    """The same bytes and edges at the same times, to the specification in Python and to the firmware's core in C."""
    require(shutil.which("cc"), "needs a C compiler: apt install gcc")
    boxes = Recorded(SltBox), Recorded(SltCoreInC)
    for box in boxes:
        now = begin
        box.reset(now)
        for action, *arguments in (READY if ready else []) + actions:
            if action == "command":
                box.receive(f"{arguments[1]}{arguments[0]}\n".encode(), now % (1 << 32))
            elif action == "wait":
                then = now + arguments[0]
                while (due := box.wake_at_us) is not None and (then - due) % (1 << 32) < 1 << 31:
                    box.wake(due)
                box.wake(then % (1 << 32))
                now = then
            else:
                getattr(box, action)(arguments[0], now % (1 << 32))
    assert boxes[0].moved == boxes[1].moved
    # Events may come sooner or later between answers; the order among themselves and that of the answers is fixed.
    for events in (True, False):
        said = [[line for line in box.said if line.startswith("!") is events] for box in boxes]
        assert said[0] == said[1]
