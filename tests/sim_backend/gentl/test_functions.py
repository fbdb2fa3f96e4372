"""The C functions of the simulated producer, for what harvesters never does."""

from __future__ import annotations

import contextlib
import ctypes
import threading
import time

import numpy as np
from stock_harvesters import SMALL, wait_for

from sim_backend.gentl import SimulatedCameraId, installed, producer_path

FUNCTIONS = """
    GCInitLib GCCloseLib GCGetInfo GCGetLastError GCGetPortInfo GCGetNumPortURLs GCGetPortURLInfo GCGetPortURL
    GCReadPort GCWritePort GCReadPortStacked GCWritePortStacked GCRegisterEvent GCUnregisterEvent EventGetData
    EventGetDataInfo EventGetInfo EventFlush EventKill TLOpen TLClose TLGetInfo TLUpdateInterfaceList
    TLGetNumInterfaces TLGetInterfaceID TLGetInterfaceInfo TLOpenInterface IFClose IFGetInfo IFGetParentTL
    IFUpdateDeviceList IFGetNumDevices IFGetDeviceID IFGetDeviceInfo IFOpenDevice DevClose DevGetInfo DevGetParentIF
    DevGetPort DevGetNumDataStreams DevGetDataStreamID DevOpenDataStream DSClose DSGetInfo DSGetParentDev
    DSAnnounceBuffer DSAllocAndAnnounceBuffer DSRevokeBuffer DSQueueBuffer DSFlushQueue DSStartAcquisition
    DSStopAcquisition DSGetBufferID DSGetBufferInfo DSGetBufferChunkData DSGetNumBufferParts DSGetBufferPartInfo
    DSAnnounceCompositeBuffer DSGetNumFlows DSGetFlowInfo DSGetNumBufferSegments DSGetBufferSegmentInfo
    DSGetBufferInfoStacked DSGetBufferPartInfoStacked
"""
OK, IN_USE, BAD_HANDLE, ABORT, TOO_SMALL, BUSY, TIMEOUT, NO_INIT = 0, -1004, -1006, -1012, -1016, -1022, -1011, -1002
FOREVER = 2**64 - 1


class Library:
    """The producer's functions, called as any C program would; without Python's lock, unlike the genicam binding's."""

    def __init__(self, path):
        self.c = ctypes.CDLL(str(path))

    def __call__(self, name, *arguments):
        return getattr(self.c, name)(*arguments)

    def must(self, name, *arguments):
        assert self(name, *arguments) == OK, name

    def handle(self, name, *arguments):
        handle = ctypes.c_void_p()
        self.must(name, *arguments, ctypes.byref(handle))
        return handle

    def number(self, name, *arguments):
        value, kind, size = ctypes.c_uint64(0), ctypes.c_int32(), ctypes.c_size_t(8)
        self.must(name, *arguments, ctypes.byref(kind), ctypes.byref(value), ctypes.byref(size))
        return value.value

    def read(self, port, address):
        value, size = ctypes.c_int64(), ctypes.c_size_t(8)
        self.must("GCReadPort", port, ctypes.c_uint64(address), ctypes.byref(value), ctypes.byref(size))
        return value.value

    def write(self, port, address, value):
        data, size = ctypes.c_int64(value), ctypes.c_size_t(8)
        self.must("GCWritePort", port, ctypes.c_uint64(address), ctypes.byref(data), ctypes.byref(size))

    def event(self, event, timeout_ms):
        """(code, buffer) of the next event."""
        data, size = (ctypes.c_void_p * 2)(), ctypes.c_size_t(16)
        return self("EventGetData", event, data, ctypes.byref(size), ctypes.c_uint64(timeout_ms)), data[0]


