"""One round instead of two, on small simulated mirror scenes that nothing was set on.

Angles, tilts, poses and noise are drawn here, from seeds of this file alone.
"""

from __future__ import annotations

import numpy as np
import pytest

from scanner.methods.separated import Separated
from scanner.methods.sufficiency import Evidence, weigh
from scanner.result import Flag

_rng = np.random.default_rng(27182)
CAMERA = {"width_px": 192, "height_px": 144}


def mirror(**changes):
    drawn = {
        "name": "mirror",
        "mirror_angle_deg": float(_rng.uniform(96, 108)),
        "mirror_tilt_deg": float(_rng.uniform(-8, 8)),
        "yaw_deg": float(_rng.uniform(-8, 8)),
        "pitch_deg": float(_rng.uniform(-5, 5)),
        "mirror_reflectance": float(_rng.uniform(0.6, 0.95)),
    }
    return {**drawn, **changes}


SCENES = {"smooth": mirror(), "rough": mirror(mirror_roughness=0.03)}


@pytest.mark.parametrize("name", SCENES)
def test_one_round_within_a_tenth_of_a_pixel(scan_simulated, name):
    maps, truth = scan_simulated(
        SCENES[name],
        options={"rounds": 1},
        seed=len(name),
        camera={**CAMERA, "exposure_us": 14_000},
        transport={"photons": 1_000_000},
    )
    assert maps.lit is None
    with np.errstate(invalid="ignore"):
        region = (truth.alpha > 0.02) & np.isfinite(truth.x_p) & ~truth.edge
    assert region.mean() > 0.03
    far = []
    for axis in ("x", "y"):
        apart = np.abs(getattr(truth, f"bounce_{axis}") - getattr(truth, f"{axis}_p"))
        far.append(np.abs(getattr(maps, f"{axis}_p") - getattr(truth, f"{axis}_p"))[region & (apart >= 60)])
    error = np.concatenate(far)
    assert error.size > 1000
    # NaN is not within.
    assert (error < 0.1).mean() >= 0.95
    assert (error > 4).mean() <= 0.002


def test_a_part_brighter_by_its_bounce_is_given_a_second_round(scan_simulated):
    # The part shows the board twice: by the projector's light, and by what it throws there itself. Two paths fit badly.
    scene = {"name": "polished", "mirror_angle_deg": float(_rng.uniform(97, 106)), "mirror_roughness": 0.0}
    maps, truth = scan_simulated(
        scene, options={"rounds": "auto"}, seed=6, camera=CAMERA, transport={"photons": 300_000}
    )
    with np.errstate(invalid="ignore"):
        stronger = (truth.alpha > 1) & np.isfinite(truth.x_p) & ~truth.edge
    assert stronger.sum() > 500
    assert maps.lit is not None
    flagged = (maps.flags & (Flag.THIRD_PATH | Flag.MISFIT | Flag.OFF_EPIPOLAR | Flag.NOT_LIT | Flag.STRAY)) != 0
    assert (flagged | np.isfinite(maps.x_p))[stronger & maps.interreflection].all()
    assert ((maps.flags & Flag.THIRD_PATH) != 0)[stronger].mean() > 0.2
    # The bounce is not returned for the direct light, though it is the brighter of the two.
    assert (np.abs(maps.x_p - truth.bounce_x)[stronger] < 4).mean() <= 0.01


def region_of(count=400, **changes):
    """A region of one surface whose bounce comes from outside it."""
    column = np.arange(count, dtype=np.float32)
    x, y = 100 + column % 20, 100 + column // 20
    yes, no = np.ones(count, bool), np.zeros(count, bool)
    values = {
        "shape": (40, 40),
        "pixels": np.arange(count),
        "u": {"x": x, "y": y},
        "sigma": {"x": 0.01 * np.ones(count, np.float32), "y": 0.01 * np.ones(count, np.float32)},
        "bounce": {"x": x + 300, "y": y + 40},
        "plausible": yes,
        "trusted": yes,
        "third": no,
        "off_line": no,
        "located": yes,
        "strength": 0.5 * np.ones(count, np.float32),
        "blur": np.ones(count, np.float32),
    }
    return Separated(**{**values, **changes})


def some(count, of=400):
    return np.arange(of) < count


def test_a_clear_region_needs_no_second_round():
    evidence = weigh(region_of(), (640, 400))
    assert evidence == Evidence(0.0, 0.0, 0.0, 0.0)
    assert evidence.one_round("auto")
    assert "216 frames are saved" in evidence.decision("auto", 216)
    assert not evidence.one_round(2)
    assert evidence.decision(2, 216) == ""


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"trusted": ~some(16)}, "4.0 % of the bounce region's pixels are undecided"),
        ({"blur": np.where(some(20), 2.5, 1).astype(np.float32)}, "5.0 % .* more than 2 times the noise"),
        ({"third": some(8)}, "2.0 % .* more than two light paths"),
        ({"bounce": region_of().u}, "100.0 % .* lit by another part"),
    ],
    ids=["undecided", "noisy", "third path", "mutual"],
)
def test_what_a_second_round_is_needed_for(changes, says):
    evidence = weigh(region_of(**changes), (640, 400))
    assert not evidence.one_round("auto")
    with pytest.raises(AssertionError, match=says):
        raise AssertionError(evidence.decision("auto", 216))
    # The operator may insist.
    assert evidence.one_round(1)
    assert evidence.decision(1, 216).startswith("one round, as asked: ")


def test_a_little_of_each_is_borne():
    changes = {"trusted": ~some(7), "third": some(3), "blur": np.where(some(7), 3, 1).astype(np.float32)}
    assert weigh(region_of(**changes), (640, 400)).one_round("auto")


def test_what_a_mirror_shows_is_not_counted():
    # A second round could not measure there either.
    seen = some(200)
    evidence = weigh(region_of(off_line=seen, trusted=~seen, plausible=~seen), (640, 400))
    assert evidence.enough
