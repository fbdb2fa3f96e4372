#include "registers.h"

#include <math.h>
#include <string.h>

#include "camera.h"
#include "clock.h"
#include "description.h"
#include "library.h"

static size_t slot(uint64_t address) { return (size_t)(address - REGISTERS) / 8; }

int64_t register_integer(const struct camera *camera, uint64_t address) {
    return camera->registers[slot(address)].integer;
}

double register_real(const struct camera *camera, uint64_t address) { return camera->registers[slot(address)].real; }

void register_set(struct camera *camera, uint64_t address, int64_t value) {
    camera->registers[slot(address)].integer = value;
}

static void set_real(struct camera *camera, uint64_t address, double value) {
    camera->registers[slot(address)].real = value;
}

void registers_reset(struct camera *camera) {
    memset(camera->registers, 0, sizeof camera->registers);
    register_set(camera, REG_SENSOR_WIDTH, camera->sensor_width);
    register_set(camera, REG_SENSOR_HEIGHT, camera->sensor_height);
    register_set(camera, REG_WIDTH, camera->sensor_width);
    register_set(camera, REG_HEIGHT, camera->sensor_height);
    register_set(camera, REG_PIXEL_FORMAT, MONO8);
    register_set(camera, REG_ACQUISITION_FRAME_COUNT, 1);
    set_real(camera, REG_FRAME_RATE, 30);
    set_real(camera, REG_EXPOSURE_TIME, 5000);
    set_real(camera, REG_TEMPERATURE, 41.5);
    register_set(camera, REG_LINE_MODE + 8 * LINE_OUT, LINE_OUTPUT);
    register_set(camera, REG_LINE_SOURCE + 8 * LINE_OUT, LINE_EXPOSURE_ACTIVE);
    register_set(camera, REG_LATE_BY, 200000);
    register_set(camera, REG_ID_JUMP_BY, 100);
    memset(camera->fault_frames, 0, sizeof camera->fault_frames);
}

size_t camera_payload_size(const struct camera *camera) {
    return picture_payload_size((uint32_t)register_integer(camera, REG_PIXEL_FORMAT),
                                (uint32_t)register_integer(camera, REG_WIDTH),
                                (uint32_t)register_integer(camera, REG_HEIGHT));
}

const uint8_t *camera_description(const struct camera *camera, size_t *size) {
    *size = camera->legacy ? legacy_description_size : description_size;
    return camera->legacy ? legacy_description : description;
}

/* What may be written to a register; the others can only be read. */
struct rule {
    uint64_t address;
    uint32_t count; /* registers in a row */
    double low, high;
    enum { ANY_TIME, NOT_WHILE_STREAMING } when;
    enum { INTEGER, REAL } kind;
};

static const struct rule RULES[] = {
    {REG_WIDTH, 1, 16, 1e9, NOT_WHILE_STREAMING, INTEGER},
    {REG_HEIGHT, 1, 2, 1e9, NOT_WHILE_STREAMING, INTEGER},
    {REG_OFFSET_X, 1, 0, 1e9, NOT_WHILE_STREAMING, INTEGER},
    {REG_OFFSET_Y, 1, 0, 1e9, NOT_WHILE_STREAMING, INTEGER},
    {REG_PIXEL_FORMAT, 1, 0, 4294967295.0, NOT_WHILE_STREAMING, INTEGER},
    {REG_TL_PARAMS_LOCKED, 1, 0, 1, ANY_TIME, INTEGER},
    {REG_ACQUISITION_MODE, 1, CONTINUOUS, MULTI_FRAME, NOT_WHILE_STREAMING, INTEGER},
    {REG_ACQUISITION_FRAME_COUNT, 1, 1, 65535, NOT_WHILE_STREAMING, INTEGER},
    {REG_ACQUISITION_START, 1, 1, 1, ANY_TIME, INTEGER},
    {REG_ACQUISITION_STOP, 1, 1, 1, ANY_TIME, INTEGER},
    {REG_FRAME_RATE_ENABLE, 1, 0, 1, ANY_TIME, INTEGER},
    {REG_FRAME_RATE, 1, 0.1, 1e6, ANY_TIME, REAL},
    {REG_EXPOSURE_TIME, 1, 10, 1e7, ANY_TIME, REAL},
    {REG_EXPOSURE_AUTO, 1, 0, 1, ANY_TIME, INTEGER},
    {REG_GAIN, 1, 0, 24, ANY_TIME, REAL},
    {REG_GAIN_AUTO, 1, 0, 1, ANY_TIME, INTEGER},
    {REG_GAIN_RAW, 1, 0, 240, ANY_TIME, INTEGER},
    {REG_BLACK_LEVEL, 1, 0, 255, ANY_TIME, REAL},
    {REG_TRIGGER_SELECTOR, 1, 0, TRIGGER_SELECTORS - 1, ANY_TIME, INTEGER},
    {REG_TRIGGER_SOFTWARE, 1, 1, 1, ANY_TIME, INTEGER},
    {REG_TRIGGER_MODE, TRIGGER_SELECTORS, 0, 1, ANY_TIME, INTEGER},
    {REG_TRIGGER_SOURCE, TRIGGER_SELECTORS, SOURCE_SOFTWARE, SOURCE_LINE1, ANY_TIME, INTEGER},
    {REG_TRIGGER_ACTIVATION, TRIGGER_SELECTORS, RISING_EDGE, FALLING_EDGE, ANY_TIME, INTEGER},
    {REG_TRIGGER_DELAY, TRIGGER_SELECTORS, 0, 1e6, ANY_TIME, REAL},
    {REG_LINE_SELECTOR, 1, 0, LINES - 1, ANY_TIME, INTEGER},
    {REG_LINE_SOURCE + 8 * LINE_OUT, 1, LINE_OFF, LINE_EXPOSURE_ACTIVE, ANY_TIME, INTEGER},
    {REG_TIMESTAMP_LATCH, 1, 1, 1, ANY_TIME, INTEGER},
    {REG_DISCONNECT, 1, 1, 1, ANY_TIME, INTEGER},
    {REG_RETURN_AFTER, 1, 0, 1e9, ANY_TIME, INTEGER},
    {REG_LATE_BY, 1, 0, 1e9, ANY_TIME, INTEGER},
    {REG_ID_JUMP_BY, 1, 0, 1e9, ANY_TIME, INTEGER},
    {REG_PULSE_LINE0, 1, 1, 1, ANY_TIME, INTEGER},
    {REG_PULSE_LINE1, 1, 1, 1, ANY_TIME, INTEGER},
    {REG_FAULT_IN, FAULT_COUNT, 0, 1e9, ANY_TIME, INTEGER},
    {REG_FAULT_EVERY, FAULT_COUNT, 0, 1e9, ANY_TIME, INTEGER},
};

