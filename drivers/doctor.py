"""What devices this machine has, and whether those of a bench file are among them; nothing is projected.

`examine` lists what there is and is an entry point of the group ``scanner.examinations``; `examine_hardware` judges the
settings of one bench. Every probe has a time limit of its own, so that one display or driver that hangs does not hide
what the others find; the program that calls them kills what still hangs at the end.
"""

from __future__ import annotations

import ctypes
import os
import queue
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from pydantic import BaseModel

from drivers.clock import SystemClock
from drivers.errors import OperatorError
from drivers.examination import Finding, Verdict

Probe = Callable[[], Iterator[Finding]]

CAMERAS, DISPLAYS, PORTS, PROJECTORS = "cameras", "displays", "serial ports", "USB projectors"
LIBRARIES = "libraries"

_QUICK_S = 5.0
_CAMERAS_S = 40.0
_USBFS = Path("/sys/module/usbcore/parameters/usbfs_memory_mb")
_USBFS_MB = 256
_RECEIVE = Path("/proc/sys/net/core/rmem_max")
_RECEIVE_BYTES = 8 << 20
_RATE_TOLERANCE = 0.01
_LIGHTCRAFTER_US = 16_667

_PYTHON_LIBRARIES = {
    "harvesters": ("GenICam cameras", "pip install 'mfs-scanner[genicam]'"),
    "genicam": ("GenICam cameras", "pip install 'mfs-scanner[genicam]'"),
    "pyglet": ("projector windows and preview", "pip install 'pyglet>=2.1.15,<3'"),
    "serial": ("trigger boxes", "pip install pyserial"),
    "usb": ("LightCrafter projectors", "pip install pyusb"),
    "libusb_package": ("LightCrafter projectors", "pip install libusb-package"),
}
_SYSTEM_LIBRARIES = {
    "libGL.so.1": "libgl1 libglx-mesa0 libgl1-mesa-dri",
    "libX11.so.6": "libx11-6",
    "libXrandr.so.2": "libxrandr2",
}


def examine(settings: BaseModel | None) -> Iterator[Finding]:
    """List displays, cameras by producer, serial ports, USB projectors, and the libraries that they need.

    Parameters
    ----------
    settings
        Of the bench that is looked at, or None; a producer that a section ``camera`` names is looked at too.
    """
    producers = tuple(getattr(getattr(settings, "camera", None), "producer", None) or ())
    yield from _within(_QUICK_S, LIBRARIES, _libraries)
    yield from _within(_QUICK_S, DISPLAYS, _session)
    yield from _within(_QUICK_S, DISPLAYS, _displays)
    yield from _within(_CAMERAS_S, CAMERAS, partial(_cameras, producers))
    yield from _within(_QUICK_S, CAMERAS, _transport)
    yield from _within(_QUICK_S, PORTS, _ports)
    yield from _within(_QUICK_S, PROJECTORS, _projectors)


def examine_hardware(settings: Any) -> Iterator[Finding]:
    """Judge whether the devices of a bench are there and take their settings.

    The camera and the trigger box are opened and set; of the projector it is only looked whether it is there.

    Parameters
    ----------
    settings
        Sections ``camera``, ``projector`` and ``trigger``, as far as there are any; see `drivers.hardware`.

    Returns
    -------
    Findings; one of the topic ``rig`` says what the bench needs of its rig.
    """
    for section, limit_s, judge in (
        ("projector", _QUICK_S, _judge_projector),
        ("camera", _CAMERAS_S, _judge_camera),
        ("trigger", 4 * _QUICK_S, _judge_trigger),
    ):
        if getattr(settings, section, None) is not None:
            item = getattr(getattr(settings, section), "driver", section)
            probe = partial(judge, settings)
            yield from _within(limit_s, f"bench {section}", probe, item, Verdict.FAULT)
    if getattr(settings, "synchronisation", None) == "step" and settings.settle_s is None:
        # Whether the rig has it is for those to judge who know the rig.
        yield Finding("rig", "display latency", Verdict.NOTE, "needed: settle_s is not set")


