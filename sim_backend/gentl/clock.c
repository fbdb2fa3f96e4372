#include "clock.h"

#include <time.h>

#if defined(__APPLE__)

int64_t clock_now(void) { return (int64_t)clock_gettime_nsec_np(CLOCK_UPTIME_RAW); }

void clock_condition_init(pthread_cond_t *condition) { pthread_cond_init(condition, NULL); }

void clock_wait_until(pthread_cond_t *condition, pthread_mutex_t *mutex, int64_t moment_ns) {
    int64_t left = moment_ns - clock_now();
    if (left <= 0)
        return;
    struct timespec span = {(time_t)(left / NS_PER_S), (long)(left % NS_PER_S)};
    pthread_cond_timedwait_relative_np(condition, mutex, &span);
}

#else

int64_t clock_now(void) {
    struct timespec now;
    clock_gettime(CLOCK_MONOTONIC, &now);
    return now.tv_sec * NS_PER_S + now.tv_nsec;
}

void clock_condition_init(pthread_cond_t *condition) {
    pthread_condattr_t attributes;
    pthread_condattr_init(&attributes);
    pthread_condattr_setclock(&attributes, CLOCK_MONOTONIC);
    pthread_cond_init(condition, &attributes);
    pthread_condattr_destroy(&attributes);
}

void clock_wait_until(pthread_cond_t *condition, pthread_mutex_t *mutex, int64_t moment_ns) {
    struct timespec moment = {(time_t)(moment_ns / NS_PER_S), (long)(moment_ns % NS_PER_S)};
    pthread_cond_timedwait(condition, mutex, &moment);
}

#endif