@contextlib.contextmanager
def opened(folder, identity=SMALL, pixel_format=0x01080001):
    """(library, remote port, stream, event) of a camera with eight buffers, software trigger and 10 µs of exposure."""
    with installed(folder, [identity]) as producer:
        library = Library(producer)
        library.must("GCInitLib")
        try:
            system = library.handle("TLOpen")
            library.must("TLUpdateInterfaceList", system, None, ctypes.c_uint64(0))
            interface = library.handle("TLOpenInterface", system, b"mfs-sim-0")
            library.must("IFUpdateDeviceList", interface, None, ctypes.c_uint64(0))
            device = library.handle("IFOpenDevice", interface, b"SIM0001", 4)
            port = library.handle("DevGetPort", device)
            stream = library.handle("DevOpenDataStream", device, b"stream-0")
            event = library.handle("GCRegisterEvent", stream, 1)
            library.write(port, 0x1050, pixel_format)
            payload = ctypes.c_size_t(library.number("DSGetInfo", stream, 7))
            for _ in range(8):
                library.handle("DSAllocAndAnnounceBuffer", stream, payload, None)
            library.must("DSFlushQueue", stream, 3)  # all that is not queued goes to the input
            library.write(port, 0x1100, 1)  # TriggerMode
            library.write(port, 0x10A0, int(np.float64(10.0).view(np.int64)))  # ExposureTime
            library.must("DSStartAcquisition", stream, 0, ctypes.c_uint64(FOREVER))
            library.write(port, 0x1078, 1)  # AcquisitionStart
            yield library, port, stream, event
        finally:
            library("GCCloseLib")


def test_every_function_of_the_standard_is_exported():
    library = ctypes.CDLL(str(producer_path()))
    names = FUNCTIONS.split()
    assert len(names) == 64
    assert [name for name in names if not hasattr(library, name)] == []


def test_the_library_is_strict_about_handles_and_order(folder):
    with installed(folder, [SMALL]) as producer:
        library = Library(producer)
        assert library("TLClose", ctypes.c_void_p(1)) == NO_INIT
        assert library("GCCloseLib") == NO_INIT
    with opened(folder) as (library, port, stream, event):
        assert library("GCInitLib") == IN_USE
        assert library("TLOpen", ctypes.byref(ctypes.c_void_p())) == IN_USE
        assert library("DSClose", port) == BAD_HANDLE
        assert library("DSQueueBuffer", stream, ctypes.c_void_p(77)) == BAD_HANDLE
        assert library("DSStartAcquisition", stream, 0, ctypes.c_uint64(FOREVER)) == IN_USE
        code, text, size = ctypes.c_int32(), ctypes.create_string_buffer(200), ctypes.c_size_t(200)
        library.must("GCGetLastError", ctypes.byref(code), text, ctypes.byref(size))
        assert (code.value, text.value) == (IN_USE, b"the stream runs already")
        small = ctypes.c_size_t(3)
        assert library("DevGetDataStreamID", parent(library, stream), 0, text, ctypes.byref(small)) == TOO_SMALL
        assert small.value == len("stream-0") + 1
        library.must("DSClose", stream)
        assert library("DSClose", stream) == BAD_HANDLE
        assert library.event(event, 0)[0] == BAD_HANDLE


def parent(library, stream):
    return library.handle("DSGetParentDev", stream)


def test_buffers_can_be_revoked_when_nobody_uses_them(folder):
    with opened(folder) as (library, port, stream, event):
        buffer = library.handle("DSGetBufferID", stream, 0)
        assert library("DSRevokeBuffer", stream, buffer, None, None) == BUSY
        library.write(port, 0x10D8, 1)  # TriggerSoftware
        code, taken = library.event(event, 20_000)
        assert (code, taken) == (OK, buffer.value)
        library.must("DSRevokeBuffer", stream, buffer, None, None)
        assert [library.number("DSGetInfo", stream, command) for command in (3, 4, 5)] == [7, 7, 0]
        library.must("DSFlushQueue", stream, 0)  # input to output
        assert [library.number("DSGetInfo", stream, command) for command in (3, 4, 5)] == [7, 0, 7]
        library.must("DSFlushQueue", stream, 4)  # all discarded
        assert [library.number("DSGetInfo", stream, command) for command in (3, 4, 5)] == [7, 0, 0]


