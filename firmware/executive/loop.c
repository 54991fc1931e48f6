/* Main loop of a board or an RTOS task; see loop.h. */
#include "executive/loop.h"

#include "port/hal.h"

/* At most one message is handled in a pass, so a host that sends without a pause does not keep the loop from its end.
 * Returns 1 if more bytes may have arrived. */
static int receive(executive *e) {
  for (uint32_t n = 0; n < FRAME_MAX_ENCODED; ++n) {
    const int byte = hal_rx();
    if (byte < 0) { return 0; }
    if (executive_receive(e, (uint8_t)byte)) { break; }
  }
  return 1;
}

#ifndef LOCKSTEP
/* The time of a feed is read after it, so that two feeds are never closer than the period. */
static void feed_watchdog(uint64_t now_us, uint64_t *fed_us) {
  if (now_us - *fed_us < HAL_WATCHDOG_US) { return; }
  hal_watchdog();
  *fed_us = hal_now();
}
#endif

void executive_loop(executive *e) {
  hal_init();
  executive_init(e);
#ifndef LOCKSTEP
  uint64_t fed_us = hal_now();
#endif
  for (;;) {
    const int more = receive(e);
#ifndef LOCKSTEP /* in lockstep with a simulation the time passes with the messages */
    const uint64_t now_us = hal_now();
    executive_watchdog(e, now_us);
    feed_watchdog(now_us, &fed_us);
#endif
    if (!more) { hal_wait(); }
  }
}
