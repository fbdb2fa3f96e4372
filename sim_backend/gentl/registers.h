/* Addresses and values of the camera's registers, as device.xml names them. */
#ifndef REGISTERS_H
#define REGISTERS_H

enum {
    REG_SENSOR_WIDTH = 0x1000,
    REG_SENSOR_HEIGHT = 0x1008,
    REG_WIDTH = 0x1010,
    REG_HEIGHT = 0x1018,
    REG_OFFSET_X = 0x1020,
    REG_OFFSET_Y = 0x1028,
    REG_WIDTH_MAX = 0x1030,
    REG_HEIGHT_MAX = 0x1038,
    REG_OFFSET_X_MAX = 0x1040,
    REG_OFFSET_Y_MAX = 0x1048,
    REG_PIXEL_FORMAT = 0x1050,
    REG_PAYLOAD_SIZE = 0x1058,
    REG_TL_PARAMS_LOCKED = 0x1060,
    REG_ACQUISITION_MODE = 0x1068,
    REG_ACQUISITION_FRAME_COUNT = 0x1070,
    REG_ACQUISITION_START = 0x1078,
    REG_ACQUISITION_STOP = 0x1080,
    REG_FRAME_RATE_ENABLE = 0x1088,
    REG_FRAME_RATE = 0x1090,     /* double, Hz */
    REG_FRAME_RATE_MAX = 0x1098, /* double, Hz */
    REG_EXPOSURE_TIME = 0x10A0,  /* double, µs */
    REG_EXPOSURE_AUTO = 0x10A8,
    REG_GAIN = 0x10B0, /* double, dB */
    REG_GAIN_AUTO = 0x10B8,
    REG_GAIN_RAW = 0x10C0,    /* the same gain in tenths of a dB */
    REG_BLACK_LEVEL = 0x10C8, /* double, DN */
    REG_TRIGGER_SELECTOR = 0x10D0,
    REG_TRIGGER_SOFTWARE = 0x10D8,
    REG_TRIGGER_MODE = 0x1100, /* one for each TriggerSelector, as the next three */
    REG_TRIGGER_SOURCE = 0x1110,
    REG_TRIGGER_ACTIVATION = 0x1120,
    REG_TRIGGER_DELAY = 0x1130, /* double, µs */
    REG_LINE_SELECTOR = 0x1140,
    REG_LINE_MODE = 0x1150, /* one for each line, as the next two */
    REG_LINE_SOURCE = 0x1170,
    REG_LINE_STATUS = 0x1190,
    REG_TIMESTAMP_LATCH = 0x11B0,
    REG_TIMESTAMP_VALUE = 0x11B8, /* ns */
    REG_TEMPERATURE = 0x11C0,     /* double, °C */
    REG_TRIGGERS_IGNORED = 0x1200,
    REG_DISCONNECT = 0x1208,
    REG_RETURN_AFTER = 0x1210, /* ms; 0 for never */
    REG_LATE_BY = 0x1218,      /* µs */
    REG_ID_JUMP_BY = 0x1220,
    REG_PULSE_LINE0 = 0x1228,
    REG_PULSE_LINE1 = 0x1230,
    REG_FAULT_IN = 0x1300,    /* one for each fault of faults.h */
    REG_FAULT_EVERY = 0x1380, /* one for each fault of faults.h */

    TEXT_SIZE = 64,
    TEXT_VENDOR = 0x2000,
    TEXT_MODEL = 0x2040,
    TEXT_VERSION = 0x2080,
    TEXT_SERIAL = 0x20C0,
    TEXT_USER_NAME = 0x2100,
    TEXT_END = 0x2140,

    DESCRIPTION = 0x100000 /* device.xml itself */
};

enum { TRIGGER_FRAME_START, TRIGGER_ACQUISITION_START, TRIGGER_SELECTORS };
enum { SOURCE_SOFTWARE, SOURCE_LINE0, SOURCE_LINE1 };
enum { RISING_EDGE, FALLING_EDGE };
enum { CONTINUOUS, SINGLE_FRAME, MULTI_FRAME };
enum { LINE_INPUT, LINE_OUTPUT };
enum { LINE_OFF, LINE_EXPOSURE_ACTIVE };
enum { LINE_IN0, LINE_IN1, LINE_OUT, LINES };

#endif
