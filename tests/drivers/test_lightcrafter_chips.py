"""The controllers of both chips: bytes as the manuals have them, limits, and known traps that the emulators spring."""

import numpy as np
import pytest

from drivers import DeviceLostError, DeviceSettingError, ProtocolError
from drivers.lightcrafter import dlpc350, dlpc900
from drivers.lightcrafter.chip import InputSource, Leds, StoredPattern, VideoPatterns
from drivers.lightcrafter.dlpc350 import Dlpc350, PatternClock, PatternSource, PatternWord, Trigger
from drivers.lightcrafter.dlpc900 import Dlpc900, PatternEntry
from drivers.lightcrafter.transport import RefusedCommandError, UsbTransport
from sim_backend.clock import VirtualClock
from sim_backend.lightcrafter import EmulatedDlpc350, EmulatedDlpc900, EmulatedUsb, VideoSource

SIZE = (64, 32)
WHITE = Leds.RED | Leds.GREEN | Leds.BLUE


class Rig:
    """A controller on its emulator."""

    def __init__(self, kind, *, gap_s=None, video=False, **more):
        self.clock = VirtualClock()
        self.source = VideoSource(SIZE, 60.0, self.clock) if video else None
        emulator, product = (EmulatedDlpc350, 0x6401) if kind is Dlpc350 else (EmulatedDlpc900, 0xC900)
        self.emulator = emulator(self.clock, SIZE, video=self.source, **more)
        gap_s = (dlpc350.COMMAND_GAP_S if kind is Dlpc350 else 0.0) if gap_s is None else gap_s
        link = UsbTransport("projector", product, None, self.clock, EmulatedUsb(self.emulator), gap_s)
        link.open()
        self.chip = kind(link, self.clock)
        if video:
            self.source.connect(True)
            self.clock.sleep(1.0)

    def wrote(self, command):
        return [data.hex(" ") for code, data in self.emulator.commands if code == command]


# DLPC900


def test_the_manual_s_pattern_entries():
    # DLPU018J, pattern on-the-fly example: 200 µs red 1-bit, 400 µs green 2-bit at bit position 1.
    assert PatternEntry(200, 1, Leds.RED).encoded(0).hex(" ") == "00 00 c8 00 00 11 00 00 00 00 00 00"
    assert PatternEntry(400, 2, Leds.GREEN, position=1).encoded(1).hex(" ") == "01 00 90 01 00 23 00 00 00 00 00 08"


def test_other_bits_of_a_pattern_entry():
    entry = PatternEntry(
        0x010203, 8, WHITE, image=17, position=16, dark_us=0x040506, wait_for_trigger=True, clear=False,
        trigger_out_2=False,
    )  # fmt: skip
    # bit 0 clear, 3:1 depth - 1, 6:4 LEDs, 7 wait; byte 9 bit 0 switches TRIG_OUT_2 off; 17 | 16 << 11 = 0x8011.
    assert entry.encoded(0x018F).hex(" ") == "8f 01 03 02 01 fe 06 05 04 01 11 80"


def test_the_manual_s_on_the_fly_example_goes_over_the_wire():
    rig = Rig(Dlpc900)
    rig.chip.enter(dlpc900.Mode.ON_THE_FLY)
    rig.emulator.commands.clear()
    rig.chip.define([PatternEntry(200, 1, Leds.RED), PatternEntry(400, 2, Leds.GREEN, position=1)])
    with pytest.raises(RefusedCommandError):
        rig.chip.load_image(0, bytes(6057))  # 6009 bytes and the header, but no image
    rig.chip.stop()
    commands = [(hex(code), data[:12].hex(" ")) for code, data in rig.emulator.commands if code != 0x1A2B]
    assert commands == [
        ("0x1a24", "00"),
        ("0x1a34", "00 00 c8 00 00 11 00 00 00 00 00 00"),
        ("0x1a34", "01 00 90 01 00 23 00 00 00 00 00 08"),
        ("0x1a31", "02 00 00 00 00 00"),
        ("0x1a2a", "00 00 a9 17 00 00"),
        ("0x1a24", "00"),
    ]
    packets = [data for code, data in rig.emulator.commands if code == 0x1A2B]
    assert [data[:2].hex(" ") for data in packets] == ["f8 01"] * 12 + ["09 00"]
    assert {len(data) for data in packets[:-1]} == {506}


