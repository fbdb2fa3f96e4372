/*
 * What all of the library shares: one lock for all state, handles that are never used twice, and the reason for the
 * latest failure. Only pixels are moved without the lock.
 */
#ifndef LIBRARY_H
#define LIBRARY_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "gentl.h"

struct camera;

void library_lock(void);
void library_unlock(void);

/* With the lock held: wait until something has changed; say that something has. */
void library_wait(void);
void library_wait_until(int64_t moment_ns);
void library_notify(void);

void *library_new_handle(void);

/* The modules that can be open; a system and an interface once, the others once for each camera. */
enum module_kind { MODULE_SYSTEM, MODULE_INTERFACE, MODULE_DEVICE, MODULE_REMOTE, MODULE_STREAM, MODULE_EVENT };
enum { MODULE_KINDS = MODULE_EVENT + 1 };

struct module {
    void *handle; /* NULL while it is closed */
    enum module_kind kind;
    struct camera *camera;
};

/* The one of that kind (and camera), open or not. */
struct module *module_of(enum module_kind kind, const struct camera *camera);

/* The open one with that handle, or NULL. */
struct module *module_find(const void *handle);

/*
 * Every exported function that takes a handle begins with library_enter(), which takes the lock and finds the module,
 * and ends with library_leave(). Where library_enter() fails the lock is free.
 */
GC_ERROR library_enter(void *handle, enum module_kind kind, struct module **module);
GC_ERROR library_leave(GC_ERROR code);

/* Close a module and what was opened through it. Lets the lock go while threads end. */
void library_close(struct module *module);

/* Keep the reason for GCGetLastError and give the code back. */
GC_ERROR fail(GC_ERROR code, const char *reason);

/* What an information function answers with; `buffer` NULL asks for the size only. */
GC_ERROR answer(INFO_DATATYPE kind, const void *value, size_t value_size, INFO_DATATYPE *type, void *buffer,
                size_t *size);
GC_ERROR answer_string(const char *value, INFO_DATATYPE *type, void *buffer, size_t *size);
GC_ERROR answer_int32(int32_t value, INFO_DATATYPE *type, void *buffer, size_t *size);
GC_ERROR answer_uint32(uint32_t value, INFO_DATATYPE *type, void *buffer, size_t *size);
GC_ERROR answer_uint64(uint64_t value, INFO_DATATYPE *type, void *buffer, size_t *size);
GC_ERROR answer_size(size_t value, INFO_DATATYPE *type, void *buffer, size_t *size);
GC_ERROR answer_bool(bool value, INFO_DATATYPE *type, void *buffer, size_t *size);
GC_ERROR answer_pointer(void *value, INFO_DATATYPE *type, void *buffer, size_t *size);

#define VENDOR "MFS Scanner"
#define TRANSPORT "Custom"
#define PRODUCER_VERSION "1.0.0"
#define SYSTEM_ID "mfs-sim"
#define INTERFACE_ID "mfs-sim-0"
#define STREAM_ID "stream-0"

#endif