def _within(
    limit_s: float, topic: str, probe: Probe, item: str = "search", failed: Verdict = Verdict.WARNING
) -> Iterator[Finding]:
    """Findings of one probe; what it raises, or that it hangs, is a finding with the verdict ``failed``."""
    found: queue.SimpleQueue[Finding | None] = queue.SimpleQueue()

    def work() -> None:
        try:
            for finding in probe():
                found.put(finding)
        except OperatorError as error:
            found.put(Finding(topic, item, failed, error.message, error.remedy))
        except Exception as error:  # a vendor's library may raise anything
            found.put(Finding(topic, item, failed, f"could not be looked at: {type(error).__name__}: {error}"))
        found.put(None)

    threading.Thread(target=work, name=f"examination of {topic}", daemon=True).start()
    deadline = time.monotonic() + limit_s
    while True:
        try:
            finding = found.get(timeout=max(deadline - time.monotonic(), 0.0))
        except queue.Empty:
            text = f"no answer within {limit_s:g} s"
            yield Finding(topic, item, failed, text, "Unplug and power-cycle what was connected last, and try again.")
            return
        if finding is None:
            return
        yield finding


def _libraries() -> Iterator[Finding]:
    missing = False
    for name, (purpose, install) in _PYTHON_LIBRARIES.items():
        if find_spec(name) is None:
            missing = True
            yield Finding(LIBRARIES, name, Verdict.WARNING, f"not installed; {purpose} need it", install)
    if sys.platform.startswith("linux"):
        for name, packages in _SYSTEM_LIBRARIES.items():
            try:
                ctypes.CDLL(name)
            except OSError:
                missing = True
                text = "cannot be loaded; projector windows and preview need it"
                yield Finding(LIBRARIES, name, Verdict.WARNING, text, f"sudo apt install {packages}")
    if not missing:
        yield Finding(LIBRARIES, "all", Verdict.OK, "cameras, windows, trigger boxes and LightCrafters have theirs")


def _session() -> Iterator[Finding]:
    if not sys.platform.startswith("linux"):
        text = f"{sys.platform}: projector windows are made for X11 on Linux"
        yield Finding(DISPLAYS, "session", Verdict.NOTE, text, "Drive a window projector from a Linux machine.")
        return
    kind = os.environ.get("XDG_SESSION_TYPE", "")
    if kind == "wayland" or os.environ.get("WAYLAND_DISPLAY"):
        yield Finding(
            DISPLAYS,
            "session",
            Verdict.WARNING,
            "Wayland: windows come through XWayland, which neither keeps to the refresh nor to the screen asked for",
            "Log out, and choose the X11 (Xorg) session at the login screen before you scan with a projector window.",
        )
    elif os.environ.get("DISPLAY"):
        yield Finding(DISPLAYS, "session", Verdict.OK, f"X11, display {os.environ['DISPLAY']}")
    else:
        yield Finding(
            DISPLAYS,
            "session",
            Verdict.NOTE,
            "no desktop: neither a projector window nor a preview window can be opened",
            "Log in at the machine, or set DISPLAY=:0 where somebody is logged in.",
        )


def _displays() -> Iterator[Finding]:
    if not os.environ.get("DISPLAY"):
        return
    from drivers.window.screens import find_screens

    for screen in find_screens():
        rate = "rate unknown" if screen.refresh_hz is None else f"{screen.refresh_hz:.2f} Hz"
        text = f"{screen.width_px} × {screen.height_px} px at ({screen.x_px}, {screen.y_px}), {rate}"
        text += ", primary" if screen.primary else ""
        bent = [
            word for word, is_so in (("scaled", screen.scaled), ("colour profile", not screen.gamma_linear)) if is_so
        ]
        item = f"{screen.index}: {screen.name}"
        if bent:
            text, remedy = f"{text}; {', '.join(bent)}", "As a projector it needs scale 1 and no colour profile."
            yield Finding(DISPLAYS, item, Verdict.NOTE, text, remedy)
        else:
            yield Finding(DISPLAYS, item, Verdict.OK, text)


