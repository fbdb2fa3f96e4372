"""What `drivers.doctor` finds, against an X server, producers, ports and USB devices that are made for it."""

from __future__ import annotations

import shutil
import subprocess
import sys
import threading
import time
from importlib.util import find_spec
from pathlib import Path
from types import SimpleNamespace

import pytest
from requirements import require

from drivers import MissingLibraryError, doctor
from drivers.examination import Finding, Verdict


@pytest.fixture(autouse=True)
def _bare(monkeypatch):
    """No display, no session, no producers but those a test brings."""
    for name in ("DISPLAY", "WAYLAND_DISPLAY", "XDG_SESSION_TYPE", "GENICAM_GENTL64_PATH"):
        monkeypatch.delenv(name, raising=False)


def of(topic, findings):
    return [f for f in findings if f.topic == topic]


# --- probes -----------------------------------------------------------------------------------------------------------


def test_a_probe_that_hangs_is_left_alone_and_what_it_found_is_kept():
    over = threading.Event()

    def probe():
        yield Finding("lamps", "one", Verdict.OK, "shines")
        over.wait(30)

    began = time.monotonic()
    found = list(doctor._within(1.0, "lamps", probe))
    assert time.monotonic() - began < 20
    over.set()
    assert [f.item for f in found] == ["one", "search"]
    assert found[1].verdict is Verdict.WARNING
    assert "within 1 s" in found[1].text


@pytest.mark.parametrize(
    ("error", "words", "remedy"),
    [
        (MissingLibraryError("pyserial is not installed", "pip install pyserial"), "not installed", "pip install"),
        (ZeroDivisionError("by zero"), "ZeroDivisionError: by zero", ""),
    ],
)
def test_a_probe_that_raises_is_a_finding(error, words, remedy):
    def probe():
        raise error
        yield

    (found,) = doctor._within(5.0, "lamps", probe, "two", Verdict.FAULT)
    assert (found.item, found.verdict) == ("two", Verdict.FAULT)
    assert words in found.text
    assert remedy in found.remedy


# --- what there is ----------------------------------------------------------------------------------------------------


def test_a_machine_without_devices_is_no_fault():
    found = list(doctor.examine(None))
    assert not [f for f in found if f.verdict is Verdict.FAULT]
    assert {f.topic for f in found} == {"libraries", "displays", "cameras", "serial ports", "USB projectors"}
    session = of("displays", found)[0]
    assert (session.item, session.verdict) == ("session", Verdict.NOTE)
    producers = of("cameras", found)[0]
    assert "GENICAM_GENTL64_PATH is not set" in producers.text
    assert "export GENICAM_GENTL64_PATH=" in producers.remedy


@pytest.mark.parametrize("variable", ["XDG_SESSION_TYPE", "WAYLAND_DISPLAY"])
def test_wayland_is_warned_of(monkeypatch, variable):
    monkeypatch.setenv("DISPLAY", ":0")
    monkeypatch.setenv(variable, {"XDG_SESSION_TYPE": "wayland"}.get(variable, "wayland-0"))
    (found,) = doctor._session()
    assert found.verdict is Verdict.WARNING
    assert "Wayland" in found.text
    assert "X11" in found.remedy


def test_missing_libraries_are_named_with_their_package(monkeypatch):
    there = doctor.find_spec
    monkeypatch.setattr(doctor, "find_spec", lambda name: None if name == "usb" else there(name))
    monkeypatch.setitem(doctor._SYSTEM_LIBRARIES, "libNowhere.so.7", "libnowhere7")
    found = {f.item: f for f in doctor._libraries()}
    assert set(found) == {"usb", "libNowhere.so.7"}
    assert found["usb"].remedy == "pip install pyusb"
    assert found["libNowhere.so.7"].remedy == "sudo apt install libnowhere7"
    assert all(f.verdict is Verdict.WARNING for f in found.values())


