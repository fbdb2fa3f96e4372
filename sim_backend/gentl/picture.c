#include "picture.h"

#include <string.h>

uint32_t picture_bits(uint32_t format) {
    switch (format) {
    case MONO8:
        return 8;
    case MONO10:
    case MONO10P:
        return 10;
    case MONO12:
    case MONO12P:
    case MONO12PACKED:
        return 12;
    case MONO16:
        return 16;
    default:
        return 0;
    }
}

size_t picture_raw_size(const struct exposure *exposure) {
    size_t pixels = (size_t)exposure->width * exposure->height;
    return picture_bits(exposure->format) == 8 ? pixels : 2 * pixels;
}

size_t picture_payload_size(uint32_t format, uint32_t width, uint32_t height) {
    size_t bits_stored = (format >> 16) & 0xFF; /* PFNC names the bits that a pixel takes in memory */
    return (size_t)width * height * bits_stored / 8;
}

void picture_test(const struct exposure *exposure, void *raw) {
    uint32_t bits = picture_bits(exposure->format);
    uint32_t mask = (1U << bits) - 1;
    uint32_t shift = (uint32_t)(5 * exposure->id) + (uint32_t)exposure->black_level_dn;
    for (uint32_t row = 0; row < exposure->height; row++) {
        uint32_t first = exposure->offset_x + 3 * (exposure->offset_y + row) + shift;
        uint8_t *narrow = (uint8_t *)raw + (size_t)row * exposure->width;
        uint16_t *wide = (uint16_t *)raw + (size_t)row * exposure->width;
        if (bits == 8)
            for (uint32_t column = 0; column < exposure->width; column++)
                narrow[column] = (uint8_t)(first + column);
        else
            for (uint32_t column = 0; column < exposure->width; column++)
                wide[column] = (uint16_t)((first + column) & mask);
    }
}

/* PFNC "p" formats: a stream of bits without gaps, lowest bit of the first pixel first. */
static void pack_bits(uint32_t bits, const uint16_t *raw, size_t pixels, uint8_t *payload, size_t limit) {
    uint32_t waiting = 0, count = 0;
    size_t filled = 0;
    for (size_t i = 0; i < pixels && filled < limit; i++) {
        waiting |= (uint32_t)raw[i] << count;
        count += bits;
        while (count >= 8 && filled < limit) {
            payload[filled++] = (uint8_t)waiting;
            waiting >>= 8;
            count -= 8;
        }
    }
}

/* GigE Vision's Mono12Packed: high bytes outside, both low nibbles in the byte between, the first pixel's lower. */
static void pack_pairs(const uint16_t *raw, size_t pixels, uint8_t *payload, size_t limit) {
    for (size_t i = 0; i + 1 < pixels && 3 * (i / 2) + 2 < limit; i += 2) {
        uint8_t *three = payload + 3 * (i / 2);
        three[0] = (uint8_t)(raw[i] >> 4);
        three[1] = (uint8_t)((raw[i] & 0xF) | (raw[i + 1] & 0xF) << 4);
        three[2] = (uint8_t)(raw[i + 1] >> 4);
    }
}

void picture_pack(uint32_t format, const void *raw, size_t pixels, uint8_t *payload, size_t limit) {
    size_t whole = picture_bits(format) == 8 ? pixels : 2 * pixels;
    switch (format) {
    case MONO10P:
    case MONO12P:
        pack_bits(picture_bits(format), raw, pixels, payload, limit);
        break;
    case MONO12PACKED:
        pack_pairs(raw, pixels, payload, limit);
        break;
    default:
        memcpy(payload, raw, whole < limit ? whole : limit);
    }
}
