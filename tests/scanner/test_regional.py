"""Several regional sequences: what they measure, what the recording holds of them, and what is said of the rest.

The scenes, poses and seeds of this file were not used to set anything.
"""

from __future__ import annotations

import shutil
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from conftest import ArrayBench

from drivers import DeviceLostError
from scanner.acquisition import Acquisition
from scanner.config import GatesSection, ScanSection
from scanner.decoding import Decoder
from scanner.faces import Faces
from scanner.methods import METHODS
from scanner.methods.base import Setup
from scanner.methods.fold import Fold
from scanner.methods.regional import begin
from scanner.methods.separated import Separated
from scanner.patterns import Plan
from scanner.processing import process_take
from scanner.result import Flag
from scanner.take import Take, TakeWriter


def two_faces(**changes):
    """Two surfaces side by side, each of which sees the mirror image of the other."""
    rows, columns = np.mgrid[0:100, 0:150].astype(float)
    left = columns < 75
    x, y = 30.2 + 1.3 * columns + np.where(left, 0, 60), 20.4 + 1.25 * rows + 0.05 * columns
    alpha = np.where((rows > 12) & (rows < 88) & (np.abs(columns - 74.5) > 12) & (np.abs(columns - 74.5) < 62), 0.45, 0)
    values = {
        "x": x,
        "y": y,
        "alpha": alpha,
        # Slanted by 23 px, so that the paths part on both axes.
        "x_bounce": 285 - x + 12,
        "y_bounce": np.where(left, y + 23, y - 23),
    }
    return ArrayBench(**(values | changes))


def scan(bench, folder, **options):
    section = ScanSection(**({"steps": 6, "max_regional_sequences": 4} | options))
    method = METHODS["mfs"]
    plan = method.first_round(section, bench.projector_size)
    manifest = {"method": "mfs", "bench": {}, "config": {}, "plans": [plan.to_json()], "simulated": True}
    take = TakeWriter.create(
        folder / "take", frame_format=bench.frame_format, slots=plan.frame_count, manifest=manifest
    )
    job = Acquisition(bench, method, section, Decoder(method, section, bench.noise, None), take)
    with take:
        job.run()
    return job


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    folder = tmp_path_factory.mktemp("faces")
    bench = two_faces(seed=11)
    return bench, scan(bench, folder), folder


def test_faces_that_light_each_other_take_turns(both):
    bench, job, folder = both
    maps, region = job.decoder.maps, bench.alpha > 0
    assert "2 regional sequences" in job.decoder.decision
    assert sorted(Take.open(folder / "take").rounds) == [1, 2, 3]
    error = np.abs(maps.x_p - bench.x)
    assert np.isfinite(error[region]).mean() >= 0.95
    clean = error[(bench.alpha == 0) & np.isfinite(error)]
    # Without bounces the faces would be as good as what is beside them.
    inside = error[region & np.isfinite(error)]
    assert np.sqrt(np.mean(inside**2)) <= 1.5 * np.sqrt(np.mean(clean**2))
    left = np.broadcast_to(np.arange(150) < 75, region.shape)
    seen = [maps.sequence[region & side & (maps.sequence > 0)] for side in (left, ~left)]
    assert {int(np.bincount(s).argmax()) for s in seen} == {1, 2}
    # No projector pixel of a face is lit while the other is, where bounces come from.
    for k, side in enumerate((left, ~left)):
        mine = 1 << (int(np.bincount(seen[k]).argmax()) - 1)
        column, row = (np.rint(u[region & side]).astype(int) for u in (bench.x_bounce, bench.y_bounce))
        there = (row >= 0) & (row < 200) & (column >= 0) & (column < 320)
        assert ((maps.lit_by[row[there], column[there]] & mine) > 0).mean() < 0.03
    assert (maps.lit == (maps.lit_by > 0)).all()


def test_one_sequence_alone_leaves_one_face_to_round_one(tmp_path):
    bench = two_faces(seed=12)
    job = scan(bench, tmp_path, max_regional_sequences=1)
    assert sorted(Take.open(tmp_path / "take").rounds) == [1, 2]
    assert any("after 1 regional sequence" in w for w in job.decoder.warnings)


