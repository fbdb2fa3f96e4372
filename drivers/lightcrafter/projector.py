"""What all LightCrafter projectors share: the connection, the settings that every mode takes, the state."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from drivers.devices import Clock, DeviceState, Lifecycle, PlayRecord
from drivers.errors import DeviceLostError, DeviceSettingError, OperatorError, SequenceFaultError
from drivers.lightcrafter.chip import Chip, Leds
from drivers.lightcrafter.dlpc350 import COMMAND_GAP_S, Dlpc350
from drivers.lightcrafter.dlpc900 import MODELS, Dlpc900
from drivers.lightcrafter.settings import LightCrafterSettings
from drivers.lightcrafter.transport import UsbTransport

Picture = NDArray[np.uint8]
_LIT = tuple(state for state in DeviceState if state is not DeviceState.CLOSED)
_POLL_S = 0.005
_PATIENCE_S = 0.1
# The chip's clock against this one's, and the time an acknowledgement takes.
_CLOCK_TOLERANCE = 0.01
_REPLY_S = 0.02


def make_chip(settings: LightCrafterSettings, clock: Clock, backend: Any = None) -> Chip:
    """Give the chip of a LightCrafter, not connected yet.

    Parameters
    ----------
    settings
        Which LightCrafter.
    clock
        Time.
    backend
        A `usb.backend.IBackend`; None for libusb.
    """
    name = "LightCrafter " + settings.driver.removeprefix("lightcrafter")
    if settings.driver == "lightcrafter4500":
        return Dlpc350(UsbTransport(name, 0x6401, settings.serial, clock, backend, COMMAND_GAP_S), clock)
    return Dlpc900(UsbTransport(name, 0xC900, settings.serial, clock, backend), clock)


class LightCrafter:
    """Base of the LightCrafter projectors.

    Parameters
    ----------
    settings
        Of the projector.
    clock
        Time.
    backend
        A `usb.backend.IBackend` to find the projector on; None for libusb.

    Notes
    -----
    A projector that is gone or silent is lost: `DeviceLostError`, and `close` and `open` bring it back once it is there
    again.
    """

    def __init__(self, settings: LightCrafterSettings, clock: Clock, *, backend: Any = None) -> None:
        self._settings = settings
        self._clock = clock
        self._chip = make_chip(settings, clock, backend)
        self.name = self._chip.device
        self._life = Lifecycle(self.name)
        self._identity: dict[str, Any] = {}
        self._counts = {"shown": 0, "played": 0}
        self._lit = False

    @property
    def state(self) -> DeviceState:
        """How far the device has come."""
        return self._life.state

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), px."""
        return self._settings.size

    @property
    def period_s(self) -> float:
        """Time one picture is on, black after it included, s."""
        return (self._settings.shown_us + self._settings.dark_us) * 1e-6

    def open(self) -> None:
        """Connect.

        Raises
        ------
        DeviceNotFoundError, DeviceBusyError, MissingLibraryError, HardwareError
            See `UsbTransport.open`.
        DeviceSettingError
            It is another model.
        """
        self._life.check("open")
        self._chip.transport.open()
        try:
            self._identify()
            # Whatever it shows from before, or after it was switched on, is over.
            self._chip.stop()
            self._light(False)
            self._chip.standby(False)
        except BaseException:
            self._chip.transport.close()
            raise
        self._counts = dict.fromkeys(self._counts, 0)
        self._life.move("open")

    def configure(self) -> None:
        """Apply the settings; dark until a picture is shown.

        Raises
        ------
        DeviceSettingError
            The chip cannot do what the settings ask for.
        """
        self._life.check("configure")
        settings, chip = self._settings, self._chip
        with self._watched():
            chip.flip(long_axis=settings.flip_long_axis, short_axis=settings.flip_short_axis)
            if settings.led_current is not None:
                chip.set_led_current(*settings.led_current)
            for output, trigger in enumerate((settings.trigger_out_1, settings.trigger_out_2), start=1):
                chip.set_trigger_out(
                    output,
                    inverted=trigger.inverted,
                    rising_us=trigger.rising_delay_us,
                    falling_us=trigger.falling_delay_us,
                )
            chip.stop()
            self._light(False)
            self._enter()
        self._life.move("configure")

    def darken(self) -> None:
        """Show black and end a playing sequence. In FAULT it is tried, and what goes wrong is not told again."""
        self._life.require("darken", *_LIT)
        if self.state is DeviceState.FAULT:
            with suppress(OperatorError):
                self._show_black()
            return
        with self._watched():
            self._show_black()
        if self.state is DeviceState.RUNNING:
            self._rest()

    def close(self) -> None:
        """Go dark and disconnect; allowed in every state."""
        if self.state is not DeviceState.CLOSED:
            with suppress(OperatorError):
                self._show_black()
        self._chip.transport.close()
        self._life.move("close")

    def describe(self) -> Mapping[str, Any]:
        """JSON-ready snapshot."""
        return {
            "name": self.name,
            "simulated": False,
            "state": self.state.name,
            **self._identity,
            "settings": self._settings.model_dump(mode="json"),
            "counts": {**self._counts, "usb_commands": self._chip.transport.commands},
        }

    def _identify(self) -> None:
        chip = self._chip
        self._identity = {"firmware": chip.version(), **chip.transport.identity}
        if isinstance(chip, Dlpc900):
            hardware, tag = chip.model()
            model = MODELS.get(hardware, f"with hardware number {hardware}")
            self._identity |= {"model": model, "firmware_tag": tag}
            if model != self.name:
                raise DeviceSettingError(
                    f"{self.name}: the projector on the USB is a {model}", "Name this model in the bench file."
                )
        status = chip.status()
        if status.faults:
            self._identity["faults_at_open"] = list(status.faults)

    def _enter(self) -> None:
        """Bring the chip into the mode of this projector; the sequence is stopped and the LEDs are off."""
        raise NotImplementedError

    def _show_black(self) -> None:
        self._chip.stop()
        self._light(False)

    def _light(self, on: bool) -> None:
        """Have the running sequence switch the LEDs, or switch them off."""
        self._chip.control_leds(None if on else Leds.NONE)
        self._lit = on

    @property
    def _leds(self) -> Leds:
        leds = Leds.NONE
        for colour in self._settings.leds:
            leds |= Leds[colour.upper()]
        return leds

    def _check_pictures(self, pictures: Sequence[Picture]) -> None:
        width, height = self.size
        for number, picture in enumerate(pictures):
            if picture.dtype != np.uint8 or picture.shape != (height, width):
                raise DeviceSettingError(
                    f"{self.name}: picture {number} is {picture.dtype} {picture.shape}, not uint8 {(height, width)}",
                    f"Project pictures of {width} × {height} px, 8-bit grey.",
                )
            if self._settings.bit_depth == 1 and not np.isin(picture, (0, 255)).all():
                raise DeviceSettingError(
                    f"{self.name}: picture {number} has grey values, but bit_depth is 1",
                    "Set bit_depth to 8, or project patterns of black and white.",
                )

    def _check_index(self, index: int, loaded: int) -> None:
        if not 0 <= index < loaded:
            raise DeviceSettingError(
                f"{self.name}: there is no picture {index} among the {loaded} loaded ones",
                "Load the sequence again before it is shown.",
            )

    def _rest(self) -> None:
        """No sequence plays any more; the pictures stay loaded."""
        self._life.move("stop")
        self._life.move("arm")

    @contextmanager
    def _watched(self) -> Iterator[None]:
        try:
            yield
        except DeviceLostError:
            self._life.move("fail")
            raise


