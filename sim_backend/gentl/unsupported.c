/* Functions that a producer has to export and that this one has no use for: chunks, parts, flows, segments. */
#include "library.h"

static GC_ERROR unsupported(void) { return fail(GC_ERR_NOT_IMPLEMENTED, "this producer does not have that"); }

GC_API DSGetBufferChunkData(DS_HANDLE stream, BUFFER_HANDLE buffer, void *chunks, size_t *count) {
    (void)stream, (void)buffer, (void)chunks, (void)count;
    return unsupported();
}

GC_API DSGetNumBufferParts(DS_HANDLE stream, BUFFER_HANDLE buffer, uint32_t *count) {
    (void)stream, (void)buffer, (void)count;
    return unsupported();
}

GC_API DSGetBufferPartInfo(DS_HANDLE stream, BUFFER_HANDLE buffer, uint32_t part, int32_t command, INFO_DATATYPE *type,
                           void *value, size_t *size) {
    (void)stream, (void)buffer, (void)part, (void)command, (void)type, (void)value, (void)size;
    return unsupported();
}

GC_API DSAnnounceCompositeBuffer(DS_HANDLE stream, size_t segments, void **bases, void *user, BUFFER_HANDLE *buffer) {
    (void)stream, (void)segments, (void)bases, (void)user, (void)buffer;
    return unsupported();
}

GC_API DSGetNumFlows(DS_HANDLE stream, uint32_t *count) {
    (void)stream, (void)count;
    return unsupported();
}

GC_API DSGetFlowInfo(DS_HANDLE stream, uint32_t flow, int32_t command, INFO_DATATYPE *type, void *value, size_t *size) {
    (void)stream, (void)flow, (void)command, (void)type, (void)value, (void)size;
    return unsupported();
}

GC_API DSGetNumBufferSegments(DS_HANDLE stream, BUFFER_HANDLE buffer, uint32_t *count) {
    (void)stream, (void)buffer, (void)count;
    return unsupported();
}

GC_API DSGetBufferSegmentInfo(DS_HANDLE stream, BUFFER_HANDLE buffer, uint32_t segment, int32_t command,
                              INFO_DATATYPE *type, void *value, size_t *size) {
    (void)stream, (void)buffer, (void)segment, (void)command, (void)type, (void)value, (void)size;
    return unsupported();
}

GC_API DSGetBufferInfoStacked(DS_HANDLE stream, BUFFER_HANDLE buffer, void *entries, size_t count) {
    (void)stream, (void)buffer, (void)entries, (void)count;
    return unsupported();
}

GC_API DSGetBufferPartInfoStacked(DS_HANDLE stream, BUFFER_HANDLE buffer, void *entries, size_t count) {
    (void)stream, (void)buffer, (void)entries, (void)count;
    return unsupported();
}
