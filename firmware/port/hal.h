/* Functions that a board or an RTOS task provides to the firmware. All of them return at once, except hal_wait. */
#ifndef FIRMWARE_HAL_H
#define FIRMWARE_HAL_H

#include <stdint.h>

/* prepares clock, link and watchdog; the drive is off */
void hal_init(void);

/* the next byte of the link, or -1 */
int hal_rx(void);

/* sends bytes over the link; may block until the transmitter has accepted them */
void hal_tx(const uint8_t *bytes, uint32_t size);

/* time since the start [us], monotonic */
uint64_t hal_now(void);

/* the enable input of the drive: 0 switches it off (stop category 0) */
void hal_drive_enable(int on);

/* 1 while the hardware emergency stop is pressed */
int hal_estop_in(void);

/* Feeds the hardware watchdog, which switches the drive off; only the main loop calls it, every HAL_WATCHDOG_US or later
 * [us]. A call earlier than HAL_WATCHDOG_EARLIEST_US after the one before comes from a program that runs away, and is a
 * fault (windowed watchdog). */
void hal_watchdog(void);
enum { HAL_WATCHDOG_US = 10000, HAL_WATCHDOG_EARLIEST_US = 5000 };

/* a number that differs between starts, for the session keys */
uint64_t hal_nonce(void);

/* sleeps until the next interrupt or the next byte of the link */
void hal_wait(void);

#endif
