/* One control tick; see dbk_control_tick.h. */
#include "dbk_control_tick.h"

#include <math.h>

#define OPENING_TOLERANCE 0.005 /* [m] a measured opening may be outside the range of the gripper by this much */
#define MAX_DELTA 2.0
#define DELTA_TOLERANCE 1e-3
#define COMMAND_TOLERANCE 1e-6 /* [rad/s] difference of a control and the reported command that is due to rounding */
#define SILENT_LINK \
  (DBK_CONDITION_STATE_STALE | DBK_CONDITION_STATE_LOST | DBK_CONDITION_TICK_LOST | DBK_CONDITION_FILTER_STOPPED)
#define UNUSABLE (DBK_CONDITION_STATE_IMPLAUSIBLE | DBK_CONDITION_STATE_REPEATED)

static double seconds(uint64_t us) { return (double)us / 1e6; }

void dbk_control_tick_init(dbk_control_tick *t) {
  dbk_cycle_init(&t->cycle);
  dbk_state_monitor_init(&t->monitor, t->model.n);
  dbk_loop_timing_init(&t->timing);
  t->has_state = t->drive_came_on = t->drive_off = 0;
  t->drive_request_stamp = t->drive_request_time = 0.0;
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { t->u[k] = 0.0; }
}

static void expect_drive_on(dbk_control_tick *t, double now) {
  t->drive_came_on = 0;
  t->drive_request_stamp = seconds(t->state.stamp_us);
  t->drive_request_time = now;
}

/* checks the state of this tick; a state that is not usable leaves the last one in force */
static void accept_state(dbk_control_tick *t, dbk_tick_record *record, double now) {
  if (!record->new_state) {
    t->cycle.pending |= dbk_check_state_age(&t->monitor, &t->limits, now);
    return;
  }
  const uint64_t flags = dbk_check_state(&t->monitor, &t->limits, &record->state, now);
  t->cycle.pending |= flags;
  record->state_used = !(flags & UNUSABLE);
  if (!record->state_used) { return; }
  t->state = record->state;
  if (!t->has_state) { expect_drive_on(t, now); }
  t->has_state = 1;
}

/* 1 if a wanted drive went off, or is not on in time */
static int drive_dropped(dbk_control_tick *t) {
  if (t->state.drive_enabled) {
    t->drive_came_on = 1;
    return 0;
  }
  return t->drive_came_on || !(seconds(t->state.stamp_us) - t->drive_request_stamp <= t->limits.drive_on_timeout);
}

static int is_moving(const dbk_control_tick *t) {
  int moving = 0;
  for (int32_t k = 0; k < t->model.n; ++k) { moving |= fabs(t->u[k]) > t->limits.rest_velocity; }
  return moving;
}

static void set_joints(dbk_control_tick *t) {
  dbk_in *in = &t->cycle.in;
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
    in->q[k] = k < t->model.n ? (dbk_real)t->state.q[k] : (dbk_real)0;
    in->v[k] = k < t->model.n ? (dbk_real)t->state.v[k] : (dbk_real)0;
  }
}

static int is_at_rest(const dbk_control_tick *t) {
  int at_rest = 1;
  for (int32_t k = 0; k < t->model.n; ++k) { at_rest &= fabs(t->state.v[k]) < t->limits.rest_velocity; }
  return at_rest;
}

