"""A take: the recording on disk, which survives being cut off anywhere.

Layout of the folder, a contract with tools outside of this repository::

    manifest.json   written once, atomically, when everything else is in place
    frames.bin      preallocated slots of ``stride`` bytes, a multiple of 4096; slot n begins at n · stride
    journal.jsonl   append-only, one write per record

**manifest.json** holds ``schema`` (1; 2 with several exposures), ``uid``, ``created`` (ISO 8601, UTC), ``method``,
``bench``, ``config``, ``plans`` (those known at the start, round one first), ``simulated``, ``rig``, ``noise``,
``width``, ``height``, ``bits``, ``dtype`` (NumPy's, with byte order), ``shape`` (height, width), ``stride`` and
``manifest_xxh3``, the checksum of all the rest as sorted, compact JSON.

**journal.jsonl** holds one JSON object per line. Its last member, ``record_xxh3``, is the checksum of all bytes
of the line before ``,"record_xxh3"``. Checksums are XXH3, 64 bits, in hexadecimal. The other members, by ``kind``:

=================== =========================================================================================
round_begun         ``round`` (from 1), ``plan``. Begun again with another plan, its former sequences are void.
frame               ``round``, ``sequence``, ``attempt``, ``index`` (place in the sequence), ``slot``,
                    ``frame_id``, ``t_device_s``, ``t_host_s``, ``t_shown_s`` (null where unknown),
                    ``pixels_xxh3``
sequence_committed  ``round``, ``sequence``, ``attempt``, ``plan_xxh3`` (of the plan as sorted, compact JSON),
                    ``slots`` in the order of the plan. Of several attempts the last committed one counts.
sequence_aborted    ``round``, ``sequence``, ``attempt``, ``reason``. Revokes the attempt, also a committed one.
note, state         ``text``; ``name``: the operator's log and the scan's state machine
resumed             The recording goes on after it was cut off or ended.
end                 ``status`` (completed, cancelled, failed), ``reason``
=================== =========================================================================================

A plan that is taken at several exposures has a member ``exposures`` beside those of `scanner.patterns.Plan.to_json`:
``reference_s``, the bench's own exposure, and ``made_s``, those of the round, in s. Its ``sequences`` are all that was
projected: those of the first exposure, then the same at the second, and so on.

A record with ``torn`` follows so many bytes that are what is left of a record that was not written whole; it
begins with a line feed of its own, so that empty lines may occur. All records but ``frame`` carry ``t_s``, s on
the bench's clock, where the writer knows it.

The truth is in the journal: a slot that no record claims holds nothing, and a claimed slot is never written
again. Pixels reach the disk before the record that claims them: the frame records of a sequence are held back
until it ends, then the pixels are synchronised, then the records are written and synchronised.
"""

from scanner.take.journal import (
    FRAMES,
    JOURNAL,
    MANIFEST,
    SCHEMA,
    FrameRecord,
    RecordedSequence,
    TakeError,
    TakeRefusedError,
)
from scanner.take.reader import Take
from scanner.take.writer import Resumption, TakeWriter

__all__ = [
    "FRAMES",
    "JOURNAL",
    "MANIFEST",
    "SCHEMA",
    "FrameRecord",
    "RecordedSequence",
    "Resumption",
    "Take",
    "TakeError",
    "TakeRefusedError",
    "TakeWriter",
]