def _cameras(named: Sequence[Path]) -> Iterator[Finding]:
    from drivers.genicam.discovery import discover
    from drivers.genicam.producers import SEARCH_PATH, producer_files

    files = list(dict.fromkeys([*producer_files(None), *named]))
    if not files:
        why = "names no folder with one" if SEARCH_PATH in os.environ else "is not set"
        yield Finding(
            CAMERAS,
            "producers",
            Verdict.NOTE,
            f"no GenTL producer: {SEARCH_PATH} {why}",
            f"Install the camera vendor's software, then: export {SEARCH_PATH}=/folder/with/its/cti/file",
        )
    for file in files:
        for report in discover([file]):
            if report.error is not None:
                remedy = f"Correct its path, repair the vendor's software, or take its folder out of {SEARCH_PATH}."
                yield Finding(CAMERAS, file.name, Verdict.WARNING, report.error, remedy)
            elif not report.devices:
                remedy = "Check power and cable; a network camera must be in the same subnet as its adapter."
                yield Finding(CAMERAS, file.name, Verdict.NOTE, f"sees no camera ({file})", remedy)
            for device in report.devices:
                name = f", user name {device.user_name!r}" if device.user_name else ""
                text = f"{device.vendor} {device.model}, serial {device.serial or 'not given'}{name}, {device.access}"
                closed = device.access in ("in use", "not accessible")
                yield Finding(
                    CAMERAS,
                    file.name,
                    Verdict.WARNING if closed else Verdict.OK,
                    text,
                    "Close the program that uses it; on USB, run the vendor's permission script." if closed else "",
                )


def _transport() -> Iterator[Finding]:
    """Limits of the kernel that make fast cameras lose frames."""
    usbfs = _number(_USBFS)
    if usbfs is not None and 0 < usbfs < _USBFS_MB:
        yield Finding(
            CAMERAS,
            "USB memory",
            Verdict.NOTE,
            f"{usbfs} MB for all USB devices: USB3 cameras lose large frames",
            f"echo 1000 | sudo tee {_USBFS}",
        )
    receive = _number(_RECEIVE)
    if receive is not None and receive < _RECEIVE_BYTES:
        yield Finding(
            CAMERAS,
            "network memory",
            Verdict.NOTE,
            f"{receive / 1024:.0f} KiB may wait in a socket: GigE cameras lose packets",
            f"sudo sysctl -w net.core.rmem_max={_RECEIVE_BYTES}",
        )


def _ports() -> Iterator[Finding]:
    from drivers.trigger_box.discovery import permission_remedy, serial_ports

    ports = serial_ports()
    if not ports:
        yield Finding(PORTS, "none", Verdict.OK, "no serial port; needed with a trigger box only")
    for port in ports:
        text = ", ".join(
            part
            for part in (
                port.description or "no description",
                f"USB {port.usb_id}" if port.usb_id else "",
                f"serial number {port.serial_number}" if port.serial_number else "",
            )
            if part
        )
        if port.accessible:
            yield Finding(PORTS, port.path, Verdict.OK, text)
        else:
            # A trigger box is a USB device; whatever else is built in may stay closed.
            verdict = Verdict.NOTE if port.usb_id is None else Verdict.WARNING
            yield Finding(
                PORTS, port.path, verdict, f"{text}; you may not open it", permission_remedy(port.path, port.usb_id)
            )


def _projectors() -> Iterator[Finding]:
    from drivers.lightcrafter.discovery import find_projectors

    found = find_projectors()
    if not found:
        yield Finding(PROJECTORS, "none", Verdict.OK, "no LightCrafter on the USB; needed with one only")
    for projector in found:
        text = str(projector) if projector.accessible else f"{projector}; {projector.problem}"
        verdict = Verdict.OK if projector.accessible else Verdict.WARNING
        yield Finding(PROJECTORS, projector.chip, verdict, text, projector.remedy)


def _judge_camera(settings: Any) -> Iterator[Finding]:
    from drivers.genicam import GenICamCamera

    camera = GenICamCamera(settings.camera, SystemClock())
    try:
        camera.open()
        found = camera.configure()
    finally:
        camera.close()
    text = f"opened; takes its settings: {found.width} × {found.height} px, {found.bits} bit"
    yield Finding("bench camera", camera.name, Verdict.OK, text)


