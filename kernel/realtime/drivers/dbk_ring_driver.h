/* Driver for a robot program in another thread, such as Python: one ring of states, one of commands. */
#ifndef DBK_RING_DRIVER_H
#define DBK_RING_DRIVER_H

#include "drivers/dbk_driver.h"
#include "mailboxes/dbk_ring.h"

#define DBK_RING_DRIVER_CAPACITY 64u

typedef struct {
  dbk_ring states, commands;
  dbk_joint_state state[DBK_RING_DRIVER_CAPACITY];
  dbk_joint_command command[DBK_RING_DRIVER_CAPACITY];
} dbk_ring_driver;

dbk_driver dbk_ring_driver_init(dbk_ring_driver *d);

#endif
