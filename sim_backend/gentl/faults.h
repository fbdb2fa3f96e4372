/*
 * What can go wrong with a frame. Each fault F has two registers and features: Sim<F>In counts frames (or starts) down
 * and lets the fault happen once when it reaches 0, so 1 is the next one; Sim<F>Every lets it happen to each n-th.
 */
#ifndef FAULTS_H
#define FAULTS_H

enum fault {
    FAULT_MISS_TRIGGER, /* the trigger is not answered: no exposure, no frame id */
    FAULT_DROP,         /* exposed, then lost: its frame id is missing */
    FAULT_INCOMPLETE,   /* the lower half does not arrive; the buffer says so */
    FAULT_TRUNCATE,     /* the lower half does not arrive; only the filled size says so */
    FAULT_WRONG_SIZE,   /* half the height is delivered, as if the camera were set so */
    FAULT_LATE,         /* delivered SimLateBy µs later */
    FAULT_DUPLICATE,    /* delivered twice, with the same frame id */
    FAULT_REPEAT,       /* the pixels of the frame before, under its own frame id */
    FAULT_TEAR,         /* the lower half of its pixels is of the frame before */
    FAULT_ID_JUMP,      /* frame ids jump by SimIdJumpBy, no frame is missing */
    FAULT_STALE,        /* at the start of an acquisition (that is what is counted) a frame comes without a trigger */
    FAULT_DISCONNECT,   /* the camera is unplugged before it is delivered */
    FAULT_CRASH,        /* the process is ended by SIGSEGV when the frame is fetched */
    FAULT_HANG,         /* the call that fetches the frame never returns */
    FAULT_COUNT
};

#endif
