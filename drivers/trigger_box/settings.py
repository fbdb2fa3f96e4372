"""What an operator sets of a trigger box."""

from __future__ import annotations

from typing import Literal, Self

from pydantic import BaseModel, ConfigDict, Field, model_validator

Level = Literal["high", "low"]


class SerialPortSettings(BaseModel):
    """Where the box is, and how long it is waited for."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    driver: str
    port: str | None = Field(
        None,
        description="Serial port, such as /dev/ttyACM0 or, better, its name under /dev/serial/by-id. "
        "Left out: the port with `serial_number`, or the only USB port at which such a box answers.",
    )
    serial_number: str | None = Field(
        None,
        description="Serial number of the box's USB port, as `scan doctor` lists it; the box is found by it wherever "
        "it is plugged in. Not together with `port`.",
    )
    baud: int = Field(
        115_200, ge=9_600, le=2_000_000, description="Speed, bit/s; boards that are USB devices themselves ignore it."
    )
    reply_timeout_s: float = Field(0.25, gt=0, le=10, description="How long an answer may take, s.")
    attempts: int = Field(3, ge=1, le=10, description="How often a command that is not answered is sent in all.")
    boot_timeout_s: float = Field(
        4.0,
        ge=0,
        le=30,
        description="How long a box may take to start after its port was opened, s; Arduinos restart when it is.",
    )

    @model_validator(mode="after")
    def _one_way_to_find_it(self) -> Self:
        if self.port is not None and self.serial_number is not None:
            raise ValueError("port and serial_number are both given; leave one of them out")
        return self


class SltSettings(SerialPortSettings):
    """A box that speaks SLT/1."""

    driver: Literal["slt"] = "slt"
    pulse_us: int = Field(100, ge=1, le=1_000_000, description="Length of a trigger pulse, µs.")
    delay_us: int = Field(
        0, ge=0, le=1_000_000, description="From an edge at the input (or from the scan's request) to the pulse, µs."
    )
    min_period_us: int = Field(
        1_000,
        ge=20,
        le=10_000_000,
        description="Shortest time between two pulses, µs: exposure and read-out of the camera. "
        "Edges that come earlier give no pulse and are counted as missed.",
    )
    output_level: Level = Field("high", description="Level of the output during a pulse.")
    edge: Literal["rising", "falling", "change"] = Field(
        "rising",
        description="Edge at the input EXT0 that asks for a pulse; `change` is both, for a light sensor on a patch of "
        "the picture that toggles with each pattern.",
    )
    count_back: bool = Field(
        True,
        description='Count the exposures that the camera reports on its "exposure active" line, wired to the input '
        "IN0. Only so can a scan prove that each pulse became one exposure.",
    )
    exposure_level: Level = Field("high", description='Level of the line "exposure active" during an exposure.')

    @model_validator(mode="after")
    def _pulse_fits(self) -> Self:
        if self.pulse_us >= self.min_period_us:
            raise ValueError(
                f"pulse_us ({self.pulse_us}) must be shorter than min_period_us ({self.min_period_us}), "
                "or one pulse runs into the next"
            )
        return self


class PrawnBlasterSettings(SerialPortSettings):
    """A Raspberry Pi Pico that runs the PrawnBlaster firmware; it cannot count exposures."""

    driver: Literal["prawnblaster"] = "prawnblaster"
    pulse_us: int = Field(
        100,
        ge=1,
        le=1_000_000,
        description="Length of a trigger pulse, µs; as much time passes after it before another can come. Edges are "
        "found by level: the signal at the input must be over within twice this time, or it asks for another pulse.",
    )
    output_pin: int = Field(9, ge=0, le=25, description="GPIO number of the output.")
    input_pin: int = Field(0, ge=0, le=19, description="GPIO number of the trigger input.")
