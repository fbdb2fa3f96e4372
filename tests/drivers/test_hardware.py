"""The bench kind ``hardware``: what goes together, which exposures do, and the template that operators start from."""

from __future__ import annotations

from pathlib import Path

import pytest
from pydantic import ValidationError

from drivers import DeviceSettingError, StreamedBench, SystemClock
from drivers.hardware import HardwareSettings, check_exposure_period, make_bench
from scanner.config import ConfigError, load_config

CONFIGS = Path(__file__).parents[2] / "configs"
CAMERA = {"driver": "genicam", "exposure_us": 16667}
WINDOW = {"driver": "window", "width_px": 1280, "height_px": 800}
PATCH = {"x_px": 0, "y_px": 0, "width_px": 32, "height_px": 32}
SLT = {"driver": "slt", "edge": "change"}


def settings(camera=None, projector=None, **rest):
    return HardwareSettings.model_validate(
        {"camera": CAMERA | (camera or {}), "projector": WINDOW | (projector or {}), **rest}
    )


@pytest.mark.parametrize(
    ("given", "says"),
    [
        ({"camera": {"trigger": "line"}}, "camera.trigger is line, but trigger.driver is software"),
        ({"trigger": SLT}, "set camera.trigger: line"),
        ({"synchronisation": "stream"}, "nothing but software triggers the camera"),
        ({"trigger": {"driver": "projector"}, "camera": {"trigger": "line"}}, "set synchronisation: stream"),
        ({"trigger": SLT, "camera": {"trigger": "line"}, "synchronisation": "stream"}, "set sync_patch of the window"),
        (
            {
                "trigger": {"driver": "projector"},
                "camera": {"trigger": "line"},
                "projector": {"sync_patch": PATCH},
                "synchronisation": "stream",
            },
            "no output of a screen tells which picture is the first",
        ),
    ],
)
def test_triggers_that_cannot_work_are_refused(given, says):
    with pytest.raises(ValidationError, match=says):
        settings(**given)


def test_lightcrafter_that_shows_video_does_not_trigger_the_camera():
    with pytest.raises(ValidationError, match="no output of a screen tells which picture is the first"):
        HardwareSettings.model_validate(
            {
                "camera": CAMERA | {"trigger": "line"},
                "projector": {"driver": "lightcrafter4500", "window": WINDOW | {"width_px": 912, "height_px": 1140}},
                "trigger": {"driver": "projector"},
                "synchronisation": "stream",
            }
        )


def test_a_box_and_a_patch_make_a_streamed_bench():
    bench = make_bench(
        settings(camera={"trigger": "line"}, projector={"sync_patch": PATCH}, trigger=SLT, synchronisation="stream"),
        SystemClock(),
    )
    assert isinstance(bench, StreamedBench)
    assert bench.trigger is not None


def test_lightcrafter_that_triggers_the_camera():
    chosen = HardwareSettings.model_validate(
        {
            "camera": CAMERA | {"trigger": "line"},
            "projector": {"driver": "lightcrafter6500"},
            "trigger": {"driver": "projector"},
            "synchronisation": "stream",
        }
    )
    bench = make_bench(chosen, SystemClock())
    assert isinstance(bench, StreamedBench)
    assert bench.projector_size == (1920, 1080)


# At 60 Hz a refresh is 16 666.7 µs; cameras round an exposure to their line time, some ten µs.
@pytest.mark.parametrize("exposure_us", [16_667, 16_660, 33_333, 50_000, 166_667])
def test_whole_refreshes_are_accepted(exposure_us):
    check_exposure_period(exposure_us, 1 / 60)


@pytest.mark.parametrize(
    ("exposure_us", "nearest"),
    [(5_000, "16667"), (10_000, "16667"), (20_000, "16667 or 33333"), (40_000, "33333 or 50000")],
)
def test_other_exposures_are_refused_with_the_nearest(exposure_us, nearest):
    with pytest.raises(DeviceSettingError, match="not a whole number") as caught:
        check_exposure_period(exposure_us, 1 / 60)
    assert f"exposure_us to {nearest}," in caught.value.remedy


def test_template_is_valid_and_shows_the_defaults():
    loaded = load_config(CONFIGS / "bench.yaml")
    chosen = loaded.config.bench.settings
    assert isinstance(chosen, HardwareSettings)
    # What differs from the defaults is what an operator has to think about.
    plain = HardwareSettings.model_validate({"camera": {"driver": "genicam"}, "projector": WINDOW})
    for section, own in (("camera", {"serial", "exposure_us", "gain_db"}), ("projector", set())):
        shown, default = getattr(chosen, section).model_dump(), getattr(plain, section).model_dump()
        assert {name for name in shown if shown[name] != default[name]} == own
    rest = {"camera", "projector"}
    assert chosen.model_dump(exclude=rest) == plain.model_dump(exclude=rest)


def test_mistakes_in_a_bench_file_name_the_place(tmp_path):
    text = (CONFIGS / "bench.yaml").read_text().replace("trigger: software", "trigger: line", 1)
    (tmp_path / "bench.yaml").write_text(text)
    with pytest.raises(ConfigError, match=r"bench.yaml, line \d+, column \d+: bench: camera.trigger is line"):
        load_config(tmp_path / "bench.yaml")
