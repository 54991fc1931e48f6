/* Plausibility of joint states; see dbk_state_monitor.h. */
#include "checks/dbk_state_monitor.h"

#include <math.h>

#include "dbk/dbk_conditions.h"

static const uint64_t none = 0;

static void clear_gaps(dbk_state_monitor *m) {
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { m->expected_velocity[k] = m->source_gap[k] = m->tracking_gap[k] = 0.0; }
}

void dbk_state_monitor_init(dbk_state_monitor *m, int32_t n) {
  m->n = n;
  m->received = m->plausible = 0;
  m->last_sequence = 0;
  m->last_stamp = 0.0;
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { m->last_q[k] = m->last_v[k] = m->u[k] = 0.0; }
  clear_gaps(m);
}

static double seconds(uint64_t us) { return (double)us / 1e6; }

/* 1 if no |x[k]| exceeds its limit; NaN does */
static int all_within(int32_t n, const double *x, const double *limit) {
  int within = 1;
  for (int32_t k = 0; k < n; ++k) { within &= fabs(x[k]) <= limit[k]; }
  return within;
}

static double max_abs(int32_t n, const double *x) {
  double most = 0.0;
  for (int32_t k = 0; k < n; ++k) { most = fabs(x[k]) > most ? fabs(x[k]) : most; }
  return most;
}

static int is_plausible(int32_t n, const dbk_control_limits *limits, const dbk_joint_state *state) {
  int plausible = isnan(state->opening) || isfinite(state->opening);
  for (int32_t k = 0; k < n; ++k) {
    plausible &= isfinite(state->v[k]) && state->q[k] >= limits->q_least[k] && state->q[k] <= limits->q_most[k];
    if (state->has_desired) { plausible &= isfinite(state->desired_v[k]) && isfinite(state->desired_a[k]); }
  }
  return plausible;
}

/* measured positions against measured velocities, and against the commands while the drive is on */
static uint64_t compare_sources(dbk_state_monitor *m, const dbk_control_limits *limits, const double *moved,
                                const dbk_joint_state *state, double dt) {
  const double left = 1.0 - dt / limits->leak_time, keep = left > 0.0 ? left : 0.0, half = 0.5 * dt;
  for (int32_t k = 0; k < m->n; ++k) {
    m->source_gap[k] = m->source_gap[k] * keep + (moved[k] - half * (m->last_v[k] + state->v[k]));
  }
  const uint64_t flags = max_abs(m->n, m->source_gap) > limits->max_source_gap ? DBK_CONDITION_SOURCES_DISAGREE : none;
  if (!state->drive_enabled) {
    for (int32_t k = 0; k < m->n; ++k) { m->expected_velocity[k] = m->tracking_gap[k] = 0.0; }
    return flags;
  }
  const double share = dt / limits->lag < 1.0 ? dt / limits->lag : 1.0;
  for (int32_t k = 0; k < m->n; ++k) {
    m->expected_velocity[k] = m->expected_velocity[k] + (m->u[k] - m->expected_velocity[k]) * share;
    m->tracking_gap[k] = m->tracking_gap[k] * keep + (moved[k] - m->expected_velocity[k] * dt);
  }
  const double gap = max_abs(m->n, m->tracking_gap);
  if (gap > limits->tracking_lost_gap) { return flags | DBK_CONDITION_TRACKING_OFF | DBK_CONDITION_TRACKING_LOST; }
  return flags | (gap > limits->max_tracking_gap ? DBK_CONDITION_TRACKING_OFF : none);
}

/* conditions of a plausible state against the one before */
static uint64_t compare_states(dbk_state_monitor *m, const dbk_control_limits *limits, const dbk_joint_state *state,
                               double dt) {
  double moved[DBK_MAX_DOF] = {0.0}, most[DBK_MAX_DOF] = {0.0};
  int changed = 0;
  for (int32_t k = 0; k < m->n; ++k) {
    moved[k] = state->q[k] - m->last_q[k];
    most[k] = limits->overspeed[k] * dt + limits->max_position_jump;
    changed |= state->q[k] != m->last_q[k];
  }
  if (!(dt > 0.0 && dt < (double)INFINITY)) { return changed ? DBK_CONDITION_STATE_IMPLAUSIBLE : none; }
  if (dt > limits->state_lost_after) { /* states before and after such a gap cannot be compared */
    clear_gaps(m);
    return 0;
  }
  if (!all_within(m->n, moved, most)) { return DBK_CONDITION_STATE_IMPLAUSIBLE; }
  const uint64_t fast = all_within(m->n, state->v, limits->overspeed) ? none : DBK_CONDITION_OVERSPEED;
  return fast | compare_sources(m, limits, moved, state, dt);
}

static uint64_t plausibility(dbk_state_monitor *m, const dbk_control_limits *limits, const dbk_joint_state *state) {
  if (!is_plausible(m->n, limits, state)) { return DBK_CONDITION_STATE_IMPLAUSIBLE; }
  const double stamp = seconds(state->stamp_us);
  const uint64_t flags = m->plausible ? compare_states(m, limits, state, stamp - m->last_stamp) : none;
  m->plausible = 1;
  m->last_stamp = stamp;
  for (int32_t k = 0; k < m->n; ++k) {
    m->last_q[k] = state->q[k];
    m->last_v[k] = state->v[k];
  }
  return flags;
}

uint64_t dbk_check_state_age(const dbk_state_monitor *m, const dbk_control_limits *limits, double now) {
  const double age = m->plausible ? now - m->last_stamp : 0.0;
  if (age > limits->state_lost_after) { return DBK_CONDITION_STATE_STALE | DBK_CONDITION_STATE_LOST; }
  return age > limits->state_stale_after ? DBK_CONDITION_STATE_STALE : none;
}

uint64_t dbk_check_state(dbk_state_monitor *m, const dbk_control_limits *limits, const dbk_joint_state *state,
                         double now) {
  uint64_t flags = now - seconds(state->stamp_us) >= -limits->max_clock_skew ? none : DBK_CONDITION_CLOCK_STEP;
  if (m->received && state->sequence <= m->last_sequence) {
    flags |= DBK_CONDITION_STATE_REPEATED;
  } else {
    flags |= m->received && state->sequence > m->last_sequence + 1u ? DBK_CONDITION_STATE_MISSED : none;
    flags |= plausibility(m, limits, state);
  }
  m->received = 1;
  m->last_sequence = state->sequence;
  return flags | dbk_check_state_age(m, limits, now);
}

uint64_t dbk_check_control(dbk_state_monitor *m, const dbk_control_limits *limits, const double *u) {
  if (!all_within(m->n, u, limits->control_limit)) { return DBK_CONDITION_CONTROL_BAD; }
  for (int32_t k = 0; k < m->n; ++k) { m->u[k] = u[k]; }
  return 0;
}
