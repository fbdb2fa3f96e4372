"""What an operator says about a LightCrafter."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator
from pydantic_core import PydanticCustomError

from drivers.window.settings import WindowSettings

_Current = Annotated[int, Field(ge=0, le=255)]


class _Section(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


class TriggerOutput(_Section):
    """One of the projector's trigger outputs."""

    inverted: bool = Field(False, description="Pulses go from high to low.")
    rising_delay_us: float = Field(
        0.0, ge=-20, le=20_000, description="Delay of a pulse's beginning, µs; the 4500 takes -20 to 2.7."
    )
    falling_delay_us: float = Field(
        0.0, ge=-20, le=20_000, description="Delay of a pulse's end, µs; the 4500 takes -20 to 2.7, for output 1 only."
    )


class StoredPicture(_Section):
    """A pattern that was written to the projector's flash memory with the vendor's program."""

    file: Path = Field(description="The same picture as an 8-bit grey image file of the projector's size.")
    image: int = Field(ge=0, le=255, description="Number of the 24-bit image in the flash memory, from 0.")
    first_bit: int = Field(
        ge=0, le=23, description="First of its bit planes in that image: 0, 8 or 16 for 8-bit patterns."
    )


class _LightCrafterSettings(_Section):
    """What all LightCrafters have."""

    serial: str | None = Field(
        None, description="USB serial number, as `scan doctor` lists it; null takes the only one that is connected."
    )
    bit_depth: int = Field(
        8,
        ge=1,
        le=8,
        description="Bits of a grey value that are shown; fewer are faster. With 1 only black and white are accepted.",
    )
    exposure_us: int | None = Field(
        None,
        ge=1,
        lt=1 << 24,
        description="How long each pattern is shown, µs. null: in video_pattern mode as long as the video frame "
        "allows, otherwise 16 667.",
    )
    dark_us: int = Field(0, ge=0, lt=1 << 24, description="Black after each pattern, µs; the 4500 takes 0 or ≥ 230.")
    patterns_per_frame: Literal[1, 3] = Field(
        1,
        description="video_pattern mode: 1 pattern per video frame (from green), or 3 (from green, red and blue); "
        "3 patterns of 8 bits do not fit into 1/60 s on the 4500.",
    )
    leds: tuple[Literal["red", "green", "blue"], ...] = Field(
        ("red", "green", "blue"), min_length=1, description="Which LEDs light the patterns."
    )
    led_current: tuple[_Current, _Current, _Current] | None = Field(
        None,
        description="Current of the red, green and blue LED, 0 (least) to 255; null leaves it as it is. Too much for "
        "the board's cooling destroys the LEDs: see its manual.",
    )
    trigger_out_1: TriggerOutput = Field(
        TriggerOutput(), description="Output that is high during each pattern, black ones included."
    )
    trigger_out_2: TriggerOutput = Field(
        TriggerOutput(),
        description="Output with a short pulse at the beginning of each pattern, on the 6500 and 9000 none for black: "
        "the one to trigger a camera with. On the 4500 one pulse per sequence.",
    )
    flip_long_axis: bool = Field(False, description="Mirror the picture left to right.")
    flip_short_axis: bool = Field(False, description="Mirror the picture top to bottom.")
    stored: tuple[StoredPicture, ...] = Field((), description="prestored mode: what the flash memory holds.")
    window: WindowSettings | None = Field(
        None, description="video and video_pattern mode: the projector as a screen of this computer."
    )

    @property
    def shown_us(self) -> int:
        """Exposure where the chip's own clock makes it, µs."""
        return 16_667 if self.exposure_us is None else self.exposure_us

    def check(self, mode: str, size: tuple[int, int]) -> None:
        """Refuse what does not go together; ``size`` is (width, height), px."""
        if mode == "prestored" and not self.stored:
            raise _refused("mode is prestored, but no stored pictures are named", "list them under stored")
        if mode in ("video", "video_pattern"):
            if self.window is None:
                raise _refused(f"mode is {mode}, but there is no window", "say under window which screen it is")
            if (self.window.width_px, self.window.height_px) != size:
                raise _refused(
                    f"the window is {self.window.width_px} × {self.window.height_px} px",
                    f"set it to the projector's own {size[0]} × {size[1]} px",
                )
            if mode == "video_pattern" and (self.window.hold != 1 or self.window.channels != "grey"):
                raise _refused("video patterns need every frame and all channels", "set hold: 1 and channels: grey")
        for picture in self.stored:
            if picture.first_bit % self.bit_depth or picture.first_bit + self.bit_depth > 24:
                raise _refused(
                    f"a {self.bit_depth}-bit pattern does not begin at bit {picture.first_bit}",
                    f"set first_bit to a multiple of {self.bit_depth}",
                )


class LightCrafter4500Settings(_LightCrafterSettings):
    """The LightCrafter 4500."""

    driver: Literal["lightcrafter4500"] = "lightcrafter4500"
    mode: Literal["video_pattern", "prestored", "video"] = Field(
        "video_pattern",
        description="video_pattern: patterns over HDMI, timed and triggered by the projector. prestored: patterns of "
        "its flash memory. video: an ordinary display.",
    )

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), px."""
        return 912, 1140

    @model_validator(mode="after")
    def _goes_together(self) -> Self:
        self.check(self.mode, self.size)
        return self


class _OnTheFlySettings(_LightCrafterSettings):
    mode: Literal["video_pattern", "on_the_fly", "prestored", "video"] = Field(
        "on_the_fly",
        description="on_the_fly: patterns are loaded over USB. video_pattern: patterns over HDMI, timed and triggered "
        "by the projector. prestored: patterns of its flash memory. video: an ordinary display.",
    )
    compression: Literal["enhanced_rle", "rle", "none"] = Field(
        "enhanced_rle", description="How patterns are loaded; the first is the fastest."
    )


class LightCrafter6500Settings(_OnTheFlySettings):
    """The LightCrafter 6500."""

    driver: Literal["lightcrafter6500"] = "lightcrafter6500"

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), px."""
        return 1920, 1080

    @model_validator(mode="after")
    def _goes_together(self) -> Self:
        self.check(self.mode, self.size)
        return self


class LightCrafter9000Settings(_OnTheFlySettings):
    """The LightCrafter 9000."""

    driver: Literal["lightcrafter9000"] = "lightcrafter9000"

    @property
    def size(self) -> tuple[int, int]:
        """(width, height), px."""
        return 2560, 1600

    @model_validator(mode="after")
    def _goes_together(self) -> Self:
        self.check(self.mode, self.size)
        return self


LightCrafterSettings = LightCrafter4500Settings | LightCrafter6500Settings | LightCrafter9000Settings


def _refused(what: str, remedy: str) -> PydanticCustomError:
    return PydanticCustomError("refused", "{what}: {remedy}", {"what": what, "remedy": remedy})
