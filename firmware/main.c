/* Main loop: bytes of the link -> executive; the watchdog runs at least once per millisecond. */
#include "executive/executive.h"
#include "port/hal.h"

static executive state;

int main(void) {
  hal_init();
  executive_init(&state);
  for (;;) {
    for (int byte = hal_rx(); byte >= 0; byte = hal_rx()) { executive_receive(&state, (uint8_t)byte); }
#ifndef LOCKSTEP /* in lockstep with a simulation the time passes with the messages */
    executive_watchdog(&state, hal_now());
#endif
    hal_wait();
  }
}
