"""What an operator can set of a GenICam camera: the ``camera:`` section of a bench file."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, ConfigDict, Field, StrictBool, StrictFloat, StrictInt, StrictStr, field_validator

PixelFormatName = Literal["Mono8", "Mono10", "Mono10p", "Mono10Packed", "Mono12", "Mono12p", "Mono12Packed", "Mono16"]
FeatureValue = StrictBool | StrictInt | StrictFloat | StrictStr

_OWN_SETTING = {
    "Width": "width_px",
    "Height": "height_px",
    "OffsetX": "offset_px",
    "OffsetY": "offset_px",
    "PixelFormat": "pixel_format",
    "ExposureTime": "exposure_us",
    "ExposureTimeAbs": "exposure_us",
    "Gain": "gain_db",
    "GainAbs": "gain_db",
    "GainRaw": "gain_raw",
    "TriggerMode": "trigger",
    "TriggerSource": "trigger",
    "TriggerActivation": "trigger_activation",
    "UserSetLoad": "user_set",
    "AcquisitionMode": "trigger",
}


class GenICamSettings(BaseModel):
    """A camera of any vendor that keeps to the GenICam standard (USB3 Vision, GigE Vision, CoaXPress, …)."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    driver: Literal["genicam"] = Field("genicam", description="Which driver serves the device.")
    producer: tuple[Path, ...] | None = Field(
        None,
        description="The vendor's GenTL producer, a .cti file, or a list of them; null for all in the folders of"
        " GENICAM_GENTL64_PATH, which vendors' installers set.",
    )
    serial: str | None = Field(None, description="Serial number of the camera; null where another choice is enough.")
    model: str | None = Field(None, description="Model name of the camera, to choose it by.")
    user_name: str | None = Field(None, description="Name that the camera was given by its user, to choose it by.")
    user_set: str | None = Field(
        None,
        description="User set that is loaded before anything else is set, such as Default; null keeps what the camera"
        " was last set to.",
    )
    width_px: int | None = Field(None, ge=1, le=65535, description="Width of a frame, px; null for all there is.")
    height_px: int | None = Field(None, ge=1, le=65535, description="Height of a frame, px; null for all there is.")
    offset_px: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=0)]] = Field(
        (0, 0), description="First column and first row of the sensor that is read out, px."
    )
    pixel_format: PixelFormatName = Field(
        "Mono8", description="How grey values are sent; formats of 10 and more bits see dark surfaces better."
    )
    exposure_us: float | None = Field(
        None, gt=0, le=60_000_000, description="Exposure time, µs; null for a camera that has no such feature."
    )
    gain_db: float | None = Field(None, description="Gain, dB; null leaves it as it is.")
    gain_raw: int | None = Field(None, description="Gain in the camera's own steps, where it knows no dB.")
    trigger: Literal["software", "line", "free_run"] = Field(
        "software",
        description="What exposes a frame: a command of the computer; an edge on an input of the camera, from a"
        " trigger box or the projector; or the camera itself all the time, and the next frame that surely began after"
        " it was asked for is taken.",
    )
    trigger_line: str = Field("Line0", description="Input of the camera, for `trigger: line`.")
    trigger_activation: Literal["RisingEdge", "FallingEdge", "AnyEdge", "LevelHigh", "LevelLow"] = Field(
        "RisingEdge", description="What on the input exposes a frame, for `trigger: line`."
    )
    free_run_skip_frames: int = Field(
        2,
        ge=1,
        le=100,
        description="For `trigger: free_run`: how many frames are let pass after one was asked for, because they may"
        " have begun before: one that is being exposed, and those that are on their way.",
    )
    features: dict[str, FeatureValue] = Field(
        {},
        description="Any other features of the camera by name and the values to give them, in this order, after all of"
        " the above but the trigger; a command is executed by the value true.",
    )
    buffers: int = Field(
        32, ge=16, le=1024, description="Frames that the camera's library can hold before the driver has taken them."
    )
    ring_frames: int = Field(
        16, ge=2, le=512, description="Frames that the driver can hold before the scan has taken them."
    )
    connect_timeout_s: float = Field(
        30.0, gt=0, le=300, description="How long a producer may take to find cameras, and a camera to open, s."
    )
    answer_timeout_s: float = Field(
        10.0, gt=0, le=300, description="How long the camera's library may take for any other call, s."
    )
    read_noise_dn: float | None = Field(
        None, gt=0, description="Noise in the dark, standard deviation in grey values; null has it estimated."
    )
    electrons_per_dn: float | None = Field(
        None, gt=0, description="Electrons per grey value, for the shot noise; null where not known."
    )

    @field_validator("producer", mode="before")
    @classmethod
    def _one_or_many(cls, value: Any) -> Any:
        return (value,) if isinstance(value, str | Path) else value

    @field_validator("serial", "model", "user_name", mode="before")
    @classmethod
    def _number_as_text(cls, value: Any) -> Any:
        # A serial number of digits only is a number to YAML.
        return str(value) if isinstance(value, int) and not isinstance(value, bool) else value

    @field_validator("features")
    @classmethod
    def _not_what_has_a_setting(cls, features: dict[str, FeatureValue]) -> dict[str, FeatureValue]:
        for name in features:
            if name in _OWN_SETTING:
                raise ValueError(f"{name} has a setting of its own: {_OWN_SETTING[name]}")
        return features