def test_the_recording_of_several_sequences_processes_to_the_same(both):
    _, job, folder = both
    again = process_take(Take.open(folder / "take"), job.scan, GatesSection(), None)
    for name in ("x_p", "y_p", "sequence", "flags"):
        np.testing.assert_array_equal(getattr(again.maps, name), getattr(job.decoder.maps, name))
    assert list(again.summary["frames"].values()) == [108, 108, 108]
    assert "2 regional sequences" in again.summary["rounds"]


def test_what_a_regional_sequence_refuses_beside_the_region_is_not_kept_from_round_one(both):
    _, job, folder = both
    take, method = Take.open(folder / "take"), METHODS["mfs"]
    rounds = []
    for number in (1, 2):
        rounds.append(method.collect(Plan.from_json(take.rounds[number]), take.frame_format))
        for sequence in range(len(take.rounds[number]["sequences"])):
            rounds[-1].add(sequence, take.frames(number, sequence))
    # A path from one place everywhere would be taken off as a ripple.
    setup = Setup(job.scan.model_copy(update={"remove_ripples": False}), job.bench.noise, None)
    first = method.decode(rounds[0], setup)
    undisturbed = method.join(first, rounds[1], setup).maps
    beside = ((undisturbed.flags & Flag.SECOND_ROUND) > 0) & ~undisturbed.interreflection
    assert beside.sum() > 100
    # Now the sequence shows a second path in all of these, and round one none.
    first = method.decode(rounds[0], setup)
    for axis in ("x", "y"):
        phasors = rounds[1].axis(axis)
        phasors.z[:, beside] += (
            0.5
            * np.abs(phasors.z[:, beside])
            * np.exp(2j * np.pi * phasors.frequency[:, None] * 700).astype(np.complex64)
        )
    maps = method.join(first, rounds[1], setup).maps
    assert np.isnan(maps.x_p[beside]).mean() > 0.95
    refused = beside & np.isnan(maps.x_p)
    assert (maps.flags[refused] & (Flag.MISFIT | Flag.STRAY) > 0).all()


@pytest.mark.parametrize("lost_in", [2, 3])
def test_a_recording_that_ends_within_a_regional_sequence_holds_those_before(tmp_path, lost_in):
    first = 2 + 108

    def fail(number, index):
        if number >= first * (lost_in - 1) + 40:
            raise DeviceLostError("camera: gone", "plug it in")

    bench = two_faces(seed=13, on_expose=fail)
    with pytest.raises(DeviceLostError):
        scan(bench, tmp_path, attempts=1)
    take = Take.open(tmp_path / "take")
    assert max(take.rounds) == lost_in
    result = process_take(take, ScanSection(steps=6, max_regional_sequences=4), GatesSection(), None)
    maps = result.maps
    assert any("not complete" in w for w in result.warnings)
    measured = (maps.flags & Flag.SECOND_ROUND) > 0
    assert measured.any() == (lost_in == 3)
    lost = maps.interreflection & ~maps.valid
    assert (maps.flags[lost] & Flag.INCOMPLETE).all()
    right = np.abs(maps.x_p - bench.x)[measured]
    assert lost_in == 2 or (right < 0.25).mean() > 0.97


def test_a_regional_round_that_is_damaged_costs_what_it_has_measured(both, tmp_path):
    _, job, folder = both
    place = tmp_path / "take"
    shutil.copytree(folder / "take", place)
    take = Take.open(place)
    broken = take.sequences(2)[3].frames[0].slot
    with (place / "frames.bin").open("r+b") as file:
        file.seek(broken * take.manifest["stride"])
        file.write(b"\xff" * 2000)
    result = process_take(Take.open(place), job.scan, GatesSection(), None)
    maps, whole = result.maps, job.decoder.maps
    assert any("the regional rounds are not complete" in w for w in result.warnings)
    assert not (maps.sequence == 1).any()
    # What the other round was meant for is as it was; the rest of the region holds what round one separates.
    same = whole.sequence == 2
    assert (maps.sequence[same] == 2).all()
    np.testing.assert_array_equal(maps.x_p[same], whole.x_p[same])
    lost = maps.interreflection & (whole.sequence == 1)
    assert (maps.flags[lost] & (Flag.SEPARATED | Flag.INCOMPLETE | Flag.SECOND_ROUND)).all()
    assert not (maps.flags[maps.interreflection & maps.valid] & Flag.INCOMPLETE).any()