def test_a_flush_waits_for_the_pixels_that_are_being_written(folder):
    # Packing 12 million pixels takes long enough to be met at it.
    with opened(folder, SimulatedCameraId(width_px=4096, height_px=3072), 0x010A0046) as (library, port, stream, _):
        met, started = False, 0
        while not met:
            assert started < 200
            library.write(port, 0x10D8, 1)  # TriggerSoftware
            started += 1
            wait_for(lambda expected=started: library.number("DSGetInfo", stream, 6) == expected)
            met = library.number("DSGetInfo", stream, 1) < started  # it is being filled
            library.must("DSFlushQueue", stream, 4)
            assert library.number("DSGetInfo", stream, 1) == started
            if not met:
                library.must("DSFlushQueue", stream, 3)
        for _ in range(8):
            library.must("DSRevokeBuffer", stream, library.handle("DSGetBufferID", stream, 0), None, None)


def test_registers_can_be_read_as_a_stack(folder):
    class Entry(ctypes.Structure):
        _pack_ = 1
        _fields_ = [("address", ctypes.c_uint64), ("buffer", ctypes.c_void_p), ("size", ctypes.c_size_t)]

    with opened(folder) as (library, port, _, _):
        values = (ctypes.c_int64 * 3)()
        entries = (Entry * 3)(
            *[Entry(a, ctypes.addressof(values) + 8 * i, 8) for i, a in enumerate((0x1010, 0x1018, 0x9999))]
        )
        count = ctypes.c_size_t(3)
        assert library("GCReadPortStacked", port, entries, ctypes.byref(count)) == -1015
        assert (count.value, list(values)) == (2, [64, 48, 0])


def test_a_waiting_event_can_be_killed(folder):
    with opened(folder) as (library, _, _, event):
        ends = []
        waiting = threading.Thread(target=lambda: ends.append(library.event(event, FOREVER)[0]))
        waiting.start()
        time.sleep(0.05)
        assert not ends
        library.must("EventKill", event)
        waiting.join(20.0)
        assert ends == [ABORT]
        assert library.event(event, 10)[0] == TIMEOUT


def test_every_frame_is_accounted_for_under_load(folder):
    with opened(folder) as (library, port, stream, event):
        over, hands = threading.Event(), threading.Lock()
        fetched, random = [], np.random.default_rng(5)

        def consume():
            while not over.is_set():
                with hands:
                    code, buffer = library.event(event, int(random.integers(0, 3)))
                    assert code in (OK, TIMEOUT, ABORT)
                    if code == OK:
                        handle = ctypes.c_void_p(buffer)
                        if library.number("DSGetBufferInfo", stream, handle, 4):  # new data
                            fetched.append(library.number("DSGetBufferInfo", stream, handle, 16))
                        library.must("DSQueueBuffer", stream, handle)

        def meddle():
            while not over.is_set():
                with hands:
                    library.must("DSFlushQueue", stream, int(random.integers(0, 5)))
                    library.must("DSFlushQueue", stream, 3)  # what was discarded is used again
                time.sleep(random.uniform(0, 0.003))

        def kill():
            while not over.is_set():
                library.must("EventKill", event)
                time.sleep(0.005)

        threads = [threading.Thread(target=target) for target in (consume, meddle, kill)]
        for thread in threads:
            thread.start()
        triggers, end = 0, time.monotonic() + 1.0
        while time.monotonic() < end or (len(fetched) <= 50 and time.monotonic() < end + 20.0):
            library.write(port, 0x10D8, 1)  # TriggerSoftware
            triggers += 1
        over.set()
        for thread in threads:
            thread.join()
        taken = triggers - library.read(port, 0x1200)  # SimTriggersIgnored
        wait_for(lambda: sum(library.number("DSGetInfo", stream, command) for command in (1, 2)) == taken)
        delivered = library.number("DSGetInfo", stream, 1)
        assert len(fetched) > 50
        assert fetched == sorted(set(fetched))
        assert len(fetched) <= delivered == library.number("DSGetInfo", stream, 6)
        library.must("DSStopAcquisition", stream, 0)
        library.must("DSFlushQueue", stream, 4)
        for _ in range(8):
            library.must("DSRevokeBuffer", stream, library.handle("DSGetBufferID", stream, 0), None, None)
