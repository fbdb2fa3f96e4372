/* The data stream and its new-buffer event. */
#include <signal.h>
#include <stdlib.h>
#include <string.h>
#include <unistd.h>

#include "camera.h"
#include "clock.h"
#include "library.h"

GC_API DSClose(DS_HANDLE stream) {
    struct module *module;
    GC_ERROR error = library_enter(stream, MODULE_STREAM, &module);
    if (error)
        return error;
    library_close(module);
    return library_leave(GC_ERR_SUCCESS);
}

GC_API DSGetInfo(DS_HANDLE stream, int32_t command, INFO_DATATYPE *type, void *buffer, size_t *size) {
    struct module *module;
    GC_ERROR error = library_enter(stream, MODULE_STREAM, &module);
    if (error)
        return error;
    const struct stream *state = &module->camera->stream;
    switch (command) {
    case STREAM_INFO_ID:
        return library_leave(answer_string(STREAM_ID, type, buffer, size));
    case STREAM_INFO_NUM_DELIVERED:
        return library_leave(answer_uint64(state->delivered, type, buffer, size));
    case STREAM_INFO_NUM_UNDERRUN:
        return library_leave(answer_uint64(state->underrun, type, buffer, size));
    case STREAM_INFO_NUM_ANNOUNCED:
        return library_leave(answer_size(state->announced_count, type, buffer, size));
    case STREAM_INFO_NUM_QUEUED:
        return library_leave(answer_size(state->input.count + (state->filling != NULL), type, buffer, size));
    case STREAM_INFO_NUM_AWAIT_DELIVERY:
        return library_leave(answer_size(state->output.count, type, buffer, size));
    case STREAM_INFO_NUM_STARTED:
        return library_leave(answer_uint64(state->started, type, buffer, size));
    case STREAM_INFO_PAYLOAD_SIZE:
        return library_leave(answer_size(camera_payload_size(module->camera), type, buffer, size));
    case STREAM_INFO_IS_GRABBING:
        return library_leave(answer_bool(module->camera->running, type, buffer, size));
    case STREAM_INFO_DEFINES_PAYLOADSIZE:
        return library_leave(answer_bool(false, type, buffer, size));
    case STREAM_INFO_TLTYPE:
        return library_leave(answer_string(TRANSPORT, type, buffer, size));
    case STREAM_INFO_NUM_CHUNKS_MAX:
        return library_leave(answer_size(0, type, buffer, size));
    case STREAM_INFO_BUF_ANNOUNCE_MIN:
    case STREAM_INFO_BUF_ALIGNMENT:
        return library_leave(answer_size(1, type, buffer, size));
    default:
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no such information of a stream"));
    }
}

/* --- buffers ----------------------------------------------------------------------------------------------------- */

static GC_ERROR enter_buffer(DS_HANDLE stream, BUFFER_HANDLE handle, struct module **module, struct buffer **buffer) {
    GC_ERROR error = library_enter(stream, MODULE_STREAM, module);
    if (error)
        return error;
    *buffer = stream_find(&(*module)->camera->stream, handle);
    return *buffer ? GC_ERR_SUCCESS : library_leave(fail(GC_ERR_INVALID_HANDLE, "there is no such buffer"));
}

static GC_ERROR announce(struct camera *camera, void *base, size_t size, void *user, bool owned, void **handle) {
    struct buffer *buffer = stream_announce(&camera->stream, base, size, user, owned);
    if (!buffer)
        return fail(GC_ERR_OUT_OF_MEMORY, "no memory for a buffer");
    *handle = buffer->handle;
    return GC_ERR_SUCCESS;
}

GC_API DSAnnounceBuffer(DS_HANDLE stream, void *base, size_t size, void *user, BUFFER_HANDLE *buffer) {
    struct module *module;
    GC_ERROR error = library_enter(stream, MODULE_STREAM, &module);
    if (error)
        return error;
    if (!base || !size || !buffer)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "a buffer needs memory and a place for its handle"));
    return library_leave(announce(module->camera, base, size, user, false, buffer));
}

GC_API DSAllocAndAnnounceBuffer(DS_HANDLE stream, size_t size, void *user, BUFFER_HANDLE *buffer) {
    struct module *module;
    GC_ERROR error = library_enter(stream, MODULE_STREAM, &module);
    if (error)
        return error;
    if (!size || !buffer)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "a buffer needs a size and a place for its handle"));
    void *base = calloc(1, size);
    if (!base)
        return library_leave(fail(GC_ERR_OUT_OF_MEMORY, "no memory for a buffer"));
    error = announce(module->camera, base, size, user, true, buffer);
    if (error)
        free(base);
    return library_leave(error);
}

