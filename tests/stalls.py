"""How much other Python threads are held up: a thread that only looks at the clock."""

import threading
import time


class Watcher:
    """Measures the share of time in which its thread did not get to look at the clock for more than 2 ms."""

    STALL_S = 0.002

    def __enter__(self):
        self._stop = threading.Event()
        self._stalled_s = 0.0
        self.longest_s = 0.0
        self._thread = threading.Thread(target=self._watch)
        self._began_s = time.perf_counter()
        self._thread.start()
        return self

    def __exit__(self, *_):
        self._stop.set()
        self._thread.join()
        self.share = self._stalled_s / (time.perf_counter() - self._began_s)

    def _watch(self):
        last = time.perf_counter()
        while not self._stop.is_set():
            now = time.perf_counter()
            gap, last = now - last, now
            self.longest_s = max(self.longest_s, gap)
            if gap > self.STALL_S:
                self._stalled_s += gap
