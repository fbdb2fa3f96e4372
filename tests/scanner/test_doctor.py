"""`scan doctor`: what it measures against the system's own figures, what it judges against arithmetic, that it ends."""

from __future__ import annotations

import contextlib
import io
import json
import os
import shutil
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import psutil
import pytest
from rich.console import Console

from drivers import OperatorError
from drivers.examination import Finding, Verdict
from scanner.config import load_config
from scanner.doctor import examinations, page
from scanner.doctor.bounded import CutShortError, bounded
from scanner.doctor.machine import Machine, machine_findings, measure
from scanner.doctor.readiness import Planned, judge, storage
from scanner.patterns import Plan, phase_steps

SCAN = [sys.executable, "-c", "from scanner.cli import main; main()"]
HEALTHY = Machine(
    folder=Path("/data"),
    free_bytes=500 * 10**9,
    write_bytes_per_s=900e6,
    memory_bytes=32 * 10**9,
    available_bytes=24 * 10**9,
    shared_free_bytes=16 * 10**9,
    processors=8,
    processor_name="Processor",
    system="Linux",
    clock_source="tsc",
    governor="performance",
    overslept_s=6e-5,
)


def machine(**changes):
    return Machine(**({f: getattr(HEALTHY, f) for f in HEALTHY.__dataclass_fields__} | changes))


def verdicts(findings):
    return {(f.topic, f.item): f.verdict for f in findings}


# --- in a process of its own ------------------------------------------------------------------------------------------


@pytest.fixture
def strange(tmp_path, monkeypatch):
    """A module that misbehaves, importable here and in the processes that are started."""
    (tmp_path / "strange.py").write_text(
        textwrap.dedent(
            """
            import os, signal, subprocess, sys, time
            from drivers import HardwareError

            def three():
                print("noise"); print("noise", file=sys.stderr); os.write(1, b"noise")
                yield from (1, 2, 3)

            def hangs(file):
                child = subprocess.Popen(["sleep", "600"])
                with open(file, "w") as log:
                    log.write(f"{os.getpid()} {child.pid}")
                yield "before"
                time.sleep(600)

            def crashes():
                yield "before"
                os.kill(os.getpid(), signal.SIGSEGV)

            def raises():
                yield "before"
                raise ZeroDivisionError("by zero")

            def refuses():
                raise HardwareError("the lamp is off", "Switch it on.")
                yield
            """
        ),
        encoding="utf-8",
    )
    monkeypatch.syspath_prepend(tmp_path)
    import strange

    yield strange
    del sys.modules["strange"]


def test_items_come_and_noise_does_not(strange, capfd):
    assert list(bounded(20.0, strange.three)) == [1, 2, 3]
    assert capfd.readouterr() == ("", "")


def assert_end(pids):
    """The processes whose numbers are in the file end soon."""
    deadline = time.monotonic() + 20
    for pid in map(int, pids.read_text(encoding="utf-8").split()):
        with contextlib.suppress(psutil.NoSuchProcess):
            while psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
                assert time.monotonic() < deadline
                time.sleep(0.02)


def test_what_hangs_is_ended_with_its_children_and_what_it_gave_is_kept(strange, tmp_path):
    pids = tmp_path / "pids"
    for limit_s in (1.5, 6.0, 24.0):  # a busy machine takes a while to start a process
        began, got = time.monotonic(), []
        with pytest.raises(CutShortError, match=rf"no answer within {limit_s:g} s"):
            got.extend(iter(bounded(limit_s, strange.hangs, str(pids))))
        assert time.monotonic() - began < limit_s + 10
        if got:
            break
    assert got == ["before"]
    assert_end(pids)


@pytest.mark.parametrize(
    ("function", "error", "words"),
    [
        ("crashes", CutShortError, "crashed .SIGSEGV"),
        ("raises", CutShortError, "ZeroDivisionError: by zero"),
        ("refuses", OperatorError, "lamp is off"),
    ],
)
def test_what_fails_says_how(strange, function, error, words):
    with pytest.raises(error, match=words):
        list(bounded(20.0, getattr(strange, function)))


def test_an_interrupted_look_leaves_no_process(strange, tmp_path):
    items = bounded(60.0, strange.hangs, str(tmp_path / "pids"))
    assert next(items) == "before"
    items.close()
    assert_end(tmp_path / "pids")


# --- the machine ------------------------------------------------------------------------------------------------------