static const struct rule *rule_of(uint64_t address) {
    for (size_t i = 0; i < sizeof RULES / sizeof *RULES; i++)
        if (address >= RULES[i].address && address < RULES[i].address + 8 * RULES[i].count)
            return &RULES[i];
    return NULL;
}

/* The window has to stay on the sensor, in steps that all pixel formats can pack. */
static bool geometry_fits(const struct camera *camera, uint64_t address, int64_t value) {
    int64_t width = address == REG_WIDTH ? value : register_integer(camera, REG_WIDTH);
    int64_t height = address == REG_HEIGHT ? value : register_integer(camera, REG_HEIGHT);
    int64_t x = address == REG_OFFSET_X ? value : register_integer(camera, REG_OFFSET_X);
    int64_t y = address == REG_OFFSET_Y ? value : register_integer(camera, REG_OFFSET_Y);
    return x + width <= camera->sensor_width && y + height <= camera->sensor_height && width % 8 == 0 && x % 8 == 0 &&
           height % 2 == 0 && y % 2 == 0;
}

/* Registers whose value is not what was written. */
static void refresh(struct camera *camera, uint64_t address) {
    switch (address) {
    case REG_WIDTH_MAX:
        register_set(camera, address, camera->sensor_width - register_integer(camera, REG_OFFSET_X));
        break;
    case REG_HEIGHT_MAX:
        register_set(camera, address, camera->sensor_height - register_integer(camera, REG_OFFSET_Y));
        break;
    case REG_OFFSET_X_MAX:
        register_set(camera, address, camera->sensor_width - register_integer(camera, REG_WIDTH));
        break;
    case REG_OFFSET_Y_MAX:
        register_set(camera, address, camera->sensor_height - register_integer(camera, REG_HEIGHT));
        break;
    case REG_PAYLOAD_SIZE:
        register_set(camera, address, (int64_t)camera_payload_size(camera));
        break;
    case REG_FRAME_RATE_MAX:
        set_real(camera, address, (double)NS_PER_S / (double)sensor_shortest_period(camera));
        break;
    case REG_GAIN_RAW:
        register_set(camera, address, llround(10 * register_real(camera, REG_GAIN)));
        break;
    case REG_LINE_STATUS + 8 * LINE_OUT:
        register_set(camera, address,
                     register_integer(camera, REG_LINE_SOURCE + 8 * LINE_OUT) == LINE_EXPOSURE_ACTIVE &&
                         sensor_exposing(camera));
        break;
    }
}

