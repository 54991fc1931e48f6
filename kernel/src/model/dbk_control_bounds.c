/* Bounds of the control from the velocity, acceleration, jerk and position limits of the joints, and braking within
 * them. */
#include "model/dbk_control_bounds.h"

/* maximum speed from which a joint stops within distance d if its speed decreases by a * period in every period */
static dbk_real braking_speed(dbk_real a, dbk_real period, dbk_real d) {
  const dbk_real half = (dbk_real)0.5 * a * period;
  return dbk_sqrt(half * half + (dbk_real)2 * a * d) - half;
}

/* maximum speed toward a position limit at distance d: min(alpha d, braking speed). Beyond the limit (d < 0) the speed
 * is negative, so the joint returns at a limited speed */
static inline dbk_real approach_speed(const dbk_model *model, int32_t k, dbk_real d) {
  const dbk_real linear = model->alpha_joint * d, recovery = dbk_max(linear, -(dbk_real)4 * model->recovery);
  const dbk_real inside = dbk_min(linear, braking_speed(model->a_max[k], model->period, d));
  return (d > (dbk_real)0 ? inside : recovery) - model->tracking[k];
}

/* The bounds are the intersection of the velocity limits, the acceleration limits around u_prev, and the approach
 * speeds to the position limits at y. The acceleration limits have priority: if a position limit requires more, the
 * nearest control within the acceleration limits remains, and `conflict` is set. The loop covers DBK_MAX_DOF joints for
 * vectorisation; no function reads the results after the last joint. */
DBK_SIMD_CLONES void dbk_control_bounds(const dbk_model *model, const dbk_real y[DBK_MAX_DOF],
                                        const dbk_real u_prev[DBK_MAX_DOF], dbk_real lower[restrict DBK_MAX_DOF],
                                        dbk_real upper[restrict DBK_MAX_DOF], int32_t *conflict) {
  const dbk_real margin = model->rounding; /* [rad] */
  int32_t violated = 0;
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
    const dbk_real v = model->v_max[k], step = model->a_max[k] * model->period;
    const dbk_real low = dbk_max(-v, u_prev[k] - step), high = dbk_min(v, u_prev[k] + step);
    const dbk_real above = model->q_upper[k] - margin - y[k], below = y[k] - model->q_lower[k] - margin;
    const dbk_real to_upper = approach_speed(model, k, above);
    const dbk_real to_lower = -approach_speed(model, k, below);
    const dbk_real slack = (dbk_real)0.02 * step;
    violated |= (k < model->n) & (((above > (dbk_real)0) & (to_upper < low - slack)) |
                                  ((below > (dbk_real)0) & (to_lower > high + slack)));
    lower[k] = dbk_clamp(to_lower, low, high);
    upper[k] = dbk_clamp(to_upper, lower[k], high);
  }
  *conflict |= violated;
}

/* A stop with the maximum jerk, seen along the direction toward a position limit at distance d: the control changes by
 * c in this period, by c - J in the next one, by c - 2 J in the one after that, with J = j dt^2. After k periods
 *
 *   u_k = u + k c - J k (k - 1) / 2,   d_k = d - dt (u_1 + ... + u_k),
 *   u_1 + ... + u_k = k u + c k (k + 1) / 2 - J (k - 1) k (k + 1) / 6 */
typedef struct {
  dbk_real d, u, period, jump; /* jump: J */
} jerk_stop;

static inline dbk_real stop_control(const jerk_stop *s, dbk_real c, dbk_real k) {
  return s->u + k * c - (dbk_real)0.5 * s->jump * k * (k - (dbk_real)1);
}

static inline dbk_real stop_travel(const jerk_stop *s, dbk_real c, dbk_real k) {
  const dbk_real ramp = (k - (dbk_real)1) * k * (k + (dbk_real)1) / (dbk_real)6;
  return s->period * (k * s->u + (dbk_real)0.5 * c * k * (k + (dbk_real)1) - s->jump * ramp);
}

/* the largest integer that is not above x, at least 0; the result is bounded, also for NaN */
static inline dbk_real whole_periods(dbk_real x) {
  return x >= (dbk_real)0 ? (dbk_real)(int32_t)dbk_min(x, (dbk_real)1e6) : (dbk_real)0;
}

/* The largest c for which L c + c, c - J, c - 2 J, ... down to zero add up to at most d: the largest acceleration that
 * can be reduced to zero before the control changes by d, also if the arm does not receive the next L commands and
 * continues c meanwhile. The sum of L c and m terms is (L + m) c - J m (m - 1) / 2, and that of the positive terms is
 * its maximum over m. The smallest of these bounds on c is that of the largest m with (m - 1) (2 L + m) <= 2 d / J. */
