/* Main loop: bytes of the link -> executive, its watchdog, and the hardware watchdog.
 *
 * A pass must follow at least once per millisecond. A loop that hangs, or runs away, is noticed by the hardware watchdog,
 * which is fed every 10 ms.
 */
#ifndef FIRMWARE_LOOP_H
#define FIRMWARE_LOOP_H

#include "executive/executive.h"

/* runs the safety layer for ever, with the functions of port/hal.h */
void executive_loop(executive *e);

#endif
