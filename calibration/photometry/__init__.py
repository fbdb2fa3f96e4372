"""Light: the response of projector and camera, its harmonics in fringes, the fall of contrast with frequency."""

from calibration.photometry.harmonics import Harmonics, gamma_of_harmonics, measure_harmonics
from calibration.photometry.known_phase import gamma_of_intensity, gamma_of_phase_error
from calibration.photometry.mtf import MTF_PERIODS_PX, Mtf, measure_mtf, mtf_of_modulation, mtf_plan
from calibration.photometry.power_law import GammaEstimate, fit_gamma, gamma_of_ratio, power_harmonics
from calibration.photometry.ramp import RAMP_LEVELS, PhotometryError, Ramp, take_ramp
from calibration.photometry.response import RampResult, camera_linearity, response_of_ramp
from calibration.photometry.waveform import PhaseError, fringe_harmonics, phase_error_curve, predict_phase_error

__all__ = [
    "MTF_PERIODS_PX",
    "RAMP_LEVELS",
    "GammaEstimate",
    "Harmonics",
    "Mtf",
    "PhaseError",
    "PhotometryError",
    "Ramp",
    "RampResult",
    "camera_linearity",
    "fit_gamma",
    "fringe_harmonics",
    "gamma_of_harmonics",
    "gamma_of_intensity",
    "gamma_of_phase_error",
    "gamma_of_ratio",
    "measure_harmonics",
    "measure_mtf",
    "mtf_of_modulation",
    "mtf_plan",
    "phase_error_curve",
    "power_harmonics",
    "predict_phase_error",
    "response_of_ramp",
    "take_ramp",
]
