"""Several methods on one bench, judged the way the paper does and beyond: by windows, by the truth, over seeds."""

from scanner.comparison.detection import DetectionFigures, judge_detection
from scanner.comparison.fitting import fit_plane, fit_sphere
from scanner.comparison.judging import FIGURES, Row, Trial, beside_reference, distances, judge, rows_of
from scanner.comparison.windows import Window, largest_region, windows_of

__all__ = [
    "FIGURES",
    "DetectionFigures",
    "Row",
    "Trial",
    "Window",
    "beside_reference",
    "distances",
    "fit_plane",
    "fit_sphere",
    "judge",
    "judge_detection",
    "largest_region",
    "rows_of",
    "windows_of",
]
