"""The wizard from first step to certificate, interrupted, resumed, repeated; the simulated bench knows the truth."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time

import numpy as np
import pytest
from small_bench import calibrate

from calibration.folder import CERTIFICATE, CERTIFICATE_DATA, OPENCV_RIG, RIG, read_steps
from scanner.config import load_config
from scanner.rig import Rig
from scanner.take import Take, TakeWriter

STEPS = ["focus", "exposure", "latency", "response", "geometry", "acceptance"]
CALIBRATE = [sys.executable, "-c", "from calibration.cli import main; main()"]


def truth(config):
    return load_config(config, {}).bench_settings.rig()


def agrees(rig, true, sigmas=4.0):
    """Whether every estimated parameter is within its stated uncertainty of the truth."""
    notes = rig.metadata["calibration"]
    known = dict(
        zip(notes["parameters"], zip(notes["values"], notes["standard_uncertainty"], strict=True), strict=True)
    )
    for name, lens in (("camera", true.camera), ("projector", true.projector)):
        for parameter, place in (("fx", (0, 0)), ("fy", (1, 1)), ("cx", (0, 2)), ("cy", (1, 2))):
            if f"{name}.{parameter}" in known:
                value, sigma = known[f"{name}.{parameter}"]
                assert abs(value - lens.matrix[place]) < sigmas * sigma, f"{name}.{parameter}"
                assert sigma < 0.01 * lens.matrix[0, 0], "an uncertainty that says nothing"
    length = np.linalg.norm(rig.translation)
    assert abs(length - np.linalg.norm(true.translation)) < 0.005 * length
    return True


def test_rig_is_that_of_the_bench_within_its_own_uncertainty(calibrated):
    assert calibrated.ran.code == 0, calibrated.ran
    rig = Rig.load(calibrated.folder / RIG)
    assert agrees(rig, truth(calibrated.config))
    assert rig.metadata["display_latency"]["samples"] > 0
    assert rig.metadata["projector_response"]["gamma"] == pytest.approx(1.6, abs=0.02)


def test_folder_holds_what_was_found_and_the_recordings(calibrated):
    folder = calibrated.folder
    assert list(read_steps(folder)["steps"]) == STEPS
    takes = {place.name: Take.open(place).status for place in (folder / "takes").iterdir()}
    assert {"focus", "exposure-01", "latency-steps", "latency", "response-ramp", "pose-01", "pose-05"} <= set(takes)
    assert set(takes.values()) == {"completed"}
    opened = Rig.load(folder / OPENCV_RIG)
    np.testing.assert_allclose(opened.camera.matrix, Rig.load(folder / RIG).camera.matrix)
    certificate = json.loads((folder / CERTIFICATE_DATA).read_text())
    assert certificate["simulated"] is True
    assert (folder / CERTIFICATE).read_text().startswith("<!DOCTYPE html>")


def test_terminal_says_what_to_put_into_the_bench_file(calibrated):
    said = calibrated.ran.out
    assert "rig.json" in said.split("put into")[1]
    assert "bench.camera.exposure_us: 16667" in said
    assert len(said.splitlines()) < 60, "plain lines are few"
    assert calibrated.ran.err == ""


def test_what_is_done_is_not_done_again(calibrated, tmp_path):
    folder = calibrated.copied(tmp_path / "again")
    before = sorted(place.name for place in (folder / "takes").iterdir())
    ran = calibrate("--config", calibrated.config, "--headless", "--out", folder)
    assert ran.code == 0
    assert all(f"{step}: done before" in ran.out for step in STEPS[:5])
    assert "01-plane-1 is there already" in ran.out
    assert sorted(place.name for place in (folder / "takes").iterdir()) == before


@pytest.fixture
def interrupt_at(monkeypatch):
    """Ctrl-C as the third frame of a certain recording, or the only one, is written."""
    wanted = [""]
    write = TakeWriter.write_frame

    def writing(take, *args, **kwargs):
        write(take, *args, **kwargs)
        if wanted[0] and wanted[0] in f"{take.path}/":
            wanted[0] = ""
            signal.raise_signal(signal.SIGINT)

    monkeypatch.setattr(TakeWriter, "write_frame", writing)

    def at(name):
        wanted[0] = name

    return at


def test_interrupted_in_every_step_it_goes_on(bench_file, tmp_path, interrupt_at):
    folder = tmp_path / "calibration"
    places = [
        "focus",
        "exposure-01",
        "latency-steps",
        "latency/",
        "response-ramp",
        "response-frequencies",
        "pose-01",
        "pose-04",
        "01-plane",
    ]
    for place in places:
        interrupt_at(place)
        ran = calibrate("--config", bench_file, "--headless", "--out", folder)
        assert ran.code == 130, (place, ran)
        assert "interrupted" in ran.err
        assert "goes on from here" in ran.err
        done = list(read_steps(folder)["steps"])
        step = place.strip("/").split("-")[0].replace("pose", "geometry").replace("01", "acceptance")
        assert done == STEPS[: STEPS.index(step)], place
        if place == "pose-04":
            assert len(list((folder / "poses").glob("pose-*.npz"))) == 2, "poses so far are kept"
    ran = calibrate("--config", bench_file, "--headless", "--out", folder)
    assert ran.code == 0, ran
    cut_off = {place.name for place in (folder / "takes").glob("*.cut-off")}
    # A number of a pose is never used twice, so that a cut-off one keeps its name.
    assert cut_off == {
        f"{name}.cut-off"
        for name in ("focus", "exposure-01", "latency-steps", "latency", "response-ramp", "response-frequencies")
    }
    for place in (folder / "takes").iterdir():
        is_whole = place.name not in cut_off and place.name not in ("pose-01", "pose-04")
        assert (Take.open(place).status == "completed") == is_whole, place.name
    assert agrees(Rig.load(folder / RIG), truth(bench_file))


def test_killed_and_terminated_it_goes_on(calibrated, tmp_path):
    folder = calibrated.copied(tmp_path / "calibration")
    command = [*CALIBRATE, "--config", str(calibrated.config), "--headless", "--out", str(folder)]
    for stop, again, code in ((signal.SIGKILL, ["--step", "geometry"], -9), (signal.SIGTERM, [], 130)):
        number = len(list((folder / "takes").glob("pose-*")))
        process = subprocess.Popen([*command, *again], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        try:
            deadline = time.monotonic() + 60
            while len(list((folder / "takes").glob("pose-*"))) == number:
                assert process.poll() is None, process.communicate()
                assert time.monotonic() < deadline
                time.sleep(0.02)
            process.send_signal(stop)
            _, errors = process.communicate(timeout=30)
        finally:
            process.kill()
        assert process.returncode == code, errors
        assert "Traceback" not in errors
        assert "geometry" not in read_steps(folder)["steps"]
        assert not (folder / RIG).exists(), "the former rig is not taken for the new one"
    ran = calibrate("--config", calibrated.config, "--headless", "--out", folder, "--step", "geometry")
    assert ran.code == 0, ran
    assert agrees(Rig.load(folder / RIG), truth(calibrated.config))
    assert len(list((folder / "poses").glob("dropped-pose-0[1-5].npz"))) == 5, "the former poses are kept"
    assert Rig.load(folder / "rig.former.json").to_json() == Rig.load(calibrated.folder / RIG).to_json()
    assert [old["step"] for old in read_steps(folder)["history"]] == ["geometry", "acceptance"]


def test_verify_judges_a_rig_and_keeps_the_former_scans(calibrated, tmp_path):
    folder = calibrated.copied(tmp_path / "verified")
    limits = ["--set", "calibration.acceptance.limits.flatness_mm=0.0001"]
    ran = calibrate("verify", "--config", calibrated.config, "--headless", "--out", folder, *limits)
    assert ran.code == 4, "the limit is too tight for any bench"
    assert "fail" in ran.out
    assert (folder / "acceptance.former" / "01-plane-1" / "result.json").is_file()
    empty = ["--set", "calibration.acceptance.artefacts=[]"]
    ran = calibrate("verify", "--config", calibrated.config, "--headless", "--out", folder, *empty)
    assert ran.code == 2
    assert "names nothing to scan" in ran.err


@pytest.mark.parametrize(("bump_deg", "code"), [(0.0, 0), (0.1, 4)])
def test_check_finds_a_projector_that_was_bumped(calibrated, tmp_path, bump_deg, code):
    """0.1° turns the projector's picture by 0.87 px at f ≈ 500 px, a hundred times what a point is uncertain by."""
    folder = calibrated.copied(tmp_path / "checked")
    rig = Rig.load(folder / RIG)
    turn = np.radians(bump_deg)
    about_x = np.array([[1, 0, 0], [0, np.cos(turn), -np.sin(turn)], [0, np.sin(turn), np.cos(turn)]])
    bumped = json.loads((folder / RIG).read_text())
    bumped["rotation"] = (about_x @ rig.rotation).tolist()
    (tmp_path / "rig.json").write_text(json.dumps(bumped))
    before = (folder / RIG).read_bytes()
    ran = calibrate(
        "check", "--config", calibrated.config, "--headless", "--out", folder, "--rig", tmp_path / "rig.json"
    )
    assert ran.code == code, ran
    assert ("the rig holds" in ran.out) == (code == 0)
    assert (folder / RIG).read_bytes() == before


