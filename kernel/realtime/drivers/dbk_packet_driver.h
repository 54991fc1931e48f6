/* Driver over a socket (SOCK_SEQPACKET) to the process of the robot: one packet for each state and for each command.
 *
 * A packet has the byte order of the machine, on which both processes run:
 *
 *   state    kind, n, sequence, stamp_us, opening (NaN: unknown), drive_enabled, has_desired, q[n], v[n],
 *            and with has_desired: desired_v[n], desired_a[n]
 *   command  kind, n, tick, drive_enable, 0, u[n]
 *
 * with kind, n, drive_enabled, has_desired and drive_enable as uint32, sequence, stamp_us and tick as uint64, and the rest as
 * double. A packet of another form is dropped and counted. After the other process has ended, no state arrives.
 */
#ifndef DBK_PACKET_DRIVER_H
#define DBK_PACKET_DRIVER_H

#include "drivers/dbk_driver.h"

#define DBK_STATE_PACKET UINT32_C(0x31534244)   /* DBS1 */
#define DBK_COMMAND_PACKET UINT32_C(0x31434244) /* DBC1 */

typedef struct {
  int fd, closed;
  int32_t n, fresh; /* joints; 1: `state` has not been read */
  dbk_joint_state state;
  uint64_t arrived_us, clock_us; /* CLOCK_MONOTONIC of the newest state; the robot's time returned last */
  uint64_t malformed, unsent;
} dbk_packet_driver;

/* `fd` is the connected socket of an arm with `n` joints; the caller closes it after the last tick */
dbk_driver dbk_packet_driver_init(dbk_packet_driver *d, int fd, int32_t n);

#endif
