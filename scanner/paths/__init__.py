"""Two light paths of a pixel: their separation from the first round alone, and which of them is direct."""

from scanner.paths.choice import DirectPath, choose_direct
from scanner.paths.comb import SeparationPlanError
from scanner.paths.corroboration import corroborated
from scanner.paths.joint import (
    AxisPhasorsOf,
    Coupling,
    DirectPaths,
    PathPair,
    compile_all,
    measure_coupling,
    separate_jointly,
)
from scanner.paths.neighbours import ask_neighbours
from scanner.paths.separation import TwoPaths, separate_candidates, separate_two_paths
from scanner.paths.twin import separate_two_paths_twin

__all__ = [
    "AxisPhasorsOf",
    "Coupling",
    "DirectPath",
    "DirectPaths",
    "PathPair",
    "SeparationPlanError",
    "TwoPaths",
    "ask_neighbours",
    "choose_direct",
    "compile_all",
    "corroborated",
    "measure_coupling",
    "separate_candidates",
    "separate_jointly",
    "separate_two_paths",
    "separate_two_paths_twin",
]