def test_a_refusal_says_why():
    rig = Rig(Dlpc900)
    rig.chip.stop()
    with pytest.raises(RefusedCommandError, match=r"0x1A1B: a parameter is out of range \(error 6\)"):
        rig.chip.write(0x1A1B, b"\7")
    rig.emulator.faults.nack[0x1A24] = 14
    with pytest.raises(RefusedCommandError, match=r"0x1A24: Invalid exposure \(error 14\)") as caught:
        rig.chip.stop()  # with the projector's own words
    assert caught.value.code == 14
    with pytest.raises(RefusedCommandError, match=r"no such command \(error 3\)"):
        rig.chip.read(0x7777)


def test_a_running_sequence_forbids_the_mode_and_the_controller_stops_it():
    rig = Rig(Dlpc900)  # switched on, it shows its splash pattern
    with pytest.raises(RefusedCommandError, match="error 5"):
        rig.chip.write(0x1A1B, bytes((dlpc900.Mode.ON_THE_FLY,)))
    rig.chip.enter(dlpc900.Mode.ON_THE_FLY)
    assert rig.chip.mode() == dlpc900.Mode.ON_THE_FLY
    assert not rig.chip.status().running  # the new mode began with a sequence of its own


def test_video_pattern_mode_is_reached_by_way_of_locked_video_only():
    rig = Rig(Dlpc900)
    rig.chip.stop()
    with pytest.raises(RefusedCommandError, match="error 5"):
        rig.chip.write(0x1A1B, bytes((dlpc900.Mode.VIDEO_PATTERN,)))
    with pytest.raises(ProtocolError, match="not locked"):
        rig.chip.enter(dlpc900.Mode.VIDEO_PATTERN)
    rig = Rig(Dlpc900, video=True)
    begun = rig.clock.now()
    rig.chip.enter(dlpc900.Mode.VIDEO_PATTERN)
    assert rig.clock.now() - begun >= 0.3
    assert rig.chip.mode() == dlpc900.Mode.VIDEO_PATTERN


def test_a_table_takes_effect_after_its_configuration_only():
    rig = Rig(Dlpc900)
    rig.chip.enter(dlpc900.Mode.STORED)
    rig.emulator._flash = [rig.emulator.surface().astype("uint32")]
    rig.chip.define([PatternEntry(200, 1, WHITE)])
    rig.chip.start(endless=True)
    rig.chip.stop()
    rig.chip.write(0x1A34, PatternEntry(300, 1, WHITE).encoded(0))
    with pytest.raises(RefusedCommandError, match="error 5"):
        rig.chip.start(endless=True)
    rig.chip.configure(1, 0)
    rig.chip.start(endless=True)


@pytest.mark.parametrize(("bits", "shortest"), [(1, 105), (4, 823), (8, 4046)])
def test_dlpc900_exposures_are_refused_before_sending(bits, shortest):
    rig = Rig(Dlpc900)
    rig.chip.enter(dlpc900.Mode.ON_THE_FLY)
    rig.emulator.commands.clear()
    for wrong in (shortest - 1, 1 << 24):
        with pytest.raises(DeviceSettingError, match=f"{bits} bits cannot be exposed for {wrong} µs") as caught:
            rig.chip.define([PatternEntry(wrong, bits, WHITE)])
        assert f"{shortest} … 16777215 µs" in caught.value.remedy
    with pytest.raises(DeviceSettingError, match="401 patterns do not fit into its table of 400"):
        rig.chip.define([PatternEntry(5000, bits, WHITE)] * 401)
    with pytest.raises(DeviceSettingError, match="is no dark time"):
        rig.chip.define([PatternEntry(5000, bits, WHITE, dark_us=1 << 24)])
    assert not rig.emulator.commands
    rig.chip.define([PatternEntry(shortest, bits, WHITE)])
    # The chip itself refuses the same.
    with pytest.raises(RefusedCommandError, match="error 14"):
        rig.chip.write(0x1A34, PatternEntry(shortest - 1, bits, WHITE).encoded(0))