GC_API DSRevokeBuffer(DS_HANDLE stream, BUFFER_HANDLE handle, void **base, void **user) {
    struct module *module;
    struct buffer *buffer;
    GC_ERROR error = enter_buffer(stream, handle, &module, &buffer);
    if (error)
        return error;
    if (buffer->place != UNQUEUED)
        return library_leave(fail(GC_ERR_BUSY, "the buffer is queued, flush the queues first"));
    if (base)
        *base = buffer->owned ? NULL : buffer->base;
    if (user)
        *user = buffer->user;
    stream_revoke(&module->camera->stream, buffer);
    return library_leave(GC_ERR_SUCCESS);
}

GC_API DSQueueBuffer(DS_HANDLE stream, BUFFER_HANDLE handle) {
    struct module *module;
    struct buffer *buffer;
    GC_ERROR error = enter_buffer(stream, handle, &module, &buffer);
    if (error)
        return error;
    if (buffer->place != UNQUEUED)
        return library_leave(fail(GC_ERR_RESOURCE_IN_USE, "the buffer is queued already"));
    stream_queue(&module->camera->stream, buffer);
    return library_leave(GC_ERR_SUCCESS);
}

GC_API DSFlushQueue(DS_HANDLE stream, int32_t operation) {
    struct module *module;
    GC_ERROR error = library_enter(stream, MODULE_STREAM, &module);
    if (error)
        return error;
    if (operation < ACQ_QUEUE_INPUT_TO_OUTPUT || operation > ACQ_QUEUE_ALL_DISCARD)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no such way to flush"));
    stream_flush(&module->camera->stream, operation);
    return library_leave(GC_ERR_SUCCESS);
}

GC_API DSGetBufferID(DS_HANDLE stream, uint32_t index, BUFFER_HANDLE *handle) {
    struct module *module;
    GC_ERROR error = library_enter(stream, MODULE_STREAM, &module);
    if (error)
        return error;
    const struct buffer *buffer = stream_at(&module->camera->stream, index);
    if (!buffer || !handle)
        return library_leave(fail(GC_ERR_INVALID_INDEX, "there are not so many buffers"));
    *handle = buffer->handle;
    return library_leave(GC_ERR_SUCCESS);
}

static GC_ERROR buffer_info(const struct buffer *buffer, int32_t command, INFO_DATATYPE *type, void *value,
                            size_t *size) {
    const struct frame *frame = &buffer->frame;
    const struct exposure *exposure = &frame->exposure;
    switch (command) {
    case BUFFER_INFO_BASE:
        return answer_pointer(buffer->base, type, value, size);
    case BUFFER_INFO_SIZE:
        return answer_size(buffer->size, type, value, size);
    case BUFFER_INFO_USER_PTR:
        return answer_pointer(buffer->user, type, value, size);
    case BUFFER_INFO_TIMESTAMP:
    case BUFFER_INFO_TIMESTAMP_NS:
        return answer_uint64((uint64_t)exposure->begin_ns, type, value, size);
    case BUFFER_INFO_NEW_DATA:
        return answer_bool(buffer->new_data, type, value, size);
    case BUFFER_INFO_IS_QUEUED:
        return answer_bool(buffer->place == IN_INPUT || buffer->place == IN_FILLING, type, value, size);
    case BUFFER_INFO_IS_ACQUIRING:
        return answer_bool(buffer->place == IN_FILLING, type, value, size);
    case BUFFER_INFO_IS_INCOMPLETE:
        return answer_bool(frame->incomplete, type, value, size);
    case BUFFER_INFO_TLTYPE:
        return answer_string(TRANSPORT, type, value, size);
    case BUFFER_INFO_SIZE_FILLED:
    case BUFFER_INFO_DATA_SIZE:
        return answer_size(frame->filled, type, value, size);
    case BUFFER_INFO_WIDTH:
        return answer_size(exposure->width, type, value, size);
    case BUFFER_INFO_HEIGHT:
    case BUFFER_INFO_DELIVERED_IMAGEHEIGHT:
        return answer_size(exposure->height, type, value, size);
    case BUFFER_INFO_XOFFSET:
        return answer_size(exposure->offset_x, type, value, size);
    case BUFFER_INFO_YOFFSET:
        return answer_size(exposure->offset_y, type, value, size);
    case BUFFER_INFO_XPADDING:
    case BUFFER_INFO_YPADDING:
    case BUFFER_INFO_IMAGEOFFSET:
        return answer_size(0, type, value, size);
    case BUFFER_INFO_FRAMEID:
        return answer_uint64(exposure->id, type, value, size);
    case BUFFER_INFO_IMAGEPRESENT:
        return answer_bool(true, type, value, size);
    case BUFFER_INFO_PAYLOADTYPE:
        return answer_size(PAYLOAD_TYPE_IMAGE, type, value, size);
    case BUFFER_INFO_PIXELFORMAT:
        return answer_uint64(exposure->format, type, value, size);
    case BUFFER_INFO_PIXELFORMAT_NAMESPACE:
        return answer_uint64(PIXELFORMAT_NAMESPACE_PFNC_32BIT, type, value, size);
    case BUFFER_INFO_PIXEL_ENDIANNESS:
        return answer_int32(PIXELENDIANNESS_LITTLE, type, value, size);
    case BUFFER_INFO_DATA_LARGER_THAN_BUFFER:
        return answer_bool(frame->payload > buffer->size, type, value, size);
    case BUFFER_INFO_CONTAINS_CHUNKDATA:
        return answer_bool(false, type, value, size);
    default:
        return fail(GC_ERR_NOT_AVAILABLE, "no such information of a buffer");
    }
}

