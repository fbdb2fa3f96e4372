"""Where a picture shows a board's points, and how surely."""

from calibration.detection.diagnosis import BoardNotFoundError
from calibration.detection.finding import find_board
from calibration.detection.mapping import PlaneMap

__all__ = ["BoardNotFoundError", "PlaneMap", "find_board"]