def test_patterns_of_a_video_frame_leave_room_for_the_black_before_the_next():
    rig = Rig(Dlpc900, video=True)
    fits = VideoPatterns(3, 8, 5519, 0, WHITE)  # 3 × 5519 + 105 = 16662 of 16667 µs
    rig.chip.show_video(fits, 1 / 60)
    rig.chip.start(endless=True)
    with pytest.raises(DeviceSettingError, match="3 × 5521 µs and 105 µs of black") as caught:
        rig.chip.show_video(VideoPatterns(3, 8, 5521, 0, WHITE), 1 / 60)
    assert "exposure_us + dark_us to 5520 µs at most" in caught.value.remedy
    assert rig.wrote(0x1A34)[0].split()[5] == "ff"  # clear, 8 bits, white, waits for VSYNC
    assert [entry.split()[5] for entry in rig.wrote(0x1A34)[1:]] == ["7f", "7f"]
    assert [entry.split()[-1] for entry in rig.wrote(0x1A34)] == ["00", "40", "80"]  # planes 0, 8 and 16


def test_dlpc900_trigger_outputs():
    rig = Rig(Dlpc900)
    rig.chip.set_trigger_out(1, inverted=True, rising_us=-20, falling_us=20_000)
    rig.chip.set_trigger_out(2, inverted=False, rising_us=5, falling_us=0)
    assert rig.wrote(0x1A1D) == ["01 ec ff 20 4e"]
    assert rig.wrote(0x1A1E) == ["00 05 00 00 00"]
    with pytest.raises(DeviceSettingError, match="TRIG_OUT_1 cannot be delayed by -21 and 0 µs"):
        rig.chip.set_trigger_out(1, inverted=False, rising_us=-21, falling_us=0)
    with pytest.raises(RefusedCommandError, match="error 13"):
        rig.chip.write(0x1A1D, bytes((0, 0xEB, 0xFF, 0, 0)))
    rig.chip.set_trigger_in(delay_us=104, falling=True)
    assert rig.wrote(0x1A35) == ["68 00 01"]
    with pytest.raises(DeviceSettingError, match="104 … 65 535"):
        rig.chip.set_trigger_in(delay_us=103, falling=True)


# DLPC350


def test_pattern_words_of_the_dlpc350():
    # b1:0 trigger, b7:2 number, b11:8 depth, b14:12 LEDs, b16 invert, b17 black, b18 swap, b19 shared.
    assert PatternWord(Trigger.EXTERNAL_RISING, 0, 8, Leds.GREEN).encoded().hex(" ") == "01 28 00"
    assert PatternWord(Trigger.NONE, 23, 1, WHITE, swap_buffer=True).encoded().hex(" ") == "5f 71 04"
    assert (
        PatternWord(Trigger.INTERNAL, 24, 1, Leds.BLUE, invert=True, insert_black=True, share_trigger=True)
        .encoded()
        .hex(" ")
        == "60 41 0b"
    )


def video(rig, **more):
    rig.chip.show_video(VideoPatterns(**{"per_frame": 1, "bit_depth": 8, "exposure_us": 16666} | more), 1 / 60)


def test_the_recipe_for_patterns_over_hdmi():
    rig = Rig(Dlpc350, video=True)
    rig.emulator.commands.clear()
    video(rig, per_frame=3, bit_depth=7, exposure_us=5000, dark_us=0, leds=WHITE)
    commands = [(hex(code), data.hex(" ")) for code, data in rig.emulator.commands]
    begin = commands.index(("0x1a22", "00"))
    assert commands[begin:] == [
        ("0x1a22", "00"),  # from video
        ("0x1a31", "02 01 02 00"),  # three, again and again
        ("0x1a23", "00"),  # VSYNC
        ("0x1a29", "88 13 00 00 88 13 00 00"),  # 5000 µs each
        ("0x1a33", "02"),
        ("0x1a32", "00"),
        ("0x1a34", "01 77 00 07 77 00 0b 77 00"),  # green waits for VSYNC, red and blue go on
        ("0x1a33", "00"),
        ("0x1a1a", "00"),
    ]
    rig.chip.start(endless=True)
    assert rig.chip.status().running