static dbk_real largest_ramp(dbk_real jump, dbk_real d, dbk_real lost) {
  const dbk_real b = (dbk_real)2 * lost - (dbk_real)1, c = (dbk_real)2 * (lost + d / jump);
  const dbk_real terms = (dbk_real)0.5 * (dbk_sqrt(b * b + (dbk_real)4 * c) - b);
  const dbk_real m = dbk_max(whole_periods(terms), (dbk_real)1);
  return (d + (dbk_real)0.5 * jump * m * (m - (dbk_real)1)) / (m + lost);
}

/* The period k >= 1 of the stop in which u_k comes closest to the approach speed alpha d_(k-1) - tracking. The gap
 * between both changes by w(k) = -alpha dt u_k - c + k J from period k to k + 1, so it is smallest at the larger root
 * of this quadratic polynomial. */
static dbk_real closest_period(const jerk_stop *s, dbk_real alpha, dbk_real c) {
  const dbk_real g = alpha * s->period, p = (dbk_real)0.5 * g * s->jump;
  const dbk_real b = s->jump - g * c - p, z = g * s->u + c, square = b * b + (dbk_real)4 * p * z;
  if (!(square > (dbk_real)0)) { return (dbk_real)1; }
  const dbk_real root = dbk_sqrt(square);
  const dbk_real k = b > (dbk_real)0 ? (dbk_real)2 * z / (b + root) : (dbk_real)0.5 * (root - b) / p;
  return whole_periods(k) + (dbk_real)1;
}

/* the largest c for which u_k <= alpha d_(k-1) - tracking in period k of the stop */
static dbk_real largest_change(const jerk_stop *s, dbk_real alpha, dbk_real tracking, dbk_real k) {
  const dbk_real before = k - (dbk_real)1, g = alpha * s->period;
  const dbk_real travelled = before * s->u - s->jump * (before - (dbk_real)1) * before * k / (dbk_real)6;
  const dbk_real free = alpha * s->d - g * travelled - tracking - s->u + (dbk_real)0.5 * s->jump * k * before;
  return free / (k + (dbk_real)0.5 * g * k * before);
}

/* The largest change c in [low, high] from which the stop keeps u_k <= alpha d_(k-1) - tracking in every period. The
 * result is below `low` if even `low` does not. The minimum over k of functions that are linear in c is concave, so the
 * iteration (Newton) approaches its root from above; a few steps suffice. */
static dbk_real approach_change(const jerk_stop *s, dbk_real alpha, dbk_real tracking, dbk_real low, dbk_real high) {
  dbk_real c = high;
  for (int32_t tries = 0; tries < DBK_STOP_TRIES; ++tries) {
    const dbk_real k = closest_period(s, alpha, c);
    const dbk_real first = largest_change(s, alpha, tracking, (dbk_real)1);
    const dbk_real most = dbk_min(first, largest_change(s, alpha, tracking, k));
    if (most >= c) { break; }
    c = most;
    if (!(c >= low)) { break; }
  }
  return c;
}

/* 1: the stop that begins with the change c, with the deceleration limited to `step` per period, ends before the
 * position limit */
static int32_t stops_in_time(const jerk_stop *s, dbk_real step, dbk_real c) {
  const dbk_real half = c + (dbk_real)0.5 * s->jump;
  if (s->u + c <= (dbk_real)0) { return 1; }
  const dbk_real ramp = whole_periods((c + step) / s->jump);
  const dbk_real rest = whole_periods((half + dbk_sqrt(half * half + (dbk_real)2 * s->jump * s->u)) / s->jump);
  const dbk_real k = dbk_min(ramp, rest), left = dbk_max(stop_control(s, c, k), (dbk_real)0);
  const dbk_real braking = rest <= ramp ? (dbk_real)0 : left * left * s->period / ((dbk_real)2 * step);
  return stop_travel(s, c, k) + braking <= s->d;
}

/* The upper bound of the change in [low, high] toward a position limit: the approach within the jerk limit. If the
 * state leaves no room for it (the joint did not follow), the bound is the hardest braking within the jerk limit, as
 * long as the joint stops before the limit. *fits is set to 0 if it does not. */
static dbk_real change_toward(const jerk_stop *s, dbk_real alpha, dbk_real tracking, dbk_real step, dbk_real low,
                              dbk_real high, int32_t *fits) {
  const dbk_real c = approach_change(s, alpha, tracking, low, high);
  if (c >= low) { return c; }
  *fits &= stops_in_time(s, step, low);
  return low;
}

/* largest change of the change of the control in one period, without the rounding of the control */
static dbk_real jerk_step(const dbk_model *model, int32_t k) {
  const dbk_real jump = model->j_max[k] * model->period * model->period;
  return dbk_max(jump - DBK_CONTROL_ROUNDING * model->v_max[k], (dbk_real)0.5 * jump);
}

/* the same for later periods: slightly smaller, so that rounding leaves room in each of them */
static dbk_real planned_jerk_step(const dbk_model *model, int32_t k) {
  const dbk_real jump = jerk_step(model, k), rounding = (dbk_real)2 * DBK_CONTROL_ROUNDING * model->v_max[k];
  return dbk_max(jump - (dbk_real)2e-3 * jump - rounding, (dbk_real)0.5 * jump);
}