/* What happens when a register is written beside its new value. */
static void act(struct camera *camera, uint64_t address) {
    int64_t now = clock_now();
    switch (address) {
    case REG_ACQUISITION_START:
        sensor_start(camera);
        break;
    case REG_ACQUISITION_STOP:
        sensor_stop(camera);
        break;
    case REG_TRIGGER_SOFTWARE: {
        int64_t selector = register_integer(camera, REG_TRIGGER_SELECTOR);
        if (register_integer(camera, REG_TRIGGER_SOURCE + 8 * (uint64_t)selector) == SOURCE_SOFTWARE)
            sensor_trigger(camera, selector, now);
        break;
    }
    case REG_PULSE_LINE0:
    case REG_PULSE_LINE1: {
        int64_t line = address == REG_PULSE_LINE0 ? LINE_IN0 : LINE_IN1;
        sensor_line(camera, line, true, now);
        sensor_line(camera, line, false, now);
        break;
    }
    case REG_GAIN_RAW:
        set_real(camera, REG_GAIN, (double)register_integer(camera, REG_GAIN_RAW) / 10);
        break;
    case REG_TIMESTAMP_LATCH:
        register_set(camera, REG_TIMESTAMP_VALUE, now);
        break;
    case REG_DISCONNECT:
        camera_unplug(camera);
        break;
    default:
        if (address >= REG_FAULT_EVERY)
            camera->fault_frames[(address - REG_FAULT_EVERY) / 8] = 0;
    }
    const struct rule *rule = rule_of(address);
    if (rule && rule->low == 1 && rule->high == 1)
        register_set(camera, address, 0); /* a command is done at once */
}

/* A text of TEXT_SIZE bytes, or NULL. */
static char *text_at(struct camera *camera, uint64_t address) {
    static char vendor[TEXT_SIZE] = VENDOR, version[TEXT_SIZE] = PRODUCER_VERSION;
    switch (address) {
    case TEXT_VENDOR:
        return vendor;
    case TEXT_MODEL:
        return camera->model;
    case TEXT_VERSION:
        return version;
    case TEXT_SERIAL:
        return camera->serial;
    case TEXT_USER_NAME:
        return camera->user_name;
    default:
        return NULL;
    }
}

GC_ERROR registers_read(struct camera *camera, uint64_t address, void *data, size_t *size) {
    size_t description_bytes;
    const uint8_t *text = camera_description(camera, &description_bytes);
    if (address >= DESCRIPTION && address < DESCRIPTION + description_bytes) {
        size_t left = DESCRIPTION + description_bytes - (size_t)address;
        if (*size > left)
            *size = left;
        memcpy(data, text + (address - DESCRIPTION), *size);
        return GC_ERR_SUCCESS;
    }
    if (address >= TEXT_VENDOR && address < TEXT_END) {
        const char *string = text_at(camera, address);
        if (!string || *size > TEXT_SIZE)
            return fail(GC_ERR_INVALID_ADDRESS, "a text register is read from its begin");
        memcpy(data, string, *size);
        return GC_ERR_SUCCESS;
    }
    if (address < REGISTERS || address >= REGISTERS_END || address % 8 || *size > 8)
        return fail(GC_ERR_INVALID_ADDRESS, "there is no register at this address");
    refresh(camera, address);
    memcpy(data, &camera->registers[slot(address)], *size);
    return GC_ERR_SUCCESS;
}

GC_ERROR registers_write(struct camera *camera, uint64_t address, const void *data, size_t size) {
    if (address == TEXT_USER_NAME) {
        if (size > NAME_SIZE)
            return fail(GC_ERR_INVALID_VALUE, "the name is too long");
        memset(camera->user_name, 0, NAME_SIZE);
        memcpy(camera->user_name, data, size);
        camera->user_name[NAME_SIZE - 1] = 0;
        return GC_ERR_SUCCESS;
    }
    const struct rule *rule = rule_of(address);
    if (!rule || address % 8 || size != 8)
        return fail(GC_ERR_ACCESS_DENIED, "nothing can be written to this address");
    if (rule->when == NOT_WHILE_STREAMING && (camera->running || register_integer(camera, REG_TL_PARAMS_LOCKED)))
        return fail(GC_ERR_ACCESS_DENIED, "this feature is locked while the camera streams");
    int64_t integer;
    double real;
    memcpy(&integer, data, 8);
    memcpy(&real, data, 8);
    double value = rule->kind == REAL ? real : (double)integer;
    if (!(value >= rule->low && value <= rule->high))
        return fail(GC_ERR_INVALID_VALUE, "the value is outside of the register's limits");
    if (address >= REG_WIDTH && address <= REG_OFFSET_Y && !geometry_fits(camera, address, integer))
        return fail(GC_ERR_INVALID_VALUE, "the window would leave the sensor or its raster");
    if (address == REG_PIXEL_FORMAT && picture_bits((uint32_t)integer) == 0)
        return fail(GC_ERR_INVALID_VALUE, "the camera does not have this pixel format");
    register_set(camera, address, integer);
    act(camera, address);
    library_notify();
    return GC_ERR_SUCCESS;
}
