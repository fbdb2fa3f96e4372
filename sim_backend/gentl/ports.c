/* Every module is a port: registers to read and write, and a description of them in GenApi's XML. */
#include <stdio.h>
#include <string.h>

#include "camera.h"
#include "clock.h"
#include "library.h"

static const char *const PORT_NAMES[] = {"SystemPort", "InterfacePort", "DevicePort", "Device", "StreamPort"};
static const char *const MODULE_NAMES[] = {"TLSystem", "TLInterface", "TLDevice", "Device", "TLDataStream"};

/* The modules of the host have no features: a root category and their port. */
static const char HOST_DESCRIPTION[] =
    "<?xml version=\"1.0\" encoding=\"utf-8\"?>\n"
    "<RegisterDescription ModelName=\"%s\" VendorName=\"MFS\" StandardNameSpace=\"None\" SchemaMajorVersion=\"1\""
    " SchemaMinorVersion=\"1\" SchemaSubMinorVersion=\"0\" MajorVersion=\"1\" MinorVersion=\"0\" SubMinorVersion=\"0\""
    " ProductGuid=\"6a37b1a2-52cd-4c5b-9d0e-2d9a3a7b3f10\" VersionGuid=\"0f5e5e0c-6a3a-4e39-8f0d-94ad9a8f4c11\""
    " xmlns=\"http://www.genicam.org/GenApi/Version_1_1\">\n"
    "<Category Name=\"Root\"/><Port Name=\"%s\"/>\n"
    "</RegisterDescription>\n";

enum { HOST_ADDRESS = 0x1000, DEVICE_ADDRESS = 0x100000, HOST_SIZE = sizeof HOST_DESCRIPTION + 64 };

static size_t host_description(enum module_kind kind, char text[HOST_SIZE]) {
    return (size_t)snprintf(text, HOST_SIZE, HOST_DESCRIPTION, MODULE_NAMES[kind], PORT_NAMES[kind]);
}

static size_t description_bytes(const struct module *module) {
    char text[HOST_SIZE];
    size_t size = 0;
    if (module->kind == MODULE_REMOTE)
        camera_description(module->camera, &size);
    else
        size = host_description(module->kind, text);
    return size;
}

static void file_name(const struct module *module, char name[64]) {
    bool legacy = module->kind == MODULE_REMOTE && module->camera->legacy;
    snprintf(name, 64, "mfs_sim_%s%s.xml", MODULE_NAMES[module->kind], legacy ? "_legacy" : "");
}

static uint64_t description_address(const struct module *module) {
    return module->kind == MODULE_REMOTE ? DEVICE_ADDRESS : HOST_ADDRESS;
}

static void url_of(const struct module *module, char url[128]) {
    char name[64];
    file_name(module, name);
    snprintf(url, 128, "local:%s;%llX;%zX", name, (unsigned long long)description_address(module),
             description_bytes(module));
}

static GC_ERROR enter_port(void *handle, struct module **module) {
    library_lock();
    *module = module_find(handle);
    if (*module && (*module)->kind != MODULE_EVENT)
        return GC_ERR_SUCCESS;
    return library_leave(fail(GC_ERR_INVALID_HANDLE, "the handle is not one of an open port"));
}

static GC_ERROR read_port(struct module *module, uint64_t address, void *buffer, size_t *size) {
    if (module->kind == MODULE_REMOTE) {
        if (camera_gone(module->camera))
            return fail(GC_ERR_IO, "the camera does not answer");
        return registers_read(module->camera, address, buffer, size);
    }
    char text[HOST_SIZE];
    size_t bytes = host_description(module->kind, text);
    if (address < HOST_ADDRESS || address >= HOST_ADDRESS + bytes)
        return fail(GC_ERR_INVALID_ADDRESS, "there is no register at this address");
    size_t begin = (size_t)(address - HOST_ADDRESS);
    if (*size > bytes - begin)
        *size = bytes - begin;
    memcpy(buffer, text + begin, *size);
    return GC_ERR_SUCCESS;
}

static GC_ERROR write_port(struct module *module, uint64_t address, const void *data, size_t size) {
    if (module->kind != MODULE_REMOTE)
        return fail(GC_ERR_ACCESS_DENIED, "this port has nothing that can be written");
    if (camera_gone(module->camera))
        return fail(GC_ERR_IO, "the camera does not answer");
    return registers_write(module->camera, address, data, size);
}

