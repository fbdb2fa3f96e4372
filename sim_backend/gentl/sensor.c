/*
 * The sensor of a camera. A trigger begins an exposure at its own moment, also when it is heard of later; a trigger that
 * falls into an exposure is ignored and counted. When an exposure has ended, the camera's thread gets its picture and
 * delivers it, in order. A second thread listens to the world's trigger lines.
 */
#include "camera.h"

#include <errno.h>
#include <stdlib.h>
#include <string.h>
#include <sys/socket.h>
#include <unistd.h>

#include "clock.h"
#include "library.h"
#include "registers.h"
#include "world.h"

static const int64_t LINE_READOUT_NS = 5 * NS_PER_US;
static const int64_t LOOK_AROUND_NS = 50 * NS_PER_MS; /* how often the thread looks whether the camera is still there */

static int64_t exposure_ns(const struct camera *camera) {
    return (int64_t)(register_real(camera, REG_EXPOSURE_TIME) * (double)NS_PER_US);
}

int64_t sensor_shortest_period(const struct camera *camera) {
    int64_t readout = register_integer(camera, REG_HEIGHT) * LINE_READOUT_NS;
    int64_t exposure = exposure_ns(camera);
    return exposure > readout ? exposure : readout;
}

static int64_t free_run_period(const struct camera *camera) {
    int64_t shortest = sensor_shortest_period(camera);
    if (!register_integer(camera, REG_FRAME_RATE_ENABLE))
        return shortest;
    int64_t period = (int64_t)((double)NS_PER_S / register_real(camera, REG_FRAME_RATE));
    return period > shortest ? period : shortest;
}

bool sensor_exposing(const struct camera *camera) {
    int64_t now = clock_now();
    return camera->latest.begin_ns <= now && now < camera->latest.end_ns;
}

static bool befalls(struct camera *camera, enum fault fault) {
    uint64_t once = REG_FAULT_IN + 8 * (uint64_t)fault;
    int64_t in = register_integer(camera, once);
    int64_t every = register_integer(camera, REG_FAULT_EVERY + 8 * (uint64_t)fault);
    camera->fault_frames[fault]++;
    if (in > 0)
        register_set(camera, once, in - 1);
    return in == 1 || (every > 0 && camera->fault_frames[fault] % (uint64_t)every == 0);
}

/* --- triggers ---------------------------------------------------------------------------------------------------- */

static bool triggered(const struct camera *camera, uint64_t selector) {
    return register_integer(camera, REG_TRIGGER_MODE + 8 * selector) != 0;
}

static void begin_exposure(struct camera *camera, int64_t begin_ns) {
    if (!camera->acquiring || camera->gone)
        return;
    if (!camera->begun || begin_ns < camera->latest.end_ns || camera->pending_count == MAX_PENDING) {
        register_set(camera, REG_TRIGGERS_IGNORED, register_integer(camera, REG_TRIGGERS_IGNORED) + 1);
        return;
    }
    if (befalls(camera, FAULT_MISS_TRIGGER))
        return;
    camera->latest = (struct exposure){
        .id = camera->next_id++,
        .begin_ns = begin_ns,
        .end_ns = begin_ns + exposure_ns(camera),
        .offset_x = (uint32_t)register_integer(camera, REG_OFFSET_X),
        .offset_y = (uint32_t)register_integer(camera, REG_OFFSET_Y),
        .width = (uint32_t)register_integer(camera, REG_WIDTH),
        .height = (uint32_t)register_integer(camera, REG_HEIGHT),
        .format = (uint32_t)register_integer(camera, REG_PIXEL_FORMAT),
        .gain_db = register_real(camera, REG_GAIN),
        .black_level_dn = register_real(camera, REG_BLACK_LEVEL),
    };
    camera->pending[camera->pending_count++] = camera->latest;
    if (camera->frames_left > 0 && --camera->frames_left == 0)
        camera->acquiring = false;
    if (camera->lines_socket >= 0 && register_integer(camera, REG_LINE_SOURCE + 8 * LINE_OUT) == LINE_EXPOSURE_ACTIVE)
        world_exposed(camera->lines_socket, &camera->latest);
    library_notify();
}

void sensor_trigger(struct camera *camera, int64_t selector, int64_t moment_ns) {
    if (!triggered(camera, (uint64_t)selector))
        return;
    double delay_us = register_real(camera, REG_TRIGGER_DELAY + 8 * (uint64_t)selector);
    moment_ns += (int64_t)(delay_us * (double)NS_PER_US);
    if (selector == TRIGGER_FRAME_START)
        begin_exposure(camera, moment_ns);
    else if (camera->acquiring && !camera->begun) {
        camera->begun = true;
        camera->next_free_run_ns = moment_ns;
        library_notify();
    }
}