static void decide(dbk_control_tick *t, dbk_tick_record *record, double now) {
  const double stamp = seconds(t->state.stamp_us);
  uint64_t flags = t->cycle.pending | record->external | dbk_check_loop(&t->timing, &t->limits, now, stamp, is_moving(t));
  if (record->speed_scale < 1.0) { flags |= DBK_CONDITION_SPEED_STAGE; }
  if (!t->drive_came_on && now - t->drive_request_time < t->limits.drive_on_silence) { flags &= ~SILENT_LINK; }
  const int drive_was_wanted = t->cycle.standstill.drive_wanted;
  set_joints(t);
  t->cycle.pending = 0;
  (void)dbk_cycle_decide(&t->cycle, t->model.n, record->now_us, t->state.stamp_us, flags, 0);
  record->conditions = flags;
  if (t->drive_off && !is_at_rest(t)) { record->drive_off = 1; } /* as for the supervisor: the control begins at zero */
  const int comes_back = t->drive_off && !record->drive_off;
  t->drive_off = record->drive_off;
  if (!t->cycle.standstill.drive_wanted || t->drive_off) { return; }
  if (!drive_was_wanted || comes_back) { expect_drive_on(t, now); }
  if (drive_dropped(t)) { t->cycle.pending |= DBK_CONDITION_DRIVE_DROPPED; }
}

/* scale in [0, 1] of the nominal control */
static double scale(const dbk_control_tick *t, double speed_scale) {
  const dbk_decision decision = t->cycle.supervisor.decision;
  if (decision.action >= DBK_ACTION_HOVER) { return 0.0; }
  if (decision.action < DBK_ACTION_SLOW) { return 1.0; }
  const int stage = decision.check < DBK_N_CHECKS && dbk_checks[decision.check].condition == DBK_CONDITION_SPEED_STAGE;
  return stage || speed_scale < t->limits.slow_scale ? speed_scale : t->limits.slow_scale;
}

/* the opening for the kernel: NaN, which it rejects, if the gripper cannot be open that far */
static dbk_real plausible_opening(double opening, double most) {
  if (isnan(opening)) { return (dbk_real)0; }
  if (most < 0.0) { return (dbk_real)opening; }
  return opening >= -OPENING_TOLERANCE && opening <= most + OPENING_TOLERANCE ? (dbk_real)opening : (dbk_real)NAN;
}

/* 1 if the intervention that the filter reports is that of its control; a result that hangs is not */
static int is_consistent(const dbk_control_tick *t, const double *u, const double *u_nom) {
  double sum = 0.0;
  for (int32_t k = 0; k < t->model.n; ++k) {
    const double gap = (u[k] - u_nom[k]) / t->limits.velocity_limit[k];
    sum += gap * gap;
  }
  const double delta = sqrt(sum / (double)t->model.n), expected = delta < MAX_DELTA ? delta : MAX_DELTA;
  return !isfinite(expected) || fabs(expected - (double)t->cycle.out.delta) <= DELTA_TOLERANCE;
}

/* the last control reduced by one factor for all joints, as fast as every acceleration limit allows */
static void brake(const dbk_control_tick *t, double *u) {
  double factor = 1.0;
  for (int32_t k = 0; k < t->model.n; ++k) {
    const double speed = fabs(t->u[k]);
    if (speed > 1e-9 && 1.0 - t->limits.braking_step[k] / speed < factor) {
      factor = 1.0 - t->limits.braking_step[k] / speed;
    }
  }
  for (int32_t k = 0; k < t->model.n; ++k) { u[k] = (factor > 0.0 ? factor : 0.0) * t->u[k]; }
}

static void restart_filter(dbk_control_tick *t, const double *u) {
  dbk_real last[DBK_MAX_DOF];
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { last[k] = (dbk_real)u[k]; }
  dbk_cycle_restart_filter(&t->cycle, last);
  (void)dbk_check_control(&t->monitor, &t->limits, u);
}

/* 1 if the command that the robot reports is not the last control */
static int lost_last_control(const dbk_control_tick *t) {
  double gap = 0.0;
  for (int32_t k = 0; k < t->model.n; ++k) { gap = fmax(gap, fabs(t->state.desired_v[k] - t->u[k])); }
  return gap > COMMAND_TOLERANCE;
}

static double clip(double value, double limit) { return fmin(fmax(value, -limit), limit); }

/* Continues the command that the robot executes if it is not the last control, which was lost on the way: the limits of
 * acceleration and jerk of the next control are those around the executed velocity. */
