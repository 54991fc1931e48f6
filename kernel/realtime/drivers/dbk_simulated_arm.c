/* Simulated arm; see dbk_simulated_arm.h. */
#include "drivers/dbk_simulated_arm.h"

#include <math.h>
#include <stddef.h>

static double follow(const dbk_simulated_arm *a, int32_t k, double dt) {
  const double share = dt / a->lag < 1.0 ? dt / a->lag : 1.0;
  return a->v[k] + (a->u[k] - a->v[k]) * share;
}

static double brake(const dbk_simulated_arm *a, int32_t k, double dt) {
  const double left = fabs(a->v[k]) - a->braking[k] * dt;
  return left > 0.0 ? copysign(left, a->v[k]) : 0.0;
}

/* moves the arm until `now_us`, in steps of at most 1 ms */
static void advance(dbk_simulated_arm *a, uint64_t now_us) {
  while (a->now_us < now_us) {
    const uint64_t step = now_us - a->now_us < 1000u ? now_us - a->now_us : 1000u;
    const double dt = (double)step / 1e6;
    const int driven = a->drive && a->now_us - a->command_us <= DBK_COMMAND_TIMEOUT_US;
    for (int32_t k = 0; k < a->n; ++k) {
      const double before = a->v[k];
      a->v[k] = driven ? follow(a, k, dt) : brake(a, k, dt);
      a->q[k] += 0.5 * (before + a->v[k]) * dt;
    }
    a->now_us += step;
  }
}

static int read_state(void *self, uint64_t now_us, dbk_joint_state *state) {
  dbk_simulated_arm *a = (dbk_simulated_arm *)self;
  if (a->sequence == 0 || now_us > a->now_us + UINT64_C(10000000)) { a->now_us = a->command_us = now_us; }
  advance(a, now_us);
  state->sequence = ++a->sequence;
  state->stamp_us = now_us;
  state->opening = (double)NAN;
  state->has_desired = 0;
  state->drive_enabled = a->drive;
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
    state->q[k] = a->q[k];
    state->v[k] = a->v[k];
  }
  return 1;
}

static void write_command(void *self, uint64_t now_us, const dbk_joint_command *command) {
  dbk_simulated_arm *a = (dbk_simulated_arm *)self;
  a->command_us = now_us;
  a->drive = command->drive_enable;
  for (int32_t k = 0; k < a->n; ++k) { a->u[k] = command->u[k]; }
}

dbk_driver dbk_simulated_arm_init(dbk_simulated_arm *a, int32_t n, const double *q, const double *braking, double lag) {
  const dbk_driver driver = {a, read_state, write_command, NULL, NULL};
  a->n = n;
  a->drive = 1;
  a->sequence = a->now_us = a->command_us = 0;
  a->lag = lag;
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
    a->q[k] = k < n ? q[k] : 0.0;
    a->braking[k] = k < n ? braking[k] : 0.0;
    a->v[k] = a->u[k] = 0.0;
  }
  return driver;
}
