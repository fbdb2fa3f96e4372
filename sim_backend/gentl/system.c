/* The system, its one interface, and the list of cameras. */
#include <dlfcn.h>
#include <stdio.h>
#include <string.h>

#include "camera.h"
#include "clock.h"
#include "library.h"
#include "presence.h"

static GC_ERROR open_module(enum module_kind kind, void **handle) {
    struct module *module = module_of(kind, NULL);
    if (!handle)
        return fail(GC_ERR_INVALID_PARAMETER, "no place for the handle");
    if (module->handle)
        return fail(GC_ERR_RESOURCE_IN_USE, "the module is open already");
    *handle = module->handle = library_new_handle();
    return GC_ERR_SUCCESS;
}

static GC_ERROR close_module(void *handle, enum module_kind kind) {
    struct module *module;
    GC_ERROR error = library_enter(handle, kind, &module);
    if (error)
        return error;
    library_close(module);
    return library_leave(GC_ERR_SUCCESS);
}

/* The handle of a module that is opened together with, or before, this one. */
static GC_ERROR related(void *handle, enum module_kind kind, enum module_kind other, void **answer_handle) {
    struct module *module;
    GC_ERROR error = library_enter(handle, kind, &module);
    if (error)
        return error;
    if (!answer_handle)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no place for the handle"));
    *answer_handle = module_of(other, other >= MODULE_DEVICE ? module->camera : NULL)->handle;
    return library_leave(GC_ERR_SUCCESS);
}

/* --- system ------------------------------------------------------------------------------------------------------ */

GC_API GCGetInfo(int32_t command, INFO_DATATYPE *type, void *buffer, size_t *size) {
    Dl_info file = {.dli_fname = ""};
    static const char anchor;
    dladdr(&anchor, &file);
    const char *path = file.dli_fname;
    const char *slash = strrchr(path, '/');
    switch (command) {
    case TL_INFO_ID:
        return answer_string(SYSTEM_ID, type, buffer, size);
    case TL_INFO_VENDOR:
        return answer_string(VENDOR, type, buffer, size);
    case TL_INFO_MODEL:
    case TL_INFO_DISPLAYNAME:
        return answer_string("MFS simulated cameras", type, buffer, size);
    case TL_INFO_VERSION:
        return answer_string(PRODUCER_VERSION, type, buffer, size);
    case TL_INFO_TLTYPE:
        return answer_string(TRANSPORT, type, buffer, size);
    case TL_INFO_NAME:
        return answer_string(slash ? slash + 1 : path, type, buffer, size);
    case TL_INFO_PATHNAME:
        return answer_string(path, type, buffer, size);
    case TL_INFO_CHAR_ENCODING:
        return answer_int32(TL_CHAR_ENCODING_UTF8, type, buffer, size);
    case TL_INFO_GENTL_VER_MAJOR:
        return answer_uint32(1, type, buffer, size);
    case TL_INFO_GENTL_VER_MINOR:
        return answer_uint32(6, type, buffer, size);
    default:
        return fail(GC_ERR_INVALID_PARAMETER, "no such information of the system");
    }
}

GC_API TLOpen(TL_HANDLE *system) {
    library_lock();
    return library_leave(open_module(MODULE_SYSTEM, system));
}

GC_API TLClose(TL_HANDLE system) { return close_module(system, MODULE_SYSTEM); }

GC_API TLGetInfo(TL_HANDLE system, int32_t command, INFO_DATATYPE *type, void *buffer, size_t *size) {
    struct module *module;
    GC_ERROR error = library_enter(system, MODULE_SYSTEM, &module);
    return error ? error : library_leave(GCGetInfo(command, type, buffer, size));
}

GC_API TLUpdateInterfaceList(TL_HANDLE system, bool8_t *did_change, uint64_t timeout_ms) {
    struct module *module;
    GC_ERROR error = library_enter(system, MODULE_SYSTEM, &module);
    (void)timeout_ms;
    if (error)
        return error;
    if (did_change)
        *did_change = 0;
    return library_leave(GC_ERR_SUCCESS);
}

GC_API TLGetNumInterfaces(TL_HANDLE system, uint32_t *count) {
    struct module *module;
    GC_ERROR error = library_enter(system, MODULE_SYSTEM, &module);
    if (error)
        return error;
    if (!count)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no place for the count"));
    *count = 1;
    return library_leave(GC_ERR_SUCCESS);
}

GC_API TLGetInterfaceID(TL_HANDLE system, uint32_t index, char *id, size_t *size) {
    struct module *module;
    INFO_DATATYPE type;
    GC_ERROR error = library_enter(system, MODULE_SYSTEM, &module);
    if (error)
        return error;
    if (index > 0)
        return library_leave(fail(GC_ERR_INVALID_INDEX, "there is one interface"));
    return library_leave(answer_string(INTERFACE_ID, &type, id, size));
}

