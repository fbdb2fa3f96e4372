"""A device in a process of its own: what becomes of it when it, or this program, does not behave."""

import contextlib
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest
from process_servers import Echo, Sulking, crash_at_once, hang_at_once, nothing_there

from drivers import DeviceLostError, DeviceNotFoundError, FrameLossError, HardwareError
from drivers.process import DeviceProcess

TESTS = Path(__file__).parent.parent


@pytest.fixture(scope="module")
def standing():
    process = DeviceProcess("echo", Echo, "hello")
    yield process
    process.stop()


@pytest.fixture
def echo(standing):
    """A running process with nothing left to say; it is only made anew where a test has ended it."""
    if not standing.alive:
        standing.stop()
        standing.start()
    assert standing.next_event(0.0) is None
    return standing


def gone(pid, within_s=20.0):
    """Whether the process ends in time."""
    deadline = time.monotonic() + within_s
    with contextlib.suppress(psutil.NoSuchProcess):
        while psutil.Process(pid).status() != psutil.STATUS_ZOMBIE:
            if time.monotonic() > deadline:
                return False
            time.sleep(0.02)
    return True


def test_calls_are_answered_by_another_process(echo):
    answer = echo.call("greet", "you")
    assert answer == f"hello you from {echo.pid}"
    assert echo.pid != os.getpid()
    assert echo.alive


def test_events_come_in_order_and_none_is_made_up(echo):
    echo.call("emit", 1, "two", (3.0, None))
    assert [echo.next_event(1.0) for _ in range(3)] == [1, "two", (3.0, None)]
    began = time.monotonic()
    assert echo.next_event(0.1) is None
    assert time.monotonic() - began >= 0.1


def test_a_post_is_not_waited_for(echo):
    echo.call("ticks")
    echo.post("emit", "posted")
    assert echo.next_event(5.0) == "posted"
    # The answer to a call is never that of the post before it.
    echo.post("ticks")
    assert echo.call("greet", "you").startswith("hello you")


def test_what_a_post_raises_arrives_as_an_event(echo):
    echo.post("fail_as_operator")
    error = echo.next_event(5.0)
    assert isinstance(error, FrameLossError)
    assert error.message == "frames 3 to 5 are missing"


def test_errors_travel_with_their_kind_and_remedy(echo):
    with pytest.raises(FrameLossError, match="frames 3 to 5 are missing") as caught:
        echo.call("fail_as_operator")
    assert caught.value.remedy == "Take it again."
    with pytest.raises(HardwareError, match=r"fail_as_program\(\) failed: ZeroDivisionError: one by none"):
        echo.call("fail_as_program")
    assert echo.call("greet", "you").startswith("hello")


def test_it_is_idle_between_commands(echo):
    ticks = 0
    for seconds in (0.1, 0.4, 1.6, 6.4):  # a busy machine may give it no processor at first
        before = echo.call("ticks")
        time.sleep(seconds)
        ticks = echo.call("ticks") - before
        if ticks > 5:
            break
    assert ticks > 5


def test_a_crash_is_named_by_its_signal(echo):
    pid = echo.pid
    with pytest.raises(DeviceLostError, match="echo: its process was ended by SIGSEGV") as caught:
        echo.call("crash")
    assert caught.value.remedy
    assert not echo.alive
    with pytest.raises(DeviceLostError, match="SIGSEGV"):
        echo.next_event(1.0)
    with pytest.raises(DeviceLostError, match="SIGSEGV"):
        echo.post("ticks")
    assert gone(pid)
    echo.stop()
    echo.start()
    assert echo.call("greet", "again").startswith("hello again")


def test_events_before_a_crash_are_not_lost(echo):
    echo.call("emit", 1, 2)
    with pytest.raises(DeviceLostError):
        echo.call("crash")
    assert [echo.next_event(1.0), echo.next_event(1.0)] == [1, 2]
    with pytest.raises(DeviceLostError):
        echo.next_event(1.0)


def test_an_end_that_nobody_asked_for_is_seen(echo):
    with pytest.raises(DeviceLostError, match="exit code 7"):
        echo.call("leave", 7)


def test_what_hangs_is_given_up_and_killed(echo):
    pid = echo.pid
    with pytest.raises(DeviceLostError, match=r"no answer to hang\(\) within 0\.2 s"):
        echo.call("hang", timeout_s=0.2)
    assert gone(pid)
    with pytest.raises(DeviceLostError):
        echo.call("greet", "you")


def test_the_terminals_interrupt_does_not_reach_it(echo):
    os.kill(echo.pid, signal.SIGINT)
    assert echo.call("greet", "you").startswith("hello")
    assert echo.call("interrupt_handling")


def test_the_answer_to_an_interrupted_call_is_not_taken_for_the_next(echo):
    def interrupted_call():
        signal.setitimer(signal.ITIMER_REAL, 0.1)
        echo.call("hang", 0.4)

    signal.signal(signal.SIGALRM, signal.default_int_handler)
    try:
        with pytest.raises(KeyboardInterrupt):
            interrupted_call()
    finally:
        signal.signal(signal.SIGALRM, signal.SIG_DFL)
    assert echo.call("greet", "you").startswith("hello you")
    assert echo.alive


def test_interrupts_of_this_program_are_as_before(echo):
    assert signal.pthread_sigmask(signal.SIG_BLOCK, []) == set()
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)


@pytest.mark.parametrize(
    ("factory", "patience_s", "error", "words"),
    [
        (nothing_there, 20.0, DeviceNotFoundError, "no such thing"),
        (crash_at_once, 20.0, DeviceLostError, "SIGSEGV"),
        (hang_at_once, 0.5, DeviceLostError, r"no answer to start\(\)"),
    ],
)
def test_what_cannot_start_leaves_no_process(factory, patience_s, error, words):
    process = DeviceProcess("echo", factory)
    with pytest.raises(error, match=words):
        process.start(patience_s)
    assert not process.alive
    assert process.pid is None


def test_stop_closes_the_server_and_may_be_called_at_any_time(tmp_path):
    note = tmp_path / "note"
    process = DeviceProcess("echo", Echo, str(note))
    process.stop()
    process.start()
    pid = process.pid
    process.stop()
    process.stop()
    assert note.read_text() == "closed"
    assert gone(pid)
    with pytest.raises(DeviceLostError, match="not running"):
        process.call("greet", "you")
    with pytest.raises(DeviceLostError, match="not running"):
        process.next_event(0.1)


def test_what_cannot_be_closed_is_killed():
    process = DeviceProcess("echo", Sulking)
    process.start()
    pid = process.pid
    began = time.monotonic()
    process.stop(timeout_s=0.3)
    assert time.monotonic() - began < 30.0, "half of what it would take by itself"
    assert gone(pid)


def test_it_ends_with_this_program_even_where_that_is_killed(tmp_path):
    note = tmp_path / "note"
    program = subprocess.Popen(
        [sys.executable, "-c", f"from process_servers import main_program; main_program({str(note)!r})"],
        stdout=subprocess.PIPE,
        text=True,
        cwd=TESTS.parent,
        env={**os.environ, "PYTHONPATH": f"{TESTS}{os.pathsep}{TESTS.parent}"},
    )
    with program:
        pid = int(program.stdout.readline())
        assert psutil.pid_exists(pid)
        program.kill()
    assert gone(pid)
    assert note.read_text() == "closed"
