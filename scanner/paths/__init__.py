"""Two light paths of a pixel: their separation from the first round alone, and which of them is direct."""

from scanner.paths.choice import DirectPath, choose_direct
from scanner.paths.comb import SeparationPlanError
from scanner.paths.separation import TwoPaths, separate_candidates, separate_two_paths
from scanner.paths.twin import separate_two_paths_twin

__all__ = [
    "DirectPath",
    "SeparationPlanError",
    "TwoPaths",
    "choose_direct",
    "separate_candidates",
    "separate_two_paths",
    "separate_two_paths_twin",
]
