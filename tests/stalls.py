"""How much other Python threads are held up: a thread that only looks at the clock."""

import os
import threading
import time

STALL_S = 0.002


class Watcher:
    """A thread that only looks at the clock: the share of time in which it did not get to it for more than 2 ms.

    ``share`` counts all such time, ``share_locked`` leaves out what the thread, or the main thread that may hold the
    interpreter's lock, waited for a processor, as Linux counts it: other programs are not the camera's fault.
    """

    def __enter__(self):
        self._stop = threading.Event()
        self._stalled_s = self._locked_s = self.longest_locked_s = 0.0
        self._thread = threading.Thread(target=self._watch)
        self._began_s = time.perf_counter()
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()
        took_s = time.perf_counter() - self._began_s
        self.share, self.share_locked = self._stalled_s / took_s, self._locked_s / took_s

    def _watch(self):
        with open("/proc/thread-self/schedstat", "rb", 0) as own, open("/proc/self/schedstat", "rb", 0) as main:

            def waited_s():
                return sum(int(os.pread(file.fileno(), 64, 0).split()[1]) for file in (own, main)) * 1e-9

            last = read_at = time.perf_counter()
            waited = waited_s()
            while not self._stop.is_set():
                now = time.perf_counter()
                gap, last = now - last, now
                if gap > STALL_S:
                    locked_s = gap - (waited_s() - waited)
                    self._stalled_s += gap
                    if locked_s > STALL_S:
                        self._locked_s += locked_s
                        self.longest_locked_s = max(self.longest_locked_s, locked_s)
                if gap > STALL_S or now - read_at > 0.001:
                    waited, read_at = waited_s(), now
