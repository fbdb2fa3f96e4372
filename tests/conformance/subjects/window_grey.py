"""A window under Xvfb that shows grey; the surface is the X server's own frame buffer."""

from windows import window_subject

PLAYS = True


def projector(tmp_path):
    return window_subject("grey")
