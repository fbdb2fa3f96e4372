#include "stream.h"

#include <stdlib.h>

#include "gentl.h"
#include "library.h"

static void append(struct queue *queue, struct buffer *buffer, enum buffer_place place) {
    buffer->behind = NULL;
    buffer->place = place;
    if (queue->last)
        queue->last->behind = buffer;
    else
        queue->first = buffer;
    queue->last = buffer;
    queue->count++;
}

static struct buffer *pop(struct queue *queue) {
    struct buffer *buffer = queue->first;
    if (!buffer)
        return NULL;
    queue->first = buffer->behind;
    if (!queue->first)
        queue->last = NULL;
    queue->count--;
    buffer->place = UNQUEUED;
    return buffer;
}

/* Buffers cannot be taken away while pixels are written to them. */
static void wait_for_filling(const struct stream *stream) {
    while (stream->filling)
        library_wait();
}

struct buffer *stream_announce(struct stream *stream, void *base, size_t size, void *user, bool owned) {
    struct buffer *buffer = calloc(1, sizeof *buffer);
    if (!buffer)
        return NULL;
    *buffer = (struct buffer){.handle = library_new_handle(), .base = base, .user = user, .size = size, .owned = owned};
    struct buffer **end = &stream->announced;
    while (*end)
        end = &(*end)->next;
    *end = buffer;
    stream->announced_count++;
    return buffer;
}

struct buffer *stream_find(const struct stream *stream, const void *handle) {
    struct buffer *buffer = stream->announced;
    while (buffer && buffer->handle != handle)
        buffer = buffer->next;
    return buffer;
}

struct buffer *stream_at(const struct stream *stream, uint32_t index) {
    struct buffer *buffer = stream->announced;
    while (buffer && index-- > 0)
        buffer = buffer->next;
    return buffer;
}

void stream_revoke(struct stream *stream, struct buffer *buffer) {
    struct buffer **link = &stream->announced;
    while (*link != buffer)
        link = &(*link)->next;
    *link = buffer->next;
    stream->announced_count--;
    if (buffer->owned)
        free(buffer->base);
    free(buffer);
}

void stream_queue(struct stream *stream, struct buffer *buffer) {
    buffer->new_data = false;
    append(&stream->input, buffer, IN_INPUT);
}

void stream_flush(struct stream *stream, int32_t operation) {
    struct buffer *buffer;
    wait_for_filling(stream);
    switch (operation) {
    case ACQ_QUEUE_INPUT_TO_OUTPUT:
        while ((buffer = pop(&stream->input)))
            append(&stream->output, buffer, IN_OUTPUT);
        break;
    case ACQ_QUEUE_OUTPUT_DISCARD:
        while (pop(&stream->output))
            ;
        break;
    case ACQ_QUEUE_ALL_TO_INPUT:
        while (pop(&stream->output))
            ;
        /* fall through */
    case ACQ_QUEUE_UNQUEUED_TO_INPUT:
        for (buffer = stream->announced; buffer; buffer = buffer->next)
            if (buffer->place == UNQUEUED)
                stream_queue(stream, buffer);
        break;
    case ACQ_QUEUE_ALL_DISCARD:
        while (pop(&stream->input) || pop(&stream->output))
            ;
        break;
    }
    library_notify();
}

struct buffer *stream_take(struct stream *stream) { return pop(&stream->output); }

void stream_put(struct stream *stream, const struct frame *frame, const void *raw) {
    struct buffer *buffer = pop(&stream->input);
    if (!buffer) {
        stream->underrun++;
        return;
    }
    buffer->place = IN_FILLING;
    buffer->frame = *frame;
    if (buffer->frame.filled > buffer->size) {
        buffer->frame.filled = buffer->size;
        buffer->frame.incomplete = true;
    }
    stream->filling = buffer;
    stream->started++;
    library_unlock();
    const struct exposure *exposure = &frame->exposure;
    picture_pack(exposure->format, raw, (size_t)exposure->width * exposure->height, buffer->base, buffer->frame.filled);
    library_lock();
    stream->filling = NULL;
    buffer->new_data = true;
    append(&stream->output, buffer, IN_OUTPUT);
    stream->delivered++;
    stream->fired++;
    library_notify();
}
