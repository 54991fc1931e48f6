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
static inline dbk_real approach_speed(const dbk_model *model, dbk_real a_max, dbk_real d) {
  const dbk_real linear = model->alpha_joint * d, recovery = dbk_max(linear, -(dbk_real)4 * model->recovery);
  const dbk_real inside = dbk_min(linear, braking_speed(a_max, model->period, d));
  return (d > (dbk_real)0 ? inside : recovery) - model->tracking;
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
    const dbk_real to_upper = approach_speed(model, model->a_max[k], above);
    const dbk_real to_lower = -approach_speed(model, model->a_max[k], below);
    const dbk_real slack = (dbk_real)0.02 * step;
    violated |= (k < model->n) & (((above > (dbk_real)0) & (to_upper < low - slack)) |
                                  ((below > (dbk_real)0) & (to_lower > high + slack)));
    lower[k] = dbk_clamp(to_lower, low, high);
    upper[k] = dbk_clamp(to_upper, lower[k], high);
  }
  *conflict |= violated;
}

/* The change of the control stays within u_change -+ j dt^2. In addition, the acceleration toward v_max is limited such
 * that it can be reduced to zero before the joint reaches v_max. */
int32_t dbk_jerk_bounds(const dbk_model *model, const dbk_real u_prev[DBK_MAX_DOF],
                        const dbk_real u_change[DBK_MAX_DOF], dbk_real lower[DBK_MAX_DOF],
                        dbk_real upper[DBK_MAX_DOF]) {
  const dbk_real dt = model->period;
  int32_t feasible = 1;
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real j = model->j_max[k];
    if (!(j > (dbk_real)0)) { continue; }
    const dbk_real step = j * dt * dt;
    const dbk_real up = dt * braking_speed(j, dt, dbk_max(model->v_max[k] - u_prev[k], (dbk_real)0));
    const dbk_real down = dt * braking_speed(j, dt, dbk_max(model->v_max[k] + u_prev[k], (dbk_real)0));
    const dbk_real low = u_prev[k] + dbk_max(u_change[k] - step, dbk_min(-down, u_change[k] + step));
    const dbk_real high = u_prev[k] + dbk_min(u_change[k] + step, dbk_max(up, u_change[k] - step));
    if (low > upper[k] || high < lower[k]) {
      feasible = 0;
      continue;
    }
    lower[k] = dbk_max(lower[k], low);
    upper[k] = dbk_min(upper[k], high);
  }
  return feasible;
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
