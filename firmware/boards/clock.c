/* Time from SysTick: an interrupt per millisecond, and the counter within it. */
#include "boards/board.h"
#include "port/hal.h"

#define SYSTICK_CONTROL REGISTER(0xE000E010u)
#define SYSTICK_RELOAD REGISTER(0xE000E014u)
#define SYSTICK_COUNTER REGISTER(0xE000E018u)
#define CYCLES_PER_MS (CLOCK_HZ / 1000u)

static volatile uint32_t milliseconds;
static uint32_t last_milliseconds, wraps;
static uint64_t last_us;

void board_systick_handler(void) { ++milliseconds; }

void clock_start(void) {
  SYSTICK_RELOAD = CYCLES_PER_MS - 1u;
  SYSTICK_COUNTER = 0;
  SYSTICK_CONTROL = 7u;
}

uint64_t hal_now(void) {
  uint32_t ms, counter;
  do {
    ms = milliseconds;
    counter = SYSTICK_COUNTER;
  } while (ms != milliseconds);
  if (ms < last_milliseconds) { ++wraps; }
  last_milliseconds = ms;
  const uint64_t all = ((uint64_t)wraps << 32) | ms;
  const uint64_t now = all * 1000u + (CYCLES_PER_MS - 1u - counter) * 1000u / CYCLES_PER_MS; /* without a 64-bit division */
  if (now > last_us) { last_us = now; } /* a counter that has wrapped before its interrupt must not turn the time back */
  return last_us;
}
