"""What the array bench sees between the pixels of its pictures is what SciPy says."""

import numpy as np
import pytest
from scipy.ndimage import map_coordinates, spline_filter
from splines import coefficients, looked_up

PICTURES = {
    "any": np.random.default_rng(1).integers(0, 256, (40, 60)),
    "columns": np.tile(np.random.default_rng(2).integers(0, 256, (1, 60)), (40, 1)),
    "rows": np.tile(np.random.default_rng(3).integers(0, 256, (40, 1)), (1, 60)),
}


@pytest.mark.parametrize("picture", PICTURES.values(), ids=PICTURES)
def test_within_the_picture_and_beyond_its_border(picture):
    rows, columns = np.mgrid[:30, :50].astype(float)
    x, y = 1.4 * columns + 0.05 * rows - 5.3, 1.6 * rows - 4.7
    seen = (looked_up(x, y, picture.shape) @ coefficients(picture.astype(np.float32)).ravel()).reshape(x.shape)
    spline = spline_filter(picture.astype(float), order=3, mode="nearest")
    expected = map_coordinates(spline, [y, x], order=3, mode="nearest", prefilter=False)
    np.testing.assert_allclose(seen, expected, atol=1e-9)
