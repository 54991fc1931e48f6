/* Main loop of a board or an RTOS task; see loop.h. */
#include "executive/loop.h"

#include "port/hal.h"

/* At most one message is handled in a pass, so a host that sends without a pause does not keep the loop from its end. */
static void receive(executive *e) {
  for (uint32_t n = 0; n < FRAME_MAX_ENCODED; ++n) {
    const int byte = hal_rx();
    if (byte < 0) { break; }
    executive_receive(e, (uint8_t)byte);
  }
}

void executive_loop(executive *e) {
  hal_init();
  executive_init(e);
  for (;;) {
    receive(e);
#ifndef LOCKSTEP /* in lockstep with a simulation the time passes with the messages */
    executive_watchdog(e, hal_now());
    hal_watchdog();
#endif
    hal_wait();
  }
}
