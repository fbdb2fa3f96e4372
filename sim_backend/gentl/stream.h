/* A data stream's buffers: where each one is, and what the frame in it is like. The library's lock is held throughout. */
#ifndef STREAM_H
#define STREAM_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "picture.h"

/* A frame on its way into a buffer, faults included. */
struct frame {
    struct exposure exposure; /* as delivered: its height and id may be false */
    size_t payload;           /* bytes the frame should have */
    size_t filled;            /* bytes that arrive */
    bool incomplete;
    bool crash, hang; /* what becomes of the process when the frame is fetched */
};

enum buffer_place { UNQUEUED, IN_INPUT, IN_FILLING, IN_OUTPUT };

struct buffer {
    void *handle;
    void *base, *user;
    size_t size;
    bool owned; /* allocated here */
    enum buffer_place place;
    bool new_data;
    struct frame frame;
    struct buffer *next; /* announced after this one */
    struct buffer *behind; /* in the same queue */
};

struct queue {
    struct buffer *first, *last;
    uint64_t count;
};

struct stream {
    struct buffer *announced;
    uint64_t announced_count;
    struct queue input, output;
    struct buffer *filling;
    uint64_t delivered, underrun, started;
    uint64_t fired;    /* new-buffer events since the event was registered */
    bool event_killed; /* the next EventGetData ends with GC_ERR_ABORT */
};

struct buffer *stream_announce(struct stream *stream, void *base, size_t size, void *user, bool owned);
struct buffer *stream_find(const struct stream *stream, const void *handle);
struct buffer *stream_at(const struct stream *stream, uint32_t index);
void stream_revoke(struct stream *stream, struct buffer *buffer);
void stream_queue(struct stream *stream, struct buffer *buffer);
void stream_flush(struct stream *stream, int32_t operation);

/* The oldest delivered buffer, or NULL. */
struct buffer *stream_take(struct stream *stream);

/* Lay a picture into the next free buffer and deliver it; the lock is let go while pixels are copied. */
void stream_put(struct stream *stream, const struct frame *frame, const void *raw);

#endif
