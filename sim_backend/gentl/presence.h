/*
 * Which camera is plugged in, and who holds it. Both are kept as files in the folder that MFS_SIM_GENTL_DIR names
 * (without it: mfs-sim-gentl-<uid> in the folder for temporary files), so that all processes see the same cameras:
 *     <serial>.lock        locked (flock) by the process that has the camera open
 *     <serial>.unplugged   the camera is not there; the file holds the moment at which it is back (monotonic
 *                          nanoseconds), or 0 for: when the file is deleted
 */
#ifndef PRESENCE_H
#define PRESENCE_H

#include <stdbool.h>
#include <stdint.h>

bool presence_plugged(const char *serial);
void presence_unplug(const char *serial, int64_t back_ns);

/* A lock to give back to presence_release, or -1 where another process holds the camera. */
int presence_claim(const char *serial);
void presence_release(int lock);

/* Whether a process has claimed it; not to be asked by the one that has. */
bool presence_claimed(const char *serial);

#endif
