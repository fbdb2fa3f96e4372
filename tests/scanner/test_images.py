"""A folder of images with a plan file: the right coordinates, and a clear word about every mistake."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from drivers import OperatorError
from scanner.config import GatesSection, ScanSection
from scanner.images import open_images
from scanner.processing import process_images
from scanner.quality import passed

HEIGHT, WIDTH = 60, 90
PLAN = """\
projector: {width: 320, height: 200}
sequences:
  - {axis: x, period_px: 16, steps: 4}
  - {axis: x, period_px: 320, steps: 4}
"""


@pytest.fixture
def truth():
    return np.broadcast_to(np.linspace(20, 250, WIDTH), (HEIGHT, WIDTH))


@pytest.fixture
def folder(tmp_path, truth):
    rng = np.random.default_rng(0)
    number = 0
    for period in (16, 320):
        for n in range(1, 5):
            ideal = 110 + 80 * np.cos(2 * np.pi * truth / period + np.pi / 2 * n)
            noisy = np.rint(ideal + rng.normal(0, 1.5, ideal.shape)).astype(np.uint8)
            cv2.imwrite(str(tmp_path / f"frame{number}.png"), noisy)
            number += 1
    (tmp_path / "plan.yaml").write_text(PLAN, encoding="utf-8")
    return tmp_path


def process(folder):
    return process_images(open_images(folder), ScanSection(method="tps"), GatesSection(), None)


def refusal(folder):
    with pytest.raises(OperatorError) as caught:
        process(folder)
    assert caught.value.exit_code == 2
    assert caught.value.remedy
    return str(caught.value)


def test_coordinates(folder, truth):
    maps = process(folder).maps
    # σ_φ = √(2/4)·1.5/80, over 2π/16 px.
    bound = np.sqrt(2 / 4) * np.sqrt(1.5**2 + 1 / 12) / 80 * 16 / (2 * np.pi)
    error = maps.x_p - truth
    assert np.isfinite(error).all()
    assert error.std() == pytest.approx(bound, rel=0.05)
    assert maps.y_p is None


def test_other_phase_conventions(folder, truth):
    # The same images said backwards: step 0 first is step 4 of 4, and with the sign reversed the order too.
    names = [f"frame{i}.png" for i in (3, 2, 1, 0, 7, 6, 5, 4)]
    (folder / "plan.yaml").write_text(
        f"files: [{', '.join(names)}]\nphase: {{sign: -1, first_step: 0}}\n{PLAN}", encoding="utf-8"
    )
    np.testing.assert_allclose(process(folder).maps.x_p, truth, atol=0.3)


def test_frames_are_taken_in_natural_order(folder):
    for i in reversed(range(8)):
        (folder / f"frame{i}.png").rename(folder / f"frame{i + 5}.png")
    assert [p.name for p in open_images(folder).files[1]] == [f"frame{i}.png" for i in (9, 10, 11, 12)]


def test_no_plan(folder):
    (folder / "plan.yaml").unlink()
    assert "no plan file" in refusal(folder)


def test_wrong_count(folder):
    (folder / "frame7.png").unlink()
    assert "holds 7 images, the plan asks for 8 (4 + 4)" in refusal(folder)


def test_mixed_sizes(folder):
    cv2.imwrite(str(folder / "frame5.png"), np.full((50, 90), 100, np.uint8))
    said = refusal(folder)
    assert "frame5.png is 90 × 50 px" in said
    assert "90 × 60 px" in said


def test_colour(folder):
    cv2.imwrite(str(folder / "frame2.png"), np.zeros((HEIGHT, WIDTH, 3), np.uint8))
    assert "frame2.png is a colour image" in refusal(folder)


def test_truncated_file(folder):
    path = folder / "frame6.png"
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    assert "frame6.png" in refusal(folder)


def test_no_image_at_all(folder):
    (folder / "frame1.png").write_text("hello", encoding="utf-8")
    assert "frame1.png cannot be read as an image" in refusal(folder)


def test_all_black(folder):
    for i in range(8):
        rng = np.random.default_rng(i)
        cv2.imwrite(str(folder / f"frame{i}.png"), rng.integers(0, 3, (HEIGHT, WIDTH)).astype(np.uint8))
    assert "are black" in refusal(folder)


def test_saturated(folder):
    for i in range(8):
        cv2.imwrite(str(folder / f"frame{i}.png"), np.full((HEIGHT, WIDTH), 255 - (i == 3), np.uint8))
    for i in range(8):
        frame = np.full((HEIGHT, WIDTH), 255, np.uint8)
        frame[0, i] = 100
        cv2.imwrite(str(folder / f"frame{i}.png"), frame)
    assert "saturated in every image" in refusal(folder)


def test_one_frame_repeated(folder):
    (folder / "frame2.png").write_bytes((folder / "frame1.png").read_bytes())
    assert "frame2.png is frame1.png over again" in refusal(folder)


def test_shuffled_order_within_a_sequence(folder):
    a, b = folder / "frame1.png", folder / "frame2.png"
    first, second = a.read_bytes(), b.read_bytes()
    a.write_bytes(second)
    b.write_bytes(first)
    said = refusal(folder)
    assert "frame1.png" in said
    assert "shows step 3 of 4" in said


def test_sequences_exchanged_fail_the_gates(folder):
    text = PLAN.replace("16,", "X,").replace("320, steps", "16, steps").replace("X,", "320,")
    (folder / "plan.yaml").write_text(text, encoding="utf-8")
    result = process(folder)
    assert not passed(result)
    assert any("another order" in w for w in result.warnings)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("steps: 4", "stepps: 4", ["line 3", "stepps", "steps"]),
        ("axis: x", "axis: z", ["line 3", "axis"]),
        ("period_px: 320", "period_px: 32", ["unambiguous", "32", "320"]),
        ("projector: {width: 320, height: 200}\n", "", ["projector"]),
        ("period_px: 16", "period_px: sixteen", ["line 3", "period_px"]),
    ],
)
def test_mistakes_in_the_plan_file(folder, old, new, words):
    (folder / "plan.yaml").write_text(PLAN.replace(old, new, 1), encoding="utf-8")
    said = refusal(folder)
    assert "plan.yaml" in said
    for word in words:
        assert word in said
