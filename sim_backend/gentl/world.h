/*
 * The connection to the world: who makes the pictures, gives the edges of the trigger lines and hears of exposures.
 *
 * The world listens on the unix stream socket that MFS_SIM_WORLD names; a camera that acquires has two connections to
 * it. All numbers are little-endian, nothing is padded. A connection begins with
 *     camera → world   "MFS1", uint32 channel (1 pictures, 2 lines), char serial[64] (UTF-8, filled up with 0)
 * which is not answered: the world may be in the process that uses the camera, and stand still until the call returns.
 * On channel 1, for each exposure once it has ended:
 *     camera → world   "PICT", uint32 bits, uint64 id, int64 begin ns, int64 duration ns,
 *                      uint32 offset x, offset y, width, height (px), float64 gain dB, float64 black level DN
 *     world → camera   "PICT", uint32 status (0 good), uint64 bytes, then so many bytes of pixels:
 *                      rows from the top, uint8 where bits is 8, else uint16
 * On channel 2, whenever it happens:
 *     world → camera   uint32 kind, uint32 a, uint32 b, uint32 c, int64 time ns
 *                      kind 1: edge on line a (0, 1), b = 1 rising or 0 falling, at that time
 *                      kind 2: fault a (see faults.h) befalls the c-th frame from now (b = 0) or every c-th (b = 1)
 *     camera → world   uint64 id, int64 begin ns, int64 end ns: an exposure, when its trigger was accepted
 */
#ifndef WORLD_H
#define WORLD_H

#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "picture.h"

enum world_channel { WORLD_PICTURES = 1, WORLD_LINES = 2 };
enum { WORLD_EDGE = 1, WORLD_FAULT = 2 };

struct world_message {
    uint32_t kind, a, b, c;
    int64_t time_ns;
};

/* Whether there is a world at all. */
bool world_exists(void);

/* A socket, or -1 with the reason in errno. */
int world_connect(const char *serial, enum world_channel channel);

/* Ask for a picture; blocks. False where the world is gone or could not make it. */
bool world_picture(int socket, const struct exposure *exposure, void *raw, size_t size);

/* Wait for the next message on the lines; false when the connection has ended. */
bool world_next_message(int socket, struct world_message *message);

/* Tell of an exposure; never blocks. */
void world_exposed(int socket, const struct exposure *exposure);

#endif