def test_step_again_says_what_it_may_have_spoilt(calibrated, tmp_path):
    folder = calibrated.copied(tmp_path / "focus")
    ran = calibrate("--config", calibrated.config, "--headless", "--out", folder, "--step", "focus")
    assert ran.code == 0
    assert "the rig was found before this" in ran.out
    assert (folder / "takes" / "focus.former").is_dir()


def test_step_that_finds_a_fault_stops_with_a_remedy_and_is_not_done(bench_file, tmp_path):
    folder = tmp_path / "dark"
    bright = ["--set", "bench.camera.exposure_us=60000", "--set", "calibration.exposure.shortest_us=50000"]
    ran = calibrate("--config", bench_file, "--headless", "--out", folder, *bright)
    assert ran.code == 4, ran
    assert "too_bright" in ran.err
    assert "Close the aperture" in ran.err
    assert "the same command" in ran.err
    assert list(read_steps(folder)["steps"]) == ["focus"]


def test_geometry_that_is_refused_says_how_to_go_on(calibrated, tmp_path):
    folder = calibrated.copied(tmp_path / "refused")
    wrong = ["--set", "calibration.expected.baseline_mm=250", "--set", "calibration.hand.seed=5"]
    ran = calibrate("--config", calibrated.config, "--headless", "--out", folder, "--step", "geometry", *wrong)
    assert ran.code == 4, ran
    assert "wrong_scale" in ran.err
    assert "calibration.geometry.poses=7" in ran.err
    assert not (folder / RIG).exists()
    assert len(list((folder / "poses").glob("pose-*.npz"))) == 5, "what was taken stays"
