"""One libusb for all: the wheel `libusb-package` carries it, so that nobody has to install it on the system.

Open3D's wheel and pyusb both look for ``libusb-1.0.so.0``; once it is loaded for all to see, both find it.
"""

from __future__ import annotations

import ctypes
from functools import cache


@cache
def load_libusb() -> None:
    """Load the wheel's libusb into the process, once."""
    import libusb_package

    ctypes.CDLL(str(libusb_package.get_library_path()), mode=ctypes.RTLD_GLOBAL)
