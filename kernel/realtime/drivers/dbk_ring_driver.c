/* Driver over two rings; see dbk_ring_driver.h. */
#include "drivers/dbk_ring_driver.h"

#include <stddef.h>

/* the newest state; a full ring is read once, so that a flood does not delay the tick */
static int read_newest(void *self, uint64_t now_us, dbk_joint_state *state) {
  dbk_ring_driver *d = (dbk_ring_driver *)self;
  int found = 0;
  (void)now_us;
  for (uint32_t i = 0; i < DBK_RING_DRIVER_CAPACITY && dbk_ring_pop(&d->states, state); ++i) { found = 1; }
  return found;
}

static void write_command(void *self, uint64_t now_us, const dbk_joint_command *command) {
  dbk_ring_driver *d = (dbk_ring_driver *)self;
  (void)now_us;
  (void)dbk_ring_push(&d->commands, command);
  d->newest_command[d->newest.writing] = *command;
  dbk_latest_publish(&d->newest);
}

/* a command that the mailbox had first is skipped in the ring */
int dbk_ring_driver_take_command(dbk_ring_driver *d, dbk_joint_command *command) {
  int found = 0;
  while (!found && dbk_ring_pop(&d->commands, command)) { found = command->tick > d->taken_tick; }
  if (!found && dbk_latest_take(&d->newest)) {
    *command = d->newest_command[d->newest.reading];
    found = command->tick > d->taken_tick;
  }
  if (found) { d->taken_tick = command->tick; }
  return found;
}

dbk_driver dbk_ring_driver_init(dbk_ring_driver *d) {
  const dbk_driver driver = {d, read_newest, write_command, NULL, NULL};
  dbk_ring_init(&d->states, d->state, DBK_RING_DRIVER_CAPACITY, (uint32_t)sizeof d->state[0]);
  dbk_latest_init(&d->newest);
  d->taken_tick = 0;
  dbk_ring_init(&d->commands, d->command, DBK_RING_DRIVER_CAPACITY, (uint32_t)sizeof d->command[0]);
  return driver;
}