GC_API DSGetBufferInfo(DS_HANDLE stream, BUFFER_HANDLE handle, int32_t command, INFO_DATATYPE *type, void *value,
                       size_t *size) {
    struct module *module;
    struct buffer *buffer;
    GC_ERROR error = enter_buffer(stream, handle, &module, &buffer);
    return error ? error : library_leave(buffer_info(buffer, command, type, value, size));
}

/* --- acquisition ------------------------------------------------------------------------------------------------- */

GC_API DSStartAcquisition(DS_HANDLE stream, int32_t flags, uint64_t frames) {
    struct module *module;
    GC_ERROR error = library_enter(stream, MODULE_STREAM, &module);
    (void)flags;
    if (error)
        return error;
    struct camera *camera = module->camera;
    if (camera->running)
        return library_leave(fail(GC_ERR_RESOURCE_IN_USE, "the stream runs already"));
    if (frames != GENTL_INFINITE)
        return library_leave(fail(GC_ERR_NOT_IMPLEMENTED, "a stream runs until it is stopped"));
    if (camera_gone(camera))
        return library_leave(fail(GC_ERR_IO, "the camera does not answer"));
    camera->stream.delivered = 0;
    return library_leave(sensor_run(camera));
}

GC_API DSStopAcquisition(DS_HANDLE stream, int32_t flags) {
    struct module *module;
    GC_ERROR error = library_enter(stream, MODULE_STREAM, &module);
    (void)flags;
    if (error)
        return error;
    if (!module->camera->running)
        return library_leave(fail(GC_ERR_RESOURCE_IN_USE, "the stream does not run"));
    sensor_end(module->camera);
    return library_leave(GC_ERR_SUCCESS);
}

/* --- events ------------------------------------------------------------------------------------------------------ */

GC_API GCRegisterEvent(EVENTSRC_HANDLE source, int32_t kind, EVENT_HANDLE *event) {
    library_lock();
    const struct module *module = module_find(source);
    if (!module)
        return library_leave(fail(GC_ERR_INVALID_HANDLE, "the handle is not one of an open module"));
    if (module->kind != MODULE_STREAM || kind != EVENT_NEW_BUFFER)
        return library_leave(fail(GC_ERR_NOT_IMPLEMENTED, "the only event is the new buffer of a stream"));
    struct camera *camera = module->camera;
    struct module *registered = module_of(MODULE_EVENT, camera);
    if (registered->handle)
        return library_leave(fail(GC_ERR_RESOURCE_IN_USE, "the event is registered already"));
    if (!event)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no place for the handle"));
    *event = registered->handle = library_new_handle();
    camera->stream.event_killed = false;
    camera->stream.fired = 0;
    return library_leave(GC_ERR_SUCCESS);
}

GC_API GCUnregisterEvent(EVENTSRC_HANDLE source, int32_t kind) {
    struct module *module;
    GC_ERROR error = library_enter(source, MODULE_STREAM, &module);
    if (error)
        return error;
    struct module *registered = module_of(MODULE_EVENT, module->camera);
    if (kind != EVENT_NEW_BUFFER || !registered->handle)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "this event is not registered"));
    library_close(registered);
    return library_leave(GC_ERR_SUCCESS);
}

static void crash(void) {
    signal(SIGSEGV, SIG_DFL);
    raise(SIGSEGV);
}

