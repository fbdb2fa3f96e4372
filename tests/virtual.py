"""What tests of the virtual bench share: the small bench with direct light, and what it may need."""

import os
import shutil

import numpy as np
from requirements import require

from drivers import HardwareError
from sim_backend.virtual_settings import VirtualSettings

WIDTH, HEIGHT = 320, 200
LATENCY = 0.02
SMALL = {
    "light": "direct",
    "camera": {"width_px": WIDTH, "height_px": HEIGHT, "exposure_us": 12_000, "readout_s": 0.0},
    "projector": {"width_px": WIDTH, "height_px": HEIGHT, "latency_s": LATENCY},
    "reconnect_s": 5.0,
}


def require_virtual_bench():
    require(shutil.which("Xvfb"), "the virtual bench needs Xvfb: apt install xvfb libgl1 libglx-mesa0 libgl1-mesa-dri")
    compiler = shutil.which(os.environ.get("CC", "cc"))
    require(compiler, "the simulated camera needs a C compiler: apt install gcc libc6-dev")


def merged(base, changes):
    return base | {k: merged(base[k], v) if isinstance(v, dict) and k in base else v for k, v in changes.items()}


def small(**changes):
    """Settings of the small bench."""
    return VirtualSettings.model_validate(merged(SMALL, changes))


def photographed(bench, index):
    frame = np.empty(bench.frame_format.shape, bench.frame_format.dtype)
    return frame, bench.expose(index, frame)


def all_photographed(bench, patterns):
    """Frames and stamps of the prepared sequence."""
    pairs = [photographed(bench, index) for index in range(len(patterns))]
    return [frame for frame, _ in pairs], [stamp for _, stamp in pairs]


def sequence(bench, patterns, attempts=30):
    """Frames and stamps of one good sequence; a busy machine may cost an attempt, as in a scan."""
    for attempt in range(attempts):
        try:
            bench.prepare(patterns)
            return all_photographed(bench, patterns)
        except HardwareError as error:
            bench.darken()
            if not error.repeatable or attempt == attempts - 1:
                raise
    raise AssertionError
