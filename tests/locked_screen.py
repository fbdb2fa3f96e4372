"""A screen with a refresh, which Xvfb has not: a swap waits for the next multiple of 1 / 75 s."""

import time

from drivers.window.projector import serve_window

REFRESH_S = 1 / 75


def serve(emit, settings):
    """What `WindowProjector` takes as ``server``."""
    server = serve_window(emit, settings)
    swap = server._swap

    def locked_swap():
        time.sleep(REFRESH_S - time.monotonic() % REFRESH_S)
        return swap()

    server._swap = locked_swap
    return server
