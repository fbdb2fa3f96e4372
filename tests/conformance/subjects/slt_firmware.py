"""The SLT/1 driver on a pseudo-terminal, with the boards' own protocol core in C at its far end."""

from slt_core_in_c import SltCoreInC
from trigger_boxes import slt_subject


def trigger(tmp_path):
    return slt_subject(firmware=SltCoreInC)