def _judge_projector(settings: Any) -> Iterator[Finding]:
    projector = settings.projector
    video = getattr(projector, "mode", None) in ("video", "video_pattern")
    window = projector if projector.driver == "window" else projector.window if video else None
    period_s = None
    if projector.driver.startswith("lightcrafter"):
        yield _judge_lightcrafter(projector)
        period_s = 1e-6 * ((projector.exposure_us or _LIGHTCRAFTER_US) + projector.dark_us)
    if window is not None:
        found, refresh_hz = _judge_screen(window)
        yield found
        if refresh_hz:  # what comes over a video cable keeps the screen's time
            period_s = 1 / refresh_hz / getattr(projector, "patterns_per_frame", 1)
    exposure_us = getattr(getattr(settings, "camera", None), "exposure_us", None)
    if period_s is not None and exposure_us is not None:
        yield _judge_exposure(settings, exposure_us, period_s)


def _judge_lightcrafter(projector: Any) -> Finding:
    from drivers.lightcrafter.discovery import CHIPS
    from drivers.lightcrafter.transport import UsbTransport

    product = next(number for number, chip in CHIPS.items() if projector.driver.removeprefix("lightcrafter") in chip)
    usb = UsbTransport(projector.driver, product, projector.serial, SystemClock())
    try:
        usb.open()
        identity = dict(usb.identity)
    finally:
        usb.close()
    text = f"opened: {CHIPS[product]}, serial {identity['usb_serial'] or 'not given'}, bus {identity['bus']}"
    return Finding("bench projector", projector.driver, Verdict.OK, text)


def _judge_screen(window: Any) -> tuple[Finding, float | None]:
    """The screen that a window is meant for, and its rate, Hz."""
    from drivers.window.screens import choose_screen, find_screens

    screen = choose_screen(find_screens(window.display), window.screen, (window.width_px, window.height_px))
    told, wanted = screen.refresh_hz, window.refresh_hz
    if told is not None and wanted is not None and abs(told / wanted - 1) > _RATE_TOLERANCE:
        size = f"{screen.width_px}x{screen.height_px}"
        return Finding(
            "bench projector",
            screen.name,
            Verdict.FAULT,
            f"the screen runs at {told:.2f} Hz, the bench file asks for {wanted:g} Hz",
            f"xrandr --output {screen.name} --mode {size} --rate {wanted:g}; or correct refresh_hz.",
        ), told
    return Finding("bench projector", screen.name, Verdict.OK, f"screen {screen}"), wanted or told


def _judge_exposure(settings: Any, exposure_us: float, period_s: float) -> Finding:
    """Exposure against the time that one picture is on."""
    text = (
        f"exposure {exposure_us:.0f} µs, {exposure_us * 1e-6 / period_s:.4g} × the projector's {1e3 * period_s:.3f} ms"
    )
    topic, item = "bench projector", "exposure"
    if getattr(settings, "synchronisation", "step") == "stream":
        if exposure_us * 1e-6 < period_s:
            return Finding(topic, item, Verdict.OK, text)
        remedy = f"Shorten bench.camera.exposure_us below {1e6 * period_s:.0f}: frames must not overlap two pictures."
        return Finding(topic, item, Verdict.FAULT, text, remedy)
    if getattr(settings, "whole_refreshes", False):
        from drivers.hardware import check_exposure_period

        try:
            check_exposure_period(exposure_us, period_s)
        except OperatorError as error:
            return Finding(topic, item, Verdict.FAULT, error.message, error.remedy)
    return Finding(topic, item, Verdict.OK, text)


def _judge_trigger(settings: Any) -> Iterator[Finding]:
    from drivers.hardware import make_trigger

    trigger = make_trigger(settings.trigger, SystemClock())
    if trigger is None:
        yield Finding("bench trigger", settings.trigger.driver, Verdict.OK, "no box is needed")
        return
    try:
        trigger.open()
        trigger.configure()
        known = trigger.describe()
    finally:
        trigger.close()
    where = f" at {known['port']}" if known.get("port") else ""
    yield Finding("bench trigger", trigger.name, Verdict.OK, f"answers{where} and takes its settings")


def _number(path: Path) -> int | None:
    try:
        return int(path.read_text(encoding="ascii"))
    except (OSError, ValueError):
        return None