void sensor_line(struct camera *camera, int64_t line, bool rising, int64_t moment_ns) {
    int64_t source = line == LINE_IN0 ? SOURCE_LINE0 : SOURCE_LINE1;
    register_set(camera, REG_LINE_STATUS + 8 * (uint64_t)line, rising);
    for (uint64_t selector = TRIGGER_SELECTORS; selector-- > 0;)
        if (register_integer(camera, REG_TRIGGER_SOURCE + 8 * selector) == source &&
            (register_integer(camera, REG_TRIGGER_ACTIVATION + 8 * selector) == RISING_EDGE) == rising)
            sensor_trigger(camera, (int64_t)selector, moment_ns);
}

void sensor_start(struct camera *camera) {
    if (camera->acquiring)
        return;
    int64_t mode = register_integer(camera, REG_ACQUISITION_MODE);
    camera->acquiring = true;
    camera->begun = !triggered(camera, TRIGGER_ACQUISITION_START);
    camera->frames_left = mode == CONTINUOUS     ? -1
                          : mode == SINGLE_FRAME ? 1
                                                 : register_integer(camera, REG_ACQUISITION_FRAME_COUNT);
    camera->id_shift = 0;
    camera->next_free_run_ns = clock_now();
    camera->latest = (struct exposure){0};
    register_set(camera, REG_TRIGGERS_IGNORED, 0);
    camera->stale_due = befalls(camera, FAULT_STALE);
    camera->next_id = camera->stale_due ? 1 : 0; /* the first number is that of the stale frame, whenever it goes out */
}

void sensor_stop(struct camera *camera) { camera->acquiring = false; }

/* --- pictures ---------------------------------------------------------------------------------------------------- */

static void swap_pictures(struct camera *camera) {
    void *raw = camera->raw;
    camera->raw = camera->former;
    camera->former = raw;
}

static struct frame frame_of(const struct exposure *exposure) {
    size_t payload = picture_payload_size(exposure->format, exposure->width, exposure->height);
    return (struct frame){.exposure = *exposure, .payload = payload, .filled = payload};
}

static void deliver_stale(struct camera *camera) {
    struct exposure exposure = camera->former_exposure;
    exposure.id = 0;
    struct frame frame = frame_of(&exposure);
    if (picture_raw_size(&exposure) == camera->raw_size)
        stream_put(&camera->stream, &frame, camera->former);
}

static void wait_in_camera(struct camera *camera, int64_t until_ns) {
    while (!camera->ending && clock_now() < until_ns)
        library_wait_until(until_ns);
}

/* Get the picture of an exposure and deliver it, as the faults that befall it want it. */
static void deliver(struct camera *camera, const struct exposure *exposure) {
    if (befalls(camera, FAULT_DISCONNECT)) {
        camera_unplug(camera);
        return;
    }
    if (befalls(camera, FAULT_ID_JUMP))
        camera->id_shift += (uint64_t)register_integer(camera, REG_ID_JUMP_BY);
    bool dropped = befalls(camera, FAULT_DROP);

    library_unlock();
    bool made = true;
    if (camera->picture_socket >= 0)
        made = world_picture(camera->picture_socket, exposure, camera->raw, camera->raw_size);
    else
        picture_test(exposure, camera->raw);
    library_lock();

    struct frame frame = frame_of(exposure);
    frame.exposure.id += camera->id_shift;
    frame.crash = befalls(camera, FAULT_CRASH);
    frame.hang = befalls(camera, FAULT_HANG);
    if (!made) {
        frame.filled = 0;
        frame.incomplete = true;
    }
    if (befalls(camera, FAULT_INCOMPLETE)) {
        frame.filled /= 2;
        frame.incomplete = true;
    }
    if (befalls(camera, FAULT_TRUNCATE))
        frame.filled /= 2;
    if (befalls(camera, FAULT_WRONG_SIZE)) {
        frame.exposure.height /= 2;
        frame.filled /= 2;
    }
    bool repeated = befalls(camera, FAULT_REPEAT);
    if (befalls(camera, FAULT_TEAR)) {
        size_t half = camera->raw_size / exposure->height * (exposure->height / 2);
        memcpy((char *)camera->raw + half, (char *)camera->former + half, camera->raw_size - half);
    }
    if (befalls(camera, FAULT_LATE))
        wait_in_camera(camera, clock_now() + register_integer(camera, REG_LATE_BY) * NS_PER_US);
    int copies = befalls(camera, FAULT_DUPLICATE) ? 2 : 1;
    for (int copy = 0; copy < copies && !dropped; copy++)
        stream_put(&camera->stream, &frame, repeated ? camera->former : camera->raw);
    camera->former_exposure = *exposure;
    if (!repeated)
        swap_pictures(camera);
}

/* --- threads ----------------------------------------------------------------------------------------------------- */