dbk_real dbk_velocity_ramp(const dbk_model *model, int32_t k, dbk_real room) {
  return largest_ramp(planned_jerk_step(model, k), dbk_max(room, (dbk_real)0), DBK_LOST_COMMANDS);
}

/* The change of the control stays within u_change -+ j dt^2. In addition, it is limited such that no later period needs
 * a higher jerk: the acceleration toward v_max can be reduced to zero before the joint reaches v_max, and the approach
 * to a position limit stays below alpha d - tracking if the joint brakes with the maximum jerk from the next period on.
 * The gain is limited to the one that the acceleration limit can follow at v_max. */
int32_t dbk_jerk_bounds(const dbk_model *model, const dbk_real y[DBK_MAX_DOF], const dbk_real u_prev[DBK_MAX_DOF],
                        const dbk_real u_change[DBK_MAX_DOF], dbk_real lower[DBK_MAX_DOF],
                        dbk_real upper[DBK_MAX_DOF]) {
  const dbk_real dt = model->period;
  int32_t feasible = 1;
  for (int32_t k = 0; k < model->n; ++k) {
    if (!(model->j_max[k] > (dbk_real)0)) { continue; }
    const dbk_real v = model->v_max[k], u = u_prev[k], rounding = DBK_CONTROL_ROUNDING * v;
    const dbk_real jump = jerk_step(model, k), step = model->a_max[k] * dt - rounding;
    const dbk_real planned = planned_jerk_step(model, k);
    const dbk_real up = dbk_velocity_ramp(model, k, v - u), down = dbk_velocity_ramp(model, k, v + u);
    const dbk_real low = dbk_max(u_change[k] - jump, dbk_min(-down, u_change[k] + jump));
    const dbk_real high = dbk_min(u_change[k] + jump, dbk_max(up, u_change[k] - jump));
    /* the changes within the velocity and acceleration limits */
    const dbk_real slow = dbk_max(low, dbk_max(-v - u, -step)), most = dbk_min(high, dbk_min(v - u, step));
    const dbk_real least = slow > most && slow <= most + rounding ? most : slow;
    /* beyond a limit the joint returns at a limited speed */
    const dbk_real alpha = dbk_min(model->alpha_joint, model->a_max[k] / v), margin = model->rounding;
    const dbk_real beyond = -(dbk_real)4 * model->recovery / alpha;
    const jerk_stop to_upper = {dbk_max(model->q_upper[k] - margin - y[k], beyond), u, dt, planned};
    const jerk_stop to_lower = {dbk_max(y[k] - model->q_lower[k] - margin, beyond), -u, dt, planned};
    int32_t fits = least <= most;
    const dbk_real above = change_toward(&to_upper, alpha, model->tracking[k], step, least, most, &fits);
    const dbk_real below = -change_toward(&to_lower, alpha, model->tracking[k], step, -most, -least, &fits);
    if (!fits || below > above) {
      feasible = 0;
      continue;
    }
    lower[k] = dbk_clamp(u + below, -v, v);
    upper[k] = dbk_clamp(u + above, lower[k], v);
  }
  return feasible;
}

void dbk_limit_brake_jerk(const dbk_model *model, const dbk_real u_prev[DBK_MAX_DOF],
                          const dbk_real u_change[DBK_MAX_DOF], dbk_real u[DBK_MAX_DOF]) {
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real step = model->a_max[k] * model->period, v = model->v_max[k];
    if (!(model->j_max[k] > (dbk_real)0)) { continue; }
    const dbk_real jump = jerk_step(model, k), most = largest_ramp(jump, dbk_abs(u_prev[k]), (dbk_real)0);
    const dbk_real change = dbk_clamp(u[k] - u_prev[k], -most, most);
    const dbk_real low = dbk_max(u_change[k] - jump, -step), high = dbk_min(u_change[k] + jump, step);
    u[k] = dbk_clamp(u_prev[k] + dbk_clamp(change, low, high), -v, v);
  }
}

/* Maximum deceleration along the direction of motion: all joint velocities are scaled by the same factor, so no pair
 * closes faster than before. One joint decelerates at its limit, and all joints reach zero at the same time. */
void dbk_brake(const dbk_model *model, const dbk_real u_prev[DBK_MAX_DOF], dbk_real u[DBK_MAX_DOF]) {
  dbk_real factor = (dbk_real)0;
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real step = model->a_max[k] * model->period, speed = dbk_abs(u_prev[k]);
    if (speed > step) { factor = dbk_max(factor, (dbk_real)1 - step / speed); }
  }
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real step = model->a_max[k] * model->period;
    u[k] = dbk_clamp(factor * u_prev[k], u_prev[k] - step, u_prev[k] + step);
  }
}
