"""Several exposures of one scan: dark and glossy parts together.

A round is taken whole at one exposure after the other, each pass verified from its own pictures. Then, before anything
is decoded, the frames of every pattern are fused pixel by pixel into one of greater range: in units of the bench's own
exposure, by maximum likelihood, from the exposures in which the pixel never saturates. So every method gets them.
"""

from scanner.exposures.fusion import Fused, FusedNoise, Source, fuse
from scanner.exposures.linearity import LightRatio, contrast_ratio
from scanner.exposures.passes import NEAR_SATURATION, ExposurePass
from scanner.exposures.series import ExposureSeries, agree, read_plan

__all__ = [
    "NEAR_SATURATION",
    "ExposurePass",
    "ExposureSeries",
    "Fused",
    "FusedNoise",
    "LightRatio",
    "Source",
    "agree",
    "contrast_ratio",
    "fuse",
    "read_plan",
]
