"""The simulated producer, running freely."""

from contextlib import contextmanager

from cameras import plugged_in, simulated


@contextmanager
def camera(tmp_path):
    with plugged_in(tmp_path):
        yield simulated(
            trigger="free_run", features={"AcquisitionFrameRateEnable": True, "AcquisitionFrameRate": 200.0}
        )