static void continue_desired_motion(dbk_control_tick *t, dbk_tick_record *record) {
  const dbk_joint_state *state = &t->state;
  const int driven = t->cycle.standstill.drive_wanted && !record->drive_off && state->drive_enabled;
  if (!record->state_used || !state->has_desired || !driven || !lost_last_control(t)) { return; }
  for (int32_t k = 0; k < t->model.n; ++k) { t->u[k] = clip(state->desired_v[k], t->limits.velocity_limit[k]); }
  restart_filter(t, t->u);
  for (int32_t k = 0; k < t->model.n; ++k) {
    const double change = clip(state->desired_a[k] * t->limits.command_period, t->limits.braking_step[k]);
    t->cycle.ctx.u_change[k] = (dbk_real)change;
  }
  record->continued = 1;
}

/* 1 if the control can become zero within the limits of acceleration */
static int can_rest(const dbk_control_tick *t) {
  int slow = 1;
  for (int32_t k = 0; k < t->model.n; ++k) { slow &= fabs(t->u[k]) <= t->limits.braking_step[k]; }
  return slow;
}

/* the control to write: scaled, filtered and checked */
static void control(dbk_control_tick *t, const dbk_stamped_scene *scene, dbk_tick_record *record, double now) {
  dbk_in *in = &t->cycle.in;
  dbk_real filtered[DBK_MAX_DOF];
  double scaled[DBK_MAX_DOF] = {0.0}, u[DBK_MAX_DOF] = {0.0};
  const double factor = scale(t, record->speed_scale);
  for (int32_t k = 0; k < t->model.n; ++k) { /* + 0.0: 0 and not -0 */
    const double wish = record->standstill ? 0.0 : record->u_nom[k];
    scaled[k] = factor == 1.0 ? wish : factor * wish + 0.0;
  }
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { in->u_nom[k] = (dbk_real)scaled[k]; }
  in->opening = plausible_opening(t->state.opening, t->limits.opening_max);
  in->state_age = (dbk_real)(now - seconds(t->state.stamp_us));
  in->scene_age = (dbk_real)(now - scene->stamp);
  in->mobile = 0;
  const int hull = isnan(t->state.opening) && t->limits.opening_max >= 0.0;
  const int standstill = dbk_cycle_filter(&t->cycle, hull ? &t->hull_model : &t->model, &scene->scene, filtered);
  const int rests = record->drive_off || !t->drive_came_on || (record->standstill && can_rest(t));
  for (int32_t k = 0; k < t->model.n; ++k) { u[k] = rests ? 0.0 : (double)filtered[k]; }
  if (standstill || rests) {
    restart_filter(t, u);
  } else if (dbk_check_control(&t->monitor, &t->limits, u) || !is_consistent(t, u, scaled)) {
    t->cycle.pending |= DBK_CONDITION_CONTROL_BAD;
    brake(t, u);
    restart_filter(t, u);
  }
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) { t->u[k] = record->u[k] = u[k]; }
}

static void write_result(const dbk_control_tick *t, dbk_tick_record *record) {
  const dbk_out *out = &t->cycle.out;
  record->delta = (double)out->delta;
  record->h_min = (double)out->h_min;
  record->status = out->status;
  record->flags = out->flags;
  record->certified = out->certified;
  record->iterations = out->iterations;
  record->n_rows = out->n_rows;
  record->action = t->cycle.supervisor.decision.action;
  record->check = t->cycle.supervisor.decision.check;
  record->drive_enable = t->cycle.standstill.drive_wanted && !record->drive_off;
  record->at_standstill = t->cycle.standstill.at_standstill;
}

int dbk_control_tick_run(dbk_control_tick *t, const dbk_stamped_scene *scene, dbk_tick_record *record) {
  const double now = seconds(record->now_us);
  record->state_used = 0;
  accept_state(t, record, now);
  if (!t->has_state) { return 0; }
  decide(t, record, now);
  continue_desired_motion(t, record);
  control(t, scene, record, now);
  write_result(t, record);
  return 1;
}
