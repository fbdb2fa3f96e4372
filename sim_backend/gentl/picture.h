/* Pictures: pixel formats, the picture that is made without a world, and the way pixels lie in a buffer. */
#ifndef PICTURE_H
#define PICTURE_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

/* Values of the GenICam Pixel Format Naming Convention (PFNC). */
enum {
    MONO8 = 0x01080001,
    MONO10 = 0x01100003,
    MONO12 = 0x01100005,
    MONO16 = 0x01100007,
    MONO10P = 0x010A0046,
    MONO12P = 0x010C0047,
    MONO12PACKED = 0x010C0006
};

/* What the camera knows of one exposure. */
struct exposure {
    uint64_t id;
    int64_t begin_ns, end_ns;
    uint32_t offset_x, offset_y, width, height; /* px on the sensor */
    uint32_t format;                            /* PFNC */
    double gain_db, black_level_dn;
};

/* Significant bits of a pixel; 0 for a format that the camera does not have. */
uint32_t picture_bits(uint32_t format);

/* Bytes of a picture as it is made (one or two bytes a pixel) and as it is delivered. */
size_t picture_raw_size(const struct exposure *exposure);
size_t picture_payload_size(uint32_t format, uint32_t width, uint32_t height);

/*
 * The picture without a world. The pixel in column X and row Y of the sensor is
 *     (X + 3 Y + 5 id + black level) modulo 2^bits,
 * X and Y counted on the whole sensor, id the number of the exposure from 0.
 */
void picture_test(const struct exposure *exposure, void *raw);

/* Write a picture as its format lays it out, `limit` bytes at most. */
void picture_pack(uint32_t format, const void *raw, size_t pixels, uint8_t *payload, size_t limit);

#endif