def test_measured_machine_agrees_with_the_system(tmp_path):
    deep = tmp_path / "not" / "there" / "yet"
    (found,) = measure(deep)
    assert found.folder == tmp_path
    assert not deep.parent.exists()
    assert list(tmp_path.iterdir()) == []
    assert found.free_bytes == pytest.approx(shutil.disk_usage(tmp_path).free, rel=0.05)
    assert 1e6 < found.write_bytes_per_s < 1e11
    lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
    memory = {line.split(":")[0]: int(line.split()[1]) * 1024 for line in lines}
    assert found.memory_bytes == memory["MemTotal"]
    assert found.available_bytes == pytest.approx(memory["MemAvailable"], rel=0.2)
    assert found.processors == len(os.sched_getaffinity(0))
    assert 0 <= found.overslept_s < 10
    assert found.shared_free_bytes == pytest.approx(shutil.disk_usage("/dev/shm").free, rel=0.2)


def test_a_folder_that_cannot_be_written_is_a_fault():
    (found,) = measure(Path("/proc/self/recording"))
    assert found.write_bytes_per_s is None
    assert Verdict.FAULT in [f.verdict for f in machine_findings(found) if f.topic == "disk"]


@pytest.mark.parametrize(
    ("changes", "where", "verdict"),
    [
        ({}, ("machine", "clock"), Verdict.OK),
        ({"free_bytes": 9 * 10**8}, ("disk", "/data"), Verdict.FAULT),
        ({"processors": 1}, ("machine", "processors"), Verdict.WARNING),
        ({"governor": "powersave"}, ("machine", "processors"), Verdict.NOTE),
        ({"clock_source": "hpet"}, ("machine", "clock"), Verdict.WARNING),
        ({"overslept_s": 0.004}, ("machine", "clock"), Verdict.WARNING),
        ({"shared_free_bytes": 64 << 20}, ("memory", "/dev/shm"), Verdict.WARNING),
    ],
)
def test_verdicts_on_the_machine(changes, where, verdict):
    findings = [f for f in machine_findings(machine(**changes)) if (f.topic, f.item) == where]
    assert max((f.verdict for f in findings), key=list(Verdict).index) is verdict
    assert all(bool(f.remedy) == (f.verdict is not Verdict.OK) for f in findings)


# --- one configuration ------------------------------------------------------------------------------------------------

PLAN = Plan((1280, 800), tuple(phase_steps("x", f / 1280, 12) for f in (80, 81, 82)))
PLANNED = Planned(PLAN, 2, (2448, 2048), 2)
FRAME = 2448 * 2048 * 2


def test_planned_frames_are_counted():
    assert PLANNED.frames == 2 * 3 * 12
    assert PLANNED.frame_bytes == FRAME


@pytest.mark.parametrize(("free", "verdict"), [(1.19 * 72 * FRAME, Verdict.FAULT), (1.21 * 72 * FRAME, Verdict.OK)])
def test_disk_space_for_the_planned_frames(free, verdict):
    found = storage(PLANNED, machine(free_bytes=int(free)), None)
    assert verdicts(found)["disk", "space"] is verdict


@pytest.mark.parametrize(
    ("rate", "exposure_s", "verdict"),
    [
        (59 * FRAME, None, Verdict.WARNING),
        (61 * FRAME, None, Verdict.OK),
        (19 * FRAME, 0.05, Verdict.WARNING),
        (21 * FRAME, 0.05, Verdict.OK),
        (61 * FRAME, 0.001, Verdict.OK),
    ],
)
def test_write_rate_against_the_frame_rate(rate, exposure_s, verdict):
    assert verdicts(storage(PLANNED, machine(write_bytes_per_s=rate), exposure_s))["disk", "rate"] is verdict


def test_memory_estimate_agrees_with_a_measured_decoding():
    """Peak of a process that decoded 216 frames of 4008 × 2688 px in 18 sequences: 5.37 GiB."""
    plan = Plan((1280, 800), tuple(phase_steps(a, f / 1280, 12) for a in "xy" for f in range(80, 89)))
    needed = Planned(plan, 2, (4008, 2688), 1).memory_bytes
    assert 5.37 * 2**30 < needed < 1.5 * 5.37 * 2**30
    small = Planned(plan, 2, (4008, 2688), 1)
    for share, verdict in ((0.4, Verdict.FAULT), (0.8, Verdict.WARNING), (1.1, Verdict.OK)):
        found = storage(small, machine(available_bytes=int(share * needed)), None)
        assert verdicts(found)["memory", "for this scan"] is verdict


def configuration(tmp_path, text):
    path = tmp_path / "bench.yaml"
    path.write_text(text, encoding="utf-8")
    return load_config(path)


SIMULATED = "bench: {kind: simulated, camera: {width_px: 256, height_px: 192}}\n"


def test_a_simulated_bench_is_ready(tmp_path):
    found = list(judge(configuration(tmp_path, SIMULATED), HEALTHY, None))
    assert page.worst(found) is Verdict.NOTE
    space = next(f.text for f in found if (f.topic, f.item) == ("disk", "space"))
    assert "432 frames of 256 × 192 px" in space  # two rounds of 9 frequencies, 2 axes, 12 steps


