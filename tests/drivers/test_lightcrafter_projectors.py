"""LightCrafter projectors on their emulators: what is on the surface and when, trigger pulses, faults and recovery."""

import re
import threading

import numpy as np
import PIL.Image
import pytest
from pydantic import ValidationError

from drivers import (
    DeviceLostError,
    DeviceNotFoundError,
    DeviceSettingError,
    DeviceState,
    FrameFormat,
    FrameStamp,
    Lifecycle,
    ProtocolError,
    SequenceFaultError,
    StreamedBench,
)
from drivers.lightcrafter import (
    LightCrafter4500Settings,
    LightCrafter6500Settings,
    LightCrafter9000Settings,
    make_lightcrafter,
)
from drivers.lightcrafter.chip import Leds, VideoPatterns
from drivers.lightcrafter.dlpc900 import Mode
from drivers.window.settings import WindowSettings
from sim_backend.clock import VirtualClock
from sim_backend.lightcrafter import EmulatedDlpc350, EmulatedDlpc900, EmulatedUsb, SimulatedScreen, VideoSource

SIZE = (96, 40)
REPORT_S = 125e-6


class Small6500(LightCrafter6500Settings):
    """Fewer mirrors than the real one, for speed."""

    @property
    def size(self):
        return SIZE


class Small4500(LightCrafter4500Settings):
    @property
    def size(self):
        return SIZE


def noise(count, seed=0, size=SIZE):
    return list(np.random.default_rng(seed).integers(0, 256, (count, size[1], size[0]), np.uint8))


class Rig:
    """A projector, configured, on its emulator."""

    def __init__(self, settings, *, flash=(), refresh_hz=60.0, configure=True):
        self.clock = VirtualClock()
        self.edges = []
        more = {"flash": flash, "report_s": REPORT_S, "on_edge": lambda *edge: self.edges.append(edge)}
        self.source = screen = None
        if settings.mode.startswith("video"):
            self.source = VideoSource(settings.size, refresh_hz, self.clock)
            screen = SimulatedScreen(self.source, self.clock)
        kind = EmulatedDlpc350 if settings.driver == "lightcrafter4500" else EmulatedDlpc900
        self.emulator = kind(self.clock, settings.size, video=self.source, **more)
        self.usb = EmulatedUsb(self.emulator)
        self.projector = make_lightcrafter(settings, self.clock, screen=screen, backend=self.usb)
        self.screen = screen
        if configure:
            self.projector.open()
            self.projector.configure()
            # Switched on and changing modes, the chip shows a splash pattern, pulses included.
            self.emulator.advance()
            self.edges.clear()

    def pulses(self, output):
        self.emulator.advance()
        return [at for number, rising, at in self.edges if number == output and rising]

    def wrote(self, *commands):
        return [(code, data) for code, data in self.emulator.commands if code in commands]

    def recover(self):
        self.projector.close()
        self.projector.open()
        self.projector.configure()


def on_the_fly(**more):
    return Rig(Small6500(**{"exposure_us": 5000} | more))


def video_pattern(settings=Small4500, refresh_hz=60.0, **more):
    window = WindowSettings(width_px=SIZE[0], height_px=SIZE[1])
    return Rig(settings(**{"mode": "video_pattern", "window": window} | more), refresh_hz=refresh_hz)


# On the fly


@pytest.mark.parametrize(("exposure_us", "dark_us"), [(5000, 0), (5000, 1200)])
def test_a_played_sequence_is_on_the_surface_pattern_by_pattern(exposure_us, dark_us):
    rig = on_the_fly(exposure_us=exposure_us, dark_us=dark_us)
    pictures = noise(7)
    rig.projector.load(pictures)
    rig.projector.play()
    record = rig.projector.finish(1.0)
    begins = rig.pulses(2)
    assert len(begins) == 7
    assert np.diff(begins) == pytest.approx((exposure_us + dark_us) * 1e-6)
    assert np.abs(np.subtract(record.shown_s, begins)).max() < 2e-3
    for begin, picture in zip(begins, pictures, strict=True):
        for share in (0.01, 0.5, 0.99):
            assert np.array_equal(rig.emulator.surface(begin + share * exposure_us * 1e-6), picture)
        if dark_us:
            assert not rig.emulator.surface(begin + (exposure_us + dark_us / 2) * 1e-6).any()
    assert record.late == ()


