/* Driver over packets; see dbk_packet_driver.h. */
#define _GNU_SOURCE
#include "drivers/dbk_packet_driver.h"

#include <errno.h>
#include <poll.h>
#include <string.h>
#include <sys/socket.h>

#include "dbk_clock.h"

#define MOST_AT_ONCE 1024 /* states that one tick receives; more remain for the next one */

typedef struct {
  uint32_t kind, n;
  uint64_t sequence, stamp_us;
  double opening;
  uint32_t drive_enabled, has_desired;
} state_head;

typedef struct {
  uint32_t kind, n;
  uint64_t tick;
  uint32_t drive_enable, reserved;
} command_head;

#define MOST_STATE_BYTES (sizeof(state_head) + 4u * DBK_MAX_DOF * sizeof(double))

/* 1 if the `size` bytes of `packet` are a state */
static int parse_state(const dbk_packet_driver *d, const uint8_t *packet, size_t size, dbk_joint_state *state) {
  state_head head;
  if (size < sizeof head) { return 0; }
  memcpy(&head, packet, sizeof head);
  const size_t row = (size_t)d->n * sizeof(double), rows = head.has_desired ? 4u : 2u;
  if (head.kind != DBK_STATE_PACKET || head.n != (uint32_t)d->n || size != sizeof head + rows * row) { return 0; }
  memset(state, 0, sizeof *state);
  state->sequence = head.sequence;
  state->stamp_us = head.stamp_us;
  state->opening = head.opening;
  state->drive_enabled = head.drive_enabled != 0;
  state->has_desired = head.has_desired != 0;
  const uint8_t *at = packet + sizeof head;
  memcpy(state->q, at, row);
  memcpy(state->v, at + row, row);
  if (state->has_desired) {
    memcpy(state->desired_v, at + 2u * row, row);
    memcpy(state->desired_a, at + 3u * row, row);
  }
  return 1;
}

/* Takes the packets that have arrived; the last state is the newest one. A robot that repeats its last state does not stop
 * the clock: only a newer stamp has arrived. */
static void receive(dbk_packet_driver *d, uint64_t now_us) {
  uint8_t packet[MOST_STATE_BYTES + 1u];
  const uint64_t stamp_us = d->state.stamp_us;
  for (int i = 0; i < MOST_AT_ONCE && !d->closed; ++i) {
    const ssize_t size = recv(d->fd, packet, sizeof packet, MSG_DONTWAIT);
    if (size < 0 && (errno == EAGAIN || errno == EWOULDBLOCK || errno == EINTR)) { return; }
    if (size <= 0) {
      d->closed = 1;
    } else if (parse_state(d, packet, (size_t)size, &d->state)) {
      d->fresh = 1;
      if (d->arrived_us == 0u || d->state.stamp_us > stamp_us) { d->arrived_us = now_us; }
    } else {
      __atomic_fetch_add(&d->malformed, 1u, __ATOMIC_RELAXED);
    }
  }
}

static int read_newest(void *self, uint64_t now_us, dbk_joint_state *state) {
  dbk_packet_driver *d = (dbk_packet_driver *)self;
  (void)now_us;
  if (!d->fresh) { return 0; }
  *state = d->state;
  d->fresh = 0;
  return 1;
}

/* a command that cannot be sent at once is lost; the robot has a watchdog for that */
static void write_command(void *self, uint64_t now_us, const dbk_joint_command *command) {
  dbk_packet_driver *d = (dbk_packet_driver *)self;
  uint8_t packet[sizeof(command_head) + DBK_MAX_DOF * sizeof(double)];
  const command_head head = {DBK_COMMAND_PACKET, (uint32_t)d->n, command->tick, command->drive_enable != 0, 0u};
  const size_t row = (size_t)d->n * sizeof(double);
  (void)now_us;
  memcpy(packet, &head, sizeof head);
  memcpy(packet + sizeof head, command->u, row);
  if (d->closed || send(d->fd, packet, sizeof head + row, MSG_DONTWAIT | MSG_NOSIGNAL) < 0) {
    __atomic_fetch_add(&d->unsent, 1u, __ATOMIC_RELAXED);
  }
}

/* of a closed socket no state arrives: the loop continues at its period, so that it stops the arm by its own rules */
static void wait_for_state(void *self, uint64_t until_us) {
  dbk_packet_driver *d = (dbk_packet_driver *)self;
  const uint64_t now_us = dbk_monotonic_us();
  if (until_us <= now_us) { return; }
  const uint64_t left = until_us - now_us;
  const struct timespec limit = {(time_t)(left / 1000000u), (long)(left % 1000000u) * 1000L};
  struct pollfd state = {d->fd, POLLIN, 0};
  if (d->closed || (ppoll(&state, 1, &limit, NULL) > 0 && !(state.revents & POLLIN))) { dbk_sleep_until(until_us); }
}

/* the stamp of the newest state and the time since its arrival */
static uint64_t robot_time(void *self, uint64_t now_us) {
  dbk_packet_driver *d = (dbk_packet_driver *)self;
  receive(d, now_us);
  const uint64_t since = now_us > d->arrived_us ? now_us - d->arrived_us : 0u, time = d->state.stamp_us + since;
  if (d->arrived_us != 0u && time > d->clock_us) { d->clock_us = time; }
  return d->clock_us;
}

dbk_driver dbk_packet_driver_init(dbk_packet_driver *d, int fd, int32_t n) {
  const dbk_driver driver = {d, read_newest, write_command, wait_for_state, robot_time};
  memset(d, 0, sizeof *d);
  d->fd = fd;
  d->n = n;
  return driver;
}