def test_the_first_start_after_video_mode_is_ignored_and_made_again():
    rig = Rig(Dlpc350, video=True)
    video(rig, dark_us=0, leds=WHITE)
    rig.chip.write(0x1A24, b"\2")
    assert not rig.chip.status().running  # the trap
    rig = Rig(Dlpc350, video=True)
    video(rig, dark_us=0, leds=WHITE)
    rig.chip.start(endless=True)
    assert rig.chip.status().running
    assert rig.wrote(0x1A24)[-2:] == ["02", "02"]


def test_a_sequence_that_does_not_start_is_told():
    rig = Rig(Dlpc350, video=True)
    rig.chip.enter(dlpc350.Mode.PATTERN)  # nothing was validated
    with pytest.raises(ProtocolError, match="the pattern sequence does not start"):
        rig.chip.start(endless=True)


def test_a_test_pattern_as_input_does_not_throw_it_off_the_usb():
    rig = Rig(Dlpc350)
    rig.chip.enter(dlpc350.Mode.PATTERN)
    rig.chip.select_input(InputSource.TEST_PATTERN)
    rig.chip.enter(dlpc350.Mode.VIDEO)
    assert rig.emulator.plugged
    rig.chip.enter(dlpc350.Mode.PATTERN)
    rig.chip.select_input(InputSource.TEST_PATTERN)
    with pytest.raises(DeviceLostError):
        rig.chip.write(0x1A1B, bytes((dlpc350.Mode.VIDEO,)))  # the trap
    assert not rig.emulator.plugged


def test_commands_in_quick_succession_are_lost_and_so_are_not_sent():
    hasty = Rig(Dlpc350, gap_s=0.0)
    hasty.chip.stop()
    with pytest.raises(RefusedCommandError):
        hasty.chip.stop()
    patient = Rig(Dlpc350)
    for _ in range(3):
        patient.chip.stop()


def test_exactly_two_images_are_sent_the_other_way_round():
    rig = Rig(Dlpc350, flash=[rig_image(value) for value in (1, 2, 3)])
    rig.chip.enter(dlpc350.Mode.PATTERN)
    patterns = [StoredPattern(image, 0, 8) for image in (0, 2)]
    rig.chip.show_stored(patterns, 250_000, 0, WHITE, 0)
    assert rig.wrote(0x1A34)[-1] == "02 00"
    assert rig.emulator._image_order == [0, 2]
    rig.chip.show_stored([*patterns, StoredPattern(1, 0, 8)], 250_000, 0, WHITE, 0)
    assert rig.wrote(0x1A34)[-1] == "00 02 01"
    assert rig.emulator._image_order == [0, 2, 1]


def rig_image(value):
    return np.full(SIZE[::-1], value, np.uint32)


@pytest.mark.parametrize(("bits", "shortest"), [(1, 235), (7, 4500), (8, 8333)])
def test_dlpc350_exposures_are_refused_before_sending(bits, shortest):
    rig = Rig(Dlpc350)
    rig.chip.enter(dlpc350.Mode.PATTERN)
    rig.emulator.commands.clear()

    def define(exposure_us, period_us, patterns=1):
        words = [PatternWord(Trigger.INTERNAL, 0, bits, WHITE, swap_buffer=True)] * patterns
        return rig.chip.define(
            words, exposure_us, period_us, source=PatternSource.FLASH, clock=PatternClock.INTERNAL_OR_TRIGGER_IN,
            images=(0,), repeat=True,
        )  # fmt: skip

    with pytest.raises(DeviceSettingError, match=f"{bits} bits cannot be exposed for {shortest - 1} µs"):
        define(shortest - 1, shortest - 1)
    with pytest.raises(DeviceSettingError, match="229 µs of dark time after a pattern cannot be made") as caught:
        define(shortest, shortest + 229)
    assert "0, or to 230 µs" in caught.value.remedy
    with pytest.raises(DeviceSettingError, match="129 patterns do not fit into its table of 128"):
        define(shortest, shortest, patterns=129)
    assert not rig.emulator.commands
    assert define(shortest, shortest) == []
    assert define(shortest, shortest + 230) == []


