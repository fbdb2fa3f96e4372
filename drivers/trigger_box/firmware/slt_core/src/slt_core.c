#include "slt_core.h"

#include <string.h>

enum { EVENT_PULSE, EVENT_EXT0, EVENT_IN0, EVENT_DONE };
enum { OK = 0, SYNTAX = 1, RANGE = 2, STATE = 3, BUSY = 4, CHECK = 5, TOO_LONG = 6 };

static const char *const ERRORS[] = {"", "1 SYNTAX", "2 RANGE", "3 STATE", "4 BUSY", "5 CHECK", "6 LONG"};
static const char *const STATES[] = {"RESET", "IDLE", "ARMED", "RUNNING", "DONE"};
static const char *const EVENTS[] = {"!PULSE OUT0 ", "!EDGE EXT0 ", "!EDGE IN0 ", "!DONE "};

/* --- text ---------------------------------------------------------------------------------------------------- */

typedef struct {
    char text[SLT_LONGEST_REPLY + 1];
    uint8_t length;
} writer;

static void put(writer *to, const char *text) {
    while (*text && to->length < SLT_LONGEST_REPLY) to->text[to->length++] = *text++;
    to->text[to->length] = 0;
}

static void put_number(writer *to, uint32_t number) {
    char digits[11];
    uint8_t at = 10;
    digits[10] = 0;
    do {
        digits[--at] = (char)('0' + number % 10);
        number /= 10;
    } while (number);
    put(to, digits + at);
}

static uint8_t checksum(const char *text, uint8_t length) {
    uint8_t rest = 0;
    while (length--) {
        rest ^= (uint8_t)*text++;
        for (uint8_t bit = 0; bit < 8; bit++) rest = (uint8_t)((rest << 1) ^ (rest & 0x80 ? 0x07 : 0));
    }
    return rest;
}

static char hexadecimal(uint8_t digit) { return (char)(digit < 10 ? '0' + digit : 'A' + digit - 10); }

static void tell(slt_box *box, const char *text) {
    uint8_t length = (uint8_t)strlen(text), sum = checksum(text, length);
    char end[4] = {'*', hexadecimal(sum >> 4), hexadecimal(sum & 15), '\n'};
    box->calls->send(box->board, text, length);
    box->calls->send(box->board, end, sizeof end);
}

static void tell_error(slt_box *box, uint8_t error) {
    writer out = {{0}, 0};
    put(&out, "ERR ");
    put(&out, ERRORS[error]);
    tell(box, out.text);
}

/* Step over `word` at the beginning of *text. */
static bool take(const char **text, const char *word) {
    size_t length = strlen(word);
    if (strncmp(*text, word, length) != 0) return false;
    *text += length;
    return true;
}

/* Step over 1 to 10 digits; too large a number is read as the largest, which is out of every range. */
static bool take_number(const char **text, uint32_t *number) {
    uint8_t digits = 0;
    uint32_t value = 0;
    bool huge = false;
    for (; **text >= '0' && **text <= '9'; ++*text, ++digits) {
        uint8_t digit = (uint8_t)(**text - '0');
        huge = huge || value > (UINT32_MAX - digit) / 10;
        value = value * 10 + digit;
    }
    *number = huge ? UINT32_MAX : value;
    return digits >= 1 && digits <= 10;
}

static bool within(slt_range range, uint32_t value) { return range.least <= value && value <= range.most; }

/* --- time and inputs: interrupts may be here ------------------------------------------------------------------ */

static bool reached(uint32_t now, uint32_t due) { return (uint32_t)(now - due) < UINT32_C(0x80000000); }

static bool counting(const slt_box *box) { return box->state >= SLT_ARMED; }

static void note(slt_box *box, uint8_t kind, uint32_t number, uint32_t t_us) {
    if (!box->events_on) return;
    if (box->event_count == SLT_EVENTS) {
        box->events_lost++;
        return;
    }
    slt_event *event = &box->events[(box->event_first + box->event_count) % SLT_EVENTS];
    event->kind = kind;
    event->number = number;
    event->t_us = t_us;
    box->event_count++;
}

static void set_output(slt_box *box, bool high, uint32_t t_us) {
    slt_level inactive = box->active == SLT_HIGH ? SLT_LOW : SLT_HIGH;
    box->high = high;
    box->calls->drive(box->board, high ? box->active : inactive, t_us);
}