def test_screens_are_listed_as_the_x_server_has_them(monkeypatch):
    from sim_backend.xserver import Area, XServer

    require(shutil.which("Xvfb") and shutil.which("xrandr"), "screens need: apt install xvfb x11-xserver-utils")
    monitors = {"DESK": Area(0, 0, 1024, 768), "BEAMER": Area(1024, 0, 640, 400)}
    with XServer(1664, 768, monitors=monitors) as server:
        monkeypatch.setenv("DISPLAY", server.display)
        found = of("displays", doctor.examine(None))
        assert [f.item for f in found] == ["session", "0: DESK", "1: BEAMER"]
        assert found[2].text.startswith("640 × 400 px at (1024, 0)")

        window = SimpleNamespace(
            driver="window", display=None, screen=None, width_px=640, height_px=400, refresh_hz=60.0
        )
        camera = SimpleNamespace(exposure_us=16_667.0)
        bench = {"projector": window, "synchronisation": "step", "whole_refreshes": True}
        judged = list(doctor._judge_projector(SimpleNamespace(camera=camera, **bench)))
        assert [(f.item, f.verdict) for f in judged] == [("BEAMER", Verdict.OK), ("exposure", Verdict.OK)]
        camera = SimpleNamespace(exposure_us=20_000.0)
        assert of_exposure(SimpleNamespace(camera=camera, **bench)).verdict is Verdict.FAULT
        assert "16667 or 33333" in of_exposure(SimpleNamespace(camera=camera, **bench)).remedy
        # In a stream a frame only has to end before the next picture.
        bench |= {"synchronisation": "stream"}
        assert of_exposure(SimpleNamespace(camera=camera, **bench)).verdict is Verdict.FAULT
        camera = SimpleNamespace(exposure_us=12_345.0)
        assert of_exposure(SimpleNamespace(camera=camera, **bench)).verdict is Verdict.OK

        window.width_px = 800
        (fault,) = doctor.examine_hardware(SimpleNamespace(projector=window))
        assert (fault.topic, fault.item, fault.verdict) == ("bench projector", "window", Verdict.FAULT)
        assert "1: BEAMER 640 × 400 px" in fault.text
        # Nothing was shown: no window but the root has ever lit a pixel.
        assert not server.surface().any()


def of_exposure(settings):
    return next(f for f in doctor._judge_projector(settings) if f.item == "exposure")


def viky():
    spec = find_spec("genicam")
    path = Path(spec.origin).parent / "viky.cti" if spec else None
    require(path is not None and path.exists(), "needs the wheel genicam: pip install 'mfs-scanner[genicam]'")
    return path


def test_cameras_are_listed_by_producer_and_a_broken_producer_hides_none(monkeypatch, tmp_path):
    good = viky()
    compiler = shutil.which("cc")
    require(compiler, "needs a C compiler: apt install gcc")
    (tmp_path / "bad.c").write_text(
        "#include <stdlib.h>\n__attribute__((constructor)) static void die(void) { abort(); }\n", encoding="ascii"
    )
    subprocess.run([compiler, "-shared", "-fPIC", "-o", tmp_path / "bad.cti", tmp_path / "bad.c"], check=True)
    (tmp_path / "text.cti").write_text("no library\n", encoding="ascii")
    monkeypatch.setenv("GENICAM_GENTL64_PATH", f"{tmp_path}:{good.parent}")
    found = list(doctor._cameras(()))
    assert {f.item for f in found if f.verdict is Verdict.OK} == {"viky.cti"}
    assert sum("Viky" in f.text for f in found) == 3
    assert [f.item for f in found if f.verdict is Verdict.WARNING] == ["bad.cti", "text.cti"]
    assert "SIGABRT" in next(f.text for f in found if f.item == "bad.cti")


def test_a_camera_of_the_bench_is_opened_and_takes_its_settings():
    from drivers.genicam.settings import GenICamSettings

    settings = GenICamSettings(producer=viky(), serial="1", width_px=320, height_px=240, trigger="free_run")
    (found,) = doctor.examine_hardware(SimpleNamespace(camera=settings))
    assert found.verdict is Verdict.OK, found
    assert "320 × 240 px, 8 bit" in found.text
    (found,) = doctor.examine_hardware(SimpleNamespace(camera=settings.model_copy(update={"serial": "77"})))
    assert (found.topic, found.item, found.verdict) == ("bench camera", "genicam", Verdict.FAULT)
    assert "77" in found.text
    assert found.remedy


