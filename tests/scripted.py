"""Devices that do what a test tells them, and write down every move: for tests of benches."""

from __future__ import annotations

import numpy as np

from drivers import DeviceLostError, DeviceState, FrameFormat, FrameStamp, Lifecycle, PlayRecord, TriggerCounts

PATTERNS = [np.full((4, 6), 40 * n, np.uint8) for n in range(5)]


class Scripted:
    """What the three devices below share: a life, a log, and moves that fail when they are told to."""

    def __init__(self, name, clock, log):
        self.name, self.clock, self.log = name, clock, log
        self.life = Lifecycle(name)
        self.fail_next = {}
        self.away = 0

    @property
    def state(self):
        return self.life.state

    def move(self, call, move=None):
        self.log.append(f"{self.name}.{call}")
        if call in self.fail_next:
            error = self.fail_next.pop(call)
            if isinstance(error, DeviceLostError):
                self.life.move("fail")
            raise error
        if move:
            self.life.move(move)

    def open(self):
        if self.away > 0:
            self.away -= 1
            raise DeviceLostError(f"{self.name}: not there", "plug it in")
        self.move("open", "open")

    def close(self):
        self.move("close", "close")

    def describe(self):
        return {"name": self.name}


class Projector(Scripted):
    size = (6, 4)
    period_s = 0.02
    late = ()
    disturbed = None

    def configure(self):
        self.move("configure", "configure")

    def load(self, patterns):
        self.move("load", "arm")
        self.patterns = list(patterns)

    def show(self, index):
        self.move(f"show {index}")
        self.shown = index
        return self.clock.now()

    def verify(self):
        if self.disturbed:
            raise self.disturbed

    def play(self):
        self.move("play")

    def finish(self, timeout_s):
        self.move("finish")
        return PlayRecord(tuple(0.02 * n for n in range(len(self.patterns))), tuple(self.late))

    def darken(self):
        self.log.append(f"{self.name}.darken")


class Camera(Scripted):
    noise = None
    format = FrameFormat(6, 4, 8)
    next_id = 0

    def configure(self):
        self.move("configure", "configure")
        return self.format

    def arm(self):
        self.move("arm", "arm")

    def start(self):
        self.move("start", "start")

    def stop(self):
        self.move("stop", "stop")

    def trigger(self):
        self.move("trigger")

    def fetch(self, out, timeout_s):
        self.move("fetch")
        out[:] = self.next_id
        self.next_id += 1
        return FrameStamp(self.next_id - 1, self.clock.now(), self.clock.now())


class Box(Scripted):
    min_period_s = 0.01
    report = None
    sent = 0

    def configure(self):
        self.move("configure", "configure")

    def arm(self, pulses=None):
        self.move(f"arm {pulses}", "arm")
        self.sent = pulses or 0

    def fire(self):
        self.move("fire")
        self.sent += 1

    def counts(self):
        self.move("counts")
        return self.report or TriggerCounts(self.sent, self.sent, 0)

    def stop(self):
        self.move("stop")
        self.life.state = DeviceState.CONFIGURED


def take(bench, patterns=PATTERNS):
    out = np.zeros((len(patterns), 4, 6), np.uint8)
    bench.prepare(patterns)
    return [bench.expose(i, out[i]) for i in range(len(patterns))]
