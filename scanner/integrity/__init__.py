"""Did these frames show these patterns? Checks that need no extra pattern.

From six steps on a sequence tells by itself which frame is stale, torn, mixed, dark or in another light: what no
waveform explains is an error, however the projector responds (`waveform`). What a sequence cannot tell of itself, the
`SequenceHistory` of its scan does: whether its pictures are another sequence's, began at another step, or are missing
altogether, and with three to seven steps whether their mean is that of all others. What three to five steps do not show
because it is hardly beyond the noise, the sequences of a round show of each other once it is complete (`agreement`);
from six steps on the forms that an error can have tell it (`frame_errors`). Where each frequency has one frame, their
code takes the place of the other sequences (`codes`).

Not to be seen from images: a lamp that follows the steps; an error of all frames alike; that the very first sequence of
an axis began at another step, before others of the axis contradict it, which then are the ones that are refused; and
where unwrapping needs every sequence of an axis, as TPS with three frequencies does, that one began at another step.
"""

from __future__ import annotations

from scanner.integrity.check import check_sequence, repeated_frames
from scanner.integrity.findings import Finding, SequenceCheck
from scanner.integrity.history import SequenceHistory

__all__ = ["Finding", "SequenceCheck", "SequenceHistory", "check_sequence", "repeated_frames"]
