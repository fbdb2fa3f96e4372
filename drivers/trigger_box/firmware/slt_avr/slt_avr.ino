/* SLT/1 trigger box on an ATmega328P at 16 MHz: Arduino Uno, Nano, Pro Mini 5 V.
 *
 * OUT0 = D8 (PB0), EXT0 = D2 (INT0), IN0 = D3 (INT1), all 5 V logic; serial port 115200 8N1.
 * EXT0 and IN0 must stay at each level for 100 us at least. Protocol: ../../SLT1.md; building and wiring: ../README.md.
 *
 * Only avr-libc is used, no Arduino function: nothing else runs on the timer or in interrupts.
 */
#include <avr/interrupt.h>
#include <avr/io.h>
#include <slt_core.h>

#ifndef SLT_SERIAL
#define SLT_SERIAL "1" /* give each board its own, where there are several */
#endif

#define OUT0 PB0
#define EXT0 PD2
#define IN0 PD3
#define RECEIVED 128 /* power of two */

static slt_box box;
static volatile uint32_t overflows;
static volatile uint8_t received[RECEIVED], received_in;
static uint8_t received_out, interrupts_before;
static bool ext0_high, in0_high;

/* --- time: Timer1 counts half microseconds ------------------------------------------------------------------- */

/* With interrupts off. */
static uint32_t time_us(void) {
    uint16_t ticks = TCNT1;
    uint32_t rounds = overflows;
    if ((TIFR1 & _BV(TOV1)) && ticks < 0x8000) rounds++;
    /* (rounds * 65536 + ticks) / 2, of 33 bits, without a shift by 15, which takes 90 cycles here. */
    uint32_t now = ((uint32_t)(uint16_t)rounds << 16 | ticks) >> 1;
    return rounds & 0x10000UL ? now | 0x80000000UL : now;
}

ISR(TIMER1_OVF_vect) { overflows++; }

ISR(TIMER1_COMPA_vect) {
    TIMSK1 &= ~_BV(OCIE1A);
    slt_wake(&box, time_us());
}

/* With interrupts off. A time more than one round of the timer ahead is met early once each round: the core asks again. */
static void wake_at(void *, uint32_t t_us) {
    uint32_t now = time_us();
    if ((int32_t)(t_us - now) < 8) t_us = now + 8;
    OCR1A = (uint16_t)(t_us << 1);
    TIFR1 = _BV(OCF1A);
    TIMSK1 |= _BV(OCIE1A);
}

/* --- pins ----------------------------------------------------------------------------------------------------- */

static void drive(void *, slt_level level, uint32_t) {
    if (level == SLT_FLOATING) {
        DDRB &= ~_BV(OUT0);
        PORTB &= ~_BV(OUT0);
        return;
    }
    if (level == SLT_HIGH) {
        PORTB |= _BV(OUT0);
    } else {
        PORTB &= ~_BV(OUT0);
    }
    DDRB |= _BV(OUT0);
}

/* An input that is found as it was has changed twice since: both changes are told. */
ISR(INT0_vect) {
    uint32_t now = time_us();
    bool high = PIND & _BV(EXT0);
    if (high == ext0_high) slt_edge(&box, !high, now);
    ext0_high = high;
    slt_edge(&box, high, now);
}

ISR(INT1_vect) {
    uint32_t now = time_us();
    bool high = PIND & _BV(IN0);
    if (high == in0_high) slt_exposure(&box, high ? SLT_LOW : SLT_HIGH, now);
    in0_high = high;
    slt_exposure(&box, high ? SLT_HIGH : SLT_LOW, now);
}

/* --- serial port ------------------------------------------------------------------------------------------------ */

ISR(USART_RX_vect) {
    received[received_in] = UDR0;
    received_in = (received_in + 1) & (RECEIVED - 1);
}

static void send(void *, const char *text, uint8_t length) {
    while (length--) {
        while (!(UCSR0A & _BV(UDRE0))) {
        }
        UDR0 = *text++;
    }
}

/* --- the box ---------------------------------------------------------------------------------------------------- */

static uint32_t now_us(void *) { return time_us(); }

static void lock(void *) {
    interrupts_before = SREG;
    cli();
}

static void unlock(void *) { SREG = interrupts_before; }

static const slt_board_calls calls = {send, drive, wake_at, now_us, lock, unlock};
static const slt_board_facts facts = {
    "SLT,atmega328p," SLT_SERIAL ",1.0.0,1", {1, 65535}, {300, 10000000}, {50, 1000000}, {0, 1000000}};

void setup() {
    cli();
    /* Whatever ran before: Timer1 free-running at 2 MHz, the Arduino core's own timer off. */
    TIMSK0 = 0;
    TCCR1A = 0;
    TCCR1B = _BV(CS11);
    TCNT1 = 0;
    TIFR1 = _BV(TOV1) | _BV(OCF1A);
    TIMSK1 = _BV(TOIE1);

    UBRR0 = 16; /* 115200 at double speed, 2.1 % fast */
    UCSR0A = _BV(U2X0);
    UCSR0C = _BV(UCSZ01) | _BV(UCSZ00);
    UCSR0B = _BV(RXCIE0) | _BV(RXEN0) | _BV(TXEN0);

    PORTD |= _BV(EXT0) | _BV(IN0); /* pulled up: an open input rests, and open-collector outputs work */
    EICRA = _BV(ISC10) | _BV(ISC00);
    EIFR = _BV(INTF1) | _BV(INTF0);
    EIMSK = _BV(INT1) | _BV(INT0);
    slt_begin(&box, &facts, &calls, 0);
    ext0_high = PIND & _BV(EXT0);
    in0_high = PIND & _BV(IN0);
    slt_exposure(&box, in0_high ? SLT_HIGH : SLT_LOW, 0);
    sei();
}

void loop() {
    while (received_out != received_in) {
        slt_receive(&box, (char)received[received_out]);
        received_out = (received_out + 1) & (RECEIVED - 1);
    }
    slt_poll(&box);
}