def test_what_the_chip_finds_invalid_is_told():
    rig = Rig(Dlpc350)
    rig.chip.enter(dlpc350.Mode.PATTERN)
    word = PatternWord(Trigger.INTERNAL, 3, 8, WHITE)  # there are groups 0 to 2
    with pytest.raises(ProtocolError, match="finds the pattern table invalid: a pattern number is out of range"):
        rig.chip.define(
            [word], 9000, 9000, source=PatternSource.FLASH, clock=PatternClock.INTERNAL_OR_TRIGGER_IN, repeat=True
        )


def test_three_patterns_of_eight_bits_do_not_fit_into_a_sixtieth():
    rig = Rig(Dlpc350, video=True)
    with pytest.raises(DeviceSettingError, match="3 × 8333 µs do not fit into a video frame of 16667 µs") as caught:
        video(rig, per_frame=3, exposure_us=8333, dark_us=0, leds=WHITE)
    assert "5555 µs at most; 8 bits need 8333 µs" in caught.value.remedy
    with pytest.raises(DeviceSettingError, match="highest 5 bits of a channel") as caught:
        video(rig, bit_depth=5, dark_us=0, leds=WHITE)
    assert "8, 7, 4, 2, 1" in caught.value.remedy


def test_flash_images_that_cannot_be_loaded_in_time_are_refused():
    rig = Rig(Dlpc350, flash=[rig_image(0)] * 4)
    rig.chip.enter(dlpc350.Mode.PATTERN)
    patterns = [StoredPattern(number // 3, number % 3 * 8, 8) for number in range(9)]
    rig.chip.show_stored(patterns[:6], 10_000, 0, WHITE, 6)
    with pytest.raises(DeviceSettingError, match=r"3 images .* only 2 can be loaded before the sequence") as caught:
        rig.chip.show_stored(patterns, 10_000, 0, WHITE, 9)
    assert "66667 µs or more" in caught.value.remedy
    rig.chip.show_stored(patterns, 67_000, 0, WHITE, 9)


def test_dlpc350_trigger_outputs():
    rig = Rig(Dlpc350)
    rig.chip.set_trigger_out(1, inverted=False, rising_us=0, falling_us=2.787)
    rig.chip.set_trigger_out(2, inverted=True, rising_us=-20.05, falling_us=0)
    assert rig.wrote(0x1A1D) == ["00 bb d5"]  # 0xBB is no delay, 0xD5 2.787 µs
    assert rig.wrote(0x1A1E) == ["01 00"]
    with pytest.raises(DeviceSettingError, match=r"-20\.0 … 2\.7 µs"):
        rig.chip.set_trigger_out(1, inverted=False, rising_us=3, falling_us=0)
    rig.chip.set_trigger_in(delay_us=107.2, falling=False)
    assert rig.wrote(0x1A35) == ["e8 03 00 00"]


# both


@pytest.mark.parametrize("kind", [Dlpc350, Dlpc900])
def test_identity_and_status(kind):
    rig = Rig(kind)
    assert rig.chip.version() == "4.1.3"
    rig.chip.stop()
    status = rig.chip.status()
    assert (status.parked, status.running, bool(status.locked), status.faults) == (False, False, False, ())
    rig.chip.standby(True)
    assert rig.chip.status().parked
    rig.emulator._aborted = True
    assert rig.chip.status().faults == ("the sequencer gave up",)


@pytest.mark.parametrize("kind", [Dlpc350, Dlpc900])
def test_led_currents_go_the_right_way_round(kind):
    rig = Rig(kind)
    rig.chip.set_led_current(0, 100, 255)
    assert rig.wrote(0x0B01) == ["ff 9b 00"]  # this board's drivers are inverted
    rig.chip.write(0x1A05, b"\0")
    rig.chip.set_led_current(0, 100, 255)
    assert rig.wrote(0x0B01)[-1] == "00 64 ff"


@pytest.mark.parametrize("kind", [Dlpc350, Dlpc900])
def test_a_short_register_is_a_protocol_error(kind):
    rig = Rig(kind)
    rig.emulator._registers[0x0201] = b""
    with pytest.raises(ProtocolError, match="register 0x0201 has 0 bytes instead of 1"):
        rig.chip.read_exactly(0x0201, 1)