def test_progress_counts_the_sequences_that_are_planned(tmp_path):
    seen = []

    class Listener:
        def state(self, state, what):
            pass

        def frame(self, progress):
            seen.append(progress)

        def note(self, text):
            pass

    bench = two_faces(seed=14)
    section, method = ScanSection(steps=6, max_regional_sequences=4), METHODS["mfs"]
    plan = method.first_round(section, bench.projector_size)
    manifest = {"method": "mfs", "bench": {}, "config": {}, "plans": [plan.to_json()], "simulated": True}
    with TakeWriter.create(
        tmp_path / "take", frame_format=bench.frame_format, slots=plan.frame_count, manifest=manifest
    ) as take:
        decoder = Decoder(method, section, bench.noise, None)
        Acquisition(bench, method, section, decoder, take, Listener()).run()
    assert [p.done for p in seen] == list(range(1, len(seen) + 1))
    assert {p.rounds for p in seen if p.round == 2} == {3}
    last = seen[-1]
    assert (last.round, last.done) == (last.rounds, last.total)


def test_where_a_bounce_is_too_weak_to_be_detected_it_is_gone_as_well(scan_simulated):
    # The paper's second experiment, small, in a pose of its own: weak bounces cover the board, below detection at W2.
    scene = {"name": "v_board_sphere", "distance_mm": 655.0, "opening_deg": 114.0, "yaw_deg": 2.0}
    settings = {
        "seed": 23,
        "camera": {"width_px": 256, "height_px": 192},
        "projector": {"width_px": 640, "height_px": 400},
        "transport": {"photons": 200_000},
    }
    maps, truth = scan_simulated(scene, options={"max_regional_sequences": 4}, **settings)
    without, _ = scan_simulated({**scene, "blackened": ["ball"]}, options={"rounds": 1}, **settings)
    window = truth.in_window("W2")
    assert not maps.interreflection[window].all()
    assert np.isfinite(maps.depth[window]).mean() >= 0.98
    # No fold between shiny faces: nothing is refused for being too near to one.
    assert ((maps.flags & np.uint16(Flag.BLIND)) > 0).sum() <= 0.001 * np.isfinite(truth.x_p).sum()
    # Between the 16 and 84 % points: a few pixels beside the ball's limb, lit with it, keep an error of their own.
    spread, twin = (
        np.subtract(*np.nanquantile((m.depth - truth.depth)[window], (0.84, 0.16))) for m in (maps, without)
    )
    assert spread <= 1.15 * twin
    alone = np.abs(maps.x_p_round1 - truth.x_p)[window]
    assert np.nanmedian(alone) > 2 * np.nanmedian(np.abs(maps.x_p - truth.x_p)[window])


def separation(x, y, bounce_x, fits):
    """Round one's separation of whole pictures: clear where it fits, a third path elsewhere."""
    fits = fits.ravel()
    return Separated(
        shape=x.shape,
        pixels=np.arange(x.size),
        u={"x": x.ravel(), "y": y.ravel()},
        sigma={"x": np.full(x.size, 0.01, np.float32), "y": np.full(x.size, 0.01, np.float32)},
        bounce={"x": bounce_x.ravel(), "y": y.ravel()},
        plausible=fits,
        trusted=fits,
        third=~fits,
        off_line=np.zeros(x.size, bool),
        located=fits,
        strength=np.full(x.size, 0.5, np.float32),
        blur=np.ones(x.size, np.float32),
    )


