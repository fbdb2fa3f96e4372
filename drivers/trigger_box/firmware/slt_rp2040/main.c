/* SLT/1 trigger box on an RP2040 (or RP2350): Raspberry Pi Pico and its like, Pico SDK 2.0 or newer.
 *
 * OUT0 = GP2, EXT0 = GP3, IN0 = GP4, all 3.3 V logic and not 5 V tolerant; serial port over the board's own USB.
 * Protocol: ../../SLT1.md; building and wiring: ../README.md.
 */
#include <stdio.h>

#include "hardware/gpio.h"
#include "hardware/irq.h"
#include "hardware/sync.h"
#include "hardware/timer.h"
#include "pico/stdio_usb.h"
#include "pico/stdlib.h"
#include "pico/unique_id.h"
#include "slt_core.h"

enum { OUT0 = 2, EXT0 = 3, IN0 = 4 };
enum { ABOVE_USB = 0x40 }; /* interrupt priority: smaller is more urgent, 0x80 is that of all others */
#define EDGES (GPIO_IRQ_EDGE_RISE | GPIO_IRQ_EDGE_FALL)

static slt_box box;
static uint alarm_number;
static uint32_t interrupts_before;

static void wake_at(void *board, uint32_t t_us) {
    (void)board;
    uint64_t now = time_us_64();
    absolute_time_t target;
    update_us_since_boot(&target, now + (int32_t)(t_us - (uint32_t)now));
    if (hardware_alarm_set_target(alarm_number, target)) hardware_alarm_force_irq(alarm_number);
}

static void on_alarm(uint number) {
    (void)number;
    slt_wake(&box, time_us_32());
}

static void drive(void *board, slt_level level, uint32_t t_us) {
    (void)board;
    (void)t_us;
    if (level == SLT_FLOATING) {
        gpio_set_dir(OUT0, GPIO_IN);
        return;
    }
    gpio_put(OUT0, level == SLT_HIGH);
    gpio_set_dir(OUT0, GPIO_OUT);
}

static void tell(uint pin, bool high, uint32_t now) {
    if (pin == EXT0) {
        slt_edge(&box, high, now);
    } else {
        slt_exposure(&box, high ? SLT_HIGH : SLT_LOW, now);
    }
}

/* Both edges at once: the pin has been at the other level since, and both are told in their order. */
static void on_edge(uint pin, uint32_t edges) {
    uint32_t now = time_us_32();
    bool rise = edges & GPIO_IRQ_EDGE_RISE, fall = edges & GPIO_IRQ_EDGE_FALL;
    if (rise && fall) {
        bool high = gpio_get(pin);
        tell(pin, !high, now);
        tell(pin, high, now);
    } else if (rise || fall) {
        tell(pin, rise, now);
    }
}

static void send(void *board, const char *text, uint8_t length) {
    (void)board;
    while (length--) putchar_raw(*text++);
}

static uint32_t now_us(void *board) {
    (void)board;
    return time_us_32();
}

static void lock(void *board) {
    (void)board;
    interrupts_before = save_and_disable_interrupts();
}

static void unlock(void *board) {
    (void)board;
    restore_interrupts(interrupts_before);
}

int main(void) {
    static const slt_board_calls calls = {send, drive, wake_at, now_us, lock, unlock};
    static char identity[64];
    static slt_board_facts facts = {identity, {1, 65535}, {50, 10000000}, {10, 1000000}, {0, 1000000}};
    char serial[2 * PICO_UNIQUE_BOARD_ID_SIZE_BYTES + 1];

    gpio_init(OUT0);
    gpio_init(EXT0);
    gpio_init(IN0);
    gpio_pull_up(EXT0); /* an open input rests, and open-collector outputs work */
    gpio_pull_up(IN0);

    stdio_init_all();
    stdio_set_translate_crlf(&stdio_usb, false);
    pico_get_unique_board_id_string(serial, sizeof serial);
    snprintf(identity, sizeof identity, "SLT,rp2040,%s,1.0.0,1", serial);
    /* A banner that is sent before the host has opened the port would be lost. */
    while (!stdio_usb_connected()) sleep_ms(1);

    slt_begin(&box, &facts, &calls, NULL);
    slt_exposure(&box, gpio_get(IN0) ? SLT_HIGH : SLT_LOW, time_us_32());
    alarm_number = (uint)hardware_alarm_claim_unused(true);
    hardware_alarm_set_callback(alarm_number, on_alarm);
    /* The same priority for both, so that neither comes inside the other. */
    irq_set_priority(hardware_alarm_get_irq_num(alarm_number), ABOVE_USB);
    irq_set_priority(IO_IRQ_BANK0, ABOVE_USB);
    gpio_set_irq_enabled_with_callback(EXT0, EDGES, true, on_edge);
    gpio_set_irq_enabled(IN0, EDGES, true);

    for (;;) {
        int character = getchar_timeout_us(0);
        if (character >= 0) slt_receive(&box, (char)character);
        slt_poll(&box);
    }
}
