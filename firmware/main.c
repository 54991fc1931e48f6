/* Main loop: bytes of the link -> executive; the watchdog runs at least once per millisecond.
 *
 * A loop that hangs is noticed by the hardware watchdog. At most one message of the link is handled between two calls of
 * it, so a host that sends without a pause does not keep the loop from its end. */
#include "executive/executive.h"
#include "port/hal.h"

static executive state;

int main(void) {
  hal_init();
  executive_init(&state);
  for (;;) {
    for (uint32_t n = 0; n < FRAME_MAX_ENCODED; ++n) {
      const int byte = hal_rx();
      if (byte < 0) { break; }
      executive_receive(&state, (uint8_t)byte);
    }
#ifndef LOCKSTEP /* in lockstep with a simulation the time passes with the messages */
    executive_watchdog(&state, hal_now());
    hal_watchdog();
#endif
    hal_wait();
  }
}