def test_trigger_output_1_frames_each_exposure_and_delays_shift_both():
    trigger = {"rising_delay_us": 200, "falling_delay_us": -20, "inverted": True}
    rig = on_the_fly(dark_us=1000, trigger_out_1=trigger, trigger_out_2={"rising_delay_us": 50})
    rig.projector.load(noise(3))
    rig.emulator.advance()
    rig.edges.clear()
    rig.projector.play()
    rig.projector.finish(1.0)
    begins = np.array([at for output, rising, at in rig.edges if (output, rising) == (2, True)]) - 50e-6
    ones = [(rising, at) for output, rising, at in rig.edges if output == 1]
    assert [at for rising, at in ones if rising] == pytest.approx(begins + 200e-6)
    assert [at for rising, at in ones if not rising] == pytest.approx(begins + 5000e-6 - 20e-6)
    assert rig.emulator._sequencer.inverted == {1: True, 2: False}


def test_no_camera_pulse_comes_but_from_played_patterns():
    rig = on_the_fly()
    rig.projector.load(noise(3))
    rig.clock.sleep(0.5)
    rig.projector.darken()
    rig.clock.sleep(0.5)
    assert rig.pulses(2) == []
    for plays in (1, 2):
        rig.projector.play()
        rig.projector.finish(1.0)
        rig.projector.darken()
        rig.clock.sleep(0.5)
        assert len(rig.pulses(2)) == 3 * plays


@pytest.mark.parametrize("bits", range(1, 9))
def test_every_bit_depth(bits):
    rig = on_the_fly(bit_depth=bits)
    levels = (1 << bits) - 1
    pictures = [np.where(picture > 127, 255, 0).astype(np.uint8) if bits == 1 else picture for picture in noise(30)]
    rig.projector.load(pictures)
    for index in (0, 11, 29):
        rig.projector.show(index)
        rig.clock.sleep(0.001)
        expected = np.rint(np.rint(pictures[index] / 255 * levels) / levels * 255)
        assert np.array_equal(rig.emulator.surface(), expected)


def test_one_bit_refuses_grey():
    rig = on_the_fly(bit_depth=1)
    with pytest.raises(DeviceSettingError, match="picture 1 has grey values, but bit_depth is 1"):
        rig.projector.load([np.zeros(SIZE[::-1], np.uint8), *noise(1)])


