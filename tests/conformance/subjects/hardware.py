"""The real devices of a bench file: run the suites with ``--hardware bench.yaml``. They light up and flash."""

import os
from contextlib import contextmanager

if config_file := os.environ.get("MFS_SCANNER_HARDWARE"):
    from drivers import SequencePlayer, SystemClock
    from drivers.hardware import SoftwareTrigger, make_projector, make_trigger
    from scanner.config import load_config

    settings = load_config(config_file).config.bench.settings

    PLAYS = isinstance(make_projector(settings.projector, SystemClock()), SequencePlayer)

    if settings.camera.trigger != "line":

        @contextmanager
        def camera(tmp_path):
            from drivers.genicam import GenICamCamera

            yield GenICamCamera(settings.camera, SystemClock())

    @contextmanager
    def projector(tmp_path):
        # What is on the wall nobody reads back: look at it.
        yield make_projector(settings.projector, SystemClock()), lambda: None

    if not isinstance(settings.trigger, SoftwareTrigger):

        @contextmanager
        def trigger(tmp_path):
            box = make_trigger(settings.trigger, SystemClock())

            def edges(count):
                input(f"Give {count} edges to the box's input, then press Enter: ")

            yield box, edges, lambda: box.counts().sent