static uint32_t next_due(const slt_box *box) {
    return box->high ? box->fall_at : box->rises ? box->rise_at : box->busy_until;
}

static void advance(slt_box *box, uint32_t t_us) {
    while (box->state == SLT_RUNNING && reached(t_us, next_due(box))) {
        uint32_t due = next_due(box);
        if (box->high) {
            set_output(box, false, due);
        } else if (box->rises) {
            box->rises--;
            box->sent++;
            set_output(box, true, due);
            /* A pulse that begins late, by the time the interrupt takes, is as long as any other. */
            box->fall_at = box->calls->now_us(box->board) + box->width_us;
            box->rise_at = due + box->period_us;
            note(box, EVENT_PULSE, box->sent, due);
        } else if (box->source != SLT_GO && box->started == box->owed) {
            box->state = SLT_DONE;
            note(box, EVENT_DONE, box->sent, due);
        } else {
            box->state = SLT_ARMED;
        }
    }
}

static void ask_to_be_woken(slt_box *box) {
    if (box->state == SLT_RUNNING) box->calls->wake_at(box->board, next_due(box));
}

static void start(slt_box *box, uint32_t pulses, uint32_t t_us) {
    uint32_t whole = box->delay_us + box->width_us;
    box->state = SLT_RUNNING;
    box->started += pulses;
    box->rises = pulses;
    box->rise_at = t_us + box->delay_us;
    /* The pulse first: it is what somebody waits for. The rest is not looked at before it is over. */
    advance(box, t_us);
    if (whole < box->period_us) whole = box->period_us;
    box->busy_until = t_us + (pulses - 1) * box->period_us + whole;
}

void slt_wake(slt_box *box, uint32_t t_us) {
    advance(box, t_us);
    ask_to_be_woken(box);
}

void slt_edge(slt_box *box, bool rising, uint32_t t_us) {
    advance(box, t_us);
    if (counting(box) &&
        (box->source == SLT_CHANGE || box->source == (rising ? SLT_RISING : SLT_FALLING))) {
        box->edges++;
        note(box, EVENT_EXT0, box->edges, t_us);
        if (box->started != box->owed) {
            if (box->state == SLT_RUNNING) {
                box->missed++;
            } else {
                start(box, 1, t_us);
            }
        }
    }
    ask_to_be_woken(box);
}

void slt_exposure(slt_box *box, slt_level level, uint32_t t_us) {
    slt_level before = box->exposure_level;
    box->exposure_level = level;
    advance(box, t_us);
    if (counting(box) && level != before && level == box->exposing) {
        box->exposed++;
        note(box, EVENT_IN0, box->exposed, t_us);
    }
    ask_to_be_woken(box);
}

/* --- commands: called with the lock held, and the time ---------------------------------------------------------- */

static uint8_t configure(slt_box *box, const char *rest, uint32_t now) {
    slt_level active, exposing = SLT_FLOATING;
    bool events = false;
    if (take(&rest, "HIGH")) {
        active = SLT_HIGH;
    } else if (take(&rest, "LOW")) {
        active = SLT_LOW;
    } else {
        return SYNTAX;
    }
    if (take(&rest, " IN0 ")) {
        if (take(&rest, "HIGH")) {
            exposing = SLT_HIGH;
        } else if (take(&rest, "LOW")) {
            exposing = SLT_LOW;
        } else if (!take(&rest, "OFF")) {
            return SYNTAX;
        }
    }
    if (take(&rest, " EVENTS ")) {
        events = take(&rest, "ON");
        if (!events && !take(&rest, "OFF")) return SYNTAX;
    }
    if (*rest) return SYNTAX;
    if (box->state == SLT_RUNNING) return STATE;
    box->active = active;
    box->exposing = exposing;
    box->events_on = events;
    box->state = SLT_IDLE;
    set_output(box, false, now);
    return OK;
}

