/* Enforcement of decisions; see dbk_standstill.h. */
#include "dbk/dbk_standstill.h"

#include "dbk_math.h"

void dbk_standstill_init(dbk_standstill *s) {
  s->drive_wanted = 1;
  s->at_standstill = s->stopping = s->drive_off_known = 0;
  s->stop_since_us = s->drive_off_us = 0;
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
    s->standstill_q[k] = s->drive_off_q[k] = s->coast_limit[k] = (dbk_real)0;
  }
}

/* 1 if every |x[k]| is at most its limit; NaN is not */
static int all_below(int32_t n, const dbk_real *x, dbk_real limit) {
  int below = 1;
  for (int32_t k = 0; k < n; ++k) { below &= dbk_abs(x[k]) <= limit; }
  return below;
}

static int moved_at_most(int32_t n, const dbk_real *from, const dbk_real *q, dbk_real limit) {
  int within = 1;
  for (int32_t k = 0; k < n; ++k) { within &= dbk_abs(q[k] - from[k]) <= limit; }
  return within;
}

static int coasted_at_most(const dbk_standstill *s, int32_t n, const dbk_real *q) {
  int within = 1;
  for (int32_t k = 0; k < n; ++k) { within &= dbk_abs(q[k] - s->drive_off_q[k]) <= s->coast_limit[k]; }
  return within;
}

static void switch_drive(dbk_standstill *s, int on, int32_t n, const dbk_real *q, const dbk_real *v,
                         uint64_t stamp_us) {
  s->drive_wanted = (uint8_t)on;
  s->drive_off_known = (uint8_t)!on;
  s->drive_off_us = stamp_us;
  for (int32_t k = 0; k < n; ++k) {
    s->drive_off_q[k] = q[k];
    s->coast_limit[k] = DBK_MAX_BRAKE_SLIP + DBK_BRAKE_TIME * dbk_abs(v[k]);
  }
}

static int is_at_rest(int32_t n, const dbk_real *v) {
  int at_rest = 1;
  for (int32_t k = 0; k < n; ++k) { at_rest &= dbk_abs(v[k]) < DBK_REST_VELOCITY; }
  return at_rest;
}

/* switches the drive as the decision requires, and on only at rest, because the control begins at zero; while it is
 * off, checks that the brakes hold */
static uint64_t update_drive(dbk_standstill *s, dbk_decision decision, int32_t n, const dbk_real *q,
                             const dbk_real *v, uint64_t stamp_us) {
  if ((decision.action >= DBK_ACTION_ESTOP || decision.immediate_drive_off) && s->drive_wanted) {
    switch_drive(s, 0, n, q, v, stamp_us);
  } else if (decision.action < DBK_ACTION_CONTROLLED_STOP && !s->drive_wanted && is_at_rest(n, v)) {
    switch_drive(s, 1, n, q, v, stamp_us);
  }
  if (s->drive_wanted || !s->drive_off_known || stamp_us <= s->drive_off_us) { return 0; }
  const int braked = stamp_us - s->drive_off_us > DBK_BRAKE_TIME_US;
  const int fast = braked && !all_below(n, v, (dbk_real)10 * DBK_REST_VELOCITY);
  return fast || !coasted_at_most(s, n, q) ? DBK_CONDITION_FALLING : 0;
}

/* notes the standstill, and checks its drift and the duration of the stop */
static uint64_t monitor_stop(dbk_standstill *s, int32_t n, const dbk_real *q, const dbk_real *v, uint64_t stamp_us) {
  if (!s->stopping) {
    s->stopping = 1;
    s->stop_since_us = stamp_us;
  }
  if (s->at_standstill) { return moved_at_most(n, s->standstill_q, q, DBK_MAX_DRIFT) ? 0 : DBK_CONDITION_DRIFT; }
  if (is_at_rest(n, v)) {
    s->at_standstill = 1;
    for (int32_t k = 0; k < n; ++k) { s->standstill_q[k] = q[k]; }
    return 0;
  }
  const int overdue = stamp_us >= s->stop_since_us && stamp_us - s->stop_since_us > DBK_STOP_TIMEOUT_US;
  return overdue ? DBK_CONDITION_STOP_OVERDUE : 0;
}

uint64_t dbk_standstill_apply(dbk_standstill *s, dbk_decision decision, int yielding, int32_t n, const dbk_real *q,
                              const dbk_real *v, uint64_t stamp_us) {
  uint64_t conditions = update_drive(s, decision, n, q, v, stamp_us);
  if (decision.action < DBK_ACTION_HOLD || !s->drive_wanted || yielding) {
    s->stopping = s->at_standstill = 0;
    return conditions;
  }
  conditions |= monitor_stop(s, n, q, v, stamp_us);
  if (decision.action >= DBK_ACTION_CONTROLLED_STOP && s->at_standstill) { switch_drive(s, 0, n, q, v, stamp_us); }
  return conditions;
}