static GC_ERROR interface_info(int32_t command, INFO_DATATYPE *type, void *buffer, size_t *size) {
    switch (command) {
    case INTERFACE_INFO_ID:
        return answer_string(INTERFACE_ID, type, buffer, size);
    case INTERFACE_INFO_DISPLAYNAME:
        return answer_string("MFS simulated interface", type, buffer, size);
    case INTERFACE_INFO_TLTYPE:
        return answer_string(TRANSPORT, type, buffer, size);
    default:
        return fail(GC_ERR_INVALID_PARAMETER, "no such information of an interface");
    }
}

GC_API TLGetInterfaceInfo(TL_HANDLE system, const char *id, int32_t command, INFO_DATATYPE *type, void *buffer,
                          size_t *size) {
    struct module *module;
    GC_ERROR error = library_enter(system, MODULE_SYSTEM, &module);
    if (error)
        return error;
    if (!id || strcmp(id, INTERFACE_ID) != 0)
        return library_leave(fail(GC_ERR_INVALID_ID, "there is no such interface"));
    return library_leave(interface_info(command, type, buffer, size));
}

GC_API TLOpenInterface(TL_HANDLE system, const char *id, IF_HANDLE *interface) {
    struct module *module;
    GC_ERROR error = library_enter(system, MODULE_SYSTEM, &module);
    if (error)
        return error;
    if (!id || strcmp(id, INTERFACE_ID) != 0)
        return library_leave(fail(GC_ERR_INVALID_ID, "there is no such interface"));
    return library_leave(open_module(MODULE_INTERFACE, interface));
}

/* --- interface --------------------------------------------------------------------------------------------------- */

GC_API IFClose(IF_HANDLE interface) { return close_module(interface, MODULE_INTERFACE); }

GC_API IFGetInfo(IF_HANDLE interface, int32_t command, INFO_DATATYPE *type, void *buffer, size_t *size) {
    struct module *module;
    GC_ERROR error = library_enter(interface, MODULE_INTERFACE, &module);
    return error ? error : library_leave(interface_info(command, type, buffer, size));
}

GC_API IFGetParentTL(IF_HANDLE interface, TL_HANDLE *system) {
    return related(interface, MODULE_INTERFACE, MODULE_SYSTEM, system);
}

GC_API IFUpdateDeviceList(IF_HANDLE interface, bool8_t *did_change, uint64_t timeout_ms) {
    struct module *module;
    GC_ERROR error = library_enter(interface, MODULE_INTERFACE, &module);
    (void)timeout_ms;
    if (error)
        return error;
    bool different = false;
    for (uint32_t i = 0; i < camera_count; i++) {
        bool listed = presence_plugged(cameras[i].serial);
        different = different || listed != cameras[i].listed;
        cameras[i].listed = listed;
    }
    if (did_change)
        *did_change = different;
    return library_leave(GC_ERR_SUCCESS);
}

GC_API IFGetNumDevices(IF_HANDLE interface, uint32_t *count) {
    struct module *module;
    GC_ERROR error = library_enter(interface, MODULE_INTERFACE, &module);
    if (error)
        return error;
    if (!count)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no place for the count"));
    *count = 0;
    for (uint32_t i = 0; i < camera_count; i++)
        *count += cameras[i].listed;
    return library_leave(GC_ERR_SUCCESS);
}

GC_API IFGetDeviceID(IF_HANDLE interface, uint32_t index, char *id, size_t *size) {
    struct module *module;
    INFO_DATATYPE type;
    GC_ERROR error = library_enter(interface, MODULE_INTERFACE, &module);
    if (error)
        return error;
    for (uint32_t i = 0; i < camera_count; i++)
        if (cameras[i].listed && index-- == 0)
            return library_leave(answer_string(cameras[i].serial, &type, id, size));
    return library_leave(fail(GC_ERR_INVALID_INDEX, "there are not so many cameras"));
}

static struct camera *camera_by_id(const char *id) {
    for (uint32_t i = 0; id && i < camera_count; i++)
        if (cameras[i].listed && strcmp(cameras[i].serial, id) == 0)
            return &cameras[i];
    return NULL;
}

static int32_t access_status(struct camera *camera) {
    if (module_of(MODULE_DEVICE, camera)->handle)
        return camera_gone(camera) ? DEVICE_ACCESS_STATUS_NOACCESS : DEVICE_ACCESS_STATUS_OPEN_READWRITE;
    if (!presence_plugged(camera->serial))
        return DEVICE_ACCESS_STATUS_NOACCESS;
    return presence_claimed(camera->serial) ? DEVICE_ACCESS_STATUS_BUSY : DEVICE_ACCESS_STATUS_READWRITE;
}

