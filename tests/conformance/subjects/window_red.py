"""A window under Xvfb that shows patterns in red alone; the surface is the X server's own frame buffer."""

from windows import window_subject

PLAYS = True


def projector(tmp_path):
    return window_subject("red")