static uint8_t set_train(slt_box *box, const char *rest) {
    uint32_t pulses, period, width, delay;
    if (!(take_number(&rest, &pulses) && take(&rest, " ") && take_number(&rest, &period) && take(&rest, " ") &&
          take_number(&rest, &width) && take(&rest, " ") && take_number(&rest, &delay)) ||
        *rest)
        return SYNTAX;
    if (!within(box->facts->pulses, pulses) || !within(box->facts->period_us, period) ||
        !within(box->facts->width_us, width) || !within(box->facts->delay_us, delay) || width >= period)
        return RANGE;
    if (box->state == SLT_RESET || box->state == SLT_RUNNING) return STATE;
    box->pulses = pulses;
    box->period_us = period;
    box->width_us = width;
    box->delay_us = delay;
    box->trained = true;
    box->state = SLT_IDLE;
    return OK;
}

static uint8_t arm(slt_box *box, slt_source source) {
    if (box->state == SLT_RESET || box->state == SLT_RUNNING || !box->trained) return STATE;
    box->source = source;
    box->sent = box->started = box->exposed = box->edges = box->missed = 0;
    box->owed = source == SLT_GO ? 0 : box->pulses;
    box->state = SLT_ARMED;
    return OK;
}

static uint8_t go(slt_box *box, uint32_t now) {
    if (box->source != SLT_GO || (box->state != SLT_ARMED && box->state != SLT_RUNNING)) return STATE;
    if (box->state == SLT_RUNNING) {
        box->missed++;
        return BUSY;
    }
    box->owed += box->pulses;
    start(box, box->pulses, now);
    return OK;
}

static void stop(slt_box *box, uint32_t now) {
    if (box->state == SLT_RESET) return;
    box->rises = 0;
    box->state = SLT_IDLE;
    set_output(box, false, now);
}

static void put_range(writer *out, const char *name, slt_range range) {
    put(out, name);
    put_number(out, range.least);
    put(out, "-");
    put_number(out, range.most);
}

static void put_limits(const slt_box *box, writer *out) {
    put_range(out, "n=", box->facts->pulses);
    put_range(out, ",period=", box->facts->period_us);
    put_range(out, ",width=", box->facts->width_us);
    put_range(out, ",delay=", box->facts->delay_us);
}

static void put_counter(writer *out, const char *name, uint32_t value) {
    put(out, name);
    put_number(out, value);
}

static void put_status(slt_box *box, writer *out) {
    box->calls->lock(box->board);
    uint32_t now = box->calls->now_us(box->board);
    advance(box, now);
    slt_state state = box->state;
    uint32_t sent = box->sent, owed = box->owed, exposed = box->exposed, edges = box->edges, missed = box->missed;
    ask_to_be_woken(box);
    box->calls->unlock(box->board);
    put(out, STATES[state]);
    put_counter(out, ",sent=", sent);
    put_counter(out, "/", owed);
    if (box->exposing == SLT_FLOATING) {
        put(out, ",in=-");
    } else {
        put_counter(out, ",in=", exposed);
    }
    put_counter(out, ",edges=", edges);
    put_counter(out, ",missed=", missed);
    put_counter(out, ",t=", now);
}

/* Carry out a command that changes the box; what it answers is written to `out`. */
static uint8_t act(slt_box *box, const char *command, writer *out) {
    uint8_t error = SYNTAX;
    bool fired = false;
    box->calls->lock(box->board);
    uint32_t now = box->calls->now_us(box->board);
    advance(box, now);
    if (strcmp(command, "GO") == 0) {
        error = go(box, now);
        fired = true;
    } else if (strcmp(command, "STOP") == 0) {
        stop(box, now);
        error = OK;
    } else if (take(&command, "CFG OUT0 ")) {
        error = configure(box, command, now);
    } else if (take(&command, "TRAIN ")) {
        error = set_train(box, command);
    } else if (strcmp(command, "ARM") == 0) {
        error = arm(box, SLT_GO);
    } else if (strcmp(command, "ARM EXT0 RISING") == 0) {
        error = arm(box, SLT_RISING);
    } else if (strcmp(command, "ARM EXT0 FALLING") == 0) {
        error = arm(box, SLT_FALLING);
    } else if (strcmp(command, "ARM EXT0 CHANGE") == 0) {
        error = arm(box, SLT_CHANGE);
    }
    slt_state state = box->state;
    uint32_t owed = box->owed;
    ask_to_be_woken(box);
    box->calls->unlock(box->board);
    if (fired) {
        put_number(out, owed);
    } else {
        put(out, STATES[state]);
    }
    return error;
}

/* --- lines ------------------------------------------------------------------------------------------------------ */