def test_room_for_every_regional_sequence_at_every_exposure(tmp_path):
    scan = "scan: {exposures: [1, 0.25], max_regional_sequences: 3}\n"
    loaded = configuration(tmp_path, SIMULATED + scan)
    # Round one and three regional ones, of 9 frequencies, 2 axes and 12 steps each, at two exposures.
    frames = (1 + 3) * 9 * 2 * 12 * 2
    for free, verdict in ((1.19, Verdict.FAULT), (1.21, Verdict.OK)):
        found = list(judge(loaded, machine(free_bytes=int(free * frames * 256 * 192)), None))
        assert verdicts(found)["disk", "space"] is verdict
        assert any(f"{frames} frames of 256 × 192 px" in f.text for f in found)


def test_a_covariance_of_another_program_is_a_warning(tmp_path):
    from scanner.rig import Rig

    own = configuration(tmp_path, SIMULATED).bench_settings.rig()
    metadata = {"calibration": {"parameters": ["tripod.height"], "covariance": [[1.0]]}}
    Rig(own.camera, own.projector, own.rotation, own.translation, metadata).save(tmp_path / "rig.json")
    found = list(judge(configuration(tmp_path, SIMULATED + "rig: rig.json\n"), HEALTHY, None))
    assert verdicts(found)["rig", "covariance"] is Verdict.WARNING
    assert not [f for f in found if f.verdict is Verdict.FAULT]


def test_the_rig_of_another_camera_is_a_fault(tmp_path):
    from sim_backend.settings import SimulatedSettings

    SimulatedSettings().rig().save(tmp_path / "rig.json")
    found = list(judge(configuration(tmp_path, SIMULATED + "rig: rig.json\n"), HEALTHY, None))
    fault = next(f for f in found if f.verdict is Verdict.FAULT)
    assert (fault.topic, fault.item) == ("rig", "camera")
    assert "1024 × 768" in fault.text
    assert "256 × 192" in fault.text


HARDWARE = """\
bench:
  kind: hardware
  camera: {driver: genicam, exposure_us: 16667, width_px: 1024, height_px: 768}
  projector: {driver: window, width_px: 1280, height_px: 800}
  SETTLE
RIG
"""


@pytest.mark.parametrize(
    ("settle", "rig", "faulty"),
    [
        ("", "", {("rig", "own")}),
        ("", "rig: rig.json", {("rig", "display latency")}),
        ("settle_s: 0.2", "rig: rig.json", set()),
        ("", "rig: timed.json", set()),
    ],
)
def test_rig_and_latency_of_a_real_bench(tmp_path, settle, rig, faulty):
    from drivers import DisplayLatency
    from scanner.rig import Rig
    from sim_backend.settings import SimulatedSettings

    plain = SimulatedSettings().rig()
    plain.save(tmp_path / "rig.json")
    latency = DisplayLatency(0.05, 0.07, 50).to_json()
    timed = Rig(plain.camera, plain.projector, plain.rotation, plain.translation, {"display_latency": latency})
    timed.save(tmp_path / "timed.json")
    loaded = configuration(tmp_path, HARDWARE.replace("SETTLE", settle).replace("RIG", rig))
    of_bench = list(examinations.examine_bench(loaded))
    assert any(f.verdict is Verdict.FAULT for f in of_bench), "there is no projector here"
    found = list(judge(loaded, HEALTHY, of_bench))
    assert {(f.topic, f.item) for f in found if f.verdict is Verdict.FAULT} == faulty
    assert all(f.remedy for f in found if f.verdict is Verdict.FAULT)


# --- packages that examine --------------------------------------------------------------------------------------------


@pytest.fixture
def packages(tmp_path, monkeypatch):
    """Install packages with an examination each: name → body of ``examine``."""

    def install(**bodies):
        for name, body in bodies.items():
            info = tmp_path / f"{name}-1.0.dist-info"
            info.mkdir()
            (info / "METADATA").write_text(f"Metadata-Version: 2.1\nName: {name}\nVersion: 1.0\n", encoding="utf-8")
            (info / "entry_points.txt").write_text(
                f"[scanner.examinations]\n{name} = {name}:examine\n", encoding="utf-8"
            )
            text = "import os, time\nfrom drivers.examination import Finding, Verdict\ndef examine(settings):\n"
            (tmp_path / f"{name}.py").write_text(text + textwrap.indent(body, "    "), encoding="utf-8")
        monkeypatch.syspath_prepend(tmp_path)

    # This project's own examination is the subject of other tests.
    own = examinations.entry_points
    monkeypatch.setattr(
        examinations, "entry_points", lambda **which: [e for e in own(**which) if e.value != "drivers.doctor:examine"]
    )
    return install


