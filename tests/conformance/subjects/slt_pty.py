"""The SLT/1 driver on a pseudo-terminal, with the emulator at its far end."""

from trigger_boxes import slt_subject


def trigger(tmp_path):
    return slt_subject()
