import json
from importlib.metadata import entry_points

import numpy as np
import pytest
from pydantic import ValidationError

from drivers import Bench, DeviceState, IllegalCallError
from scanner.rig import Rig
from sim_backend.bench import kind
from sim_backend.settings import SimulatedSettings

QUIET = {"read_noise_dn": 0.0, "ambient_dn": 0.0}
PICTURES = [np.full((400, 640), level, np.uint8) for level in (255, 0, 128)]


def _shoot(bench, indices):
    frames = np.empty((len(indices), *bench.frame_format.shape), bench.frame_format.dtype)
    stamps = [bench.expose(index, frame) for index, frame in zip(indices, frames, strict=True)]
    return frames, stamps


def test_entry_point_names_the_bench_kind():
    (found,) = entry_points(group="scanner.benches", name="simulated")
    assert found.load() is kind
    assert kind.settings is SimulatedSettings


def test_bench_exposes_the_pattern_that_is_asked_for(small):
    with kind.open(small(scene={"name": "plane"}, camera=QUIET)) as bench:
        assert isinstance(bench, Bench)
        assert bench.simulated
        assert bench.projector_size == (640, 400)
        bench.prepare(PICTURES)
        # Exposures fall on changing phases of the projector's refresh.
        order = [0, 1, 2] * 7
        frames, stamps = _shoot(bench, order)
    lit = frames[0] > 100
    levels = {0: 1.0, 1: 0.0, 2: 128 / 255}
    for frame, index in zip(frames, order, strict=True):
        np.testing.assert_allclose(frame[lit] / frames[0][lit], levels[index], atol=0.01)
    assert [s.frame_id for s in stamps] == list(range(21))
    assert all(s.t_shown_s < s.t_device_s < s.t_host_s for s in stamps)


def test_too_short_a_settle_time_gives_stale_pictures(small):
    with kind.open(small(scene={"name": "plane"}, camera=QUIET, settle_s=0.005)) as bench:
        bench.prepare(PICTURES)
        (white, _, _), _ = _shoot(bench, [0, 0, 0])
        assert white.max() == 0
        (after_white,), _ = _shoot(bench, [1])
        assert after_white.max() > 100


def test_leaving_darkens_and_closes_whatever_happened(small):
    def fail_half_way():
        with kind.open(small(scene={"name": "plane"}, camera=QUIET)) as bench:
            opened.append(bench)
            bench.prepare(PICTURES)
            _shoot(bench, [0])
            raise ZeroDivisionError

    opened = []
    with pytest.raises(ZeroDivisionError):
        fail_half_way()
    (bench,) = opened
    assert bench.camera.state is DeviceState.CLOSED
    assert bench.projector.state is DeviceState.CLOSED
    now = bench.clock.now()
    (after,) = bench.projector.on_surface(now, now + 1)
    assert after[1].max() == 0
    with pytest.raises(IllegalCallError):
        bench.expose(0, np.empty((192, 256), np.uint8))


def test_seed_decides_the_noise(small):
    def frames(seed):
        with kind.open(small(scene={"name": "plane"}, seed=seed)) as bench:
            bench.prepare(PICTURES)
            return _shoot(bench, [2, 0])[0]

    first = frames(3)
    np.testing.assert_array_equal(first, frames(3))
    other = frames(4)
    assert (first != other).mean() > 0.3
    # Two sequences of the same pictures differ by the noise alone.
    difference = (first[0].astype(float) - other[0]).ravel()
    assert difference.std() == pytest.approx(1.5 * np.sqrt(2), rel=0.03)


@pytest.mark.parametrize("bits", [8, 12])
def test_bench_knows_its_format_noise_and_rig(small, bits):
    settings = small(scene={"name": "plane"}, camera={"bits": bits, "electrons_per_dn": 50.0})
    with kind.open(settings) as bench:
        assert bench.frame_format.dtype == (np.uint8 if bits == 8 else np.uint16)
        assert bench.noise.read_dn == pytest.approx(1.5 * (2**bits - 1) / 255)
        assert bench.noise.dn_per_electron == pytest.approx((2**bits - 1) / 255 / 50)
        rig = Rig.from_json(bench.rig)
    # Both axes meet at the convergence distance.
    on_axis = rig.projector.project(rig.to_projector_frame([[0.0, 0.0, 600.0]]))
    np.testing.assert_allclose(on_axis, [[319.5, 199.5]], atol=1e-6)
    np.testing.assert_allclose(rig.projector_centre_cam, [-180, 0, 0], atol=1e-9)


def test_description_is_json_and_says_simulated(small):
    with kind.open(small(scene={"name": "plane"})) as bench:
        document = json.loads(json.dumps(bench.describe()))
    assert document["simulated"] is True
    assert document["camera"]["exposure_us"] == 16_667.0
    assert document["projector"]["latency_s"] == 0.035


@pytest.mark.parametrize(
    "wrong",
    [
        {"scene": {"name": "cathedral"}},
        {"scene": {"name": "plane", "width": 100}},
        {"scene": {"name": "sphere", "radius_mm": 700}},
        {"scene": {"name": "plane", "finish": {"reflectance": 0.8, "gloss": 0.3}}},
        {"scene": {"name": "mirror", "mirror_angle_deg": 200}},
        {"camera": {"exposure_ms": 10}},
        {"camera": {"bits": 9}},
        {"projector": {"gamma": 0}},
        {"faults": {"drop_at": [-1]}},
        {"settle_s": -1},
        {"camera_blur": 1},
    ],
)
def test_wrong_settings_are_refused(wrong):
    with pytest.raises(ValidationError):
        SimulatedSettings.model_validate(wrong)


def test_every_setting_is_documented():
    schema = SimulatedSettings.model_json_schema()
    models = {"SimulatedSettings": schema, **schema["$defs"]}
    bare = [
        f"{name}.{field}"
        for name, model in models.items()
        for field, content in model["properties"].items()
        if field != "name" and not (content.get("description") or "$ref" in content)  # a model has its own
    ]
    assert not bare
    assert all(model.get("description") for model in models.values())
    assert all(model.get("additionalProperties") is False for model in models.values())