def test_packages_that_hang_or_crash_do_not_hide_the_others(packages, monkeypatch):
    packages(
        a_hangs="yield Finding('lamps', 'one', Verdict.OK, 'shines')\ntime.sleep(600)\n",
        b_crashes="os.abort()\nyield\n",
        c_works="yield Finding('lamps', 'two', Verdict.OK, f'shines {settings}')\n",
    )
    expected = [
        ("one", "ok"),
        ("examination a_hangs", "warning"),
        ("examination b_crashes", "warning"),
        ("two", "ok"),
    ]
    for limit_s in (2.0, 8.0, 32.0):  # a busy machine takes a while to start a process
        monkeypatch.setattr(examinations, "LIMIT_S", limit_s)
        found = list(examinations.examine_devices(None))
        if [(f.item, f.verdict.value) for f in found] == expected:
            break
    assert [(f.item, f.verdict.value) for f in found] == expected
    assert f"within {limit_s:g} s" in found[1].text
    assert "SIGABRT" in found[2].text
    assert found[3].text == "shines None"


# --- what is printed --------------------------------------------------------------------------------------------------

FINDINGS = [
    Finding("disk", "/data", Verdict.OK, "500 GB free"),
    Finding("serial ports", "/dev/ttyACM0", Verdict.WARNING, "you may not open it", "Type:\nRULE, " + 120 * "x"),
    Finding("serial ports", "/dev/ttyACM1", Verdict.WARNING, "you may not open it", "Type:\nRULE, " + 120 * "x"),
]


def printed(findings, config, width=60):
    text = io.StringIO()
    page.show(Console(file=text, width=width), findings, config)
    return text.getvalue()


def test_what_is_to_be_pasted_is_one_line_of_its_own_and_told_once():
    text = printed(FINDINGS, None)
    assert text.count("RULE") == 1
    assert "RULE, " + 120 * "x" in text.split("\n")
    assert "/dev/ttyACM0, /dev/ttyACM1: Type:" in text
    assert "nothing stands in the way of a scan; 2 warnings" in text


def test_the_verdict_names_the_configuration():
    assert "a scan with b.yaml can start" in printed(FINDINGS[:1], "b.yaml")
    broken = [*FINDINGS, Finding("rig", "own", Verdict.FAULT, "none", "Calibrate.")]
    assert "a scan with b.yaml cannot start: 1 fault, 2 warnings" in printed(broken, "b.yaml")
    document = page.to_json(broken, "b.yaml")
    assert document["ready"] is False
    assert document["worst"] == "fault"
    assert page.to_json(FINDINGS, "b.yaml")["ready"] is True
    assert page.to_json(broken, None)["ready"] is None
    assert document["findings"][0] == {
        "topic": "disk", "item": "/data", "verdict": "ok", "text": "500 GB free", "remedy": "",
    }  # fmt: skip


def doctor(tmp_path, *args):
    environment = {k: v for k, v in os.environ.items() if k not in ("DISPLAY", "GENICAM_GENTL64_PATH")}
    return subprocess.run(
        [*SCAN, "doctor", *args],
        cwd=tmp_path,
        env=environment,
        capture_output=True,
        text=True,
        timeout=120,
        check=False,
    )


def test_command_for_a_bench_that_is_ready(tmp_path):
    (tmp_path / "bench.yaml").write_text(SIMULATED, encoding="utf-8")
    done = doctor(tmp_path, "--config", "bench.yaml", "--json")
    assert done.returncode == 0, done.stderr
    document = json.loads(done.stdout)
    assert set(document) == {"schema", "scanner", "python", "config", "ready", "worst", "findings"}
    assert document["schema"] == 1
    assert document["ready"] is True
    topics = {f["topic"] for f in document["findings"]}
    assert topics >= {"disk", "memory", "machine", "libraries", "displays", "cameras", "serial ports", "USB projectors"}
    assert all(set(f) == {"topic", "item", "verdict", "text", "remedy"} for f in document["findings"])


def test_command_for_a_bench_that_is_not_there(tmp_path):
    (tmp_path / "bench.yaml").write_text(HARDWARE.replace("SETTLE", "").replace("RIG", ""), encoding="utf-8")
    done = doctor(tmp_path, "--config", "bench.yaml")
    assert done.returncode == 3, done.stderr
    assert "a scan with bench.yaml cannot start" in done.stdout
    assert "Traceback" not in done.stdout + done.stderr


def test_command_for_a_configuration_that_is_wrong(tmp_path):
    (tmp_path / "bench.yaml").write_text("bench: {kind: simulated, sead: 1}\n", encoding="utf-8")
    done = doctor(tmp_path, "--config", "bench.yaml")
    assert done.returncode == 2
    assert "sead" in done.stderr