static GC_ERROR device_info(struct camera *camera, int32_t command, INFO_DATATYPE *type, void *buffer, size_t *size) {
    char display[3 * NAME_SIZE];
    switch (command) {
    case DEVICE_INFO_ID:
    case DEVICE_INFO_SERIAL_NUMBER:
        return answer_string(camera->serial, type, buffer, size);
    case DEVICE_INFO_VENDOR:
        return answer_string(VENDOR, type, buffer, size);
    case DEVICE_INFO_MODEL:
        return answer_string(camera->model, type, buffer, size);
    case DEVICE_INFO_TLTYPE:
        return answer_string(TRANSPORT, type, buffer, size);
    case DEVICE_INFO_DISPLAYNAME:
        snprintf(display, sizeof display, "%s %s (%s)", VENDOR, camera->model, camera->serial);
        return answer_string(display, type, buffer, size);
    case DEVICE_INFO_ACCESS_STATUS:
        return answer_int32(access_status(camera), type, buffer, size);
    case DEVICE_INFO_USER_DEFINED_NAME:
        return answer_string(camera->user_name, type, buffer, size);
    case DEVICE_INFO_VERSION:
        return answer_string(PRODUCER_VERSION, type, buffer, size);
    case DEVICE_INFO_TIMESTAMP_FREQUENCY:
        return answer_uint64((uint64_t)NS_PER_S, type, buffer, size);
    default:
        return fail(GC_ERR_INVALID_PARAMETER, "no such information of a device");
    }
}

GC_API IFGetDeviceInfo(IF_HANDLE interface, const char *id, int32_t command, INFO_DATATYPE *type, void *buffer,
                       size_t *size) {
    struct module *module;
    GC_ERROR error = library_enter(interface, MODULE_INTERFACE, &module);
    if (error)
        return error;
    struct camera *camera = camera_by_id(id);
    return library_leave(camera ? device_info(camera, command, type, buffer, size)
                                : fail(GC_ERR_INVALID_ID, "there is no such camera"));
}

GC_API IFOpenDevice(IF_HANDLE interface, const char *id, int32_t access, DEV_HANDLE *device) {
    struct module *module;
    GC_ERROR error = library_enter(interface, MODULE_INTERFACE, &module);
    if (error)
        return error;
    struct camera *camera = camera_by_id(id);
    if (!device)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no place for the handle"));
    if (!camera)
        return library_leave(fail(GC_ERR_INVALID_ID, "there is no such camera"));
    if (access != DEVICE_ACCESS_CONTROL && access != DEVICE_ACCESS_EXCLUSIVE)
        return library_leave(fail(GC_ERR_NOT_IMPLEMENTED, "a camera is opened to read and write, or not at all"));
    module = module_of(MODULE_DEVICE, camera);
    if (module->handle)
        return library_leave(fail(GC_ERR_RESOURCE_IN_USE, "this process has the camera open already"));
    error = camera_open(camera);
    if (!error) {
        *device = module->handle = library_new_handle();
        module_of(MODULE_REMOTE, camera)->handle = library_new_handle();
    }
    return library_leave(error);
}

/* --- device ------------------------------------------------------------------------------------------------------ */

GC_API DevClose(DEV_HANDLE device) { return close_module(device, MODULE_DEVICE); }

GC_API DevGetInfo(DEV_HANDLE device, int32_t command, INFO_DATATYPE *type, void *buffer, size_t *size) {
    struct module *module;
    GC_ERROR error = library_enter(device, MODULE_DEVICE, &module);
    return error ? error : library_leave(device_info(module->camera, command, type, buffer, size));
}

GC_API DevGetParentIF(DEV_HANDLE device, IF_HANDLE *interface) {
    return related(device, MODULE_DEVICE, MODULE_INTERFACE, interface);
}

GC_API DevGetPort(DEV_HANDLE device, PORT_HANDLE *port) {
    return related(device, MODULE_DEVICE, MODULE_REMOTE, port);
}

GC_API DevGetNumDataStreams(DEV_HANDLE device, uint32_t *count) {
    struct module *module;
    GC_ERROR error = library_enter(device, MODULE_DEVICE, &module);
    if (error)
        return error;
    if (!count)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no place for the count"));
    *count = 1;
    return library_leave(GC_ERR_SUCCESS);
}

GC_API DevGetDataStreamID(DEV_HANDLE device, uint32_t index, char *id, size_t *size) {
    struct module *module;
    INFO_DATATYPE type;
    GC_ERROR error = library_enter(device, MODULE_DEVICE, &module);
    if (error)
        return error;
    if (index > 0)
        return library_leave(fail(GC_ERR_INVALID_INDEX, "a camera has one stream"));
    return library_leave(answer_string(STREAM_ID, &type, id, size));
}

GC_API DevOpenDataStream(DEV_HANDLE device, const char *id, DS_HANDLE *stream) {
    struct module *module;
    GC_ERROR error = library_enter(device, MODULE_DEVICE, &module);
    if (error)
        return error;
    if (!stream)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no place for the handle"));
    if (!id || strcmp(id, STREAM_ID) != 0)
        return library_leave(fail(GC_ERR_INVALID_ID, "there is no such stream"));
    struct camera *camera = module->camera;
    module = module_of(MODULE_STREAM, camera);
    if (module->handle)
        return library_leave(fail(GC_ERR_RESOURCE_IN_USE, "the stream is open already"));
    camera->stream = (struct stream){0};
    *stream = module->handle = library_new_handle();
    return library_leave(GC_ERR_SUCCESS);
}

GC_API DSGetParentDev(DS_HANDLE stream, DEV_HANDLE *device) {
    return related(stream, MODULE_STREAM, MODULE_DEVICE, device);
}