static uint8_t digit_of(char character) {
    if (character >= '0' && character <= '9') return (uint8_t)(character - '0');
    if (character >= 'A' && character <= 'F') return (uint8_t)(character - 'A' + 10);
    return 16;
}

/* Length of "#" and 1 to 5 digits at the beginning of a line, when a space or nothing follows; else 0. */
static uint8_t id_length(const char *line) {
    uint8_t at = 1;
    while (line[at] >= '0' && line[at] <= '9') at++;
    return at >= 2 && at <= 6 && (line[at] == ' ' || line[at] == 0) ? at : 0;
}

static void answer(slt_box *box) {
    char *line = box->line;
    uint8_t length = box->length, id = 0, error = OK;
    if (length >= 3 && line[length - 3] == '*' && digit_of(line[length - 2]) < 16 && digit_of(line[length - 1]) < 16) {
        uint8_t told = (uint8_t)(digit_of(line[length - 2]) << 4 | digit_of(line[length - 1]));
        length = (uint8_t)(length - 3);
        if (told != checksum(line, length)) {
            tell_error(box, CHECK);
            return;
        }
    }
    line[length] = 0;
    for (uint8_t i = 0; i < length; i++) {
        if (line[i] < 0x20 || line[i] > 0x7e) error = SYNTAX;
    }
    if (line[0] == '#' && error == OK) {
        id = id_length(line);
        if (id == 0) error = SYNTAX;
    }
    if (error != OK) {
        tell_error(box, error);
        return;
    }
    if (id && strcmp(line, box->last_command) == 0) {
        tell(box, box->last_reply);
        return;
    }

    const char *command = line + id;
    if (id && *command) command++;
    writer done = {{0}, 0}, reply = {{0}, 0};
    if (strcmp(command, "*IDN?") == 0) {
        put(&done, box->facts->identity);
    } else if (strcmp(command, "CAP?") == 0) {
        put_limits(box, &done);
    } else if (strcmp(command, "STAT?") == 0) {
        put_status(box, &done);
    } else {
        error = act(box, command, &done);
    }
    if (id) {
        memcpy(reply.text, line, id);
        reply.length = id;
        put(&reply, " ");
    }
    put(&reply, error == OK ? "OK " : "ERR ");
    put(&reply, error == OK ? done.text : ERRORS[error]);
    if (id) {
        strcpy(box->last_command, line);
        strcpy(box->last_reply, reply.text);
    }
    tell(box, reply.text);
}

void slt_receive(slt_box *box, char character) {
    if (character != '\n') {
        if (box->length > SLT_LONGEST_COMMAND) {
            box->too_long = true;
        } else {
            box->line[box->length++] = character;
        }
        return;
    }
    if (!box->too_long && box->length && box->line[box->length - 1] == '\r') box->length--;
    if (box->too_long || box->length > SLT_LONGEST_COMMAND) {
        tell_error(box, TOO_LONG);
    } else if (box->length) {
        answer(box);
    }
    box->length = 0;
    box->too_long = false;
}

void slt_poll(slt_box *box) {
    while (box->event_count || box->events_lost) {
        writer out = {{0}, 0};
        slt_event event = {0, 0, 0};
        uint32_t lost = 0;
        box->calls->lock(box->board);
        bool any = box->event_count != 0;
        if (any) {
            event = box->events[box->event_first];
            box->event_first = (uint8_t)((box->event_first + 1) % SLT_EVENTS);
            box->event_count--;
        } else {
            lost = box->events_lost;
            box->events_lost = 0;
        }
        box->calls->unlock(box->board);
        if (any) {
            put(&out, EVENTS[event.kind]);
            put_number(&out, event.number);
            put_counter(&out, " ", event.t_us);
        } else {
            put_counter(&out, "!LOST ", lost);
        }
        tell(box, out.text);
    }
}

void slt_begin(slt_box *box, const slt_board_facts *facts, const slt_board_calls *calls, void *board) {
    writer out = {{0}, 0};
    memset(box, 0, sizeof *box);
    box->facts = facts;
    box->calls = calls;
    box->board = board;
    box->active = SLT_HIGH;
    box->exposing = box->exposure_level = SLT_FLOATING;
    calls->drive(board, SLT_FLOATING, calls->now_us(board));
    calls->send(board, "\n", 1);
    put(&out, "!BOOT ");
    put(&out, facts->identity);
    tell(box, out.text);
}
