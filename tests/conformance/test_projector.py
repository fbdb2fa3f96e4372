"""What every projector does, whoever drives it.

A subject is a file in ``subjects/`` with a context manager ``projector(tmp_path)`` that yields a closed projector and a
function for the grey values (height, width) that are on its surface now; that returns None where nobody can see it.
``PLAYS = True`` says that it plays sequences by itself (`drivers.SequencePlayer`).
"""

import importlib.util
import json
import threading
import time
from pathlib import Path

import numpy as np
import psutil
import pytest

from drivers import (
    DeviceSettingError,
    DeviceState,
    IllegalCallError,
    PlayRecord,
    Projector,
    SequenceFaultError,
    SequencePlayer,
)


def _modules():
    for file in sorted((Path(__file__).parent / "subjects").glob("*.py")):
        spec = importlib.util.spec_from_file_location(f"subject_{file.stem}", file)
        module = importlib.util.module_from_spec(spec)
        spec.loader.exec_module(module)
        if hasattr(module, "projector"):
            yield pytest.param(module, id=file.stem)


SUBJECTS = list(_modules())
PLAYERS = [subject for subject in SUBJECTS if getattr(subject.values[0], "PLAYS", False)]


@pytest.fixture(params=SUBJECTS)
def subject(request, tmp_path):
    """A closed projector and its surface."""
    with request.param.projector(tmp_path) as (projector, read_surface):
        try:
            yield projector, read_surface
        finally:
            projector.close()


@pytest.fixture(params=SUBJECTS, scope="module")
def standing(request, tmp_path_factory):
    """One projector for many tests: opening a device takes longer than most of them."""
    with request.param.projector(tmp_path_factory.mktemp("subject")) as (projector, read_surface):
        try:
            yield projector, read_surface
        finally:
            projector.close()


@pytest.fixture
def ready(standing):
    """A configured projector, its surface, and four pictures of noise for it."""
    projector, read_surface = standing
    if projector.state not in (DeviceState.CONFIGURED, DeviceState.ARMED):
        projector.close()
        projector.open()
        projector.configure()
    width, height = projector.size
    pictures = np.random.default_rng(7).integers(0, 256, (4, height, width), np.uint8)
    yield projector, read_surface, pictures
    if projector.state is not DeviceState.CLOSED:
        projector.darken()


@pytest.fixture
def player(ready):
    projector, read_surface, pictures = ready
    projector.load(pictures)
    return projector, read_surface, pictures


def assert_surface(read_surface, expected):
    surface = read_surface()
    if surface is not None:
        assert np.array_equal(surface, np.broadcast_to(expected, surface.shape))


def test_goes_through_its_states(subject):
    projector, _ = subject
    assert isinstance(projector, Projector)
    states = [projector.state]
    projector.open()
    states.append(projector.state)
    projector.configure()
    states.append(projector.state)
    projector.load([np.zeros(projector.size[::-1], np.uint8)])
    states.append(projector.state)
    projector.close()
    states.append(projector.state)
    assert states == [
        DeviceState.CLOSED,
        DeviceState.OPEN,
        DeviceState.CONFIGURED,
        DeviceState.ARMED,
        DeviceState.CLOSED,
    ]


def test_refuses_what_its_state_does_not_allow(subject):
    projector, _ = subject
    picture = np.zeros(projector.size[::-1], np.uint8)
    for call, arguments in (("configure", ()), ("load", ([picture],)), ("show", (0,)), ("darken", ())):
        with pytest.raises(IllegalCallError, match=rf"{call if call != 'load' else 'arm'}\(\).*CLOSED"):
            getattr(projector, call)(*arguments)
    projector.open()
    for call, arguments in (("open", ()), ("load", ([picture],)), ("show", (0,))):
        with pytest.raises(IllegalCallError, match="OPEN"):
            getattr(projector, call)(*arguments)


def test_shows_the_very_picture(ready):
    projector, read_surface, pictures = ready
    projector.load(pictures)
    for index in (0, 1, 2, 3, 3, 0, 2, 1):
        projector.show(index)
        assert_surface(read_surface, pictures[index])


def test_every_grey_value_arrives(ready):
    projector, read_surface, _ = ready
    width, height = projector.size
    ramp = (np.arange(width * height) % 256).astype(np.uint8).reshape(height, width)
    projector.load([ramp, 255 - ramp])
    for index, picture in enumerate((ramp, 255 - ramp)):
        projector.show(index)
        assert_surface(read_surface, picture)


def test_hand_over_times_do_not_run_back(ready):
    projector, read_surface, pictures = ready
    projector.load(pictures)
    times = []
    for index in range(4):
        times.append(projector.show(index))
        read_surface()
    assert np.isfinite(times).all()
    assert (np.diff(times) >= 0).all()
    assert projector.period_s > 0


def test_a_sequence_replaces_the_former_one(ready):
    projector, read_surface, pictures = ready
    projector.load(pictures)
    projector.show(3)
    projector.load(pictures[::-1][:2])
    projector.show(1)
    assert_surface(read_surface, pictures[2])
    for index in (-1, 2):
        with pytest.raises(DeviceSettingError, match=f"no picture {index} among the 2"):
            projector.show(index)


def test_loaded_pictures_are_its_own(ready):
    projector, read_surface, pictures = ready
    given = pictures.copy()
    projector.load(given)
    given[:] = 0
    projector.show(1)
    assert_surface(read_surface, pictures[1])


