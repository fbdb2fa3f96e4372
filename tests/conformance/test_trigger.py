"""What every trigger box does, whoever drives it.

A subject is a file in ``subjects/`` with a context manager ``trigger(tmp_path)`` that yields a closed trigger box, a
function that gives so many edges to its input, slowly enough for it, and one that says how many pulses it has given.
"""

import importlib.util
import json
import os
import threading
from pathlib import Path

import psutil
import pytest

from drivers import DeviceSettingError, DeviceState, IllegalCallError, Trigger, TriggerCounts


def _modules():
    for file in sorted((Path(__file__).parent / "subjects").glob("*.py")):
        spec = importlib.util.spec_from_file_location(f"trigger_subject_{file.stem}", file)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        if hasattr(module, "trigger"):
            yield pytest.param(module, id=file.stem)


SUBJECTS = list(_modules())


@pytest.fixture(params=SUBJECTS)
def subject(request, tmp_path):
    """A closed box, its edges and its pulses."""
    with request.param.trigger(tmp_path) as (box, give_edges, pulses):
        try:
            yield box, give_edges, pulses
        finally:
            box.close()


@pytest.fixture
def ready(subject):
    """A configured box."""
    box, give_edges, pulses = subject
    box.open()
    box.configure()
    return box, give_edges, pulses


def assert_counts(box, sent):
    """As many pulses as were given, none missed, and where the camera tells, as many exposures."""
    counts = box.counts()
    assert isinstance(counts, TriggerCounts)
    assert (counts.sent, counts.missed) == (sent, 0)
    assert counts.exposed in (None, sent)


def test_goes_through_its_states(subject):
    box, _, _ = subject
    assert isinstance(box, Trigger)
    assert box.state is DeviceState.CLOSED
    for call, state in (
        ("open", DeviceState.OPEN),
        ("configure", DeviceState.CONFIGURED),
        ("configure", DeviceState.CONFIGURED),
        ("arm", DeviceState.ARMED),
        ("arm", DeviceState.ARMED),
        ("stop", DeviceState.CONFIGURED),
        ("stop", DeviceState.CONFIGURED),
        ("close", DeviceState.CLOSED),
        ("close", DeviceState.CLOSED),
        ("open", DeviceState.OPEN),
        ("stop", DeviceState.OPEN),
    ):
        getattr(box, call)()
        assert box.state is state, call


def test_refuses_what_its_state_does_not_allow(subject):
    box, _, _ = subject
    for reach, state, refused in (
        (None, "CLOSED", ("configure", "arm", "fire", "counts", "stop")),
        ("open", "OPEN", ("open", "arm", "fire", "counts")),
        ("configure", "CONFIGURED", ("open", "fire")),
        ("arm", "ARMED", ("open", "configure")),
    ):
        if reach:
            getattr(box, reach)()
        for call in refused:
            with pytest.raises(IllegalCallError, match=rf"{box.name}: {call}\(\) .* {state}"):
                getattr(box, call)()
    assert_counts(box, 0)


def test_gives_one_pulse_for_each_request(ready):
    box, _, pulses = ready
    box.arm()
    before = pulses()
    for number in range(1, 6):
        box.fire()
        threading.Event().wait(2e-3)
        assert pulses() - before == number
        assert_counts(box, number)


def test_gives_no_pulse_unasked(ready):
    box, give_edges, pulses = ready
    before = pulses()
    give_edges(2)
    box.arm()
    give_edges(2)
    assert_counts(box, 0)
    box.stop()
    give_edges(2)
    assert pulses() == before


def test_gives_one_pulse_for_each_edge_and_no_more(ready):
    box, give_edges, pulses = ready
    for wanted in (1, 7, 20):
        before = pulses()
        box.arm(wanted)
        give_edges(wanted)
        assert pulses() - before == wanted
        assert_counts(box, wanted)
        give_edges(3)
        assert pulses() - before == wanted
        assert_counts(box, wanted)
        box.stop()


def test_counts_edges_that_stay_away(ready):
    box, give_edges, pulses = ready
    before = pulses()
    box.arm(9)
    give_edges(4)
    assert_counts(box, 4)
    box.stop()
    give_edges(2)
    assert pulses() - before == 4
    assert_counts(box, 4)


def test_arming_forgets_the_counts(ready):
    box, give_edges, _ = ready
    box.arm(3)
    give_edges(3)
    box.arm(3)
    assert_counts(box, 0)
    box.arm()
    box.fire()
    box.stop()
    assert_counts(box, 1)
    box.arm()
    assert_counts(box, 0)


def test_refuses_to_fire_while_edges_are_awaited(ready):
    box, give_edges, _ = ready
    box.arm(2)
    with pytest.raises(IllegalCallError, match=r"fire\(\).*2 edges"):
        box.fire()
    give_edges(2)
    assert_counts(box, 2)


@pytest.mark.parametrize("pulses", [0, -1, 1_000_000])
def test_refuses_numbers_that_it_cannot_count(ready, pulses):
    box, _, _ = ready
    with pytest.raises(DeviceSettingError, match=f"{pulses}") as caught:
        box.arm(pulses)
    assert caught.value.remedy
    assert box.state is DeviceState.CONFIGURED


def test_describes_itself_in_every_state(subject):
    box, _, _ = subject
    for call in (None, "open", "configure", "arm", "fire", "stop", "close"):
        if call:
            getattr(box, call)()
        told = json.loads(json.dumps(box.describe()))
        assert told["name"] == box.name
        assert told["state"] == box.state.name
        assert told["settings"]["driver"]


def test_leaves_nothing_behind(subject):
    box, give_edges, _ = subject
    process = psutil.Process(os.getpid())
    before = threading.active_count(), process.num_fds(), process.children()
    for _ in range(3):
        box.open()
        box.configure()
        box.arm(2)
        give_edges(1)
        box.close()
    assert (threading.active_count(), process.num_fds(), process.children()) == before
