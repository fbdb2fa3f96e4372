#include "camera.h"

#include <stdio.h>
#include <stdlib.h>
#include <string.h>

#include "clock.h"
#include "library.h"
#include "presence.h"
#include "registers.h"

struct camera cameras[MAX_CAMERAS];
uint32_t camera_count;

/* One field of "serial:user name:model:WIDTHxHEIGHT", into `field`; gives what follows it, NULL at the end. */
static const char *next_field(const char *text, char field[NAME_SIZE]) {
    size_t length = strcspn(text, ":;");
    if (length > 0)
        snprintf(field, NAME_SIZE, "%.*s", (int)length, text);
    return text[length] == ':' ? text + length + 1 : NULL;
}

static void load_one(struct camera *camera, const char *text) {
    char size[NAME_SIZE] = "1024x768";
    *camera = (struct camera){.claim = -1, .picture_socket = -1, .lines_socket = -1};
    snprintf(camera->serial, NAME_SIZE, "SIM%04u", camera_count + 1);
    snprintf(camera->user_name, NAME_SIZE, "bench");
    snprintf(camera->model, NAME_SIZE, "MFS Sim");
    char *fields[] = {camera->serial, camera->user_name, camera->model, size};
    for (size_t i = 0; text && i < sizeof fields / sizeof *fields; i++)
        text = next_field(text, fields[i]);
    camera->legacy = strstr(camera->model, "Legacy") != NULL;
    if (sscanf(size, "%ux%u", &camera->sensor_width, &camera->sensor_height) != 2 || camera->sensor_width < 16 ||
        camera->sensor_width > 16384 || camera->sensor_height < 2 || camera->sensor_height > 16384) {
        camera->sensor_width = 1024;
        camera->sensor_height = 768;
    }
    camera->sensor_width -= camera->sensor_width % 8;
    camera->sensor_height -= camera->sensor_height % 2;
    registers_reset(camera);
}

void cameras_load(void) {
    const char *text = getenv("MFS_SIM_GENTL_DEVICES");
    if (!text)
        text = "SIM0001";
    camera_count = 0;
    while (text && *text && camera_count < MAX_CAMERAS) {
        if (*text != ';') {
            load_one(&cameras[camera_count], text);
            camera_count++;
        }
        text = strchr(text, ';');
        text = text ? text + 1 : NULL;
    }
}

GC_ERROR camera_open(struct camera *camera) {
    if (!presence_plugged(camera->serial))
        return fail(GC_ERR_IO, "the camera does not answer");
    camera->claim = presence_claim(camera->serial);
    if (camera->claim < 0)
        return fail(GC_ERR_ACCESS_DENIED, "another process has the camera open");
    camera->gone = false;
    registers_reset(camera);
    return GC_ERR_SUCCESS;
}

void camera_close(struct camera *camera) {
    presence_release(camera->claim);
    camera->claim = -1;
    free(camera->raw);
    free(camera->former);
    camera->raw = camera->former = NULL;
    camera->raw_size = 0;
}

bool camera_gone(struct camera *camera) {
    if (!camera->gone && !presence_plugged(camera->serial)) {
        camera->gone = true;
        library_notify();
    }
    return camera->gone;
}

void camera_unplug(struct camera *camera) {
    int64_t after_ms = register_integer(camera, REG_RETURN_AFTER);
    presence_unplug(camera->serial, after_ms > 0 ? clock_now() + after_ms * NS_PER_MS : 0);
    camera->gone = true;
    library_notify();
}
