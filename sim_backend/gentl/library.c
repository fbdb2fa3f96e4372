#include "library.h"

#include <pthread.h>
#include <stdio.h>
#include <string.h>

#include "camera.h"
#include "clock.h"

static pthread_mutex_t mutex = PTHREAD_MUTEX_INITIALIZER;
static pthread_cond_t changed;
static pthread_once_t prepared = PTHREAD_ONCE_INIT;
static bool initialised;

static struct module modules[MODULE_KINDS][MAX_CAMERAS];
static uintptr_t latest_handle = 0x1000;

static _Thread_local GC_ERROR last_error;
static _Thread_local char last_reason[128];

void library_lock(void) { pthread_mutex_lock(&mutex); }

void library_unlock(void) { pthread_mutex_unlock(&mutex); }

void library_wait(void) { pthread_cond_wait(&changed, &mutex); }

void library_wait_until(int64_t moment_ns) { clock_wait_until(&changed, &mutex, moment_ns); }

void library_notify(void) { pthread_cond_broadcast(&changed); }

void *library_new_handle(void) { return (void *)++latest_handle; }

struct module *module_of(enum module_kind kind, const struct camera *camera) {
    return &modules[kind][camera ? camera - cameras : 0];
}

struct module *module_find(const void *handle) {
    for (int kind = 0; handle && kind < MODULE_KINDS; kind++)
        for (int i = 0; i < MAX_CAMERAS; i++)
            if (modules[kind][i].handle == handle)
                return &modules[kind][i];
    return NULL;
}

GC_ERROR library_enter(void *handle, enum module_kind kind, struct module **module) {
    library_lock();
    *module = module_find(handle);
    if (!initialised || !*module || (*module)->kind != kind) {
        bool known = initialised;
        library_unlock();
        return known ? fail(GC_ERR_INVALID_HANDLE, "the handle is not one of an open module of the right kind")
                     : fail(GC_ERR_NOT_INITIALIZED, "GCInitLib has not been called");
    }
    return GC_ERR_SUCCESS;
}

GC_ERROR library_leave(GC_ERROR code) {
    library_unlock();
    return code;
}

void library_close(struct module *module) {
    if (!module->handle)
        return;
    struct camera *camera = module->camera;
    switch (module->kind) {
    case MODULE_SYSTEM:
        library_close(module_of(MODULE_INTERFACE, NULL));
        break;
    case MODULE_INTERFACE:
        for (uint32_t i = 0; i < camera_count; i++)
            library_close(module_of(MODULE_DEVICE, &cameras[i]));
        break;
    case MODULE_DEVICE:
        library_close(module_of(MODULE_STREAM, camera));
        library_close(module_of(MODULE_REMOTE, camera));
        camera_close(camera);
        break;
    case MODULE_STREAM:
        sensor_end(camera);
        library_close(module_of(MODULE_EVENT, camera));
        stream_flush(&camera->stream, ACQ_QUEUE_ALL_DISCARD);
        while (camera->stream.announced)
            stream_revoke(&camera->stream, camera->stream.announced);
        break;
    case MODULE_EVENT:
    case MODULE_REMOTE:
        break;
    }
    module->handle = NULL;
    library_notify();
}

GC_ERROR fail(GC_ERROR code, const char *reason) {
    last_error = code;
    snprintf(last_reason, sizeof last_reason, "%s", reason);
    return code;
}

GC_ERROR answer(INFO_DATATYPE kind, const void *value, size_t value_size, INFO_DATATYPE *type, void *buffer,
                size_t *size) {
    if (type)
        *type = kind;
    if (!size)
        return fail(GC_ERR_INVALID_PARAMETER, "no place for the size");
    if (buffer && *size < value_size) {
        *size = value_size;
        return fail(GC_ERR_BUFFER_TOO_SMALL, "the buffer is too small for the answer");
    }
    if (buffer)
        memcpy(buffer, value, value_size);
    *size = value_size;
    return GC_ERR_SUCCESS;
}

GC_ERROR answer_string(const char *value, INFO_DATATYPE *type, void *buffer, size_t *size) {
    return answer(INFO_DATATYPE_STRING, value, strlen(value) + 1, type, buffer, size);
}

GC_ERROR answer_int32(int32_t value, INFO_DATATYPE *type, void *buffer, size_t *size) {
    return answer(INFO_DATATYPE_INT32, &value, sizeof value, type, buffer, size);
}

GC_ERROR answer_uint32(uint32_t value, INFO_DATATYPE *type, void *buffer, size_t *size) {
    return answer(INFO_DATATYPE_UINT32, &value, sizeof value, type, buffer, size);
}

GC_ERROR answer_uint64(uint64_t value, INFO_DATATYPE *type, void *buffer, size_t *size) {
    return answer(INFO_DATATYPE_UINT64, &value, sizeof value, type, buffer, size);
}

GC_ERROR answer_size(size_t value, INFO_DATATYPE *type, void *buffer, size_t *size) {
    return answer(INFO_DATATYPE_SIZET, &value, sizeof value, type, buffer, size);
}

GC_ERROR answer_bool(bool value, INFO_DATATYPE *type, void *buffer, size_t *size) {
    bool8_t byte = value;
    return answer(INFO_DATATYPE_BOOL8, &byte, sizeof byte, type, buffer, size);
}

GC_ERROR answer_pointer(void *value, INFO_DATATYPE *type, void *buffer, size_t *size) {
    return answer(INFO_DATATYPE_PTR, &value, sizeof value, type, buffer, size);
}

/* --- exported ---------------------------------------------------------------------------------------------------- */

static void prepare(void) {
    clock_condition_init(&changed);
    for (int kind = 0; kind < MODULE_KINDS; kind++)
        for (int i = 0; i < MAX_CAMERAS; i++) {
            bool of_camera = kind >= MODULE_DEVICE;
            modules[kind][i].kind = (enum module_kind)kind;
            modules[kind][i].camera = of_camera ? &cameras[i] : NULL;
        }
}

GC_API GCInitLib(void) {
    pthread_once(&prepared, prepare);
    library_lock();
    if (initialised)
        return library_leave(fail(GC_ERR_RESOURCE_IN_USE, "the library is initialised already"));
    cameras_load();
    initialised = true;
    return library_leave(GC_ERR_SUCCESS);
}

GC_API GCCloseLib(void) {
    library_lock();
    if (!initialised)
        return library_leave(fail(GC_ERR_NOT_INITIALIZED, "GCInitLib has not been called"));
    library_close(module_of(MODULE_SYSTEM, NULL));
    initialised = false;
    return library_leave(GC_ERR_SUCCESS);
}

GC_API GCGetLastError(GC_ERROR *code, char *text, size_t *size) {
    if (!code)
        return GC_ERR_INVALID_PARAMETER;
    *code = last_error;
    INFO_DATATYPE type;
    char reason[sizeof last_reason];
    memcpy(reason, last_reason, sizeof reason);
    return answer_string(reason, &type, text, size);
}
