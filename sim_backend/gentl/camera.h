/* A simulated camera: identity, registers, triggers, exposures. The library's lock is held in all functions. */
#ifndef CAMERA_H
#define CAMERA_H

#include <pthread.h>
#include <stdbool.h>
#include <stddef.h>
#include <stdint.h>

#include "faults.h"
#include "gentl.h"
#include "picture.h"
#include "stream.h"

enum { MAX_CAMERAS = 16, NAME_SIZE = 64, MAX_PENDING = 64 };

/* Registers lie from here on, 8 bytes each: an integer or a double, little-endian. device.xml names the addresses. */
enum { REGISTERS = 0x1000, REGISTERS_END = 0x1400 };

struct camera {
    /* Identity, from MFS_SIM_GENTL_DEVICES. */
    char serial[NAME_SIZE], user_name[NAME_SIZE], model[NAME_SIZE];
    bool legacy; /* features by the names of SFNC 1 only */
    uint32_t sensor_width, sensor_height;

    /* Connection. */
    int claim;   /* from presence_claim, -1 while the camera is not open */
    bool gone;   /* was unplugged while it was open; stays so until it is opened again */
    bool listed; /* in the latest list of devices */

    union {
        int64_t integer;
        double real;
    } registers[(REGISTERS_END - REGISTERS) / 8];
    uint64_t fault_frames[FAULT_COUNT]; /* since Sim…Every was set */

    /* Acquisition. */
    bool running;   /* the threads below exist: between DSStartAcquisition and DSStopAcquisition */
    bool ending;    /* they are to end */
    bool acquiring; /* between AcquisitionStart and AcquisitionStop */
    bool begun;     /* the acquisition's own trigger has come, or is not needed */
    bool stale_due;
    int64_t frames_left; /* of SingleFrame and MultiFrame; negative for no end */
    pthread_t thread, lines_thread;
    int picture_socket, lines_socket; /* -1 without a world */
    struct exposure pending[MAX_PENDING]; /* exposures whose pictures are still to be made, oldest first */
    uint32_t pending_count;
    uint64_t next_id, id_shift;
    struct exposure latest;
    int64_t next_free_run_ns;
    void *raw, *former; /* pictures as they are made: of this exposure, and of the one before */
    struct exposure former_exposure;
    size_t raw_size;
    struct stream stream;
};

/* All cameras that MFS_SIM_GENTL_DEVICES names, plugged in or not. */
extern struct camera cameras[MAX_CAMERAS];
extern uint32_t camera_count;
void cameras_load(void);

GC_ERROR camera_open(struct camera *camera);
void camera_close(struct camera *camera);

/* Whether an open camera does not answer any more. */
bool camera_gone(struct camera *camera);
void camera_unplug(struct camera *camera);

/* registers.c: what is behind the remote port. */
void registers_reset(struct camera *camera);
GC_ERROR registers_read(struct camera *camera, uint64_t address, void *data, size_t *size);
GC_ERROR registers_write(struct camera *camera, uint64_t address, const void *data, size_t size);
int64_t register_integer(const struct camera *camera, uint64_t address);
double register_real(const struct camera *camera, uint64_t address);
void register_set(struct camera *camera, uint64_t address, int64_t value);
size_t camera_payload_size(const struct camera *camera);
const uint8_t *camera_description(const struct camera *camera, size_t *size);

/* sensor.c: triggers and exposures. */
GC_ERROR sensor_run(struct camera *camera);
void sensor_end(struct camera *camera);
void sensor_start(struct camera *camera);
void sensor_stop(struct camera *camera);
void sensor_trigger(struct camera *camera, int64_t selector, int64_t moment_ns);
void sensor_line(struct camera *camera, int64_t line, bool rising, int64_t moment_ns);
bool sensor_exposing(const struct camera *camera);
int64_t sensor_shortest_period(const struct camera *camera);

#endif
