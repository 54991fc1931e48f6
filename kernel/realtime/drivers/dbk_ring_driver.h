/* Driver for a robot program in another thread, such as Python: one ring of states, one of commands, and a mailbox of the
 * newest command, which a ring that is not emptied in time does not hold. */
#ifndef DBK_RING_DRIVER_H
#define DBK_RING_DRIVER_H

#include "drivers/dbk_driver.h"
#include "mailboxes/dbk_latest.h"
#include "mailboxes/dbk_ring.h"

#define DBK_RING_DRIVER_CAPACITY 64u

typedef struct {
  dbk_ring states, commands;
  dbk_latest newest;
  uint64_t taken_tick; /* of the command that was taken last */
  dbk_joint_state state[DBK_RING_DRIVER_CAPACITY];
  dbk_joint_command command[DBK_RING_DRIVER_CAPACITY], newest_command[3];
} dbk_ring_driver;

dbk_driver dbk_ring_driver_init(dbk_ring_driver *d);

/* The robot program: the next command, oldest first. Of more commands than the ring holds, the newest one follows the
 * oldest ones. Returns 0 if there is none. */
int dbk_ring_driver_take_command(dbk_ring_driver *d, dbk_joint_command *command);

#endif