def test_far_from_a_clear_separation_coordinates_that_agree_say_where_to_light():
    # A square where a third path spoils the fit of two: its direct coordinates hold, its bounces do not.
    rows, columns = np.mgrid[:200, :200].astype(np.float32)
    x, y = 100 + columns, 50 + rows
    spoilt = (np.abs(rows - 100) < 80) & (np.abs(columns - 100) < 80)
    random = np.random.default_rng(3)
    bounce = np.where(spoilt, random.uniform(300, 600, x.shape), x + 350).astype(np.float32)
    separated = separation(x, y, bounce, ~spoilt)
    no = np.zeros(x.shape, bool)
    detection = SimpleNamespace(region=~no, penumbra=no, depth_edge=no)
    first = SimpleNamespace(x_p_round1=x, y_p_round1=y, valid=no)
    begun = begin(separated, detection, Fold.none(no.shape, (700, 300)), None, first, (700, 300), 8.0, 4)
    assert len(begun.queue) == 1
    assert begun.queue[0][50:250, 100:300].all()
    # Coordinates that agree with no neighbour light nothing.
    scattered = np.where(spoilt, random.uniform(300, 600, x.shape), x).astype(np.float32)
    astray = replace(separated, u={"x": scattered.ravel(), "y": y.ravel()})
    begun = begin(astray, detection, Fold.none(no.shape, (700, 300)), None, first, (700, 300), 8.0, 4)
    assert not begun.queue[0][:, 310:].any()
    assert not begun.queue[0][130:170, 180:220].any()


def test_a_surface_that_lights_the_chosen_one_stays_dark_whether_its_separations_fit_or_not():
    # Left and right light each other; only one sequence is allowed, and the larger one, on the left, is lit.
    rows, columns = np.mgrid[:120, :200].astype(np.float32)
    left = columns < 120
    x, y = np.where(left, 100 + columns, 380 + columns).astype(np.float32), 50 + rows
    bounce = np.where(left, 500 + 80 / 120 * columns, 100 + (columns - 120) * 1.5).astype(np.float32)
    spoilt = ~left & (rows > 60)
    no = np.zeros(x.shape, bool)
    detection = SimpleNamespace(region=~no, penumbra=no, depth_edge=no)
    first = SimpleNamespace(x_p_round1=x, y_p_round1=y, valid=no)
    begun = begin(
        separation(x, y, bounce, ~spoilt), detection, Fold.none(no.shape, (700, 300)), None, first, (700, 300), 8.0, 1
    )
    assert len(begun.queue) == 1
    assert begun.queue[0][60:160, 110:210].all()
    assert not begun.queue[0][:, 480:].any()


def test_around_a_region_on_a_single_face_is_measured_along():
    # One face, lit from outside the picture: nothing takes turns, and what is undetected beside it is still served.
    rows, columns = np.mgrid[:200, :200].astype(np.float32)
    x, y = 100 + columns, 50 + rows
    region = (np.abs(rows - 100) < 30) & (np.abs(columns - 100) < 30)
    whole = separation(x, y, x + 350, np.ones(x.shape, bool))
    pixels = np.flatnonzero(region)
    per_pixel = {
        name: {a: v[pixels] for a, v in values.items()} if isinstance(values, dict) else values[pixels]
        for name, values in vars(whole).items()
        if name != "shape"
    }
    separated = replace(whole, **per_pixel)
    no = np.zeros(x.shape, bool)
    detection = SimpleNamespace(region=region, penumbra=no, depth_edge=no)
    first = SimpleNamespace(x_p_round1=x, y_p_round1=y, valid=~no)
    faces = Faces(np.ones(x.shape, np.int32), x, y)
    begun = begin(separated, detection, Fold.none(no.shape, (700, 300)), faces, first, (700, 300), 8.0, 4)
    assert len(begun.queue) == 1
    beside = ~region & (np.abs(rows - 100) < 55) & (np.abs(columns - 100) < 30)
    assert begun.served[beside].all()
    assert (begun.own[beside | region] == 1).all()
    assert begun.queue[0][100:200, 175:225].all()
    # Two fringes and the margin away it is dark.
    assert not begun.queue[0][:, 280:].any()
    assert not begun.served[:20].any()
