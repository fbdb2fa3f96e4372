"""Setting a camera as its bench file says, in the order that the standard's features depend on one another."""

from __future__ import annotations

from drivers.devices import FrameFormat
from drivers.errors import DeviceSettingError
from drivers.genicam.features import Features
from drivers.genicam.pixels import PIXEL_FORMATS
from drivers.genicam.settings import GenICamSettings

_FRAME_TRIGGERS = ("FrameStart", "ExposureStart", "AcquisitionStart")
"""What a trigger may be selected for: the standard's name, and those of older cameras that mean the same for us."""


def set_up(features: Features, settings: GenICamSettings) -> FrameFormat:
    """Set everything, read back what frames will look like.

    Raises
    ------
    DeviceSettingError
        The camera does not take a setting; the message quotes its own limits.
    """
    features.rounded.clear()
    if settings.user_set is not None:
        features.write("UserSetSelector", settings.user_set)
        features.write("UserSetLoad", True)
    features.write_if_there(["AcquisitionMode"], "Continuous")
    features.write_if_there(["GenDCStreamingMode"], "Off")
    features.write("PixelFormat", settings.pixel_format)
    _set_geometry(features, settings)
    for name in features.automatics():
        if name not in settings.features:
            features.write(name, "Off")
    _set_light(features, settings)
    for name, value in settings.features.items():
        features.write(name, value)
    _set_trigger(features, settings)
    return _read_back(features, settings)


def set_exposure(features: Features, exposure_us: float) -> float:
    """Set the exposure time; returns what the camera has made of it, µs.

    Raises
    ------
    DeviceSettingError
        The camera does not take it; the message quotes its own limits.
    """
    return float(features.write(features.first("ExposureTime", "ExposureTimeAbs") or "ExposureTime", exposure_us))


def _set_geometry(features: Features, settings: GenICamSettings) -> None:
    # A window that is not at the corner limits its own size.
    features.write_if_there(["OffsetX"], 0)
    features.write_if_there(["OffsetY"], 0)
    for name, size in (("Width", settings.width_px), ("Height", settings.height_px)):
        if size is not None and size != features.read(name):
            features.write(name, size)
        elif size is None:
            features.write_if_there([name], features.greatest(name))
    for name, offset in zip(("OffsetX", "OffsetY"), settings.offset_px, strict=True):
        if offset:
            features.write(name, offset)


def _set_light(features: Features, settings: GenICamSettings) -> None:
    if settings.exposure_us is not None:
        features.write_if_there(["ExposureMode"], "Timed")
        set_exposure(features, settings.exposure_us)
    if settings.gain_db is not None:
        features.write(features.first("Gain", "GainAbs") or "Gain", settings.gain_db)
    if settings.gain_raw is not None:
        features.write("GainRaw", settings.gain_raw)


def _set_trigger(features: Features, settings: GenICamSettings) -> None:
    if features.first("TriggerMode") is None:
        if settings.trigger != "free_run":
            raise DeviceSettingError(
                f"{features.device} cannot be triggered: it has no feature TriggerMode",
                "Set `trigger: free_run`; frames are then picked from those that the camera makes by itself.",
            )
        return
    # A trigger that another program has left on for something else would hold the frames back.
    selectors = features.entries("TriggerSelector")
    for selector in selectors:
        features.write("TriggerSelector", selector)
        features.write_if_there(["TriggerMode"], "Off")
    if settings.trigger == "free_run":
        features.write_if_there(["TriggerMode"], "Off")
        return
    if selectors:
        features.write("TriggerSelector", next((n for n in _FRAME_TRIGGERS if n in selectors), _FRAME_TRIGGERS[0]))
    if settings.trigger == "software":
        features.write("TriggerSource", "Software")
    else:
        features.write("TriggerSource", settings.trigger_line)
        features.write("TriggerActivation", settings.trigger_activation)
    features.write("TriggerMode", "On")


def _read_back(features: Features, settings: GenICamSettings) -> FrameFormat:
    width, height = features.read("Width"), features.read("Height")
    for name, asked, made in (("Width", settings.width_px, width), ("Height", settings.height_px, height)):
        if asked is not None and asked != made:
            raise DeviceSettingError(
                f"{features.device}: {name} is {made} after all features were set, not {asked}",
                "One of `features` changes the size, such as a binning: give the size that is left with it.",
            )
    pixel_format = PIXEL_FORMATS[settings.pixel_format]
    try:
        pixel_format.line_bytes(width)
    except ValueError as error:
        raise DeviceSettingError(f"{features.device}: {error}", "Set another `width_px` or `pixel_format`.") from None
    return FrameFormat(width, height, pixel_format.bits)