def test_limits_of_the_kernel_are_noted(monkeypatch, tmp_path):
    usb, network = tmp_path / "usbfs", tmp_path / "rmem"
    usb.write_text("16\n", encoding="ascii")
    network.write_text("212992\n", encoding="ascii")
    monkeypatch.setattr(doctor, "_USBFS", usb)
    monkeypatch.setattr(doctor, "_RECEIVE", network)
    assert [f.item for f in doctor._transport()] == ["USB memory", "network memory"]
    usb.write_text("1000\n", encoding="ascii")
    network.write_text("33554432\n", encoding="ascii")
    assert list(doctor._transport()) == []


def test_serial_ports_and_who_may_open_them(monkeypatch):
    from drivers.trigger_box.discovery import SerialPort

    ports = (
        SerialPort("/dev/ttyACM0", "Pico", "2e8a:000a", "E660", True),
        SerialPort("/dev/ttyACM1", "Pico", "2e8a:000a", "E661", False),
        SerialPort("/dev/ttyS0", "", None, None, False),
    )
    monkeypatch.setattr("drivers.trigger_box.discovery.serial_ports", lambda: ports)
    found = list(doctor._ports())
    assert [f.verdict for f in found] == [Verdict.OK, Verdict.WARNING, Verdict.NOTE]
    assert "serial number E660" in found[0].text
    assert "usermod -aG" in found[1].remedy
    assert 'ATTRS{idVendor}=="2e8a"' in found[1].remedy
    assert "/etc/udev/rules.d/" in found[1].remedy


def test_a_trigger_box_is_asked_whether_it_answers():
    from drivers.trigger_box.settings import SltSettings
    from sim_backend.trigger_box import SltBoxEmulator

    with SltBoxEmulator() as box:
        settings = SltSettings(port=box.port)
        (found,) = doctor.examine_hardware(SimpleNamespace(trigger=settings))
        assert found.verdict is Verdict.OK, found
        assert box.port in found.text
    (found,) = doctor.examine_hardware(SimpleNamespace(trigger=settings))
    assert (found.topic, found.item, found.verdict) == ("bench trigger", "slt", Verdict.FAULT)
    (found,) = doctor.examine_hardware(SimpleNamespace(trigger=SimpleNamespace(driver="software")))
    assert found.verdict is Verdict.OK


def test_usb_projectors_with_a_rule_to_paste(monkeypatch):
    from drivers import SystemClock
    from drivers.lightcrafter.settings import LightCrafter6500Settings
    from sim_backend.lightcrafter import EmulatedDlpc350, EmulatedDlpc900, EmulatedUsb

    there, closed = EmulatedDlpc900(SystemClock(), serial="LC65"), EmulatedDlpc350(SystemClock())
    closed.permitted = False
    usb = EmulatedUsb(there, closed)
    monkeypatch.setattr("drivers.lightcrafter.discovery.libusb", lambda: usb)
    found = list(doctor._projectors())
    assert [f.verdict for f in found] == [Verdict.OK, Verdict.WARNING]
    assert "LC65" in found[0].text
    rule = next(line for line in found[1].remedy.split("\n") if "6401" in line)
    assert rule.startswith('SUBSYSTEM=="usb", ATTR{idVendor}=="0451"')

    (found,) = doctor.examine_hardware(SimpleNamespace(projector=LightCrafter6500Settings(serial="LC65")))
    assert found.verdict is Verdict.OK, found
    assert "LC65" in found.text
    assert not usb.claimed
    (found,) = doctor.examine_hardware(SimpleNamespace(projector=LightCrafter6500Settings(serial="LC66")))
    assert (found.topic, found.item, found.verdict) == ("bench projector", "lightcrafter6500", Verdict.FAULT)
    assert "LC66" in found.text
    assert found.remedy


def test_nothing_of_it_is_loaded_before_it_is_asked():
    code = (
        "import sys, drivers.doctor; print([m for m in ('usb', 'serial', 'harvesters', 'pyglet') if m in sys.modules])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert done.stdout.strip() == "[]"
