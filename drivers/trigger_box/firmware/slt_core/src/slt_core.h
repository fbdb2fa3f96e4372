/* SLT/1, the protocol of ../../../SLT1.md, without any hardware. C99, no heap, no library but string.h.
 *
 * A board gives the core bytes, edges and time, and does what the calls of `slt_board` ask. Times are µs, modulo 2^32.
 *
 * slt_edge, slt_exposure and slt_wake may be called from interrupts, never inside each other; slt_receive and slt_poll
 * from the main loop only. Between lock() and unlock() the core must not be interrupted by the former.
 */
#ifndef SLT_CORE_H
#define SLT_CORE_H

#include <stdbool.h>
#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define SLT_LONGEST_COMMAND 95
#define SLT_LONGEST_REPLY 127
#define SLT_EVENTS 16

typedef enum { SLT_LOW = 0, SLT_HIGH = 1, SLT_FLOATING = 2 } slt_level;
typedef enum { SLT_RESET, SLT_IDLE, SLT_ARMED, SLT_RUNNING, SLT_DONE } slt_state;
typedef enum { SLT_GO, SLT_RISING, SLT_FALLING, SLT_CHANGE } slt_source;

typedef struct {
    uint32_t least, most;
} slt_range;

typedef struct {
    const char *identity; /* answer to *IDN?, without OK */
    slt_range pulses, period_us, width_us, delay_us;
} slt_board_facts;

typedef struct {
    /* Send characters to the host. Main loop only. */
    void (*send)(void *board, const char *text, uint8_t length);
    /* Drive OUT0, or let it float; t_us is when that was due. */
    void (*drive)(void *board, slt_level level, uint32_t t_us);
    /* Call slt_wake at t_us, or at once if that is past; replaces what was asked before. An early call does no harm. */
    void (*wake_at)(void *board, uint32_t t_us);
    uint32_t (*now_us)(void *board);
    void (*lock)(void *board);
    void (*unlock)(void *board);
} slt_board_calls;

typedef struct {
    uint8_t kind;
    uint32_t number, t_us;
} slt_event;

typedef struct {
    const slt_board_facts *facts;
    const slt_board_calls *calls;
    void *board;

    /* Lines: main loop only. */
    char line[SLT_LONGEST_COMMAND + 2]; /* one more for a carriage return */
    uint8_t length;
    bool too_long;
    char last_command[SLT_LONGEST_COMMAND + 1];
    char last_reply[SLT_LONGEST_REPLY + 1];

    /* What has been set. */
    slt_level active, exposing; /* exposing: SLT_FLOATING while IN0 is off */
    bool events_on, trained;
    uint32_t pulses, period_us, width_us, delay_us;

    /* The run. */
    volatile slt_state state;
    slt_source source;
    slt_level exposure_level;
    uint32_t sent, owed, started, exposed, edges, missed;
    uint32_t rises, rise_at, fall_at, busy_until;
    bool high;

    slt_event events[SLT_EVENTS];
    volatile uint8_t event_first, event_count;
    volatile uint32_t events_lost;
} slt_box;

/* Begin anew, as after power-on, and send the banner. */
void slt_begin(slt_box *box, const slt_board_facts *facts, const slt_board_calls *calls, void *board);

/* A character has come from the host. */
void slt_receive(slt_box *box, char character);

/* Send the events that have happened. */
void slt_poll(slt_box *box);

/* EXT0 has risen or fallen. */
void slt_edge(slt_box *box, bool rising, uint32_t t_us);

/* IN0 is now at this level. */
void slt_exposure(slt_box *box, slt_level level, uint32_t t_us);

/* Do all that is due by t_us. */
void slt_wake(slt_box *box, uint32_t t_us);

#ifdef __cplusplus
}
#endif

#endif