/* Wait for a buffer; a lost camera is noticed when nothing is left to fetch. */
static GC_ERROR wait_for_buffer(struct module *module, const void *event, uint64_t timeout_ms) {
    struct camera *camera = module->camera;
    struct stream *stream = &camera->stream;
    int64_t begin = clock_now();
    bool forever = timeout_ms > (uint64_t)(INT64_MAX - begin) / (uint64_t)NS_PER_MS;
    int64_t end = forever ? INT64_MAX : begin + (int64_t)timeout_ms * NS_PER_MS;
    for (;;) {
        if (module->handle != event)
            return fail(GC_ERR_ABORT, "the event was unregistered");
        if (stream->event_killed) {
            stream->event_killed = false;
            return fail(GC_ERR_ABORT, "the event was killed");
        }
        if (stream->output.count > 0)
            return GC_ERR_SUCCESS;
        if (camera_gone(camera))
            return fail(GC_ERR_IO, "the camera does not answer");
        if (clock_now() >= end)
            return fail(GC_ERR_TIMEOUT, "no buffer came in time");
        if (forever)
            library_wait();
        else
            library_wait_until(end);
    }
}

GC_API EventGetData(EVENT_HANDLE event, void *buffer, size_t *size, uint64_t timeout_ms) {
    struct module *module;
    GC_ERROR error = library_enter(event, MODULE_EVENT, &module);
    if (error)
        return error;
    EVENT_NEW_BUFFER_DATA data;
    if (!buffer || !size)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no place for the event's data"));
    if (*size < sizeof data) {
        *size = sizeof data;
        return library_leave(fail(GC_ERR_BUFFER_TOO_SMALL, "the buffer is too small for the event's data"));
    }
    error = wait_for_buffer(module, event, timeout_ms);
    if (error)
        return library_leave(error);
    const struct buffer *taken = stream_take(&module->camera->stream);
    if (taken->frame.crash)
        crash();
    while (taken->frame.hang)
        pause();
    data = (EVENT_NEW_BUFFER_DATA){taken->handle, taken->user};
    memcpy(buffer, &data, sizeof data);
    *size = sizeof data;
    return library_leave(GC_ERR_SUCCESS);
}

GC_API EventGetDataInfo(EVENT_HANDLE event, const void *data, size_t data_size, int32_t command, INFO_DATATYPE *type,
                        void *buffer, size_t *size) {
    struct module *module;
    GC_ERROR error = library_enter(event, MODULE_EVENT, &module);
    if (error)
        return error;
    EVENT_NEW_BUFFER_DATA content;
    if (!data || data_size < sizeof content)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "this is not the data of a new-buffer event"));
    memcpy(&content, data, sizeof content);
    switch (command) {
    case EVENT_DATA_ID:
        return library_leave(answer_pointer(content.BufferHandle, type, buffer, size));
    case EVENT_DATA_VALUE:
        return library_leave(answer_pointer(content.pUserPointer, type, buffer, size));
    default:
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no such information of an event's data"));
    }
}

GC_API EventGetInfo(EVENT_HANDLE event, int32_t command, INFO_DATATYPE *type, void *buffer, size_t *size) {
    struct module *module;
    GC_ERROR error = library_enter(event, MODULE_EVENT, &module);
    if (error)
        return error;
    const struct stream *stream = &module->camera->stream;
    switch (command) {
    case EVENT_INFO_EVENT_TYPE:
        return library_leave(answer_int32(EVENT_NEW_BUFFER, type, buffer, size));
    case EVENT_INFO_NUM_IN_QUEUE:
        return library_leave(answer_size(stream->output.count, type, buffer, size));
    case EVENT_INFO_NUM_FIRED:
        return library_leave(answer_uint64(stream->fired, type, buffer, size));
    case EVENT_INFO_SIZE_MAX:
    case EVENT_INFO_DATA_SIZE_MAX:
        return library_leave(answer_size(sizeof(EVENT_NEW_BUFFER_DATA), type, buffer, size));
    default:
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no such information of an event"));
    }
}

GC_API EventFlush(EVENT_HANDLE event) {
    struct module *module;
    GC_ERROR error = library_enter(event, MODULE_EVENT, &module);
    if (error)
        return error;
    stream_flush(&module->camera->stream, ACQ_QUEUE_OUTPUT_DISCARD);
    return library_leave(GC_ERR_SUCCESS);
}

GC_API EventKill(EVENT_HANDLE event) {
    struct module *module;
    GC_ERROR error = library_enter(event, MODULE_EVENT, &module);
    if (error)
        return error;
    module->camera->stream.event_killed = true;
    library_notify();
    return library_leave(GC_ERR_SUCCESS);
}