def test_takes_pictures_however_they_lie_in_memory(ready):
    projector, read_surface, pictures = ready
    projector.load([np.asfortranarray(pictures[0]), pictures[1][::-1, ::-1]])
    projector.show(0)
    assert_surface(read_surface, pictures[0])
    projector.show(1)
    assert_surface(read_surface, pictures[1][::-1, ::-1])


def test_refuses_other_pictures_and_keeps_the_loaded_ones(ready):
    projector, read_surface, pictures = ready
    projector.load(pictures)
    for wrong in (pictures[0][:-1], pictures[0].astype(np.uint16), pictures[0].astype(float), pictures[0].T):
        with pytest.raises(DeviceSettingError, match="picture 1"):
            projector.load([pictures[0], wrong])
    projector.show(3)
    assert_surface(read_surface, pictures[3])


def test_goes_dark_in_every_open_state(ready):
    projector, read_surface, pictures = ready
    projector.darken()
    projector.load(pictures)
    projector.show(0)
    projector.darken()
    assert_surface(read_surface, 0)
    projector.darken()
    projector.show(0)
    assert_surface(read_surface, pictures[0])


def test_is_dark_when_opened_and_when_closed(subject):
    projector, read_surface = subject
    projector.open()
    assert_surface(read_surface, 0)
    projector.configure()
    projector.load([np.full(projector.size[::-1], 255, np.uint8)])
    projector.show(0)
    assert_surface(read_surface, 255)
    projector.close()
    assert_surface(read_surface, 0)


def test_closes_in_every_state_any_number_of_times_and_opens_again(subject):
    projector, read_surface = subject
    picture = np.full(projector.size[::-1], 77, np.uint8)
    projector.close()
    projector.open()
    projector.close()
    projector.close()
    projector.open()
    projector.configure()
    projector.load([picture])
    projector.show(0)
    assert_surface(read_surface, picture)


def test_plays_if_it_says_so(request, subject):
    plays = request.node.callspec.params["subject"] in [player.values[0] for player in PLAYERS]
    assert isinstance(subject[0], SequencePlayer) == plays


def test_describes_itself_in_every_state(ready):
    projector, _, pictures = ready
    projector.close()
    projector.open()
    projector.configure()
    described = [projector.describe()]
    projector.load(pictures)
    described.append(projector.describe())
    projector.close()
    described.append(projector.describe())
    for snapshot, state in zip(described, ("CONFIGURED", "ARMED", "CLOSED"), strict=True):
        assert json.loads(json.dumps(snapshot))["state"] == state
        assert snapshot["name"] == projector.name


def test_leaves_nothing_behind(ready):
    projector, _, pictures = ready
    projector.load(pictures)
    projector.show(1)
    projector.close()
    deadline = time.monotonic() + 20.0
    while (left := _left_behind(projector)) and time.monotonic() < deadline:
        time.sleep(0.01)
    assert not left


def _left_behind(projector):
    processes = [p for p in psutil.Process().children(recursive=True) if projector.name in _line(p)]
    spawned = [p for p in psutil.Process().children() if "spawn_main" in _line(p)]
    threads = [t for t in threading.enumerate() if projector.name in t.name]
    return processes + spawned + threads


def _line(process):
    try:
        return " ".join(process.cmdline())
    except psutil.NoSuchProcess:
        return ""


only_players = pytest.mark.parametrize("standing", PLAYERS, indirect=True, scope="module")


@only_players
def test_plays_every_picture_for_a_period(player):
    projector, _, pictures = player
    projector.play()
    assert projector.state is DeviceState.RUNNING
    record = projector.finish(5.0)
    assert isinstance(record, PlayRecord)
    assert len(record.shown_s) == len(pictures)
    # Others share the machine: a picture may come late, and so be on for too short a time, but never unsaid.
    gaps = np.diff(record.shown_s)
    assert (gaps > 0).all()
    too_long = set(np.flatnonzero(gaps > 1.6 * projector.period_s) + 1)
    too_short = set(np.flatnonzero(gaps < 0.4 * projector.period_s))
    assert too_long | too_short <= set(record.late)


@only_players
def test_plays_again_and_shows_after_that(player):
    projector, read_surface, pictures = player
    for _ in range(2):
        projector.play()
        projector.finish(5.0)
    assert projector.state is DeviceState.ARMED
    projector.show(0)
    assert_surface(read_surface, pictures[0])


@only_players
def test_goes_dark_while_it_plays(player):
    projector, read_surface, pictures = player
    projector.load(np.repeat(pictures, 10, axis=0))
    projector.play()
    projector.darken()
    assert_surface(read_surface, 0)
    time.sleep(3 * projector.period_s)
    assert_surface(read_surface, 0)
    with pytest.raises(IllegalCallError):
        projector.finish(1.0)
    projector.play()
    assert len(projector.finish(10.0).shown_s) == 10 * len(pictures)


@only_players
def test_says_when_it_does_not_finish_in_time(player):
    projector, read_surface, pictures = player
    projector.load(np.repeat(pictures, 10, axis=0))
    projector.play()
    with pytest.raises(SequenceFaultError, match="not"):
        projector.finish(2 * projector.period_s)
    assert_surface(read_surface, 0)
    projector.play()
    assert len(projector.finish(10.0).shown_s) == 10 * len(pictures)


@only_players
def test_neither_shows_nor_loads_while_it_plays(player):
    projector, _, pictures = player
    projector.play()
    for call, argument in (("show", 0), ("load", pictures)):
        with pytest.raises(IllegalCallError, match="RUNNING"):
            getattr(projector, call)(argument)
    projector.finish(5.0)
