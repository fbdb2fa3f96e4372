"""What is projected, against the formula."""

from __future__ import annotations

import numpy as np
import pytest

from scanner.patterns import Plan, phase_steps


def test_pattern_is_the_formula_rounded():
    plan = Plan((64, 48), (phase_steps("x", 1 / 16, 12), phase_steps("y", 1 / 12.5, 3)), mean=0.5, amplitude=0.4)
    x = np.arange(64)
    for n, picture in enumerate(plan.render(0), start=1):
        exact = 255 * (0.5 + 0.4 * np.cos(2 * np.pi * x / 16 + 2 * np.pi * n / 12))
        assert picture.dtype == np.uint8
        assert np.abs(picture - exact).max() <= 0.5 + 1e-9
    y = np.arange(48)[:, None]
    exact = 255 * (0.5 + 0.4 * np.cos(2 * np.pi * y / 12.5 + 2 * np.pi * 2 / 3))
    assert np.abs(plan.render(1)[1] - exact).max() <= 0.5 + 1e-9


@pytest.mark.parametrize(
    ("frequency", "steps", "what"), [(0.5, 4, "between 0 and 1/2"), (1 / 16, 2, "at least 3"), (-0.1, 4, "between 0")]
)
def test_what_cannot_be_decoded_is_refused(frequency, steps, what):
    with pytest.raises(ValueError, match=what):
        phase_steps("x", frequency, steps)


def test_levels_outside_full_scale_are_refused():
    with pytest.raises(ValueError, match=r"within 0\.\.1"):
        Plan((64, 48), (phase_steps("x", 1 / 16, 4),), mean=0.6, amplitude=0.5)
