/* CLOCK_MONOTONIC in microseconds. The file that includes it defines _GNU_SOURCE first. */
#ifndef DBK_CLOCK_H
#define DBK_CLOCK_H

#include <errno.h>
#include <stdint.h>
#include <time.h>

static inline uint64_t dbk_monotonic_us(void) {
  struct timespec now;
  clock_gettime(CLOCK_MONOTONIC, &now);
  return (uint64_t)now.tv_sec * 1000000u + (uint64_t)now.tv_nsec / 1000u;
}

static inline void dbk_sleep_until(uint64_t us) {
  const struct timespec at = {(time_t)(us / 1000000u), (long)(us % 1000000u) * 1000L};
  while (clock_nanosleep(CLOCK_MONOTONIC, TIMER_ABSTIME, &at, NULL) == EINTR) {}
}

#endif
