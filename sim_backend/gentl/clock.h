/* Time: monotonic nanoseconds, the same count that Python's time.monotonic() gives on this machine. */
#ifndef CLOCK_H
#define CLOCK_H

#include <pthread.h>
#include <stdint.h>

#define NS_PER_US INT64_C(1000)
#define NS_PER_MS INT64_C(1000000)
#define NS_PER_S INT64_C(1000000000)

int64_t clock_now(void);

/* A condition variable whose waits are measured on the clock above. */
void clock_condition_init(pthread_cond_t *condition);
void clock_wait_until(pthread_cond_t *condition, pthread_mutex_t *mutex, int64_t moment_ns);

#endif