def test_the_real_sizes_and_two_controllers():
    for settings, emulator_size in ((LightCrafter6500Settings, (1920, 1080)), (LightCrafter9000Settings, (2560, 1600))):
        rig = Rig(settings(exposure_us=5000))
        assert rig.projector.size == emulator_size
        width, height = emulator_size
        x, y = np.arange(width), np.arange(height)[:, None]
        pictures = [
            np.broadcast_to((x // 3 % 256).astype(np.uint8), (height, width)),
            np.broadcast_to((y // 5 % 256).astype(np.uint8), (height, width)),
            np.where((x > 300) & (x < 1500) & (y > 99), 200, 0).astype(np.uint8),
        ]
        rig.projector.load(pictures)
        for index in (2, 0, 1):
            rig.projector.show(index)
            rig.clock.sleep(0.001)
            assert np.array_equal(rig.emulator.surface(), pictures[index])
        secondary = bool(rig.wrote(0x1A2C))
        assert secondary == (settings is LightCrafter9000Settings)


@pytest.mark.parametrize("compression", ["enhanced_rle", "rle", "none"])
def test_every_compression_arrives(compression):
    rig = on_the_fly(compression=compression)
    bars = np.repeat(np.arange(0, 240, 6, dtype=np.uint8)[:, None], SIZE[0], 1)
    rig.projector.load([bars])
    rig.projector.show(0)
    rig.clock.sleep(0.001)
    assert np.array_equal(rig.emulator.surface(), bars)


def test_images_go_last_one_first_and_what_is_there_is_not_sent_again():
    rig = on_the_fly()
    pictures = noise(8)
    rig.projector.load(pictures)
    assert [data[0] for _, data in rig.wrote(0x1A2A)] == [2, 1, 0]
    rig.emulator.commands.clear()
    rig.projector.show(3)
    rig.projector.play()
    rig.projector.finish(1.0)
    rig.projector.load([picture.copy() for picture in pictures])
    assert rig.wrote(0x1A2A, 0x1A2B, 0x1A34) == []
    rig.projector.load(pictures[:7])
    assert len(rig.wrote(0x1A2A)) == 3
    # The same picture twice takes no more memory than once.
    rig.emulator.commands.clear()
    rig.projector.load(pictures[:2] * 100)
    assert len(rig.wrote(0x1A34)) == 201
    assert len(rig.wrote(0x1A2A)) == 1


def test_the_images_go_when_the_table_changes_and_the_driver_does_not_change_it():
    rig = on_the_fly()
    rig.projector.load(noise(3))
    chip = rig.projector._chip
    chip.stop()
    chip.configure(3, 3)  # one line less, as if black were not there
    with pytest.raises(ProtocolError, match=r"BMP image missing \(error 11\)"):
        chip.start(endless=True)


def test_images_in_the_wrong_order_are_refused_by_the_chip():
    rig = on_the_fly()
    rig.projector.load(noise(8))
    with pytest.raises(ProtocolError, match="error 5"):  # while it runs
        rig.projector._chip.load_image(0, bytes(100))
    rig.projector._chip.stop()
    with pytest.raises(ProtocolError, match="error 6"):
        rig.projector._chip.load_image(0, bytes(100))


def test_more_than_its_memory_holds_is_refused_and_the_loaded_ones_stay():
    rig = on_the_fly()
    rig.projector.load(noise(49))  # 49 × 8 planes of 400, and one for black
    for wrong in (noise(50), noise(1) * 400, []):
        with pytest.raises(DeviceSettingError, match="do not fit into its memory") as caught:
            rig.projector.load(wrong)
    assert "It holds 49 different ones of 8 bits and shows 1 to 399" in caught.value.remedy
    rig.projector.show(48)
    rig.clock.sleep(0.001)
    assert np.array_equal(rig.emulator.surface(), noise(49)[48])


@pytest.mark.parametrize(("driver", "bits"), [(6500, 1), (6500, 5), (6500, 7), (9000, 8), (9000, 6), (9000, 1)])
def test_a_full_memory_still_has_black(driver, bits):
    kind = LightCrafter6500Settings if driver == 6500 else LightCrafter9000Settings

    class Small(kind):
        @property
        def size(self):
            return (96, 40) if driver == 6500 else (2560, 1600)

    rig = Rig(Small(exposure_us=5000, bit_depth=bits), configure=False)
    capacity = rig.projector.capacity
    assert (
        capacity
        == {(6500, 1): 399, (6500, 5): 72, (6500, 7): 54, (9000, 8): 53, (9000, 6): 71, (9000, 1): 399}[driver, bits]
    )
    if driver == 6500:
        rig.projector.open()
        rig.projector.configure()
        rig.projector.load([np.where(picture > 127, 255, 0).astype(np.uint8) for picture in noise(capacity)])
        assert not rig.emulator.surface().any()


def test_an_exposure_that_cannot_be_made_is_refused_when_configured():
    rig = Rig(Small6500(exposure_us=4000), configure=False)
    rig.projector.open()
    with pytest.raises(DeviceSettingError, match="8 bits cannot be exposed for 4000 µs") as caught:
        rig.projector.configure()
    assert "4046 …" in caught.value.remedy
    rig.projector.close()


def test_flips_mirror_the_picture():
    rig = on_the_fly(flip_long_axis=True, flip_short_axis=True)
    (picture,) = noise(1)
    rig.projector.load([picture])
    rig.projector.show(0)
    rig.clock.sleep(0.001)
    assert np.array_equal(rig.emulator.surface(), picture[::-1, ::-1])


def test_only_the_chosen_leds_light():
    rig = on_the_fly(leds=("green", "blue"), led_current=(0, 10, 20))
    rig.projector.load(noise(1))
    (entry, black) = (data for _, data in rig.wrote(0x1A34))
    assert entry[5] >> 4 & 7 == 0b110
    assert black[5] >> 4 & 7 == 0
    assert rig.wrote(0x0B01)[0][1] == bytes((255, 245, 235))


def test_it_is_another_model():
    clock = VirtualClock()
    usb = EmulatedUsb(EmulatedDlpc900(clock, SIZE))
    projector = make_lightcrafter(LightCrafter9000Settings(), clock, backend=usb)
    with pytest.raises(DeviceSettingError, match="LightCrafter 9000: the projector on the USB is a LightCrafter 6500"):
        projector.open()
    assert projector.state is DeviceState.CLOSED
    assert not usb.claimed


# A camera on the trigger output


class TriggeredCamera:
    """Exposes at each pulse what is on the emulator's surface, as a camera with its trigger line on TRIG_OUT_2."""

    name = "camera"
    noise = None

    def __init__(self, rig, exposure_s):
        self.rig, self.exposure_s = rig, exposure_s
        self.life = Lifecycle(self.name)
        self.frames = 0
        self.taken = 0

    @property
    def state(self):
        return self.life.state

    def open(self):
        self.life.move("open")

    def configure(self):
        self.life.move("configure")
        return FrameFormat(*SIZE, 8)

    def arm(self):
        self.life.move("arm")
        self.taken = self.before = len(self.rig.pulses(2))

    def start(self):
        self.life.move("start")

    def stop(self):
        self.life.move("stop")

    def close(self):
        self.life.move("close")

    def describe(self):
        return {}

    def fetch(self, out, timeout_s):
        deadline = self.rig.clock.now() + timeout_s
        while len(pulses := self.rig.pulses(2)) <= self.taken or self.rig.clock.now() < pulses[self.taken]:
            self.rig.clock.sleep(0.5e-3)
            assert self.rig.clock.now() < deadline
        begin = pulses[self.taken]
        during = [self.rig.emulator.surface(begin + share * self.exposure_s) for share in np.linspace(0, 1, 5)]
        assert all(np.array_equal(during[0], other) for other in during)
        out[...] = during[0]
        self.taken += 1
        self.frames += 1
        return FrameStamp(self.frames, begin, self.rig.clock.now())


def test_from_patterns_to_frames_through_the_trigger_output():
    rig = Rig(Small6500(exposure_us=5000, dark_us=500), configure=False)
    camera = TriggeredCamera(rig, 0.0049)
    bench = StreamedBench("bench", camera, rig.projector, rig.clock, settle_s=0.0)
    with bench:
        for seed in range(3):
            pictures = noise(9, seed)
            bench.prepare(pictures)
            rig.clock.sleep(0.3)
            for index, picture in enumerate(pictures):
                frame = np.zeros(SIZE[::-1], np.uint8)
                bench.expose(index, frame)
                assert np.array_equal(frame, picture)
            bench.darken()
    assert camera.frames == len(rig.pulses(2)) - camera.before == 27
    assert rig.projector.state is DeviceState.CLOSED
    assert not rig.emulator.surface().any()
    assert not rig.usb.claimed


# Faults, on the fly


def test_pulled_out_while_it_plays_and_back_again():
    rig = on_the_fly()
    pictures = noise(5)
    rig.projector.load(pictures)
    rig.projector.play()
    rig.emulator.unplug()
    with pytest.raises(DeviceLostError, match="LightCrafter 6500: the USB connection broke") as caught:
        rig.projector.finish(1.0)
    assert "Check the projector's power and USB cable" in caught.value.remedy
    assert rig.projector.state is DeviceState.FAULT
    rig.projector.darken()  # there is nothing left to light, and nothing to complain about
    rig.projector.close()
    with pytest.raises(DeviceNotFoundError, match="no DLPC900"):
        rig.projector.open()
    assert rig.projector.state is DeviceState.CLOSED
    rig.emulator.plugged = True
    begun = rig.clock.now()
    rig.recover()
    rig.projector.load(pictures)
    rig.projector.play()
    assert len(rig.projector.finish(1.0).shown_s) == 5
    assert rig.clock.now() - begun < 1.0


@pytest.mark.parametrize("call", ["load", "show", "play", "darken", "finish"])
def test_hanging_it_is_lost_within_two_seconds(call):
    rig = on_the_fly()
    rig.projector.load(noise(2))
    if call == "finish":
        rig.projector.play()
    rig.emulator.faults.hang = True
    begun = rig.clock.now()
    arguments = {"load": (noise(3),), "show": (0,), "finish": (5.0,)}.get(call, ())
    with pytest.raises(DeviceLostError, match=r"no answer to command 0x1A\w\w within 2 s"):
        getattr(rig.projector, call)(*arguments)
    assert rig.clock.now() - begun < 2.1
    assert rig.projector.state is DeviceState.FAULT
    rig.projector.close()
    assert rig.projector.state is DeviceState.CLOSED
    assert not rig.usb.claimed
    rig.emulator.faults.hang = False
    rig.recover()
    rig.projector.load(noise(2))


@pytest.mark.parametrize("command", [0x1A34, 0x1A31, 0x1A2A, 0x1A2B, 0x1A24])
def test_a_refused_upload_is_begun_anew(command):
    rig = on_the_fly()
    pictures = noise(5)
    rig.emulator.faults.nack[command] = 8
    with pytest.raises(ProtocolError, match=rf"refused command 0x{command:04X}: out of resources \(error 8\)"):
        rig.projector.load(pictures)
    rig.projector.load(pictures)
    rig.projector.play()
    rig.projector.finish(1.0)
    for begin, picture in zip(rig.pulses(2), pictures, strict=True):
        assert np.array_equal(rig.emulator.surface(begin + 0.001), picture)


@pytest.mark.parametrize("fault", ["garbled", "misnumbered"])
def test_a_wrong_reply_in_an_upload_is_no_reason_to_trust_it(fault):
    rig = on_the_fly()
    pictures = noise(5)
    setattr(rig.emulator.faults, fault, 1)
    with pytest.raises(ProtocolError, match="answered command"):
        rig.projector.load(pictures)
    rig.emulator.commands.clear()
    rig.projector.load(pictures)
    assert len(rig.wrote(0x1A2A)) == 2
    rig.projector.show(4)
    rig.clock.sleep(0.001)
    assert np.array_equal(rig.emulator.surface(), pictures[4])


def test_brought_into_another_mode_it_is_told_and_comes_back():
    rig = on_the_fly()
    pictures = noise(4)
    rig.projector.load(pictures)
    rig.emulator.enter_mode(Mode.VIDEO)
    with pytest.raises(ProtocolError, match=r"Command not allowed in present mode \(error 5\)"):
        rig.projector.play()
    rig.projector.load(pictures)
    rig.projector.show(2)
    rig.clock.sleep(0.001)
    assert np.array_equal(rig.emulator.surface(), pictures[2])


def test_stopped_by_somebody_else_the_sequence_counts_as_broken_and_it_is_dark():
    rig = on_the_fly(exposure_us=50_000)
    rig.projector.load(noise(10))
    rig.projector.play()
    rig.clock.sleep(0.2)
    rig.emulator._sequencer.stop(rig.clock.now())
    with pytest.raises(SequenceFaultError, match=r"was not played: it stopped after 0\.2\d* s instead of 0\.500 s"):
        rig.projector.finish(2.0)
    assert rig.projector.state is DeviceState.ARMED
    rig.clock.sleep(0.001)
    assert not rig.emulator.surface().any()
    rig.projector.play()
    assert len(rig.projector.finish(2.0).shown_s) == 10


def test_an_error_of_the_sequencer_breaks_the_sequence():
    rig = on_the_fly()
    rig.projector.load(noise(3))
    rig.projector.play()
    rig.emulator._aborted = True
    with pytest.raises(SequenceFaultError, match="the sequencer gave up"):
        rig.projector.finish(1.0)


# Video patterns


@pytest.mark.parametrize("settings", [Small4500, Small6500])
def test_patterns_over_hdmi_are_shown_one_per_frame_with_a_pulse_each(settings):
    rig = video_pattern(settings)
    pictures = noise(6)
    rig.projector.load(pictures)
    rig.projector.play()
    record = rig.projector.finish(1.0)
    rig.clock.sleep(0.1)
    begins = rig.pulses(1)
    for shown, picture in zip(record.shown_s, pictures, strict=True):
        # The chip shows a frame one refresh after it was sent.
        (begin,) = (at for at in begins if abs(at - shown - 1 / 60) < 1e-6)
        for share in (0.01, 0.5, 0.97):
            assert np.array_equal(rig.emulator.surface(begin + share / 60), picture)
    assert rig.projector.period_s == pytest.approx(1 / 60)
    exposure_us = rig.projector.describe()["exposure_us"]
    assert exposure_us == (16_666 if settings is Small4500 else 16_561)  # 105 µs of black before VSYNC


def test_an_exposure_without_room_for_black_would_miss_every_other_frame_and_is_refused():
    # Why the driver refuses it: 105 µs of black follow the exposure (DLPU018J, LUT Configuration).
    rig = video_pattern(Small6500)
    chip = rig.projector._chip
    chip.show_video(rig_patterns(16_561), 1 / 60)
    rig.emulator.commands.clear()
    with pytest.raises(DeviceSettingError, match="do not fit into a video frame"):
        chip.show_video(rig_patterns(16_600), 1 / 60)
    assert not rig.emulator.commands
    chip.show_video(rig_patterns(16_600), 1.0)  # believing that frames take a second
    chip.start(endless=True)
    begun = rig.clock.now()
    rig.clock.sleep(1.0)
    assert len([at for at in rig.pulses(1) if begun < at < begun + 1.0]) == pytest.approx(30, abs=1)


def rig_patterns(exposure_us):
    return VideoPatterns(1, 8, exposure_us, 0, Leds.GREEN)


@pytest.mark.parametrize(("settings", "refresh_hz"), [(Small6500, 60.0), (Small4500, 40.0)])
def test_three_patterns_of_a_frame(settings, refresh_hz):
    rig = video_pattern(settings, refresh_hz, patterns_per_frame=3)
    pictures = noise(7)
    rig.projector.load(pictures)
    rig.projector.play()
    record = rig.projector.finish(1.0)
    rig.clock.sleep(0.1)
    assert len(record.shown_s) == 7
    begins = np.array(rig.pulses(1))
    for shown, picture in zip(record.shown_s, pictures, strict=True):
        nearest = begins[np.abs(begins - shown - 1 / refresh_hz).argmin()]
        assert nearest == pytest.approx(shown + 1 / refresh_hz, abs=1e-6)
        assert np.array_equal(rig.emulator.surface(nearest + 0.002), picture)
    # One by one, a picture is in all three patterns of every frame.
    rig.projector.show(5)
    rig.clock.sleep(2.5 / refresh_hz)
    for moment in np.arange(3) / refresh_hz / 3 + rig.clock.now():
        rig.clock.sleep_until(moment)
        assert np.array_equal(rig.emulator.surface(), pictures[5])
    rig.projector.play()
    assert len(rig.projector.finish(1.0).shown_s) == 7


def test_three_patterns_of_eight_bits_are_too_much_for_the_4500_at_60_hz():
    rig = Rig(
        Small4500(patterns_per_frame=3, window=WindowSettings(width_px=SIZE[0], height_px=SIZE[1])), configure=False
    )
    rig.projector.open()
    with pytest.raises(DeviceSettingError, match="8 bits cannot be exposed for 5555 µs") as caught:
        rig.projector.configure()
    assert "8333" in caught.value.remedy
    rig.projector.close()


@pytest.mark.parametrize("settings", [Small4500, Small6500])
@pytest.mark.parametrize("moment", ["load", "show", "play", "finish"])
def test_a_lost_video_signal_is_seen_and_the_sequence_can_be_repeated(settings, moment):
    rig = video_pattern(settings)
    pictures = noise(5)
    if moment != "load":
        rig.projector.load(pictures)
    if moment == "finish":
        rig.projector.play()
    rig.source.connect(False)
    rig.clock.sleep(0.01)
    calls = {
        "load": lambda: rig.projector.load(pictures),
        "show": lambda: rig.projector.show(1),
        "play": rig.projector.play,
        "finish": lambda: rig.projector.finish(1.0),
    }
    with pytest.raises((SequenceFaultError, ProtocolError), match="video input") as caught:
        calls[moment]()
    assert caught.value.repeatable
    assert "Check the video cable" in caught.value.remedy
    assert not rig.emulator.surface().any()
    rig.source.connect(True)
    begun = rig.clock.now()
    rig.projector.load(pictures)
    rig.projector.play()
    record = rig.projector.finish(1.0)
    assert rig.clock.now() - begun < 3.0
    rig.clock.sleep(0.1)
    for shown, picture in zip(record.shown_s, pictures, strict=True):
        assert np.array_equal(rig.emulator.surface(shown + 1.5 / 60), picture)


def test_a_signal_that_was_away_for_a_moment_is_seen_after_the_sequence():
    rig = video_pattern()
    rig.projector.load(noise(60))
    rig.projector.play()
    rig.clock.sleep(0.3)
    rig.source.connect(False)
    rig.clock.sleep(0.05)
    rig.projector._chip.status()  # time passes for the emulator when somebody talks to it
    rig.source.connect(True)
    with pytest.raises(SequenceFaultError, match="the sequencer gave up"):
        rig.projector.finish(2.0)
    assert rig.projector.state is DeviceState.ARMED


def test_brought_into_video_mode_the_video_patterns_are_told_missing():
    rig = video_pattern()
    rig.projector.load(noise(2))
    rig.emulator.enter_mode(0)
    with pytest.raises(SequenceFaultError, match="it does not show video patterns any more"):
        rig.projector.show(0)
    rig.projector.load(noise(2))
    rig.projector.show(1)
    rig.clock.sleep(0.1)
    assert np.array_equal(rig.emulator.surface(), noise(2)[1])


def test_no_video_at_all_is_told_when_configured():
    rig = Rig(Small4500(window=WindowSettings(width_px=SIZE[0], height_px=SIZE[1])), configure=False)
    rig.projector.open()
    rig.source.connect(False)
    with pytest.raises(ProtocolError, match="the video input is not locked to a source") as caught:
        rig.projector.configure()
    assert "projector's own size" in caught.value.remedy
    rig.projector.close()
    assert rig.screen.state is DeviceState.CLOSED


def test_lost_usb_takes_the_screen_along_and_comes_back():
    rig = video_pattern()
    rig.projector.load(noise(2))
    rig.emulator.unplug()
    with pytest.raises(DeviceLostError):
        rig.projector.show(0)
    assert rig.projector.state is DeviceState.FAULT
    rig.projector.darken()
    rig.projector.close()
    assert rig.screen.state is DeviceState.CLOSED
    rig.emulator.plugged = True
    rig.recover()
    rig.projector.load(noise(2))
    rig.projector.show(1)
    rig.clock.sleep(0.1)
    assert np.array_equal(rig.emulator.surface(), noise(2)[1])


def test_plain_video_mode_is_a_display():
    window = WindowSettings(width_px=SIZE[0], height_px=SIZE[1])
    rig = Rig(Small4500(mode="video", window=window))
    pictures = noise(3)
    rig.projector.load(pictures)
    rig.projector.show(2)
    rig.clock.sleep(0.1)
    assert np.array_equal(rig.emulator.surface(), pictures[2])
    rig.projector.play()
    rig.projector.finish(1.0)
    rig.projector.darken()
    rig.clock.sleep(0.1)
    assert not rig.emulator.surface().any()
    rig.projector.close()


# Patterns of the flash memory


@pytest.fixture
def flash(tmp_path):
    """Pictures in the memory, packed by hand, and what the settings say of them; the last one is black."""
    pictures = [*noise(5), np.zeros(SIZE[::-1], np.uint8)]
    images = [
        sum(picture.astype(np.uint32) << 8 * n for n, picture in enumerate(pictures[3 * image : 3 * image + 3]))
        for image in range(2)
    ]
    stored = []
    for number, picture in enumerate(pictures):
        file = tmp_path / f"{number}.png"
        PIL.Image.fromarray(picture).save(file)
        stored.append({"file": file, "image": number // 3, "first_bit": number % 3 * 8})
    return pictures, images, stored


@pytest.mark.parametrize("settings", [Small4500, Small6500])
def test_stored_pictures_are_found_by_their_contents(settings, flash):
    pictures, images, stored = flash
    rig = Rig(settings(mode="prestored", stored=stored, exposure_us=10_000), flash=images)
    order = [1, 0, 4, 3]
    rig.projector.load([pictures[number] for number in order])
    assert not rig.emulator.surface().any()
    rig.projector.show(2)
    rig.clock.sleep(0.001)
    assert np.array_equal(rig.emulator.surface(), pictures[4])
    rig.projector.darken()
    rig.clock.sleep(0.001)
    assert not rig.emulator.surface().any()
    rig.emulator.advance()
    rig.edges.clear()
    rig.clock.sleep(0.3)
    rig.projector.play()
    rig.projector.finish(1.0)
    rig.clock.sleep(0.3)
    rig.projector.darken()
    rig.clock.sleep(0.3)
    # The output for a camera: one pulse per pattern on the 6500, and nothing pulses in the dark.
    begins = rig.pulses(2 if settings is Small6500 else 1)
    assert len(begins) == 4
    for begin, number in zip(begins, order, strict=True):
        assert np.array_equal(rig.emulator.surface(begin + 0.005), pictures[number])
    rig.projector.close()
    assert not rig.usb.claimed


@pytest.mark.parametrize("settings", [Small4500, Small6500])
def test_pictures_that_are_not_stored_are_refused(settings, flash):
    pictures, images, stored = flash
    rig = Rig(settings(mode="prestored", stored=stored, exposure_us=10_000), flash=images)
    other = noise(3, seed=9)
    with pytest.raises(DeviceSettingError, match="2 of 3 pictures are not in its flash memory, picture 1, 2 among"):
        rig.projector.load([pictures[0], *other[:2]])


def test_an_image_that_the_memory_does_not_hold_is_refused(flash):
    _, images, stored = flash
    rig = Rig(Small4500(mode="prestored", stored=stored, exposure_us=10_000), flash=images[:1], configure=False)
    rig.projector.open()
    with pytest.raises(DeviceSettingError, match="holds 1 images, from 0 to 0; not number 1"):
        rig.projector.configure()
    # The DLPC900 does not tell how many it has; it refuses when it is to show one.
    rig = Rig(Small6500(mode="prestored", stored=stored, exposure_us=10_000), flash=images[:1])
    with pytest.raises(ProtocolError, match=r"BMP image missing \(error 11\)"):
        rig.projector.load([np.zeros(SIZE[::-1], np.uint8)])


def test_a_stored_picture_of_another_size_is_refused(flash, tmp_path):
    pictures, images, stored = flash
    PIL.Image.fromarray(pictures[0][:-1]).save(tmp_path / "0.png")
    rig = Rig(Small4500(mode="prestored", stored=stored, exposure_us=10_000), flash=images, configure=False)
    rig.projector.open()
    with pytest.raises(DeviceSettingError, match=re.escape("picture 0 is uint8 (39, 96)")):
        rig.projector.configure()
    (tmp_path / "0.png").unlink()
    rig.projector.close()
    rig.projector.open()
    with pytest.raises(DeviceSettingError, match=r"0\.png cannot be read"):
        rig.projector.configure()


# Settings


@pytest.mark.parametrize(
    ("kind", "settings", "text"),
    [
        (LightCrafter4500Settings, {}, "there is no window"),
        (LightCrafter4500Settings, {"mode": "on_the_fly"}, "video_pattern"),
        (LightCrafter6500Settings, {"mode": "prestored"}, "no stored pictures are named"),
        (
            LightCrafter4500Settings,
            {"window": {"width_px": 1280, "height_px": 800}},
            "the window is 1280 × 800 px.*912 × 1140",
        ),
        (
            LightCrafter4500Settings,
            {"window": {"width_px": 912, "height_px": 1140, "hold": 2}},
            "need every frame",
        ),
        (
            LightCrafter6500Settings,
            {"mode": "prestored", "stored": [{"file": "a.png", "image": 0, "first_bit": 4}]},
            "a 8-bit pattern does not begin at bit 4",
        ),
        (LightCrafter6500Settings, {"led_current": (0, 0, 256)}, "less than or equal to 255"),
        (LightCrafter6500Settings, {"leds": ()}, "at least 1 item"),
    ],
)
def test_settings_that_do_not_go_together_are_refused(kind, settings, text):
    with pytest.raises(ValidationError, match=text):
        kind.model_validate(settings)


def test_the_window_of_the_settings_is_the_screen():
    settings = LightCrafter4500Settings(window=WindowSettings(width_px=912, height_px=1140))
    projector = make_lightcrafter(settings, VirtualClock(), backend=EmulatedUsb())
    assert projector.describe()["screen"]["name"] == "projector window"


def test_no_thread_is_left():
    before = threading.active_count()
    rig = on_the_fly()
    rig.projector.load(noise(2))
    rig.projector.close()
    assert threading.active_count() == before