class SelfTimed(LightCrafter):
    """A LightCrafter that shows patterns from its own memory by its own clock; parameters as `LightCrafter`."""

    def __init__(self, settings: LightCrafterSettings, clock: Clock, *, backend: Any = None) -> None:
        super().__init__(settings, clock, backend=backend)
        self._loaded = 0
        self._begun_s = 0.0

    def configure(self) -> None:
        """Apply the settings; see `LightCrafter.configure`."""
        for bits in {1, self._settings.bit_depth}:
            self._chip.check_exposure(self._settings.shown_us, bits)
        super().configure()

    def load(self, patterns: Sequence[Picture]) -> None:
        """Take over the pictures (height, width) of one sequence; dark until one is shown.

        Raises
        ------
        DeviceSettingError
            They are not of the projector's size, or more than it holds.
        DeviceLostError, ProtocolError
            The projector does not take them.
        """
        self._life.check("arm")
        self._check_pictures(patterns)
        self._check_load(patterns)
        if self.state is DeviceState.ARMED:
            self._life.move("stop")
        with self._watched():
            self._load(patterns)
        self._loaded = len(patterns)
        self._life.move("arm")

    def show(self, index: int) -> float:
        """Show picture ``index`` again and again; returns when it was handed over, s."""
        self._life.require("show", DeviceState.ARMED)
        self._check_index(index, self._loaded)
        with self._watched():
            self._arrange_one(index)
            if not self._lit:
                self._light(True)
            handed_over = self._clock.now()
            self._chip.start(endless=True)
        self._counts["shown"] += 1
        return handed_over

    def play(self) -> None:
        """Begin to show all pictures once; each gives its pulses at the trigger outputs."""
        self._life.check("start")
        with self._watched():
            self._arrange_all()
            self._light(True)
            self._chip.start(endless=False)
            self._begun_s = self._clock.now()
        self._life.move("start")

    def finish(self, timeout_s: float) -> PlayRecord:
        """Wait until the last picture was shown.

        Raises
        ------
        SequenceFaultError
            It was not within ``timeout_s``, the sequence stopped too early, or the sequencer reports an error; the
            projector is dark.
        """
        self._life.require("finish", DeviceState.RUNNING)
        begun = self._begun_s
        with self._watched():
            fault = self._wait_for_end(self._clock.now() + timeout_s)
            if fault:
                self._show_black()
        self._rest()
        if fault:
            raise SequenceFaultError(
                f"{self.name}: the sequence of {self._loaded} patterns was not played: {fault}",
                "The sequence can be repeated; where this comes back, check that no other program controls the "
                "projector.",
            )
        self._counts["played"] += 1
        return PlayRecord(tuple(begun + number * self.period_s for number in range(self._loaded)), ())

    def _wait_for_end(self, deadline: float) -> str:
        """Wait until the sequence has ended; returns what went wrong, empty where nothing did."""
        begun, length = self._begun_s, self._loaded * self.period_s
        while True:
            status = self._chip.status()
            now = self._clock.now()
            if status.faults:
                return ", ".join(status.faults)
            # That this bit goes out at the end of a sequence is not verified on hardware.
            if not status.running:
                early = now - begun < length * (1 - _CLOCK_TOLERANCE) - _REPLY_S
                return f"it stopped after {now - begun:.3f} s instead of {length:.3f} s" if early else ""
            if now >= deadline:
                return f"it still runs after {now - begun:.3f} s; it takes {length:.3f} s"
            self._clock.sleep(min(max(begun + length - now, _POLL_S), max(deadline - now, _POLL_S), _PATIENCE_S))

    def _check_load(self, patterns: Sequence[Picture]) -> None:
        """Refuse pictures that the projector cannot take."""
        raise NotImplementedError

    def _load(self, patterns: Sequence[Picture]) -> None:
        raise NotImplementedError

    def _arrange_one(self, index: int) -> None:
        """Stop, and have the next start show picture ``index`` for ever."""
        raise NotImplementedError

    def _arrange_all(self) -> None:
        """Stop, and have the next start show all pictures once."""
        raise NotImplementedError