static void *camera_thread(void *argument) {
    struct camera *camera = argument;
    library_lock();
    while (!camera->ending && !camera_gone(camera)) {
        int64_t now = clock_now();
        int64_t wake = now + LOOK_AROUND_NS;
        if (camera->stale_due) {
            camera->stale_due = false;
            deliver_stale(camera);
            continue;
        }
        if (camera->acquiring && camera->begun && !triggered(camera, TRIGGER_FRAME_START)) {
            if (camera->next_free_run_ns <= now) {
                int64_t begin = camera->next_free_run_ns;
                if (begin < camera->latest.end_ns)
                    begin = camera->latest.end_ns; /* the exposure time was made longer */
                camera->next_free_run_ns = begin + free_run_period(camera);
                begin_exposure(camera, begin);
            }
            if (camera->next_free_run_ns < wake)
                wake = camera->next_free_run_ns;
        }
        if (camera->pending_count > 0 && camera->pending[0].end_ns <= now) {
            struct exposure exposure = camera->pending[0];
            camera->pending_count--;
            memmove(camera->pending, camera->pending + 1, camera->pending_count * sizeof *camera->pending);
            deliver(camera, &exposure);
            continue;
        }
        if (camera->pending_count > 0 && camera->pending[0].end_ns < wake)
            wake = camera->pending[0].end_ns;
        library_wait_until(wake);
    }
    library_unlock();
    return NULL;
}

static void *lines_thread(void *argument) {
    struct camera *camera = argument;
    struct world_message message;
    while (world_next_message(camera->lines_socket, &message)) {
        library_lock();
        if (message.kind == WORLD_EDGE && message.a <= LINE_IN1)
            sensor_line(camera, message.a, message.b != 0, message.time_ns);
        if (message.kind == WORLD_FAULT && message.a < FAULT_COUNT) {
            register_set(camera, (message.b ? REG_FAULT_EVERY : REG_FAULT_IN) + 8 * (uint64_t)message.a, message.c);
            camera->fault_frames[message.a] = 0;
        }
        library_unlock();
    }
    return NULL;
}

static bool make_room(struct camera *camera) {
    struct exposure like = {.width = (uint32_t)register_integer(camera, REG_WIDTH),
                            .height = (uint32_t)register_integer(camera, REG_HEIGHT),
                            .format = (uint32_t)register_integer(camera, REG_PIXEL_FORMAT)};
    size_t size = picture_raw_size(&like);
    if (size == camera->raw_size)
        return true;
    free(camera->raw);
    free(camera->former);
    camera->raw = calloc(1, size);
    camera->former = calloc(1, size);
    camera->former_exposure = like;
    camera->raw_size = camera->raw && camera->former ? size : 0;
    return camera->raw_size == size;
}

static void disconnect_world(struct camera *camera) {
    if (camera->picture_socket >= 0)
        close(camera->picture_socket);
    if (camera->lines_socket >= 0)
        close(camera->lines_socket);
    camera->picture_socket = camera->lines_socket = -1;
}

GC_ERROR sensor_run(struct camera *camera) {
    if (!make_room(camera))
        return fail(GC_ERR_OUT_OF_MEMORY, "no memory for a picture");
    if (world_exists()) {
        camera->picture_socket = world_connect(camera->serial, WORLD_PICTURES);
        camera->lines_socket = camera->picture_socket < 0 ? -1 : world_connect(camera->serial, WORLD_LINES);
        if (camera->lines_socket < 0) {
            GC_ERROR error = fail(GC_ERR_IO, strerror(errno));
            disconnect_world(camera);
            return error;
        }
    }
    camera->pending_count = 0;
    if (pthread_create(&camera->thread, NULL, camera_thread, camera) != 0) {
        disconnect_world(camera);
        return fail(GC_ERR_RESOURCE_EXHAUSTED, "no thread for the camera");
    }
    camera->running = true;
    if (camera->lines_socket >= 0 && pthread_create(&camera->lines_thread, NULL, lines_thread, camera) != 0) {
        close(camera->lines_socket);
        camera->lines_socket = -1;
        sensor_end(camera);
        return fail(GC_ERR_RESOURCE_EXHAUSTED, "no thread for the camera's lines");
    }
    return GC_ERR_SUCCESS;
}

void sensor_end(struct camera *camera) {
    while (camera->running && camera->ending)
        library_wait(); /* somebody else ends it */
    if (!camera->running)
        return;
    camera->ending = true;
    camera->acquiring = false;
    /* Threads that wait for the world wake up; the sockets are closed when nobody uses them any more. */
    if (camera->picture_socket >= 0)
        shutdown(camera->picture_socket, SHUT_RDWR);
    if (camera->lines_socket >= 0)
        shutdown(camera->lines_socket, SHUT_RDWR);
    library_notify();
    library_unlock();
    pthread_join(camera->thread, NULL);
    if (camera->lines_socket >= 0)
        pthread_join(camera->lines_thread, NULL);
    library_lock();
    disconnect_world(camera);
    camera->pending_count = 0;
    camera->running = camera->ending = false;
    library_notify();
}