GC_API GCGetPortInfo(PORT_HANDLE port, int32_t command, INFO_DATATYPE *type, void *buffer, size_t *size) {
    struct module *module;
    GC_ERROR error = enter_port(port, &module);
    if (error)
        return error;
    bool remote = module->kind == MODULE_REMOTE;
    switch (command) {
    case PORT_INFO_ID:
        return library_leave(answer_string(module->camera ? module->camera->serial : SYSTEM_ID, type, buffer, size));
    case PORT_INFO_VENDOR:
        return library_leave(answer_string(VENDOR, type, buffer, size));
    case PORT_INFO_MODEL:
        return library_leave(answer_string(remote ? module->camera->model : MODULE_NAMES[module->kind], type, buffer,
                                           size));
    case PORT_INFO_TLTYPE:
        return library_leave(answer_string(TRANSPORT, type, buffer, size));
    case PORT_INFO_MODULE:
        return library_leave(answer_string(MODULE_NAMES[module->kind], type, buffer, size));
    case PORT_INFO_LITTLE_ENDIAN:
    case PORT_INFO_ACCESS_READ:
        return library_leave(answer_bool(true, type, buffer, size));
    case PORT_INFO_ACCESS_WRITE:
        return library_leave(answer_bool(remote, type, buffer, size));
    case PORT_INFO_BIG_ENDIAN:
    case PORT_INFO_ACCESS_NA:
    case PORT_INFO_ACCESS_NI:
        return library_leave(answer_bool(false, type, buffer, size));
    case PORT_INFO_VERSION:
        return library_leave(answer_string(PRODUCER_VERSION, type, buffer, size));
    case PORT_INFO_PORTNAME:
        return library_leave(answer_string(PORT_NAMES[module->kind], type, buffer, size));
    default:
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no such information of a port"));
    }
}

GC_API GCGetNumPortURLs(PORT_HANDLE port, uint32_t *count) {
    struct module *module;
    GC_ERROR error = enter_port(port, &module);
    if (error)
        return error;
    if (!count)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no place for the count"));
    *count = 1;
    return library_leave(GC_ERR_SUCCESS);
}

GC_API GCGetPortURLInfo(PORT_HANDLE port, uint32_t index, int32_t command, INFO_DATATYPE *type, void *buffer,
                        size_t *size) {
    struct module *module;
    GC_ERROR error = enter_port(port, &module);
    if (error)
        return error;
    if (index > 0)
        return library_leave(fail(GC_ERR_INVALID_INDEX, "a port has one description"));
    char text[128];
    switch (command) {
    case URL_INFO_URL:
        url_of(module, text);
        return library_leave(answer_string(text, type, buffer, size));
    case URL_INFO_SCHEMA_VER_MAJOR:
    case URL_INFO_SCHEMA_VER_MINOR:
    case URL_INFO_FILE_VER_MAJOR:
        return library_leave(answer_int32(1, type, buffer, size));
    case URL_INFO_FILE_VER_MINOR:
    case URL_INFO_FILE_VER_SUBMINOR:
        return library_leave(answer_int32(0, type, buffer, size));
    case URL_INFO_FILE_REGISTER_ADDRESS:
        return library_leave(answer_uint64(description_address(module), type, buffer, size));
    case URL_INFO_FILE_SIZE:
        return library_leave(answer_uint64(description_bytes(module), type, buffer, size));
    case URL_INFO_SCHEME:
        return library_leave(answer_int32(URL_SCHEME_LOCAL, type, buffer, size));
    case URL_INFO_FILENAME:
        file_name(module, text);
        return library_leave(answer_string(text, type, buffer, size));
    default:
        return library_leave(fail(GC_ERR_NOT_AVAILABLE, "no such information of a description"));
    }
}

GC_API GCGetPortURL(PORT_HANDLE port, char *url, size_t *size) {
    INFO_DATATYPE type;
    return GCGetPortURLInfo(port, 0, URL_INFO_URL, &type, url, size);
}

GC_API GCReadPort(PORT_HANDLE port, uint64_t address, void *buffer, size_t *size) {
    struct module *module;
    GC_ERROR error = enter_port(port, &module);
    if (error)
        return error;
    if (!buffer || !size)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no buffer to read into"));
    return library_leave(read_port(module, address, buffer, size));
}

GC_API GCWritePort(PORT_HANDLE port, uint64_t address, const void *buffer, size_t *size) {
    struct module *module;
    GC_ERROR error = enter_port(port, &module);
    if (error)
        return error;
    if (!buffer || !size)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "nothing to write"));
    return library_leave(write_port(module, address, buffer, *size));
}

GC_API GCReadPortStacked(PORT_HANDLE port, PORT_REGISTER_STACK_ENTRY *entries, size_t *count) {
    struct module *module;
    GC_ERROR error = enter_port(port, &module);
    if (error)
        return error;
    if (!entries || !count)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no entries to read"));
    size_t wanted = *count;
    for (*count = 0; *count < wanted && !error; *count += !error) {
        size_t size = entries[*count].Size;
        error = read_port(module, entries[*count].Address, entries[*count].pBuffer, &size);
    }
    return library_leave(error);
}

GC_API GCWritePortStacked(PORT_HANDLE port, PORT_REGISTER_STACK_ENTRY *entries, size_t *count) {
    struct module *module;
    GC_ERROR error = enter_port(port, &module);
    if (error)
        return error;
    if (!entries || !count)
        return library_leave(fail(GC_ERR_INVALID_PARAMETER, "no entries to write"));
    size_t wanted = *count;
    for (*count = 0; *count < wanted && !error; *count += !error)
        error = write_port(module, entries[*count].Address, entries[*count].pBuffer, entries[*count].Size);
    return library_leave(error);
}
