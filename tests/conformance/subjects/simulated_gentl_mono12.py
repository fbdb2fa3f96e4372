"""The simulated producer, triggered by software, Mono12."""

from contextlib import contextmanager

from cameras import plugged_in, simulated


@contextmanager
def camera(tmp_path):
    with plugged_in(tmp_path):
        yield simulated(pixel_format="Mono12")
