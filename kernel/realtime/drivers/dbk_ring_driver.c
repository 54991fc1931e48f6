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
  (void)now_us;
  (void)dbk_ring_push(&((dbk_ring_driver *)self)->commands, command);
}

dbk_driver dbk_ring_driver_init(dbk_ring_driver *d) {
  const dbk_driver driver = {d, read_newest, write_command, NULL, NULL};
  dbk_ring_init(&d->states, d->state, DBK_RING_DRIVER_CAPACITY, (uint32_t)sizeof d->state[0]);
  dbk_ring_init(&d->commands, d->command, DBK_RING_DRIVER_CAPACITY, (uint32_t)sizeof d->command[0]);
  return driver;
}
