/* The box of admissible controls, and braking inside it. */
#include "dbk_math.h"

/* speed from which a joint still stops within distance d when it brakes by a once per period (discrete braking) */
static dbk_real braking_speed(dbk_real a, dbk_real period, dbk_real d) {
  const dbk_real half = (dbk_real)0.5 * a * period;
  return dbk_sqrt(half * half + (dbk_real)2 * a * d) - half;
}

/* greatest speed toward a limit at distance d: min(alpha d, v_b(d)); outside, the way back */
static inline dbk_real approach(const dbk_model *model, dbk_real a_max, dbk_real d) {
  const dbk_real linear = model->alpha_joint * d, back = dbk_max(linear, -(dbk_real)4 * model->recovery);
  const dbk_real in_time = dbk_min(linear, braking_speed(a_max, model->period, d));
  return (d > (dbk_real)0 ? in_time : back) - model->tracking;
}

/* velocity limit, acceleration around u_prev, joint position at y. The acceleration box is never left: where a position
 * limit asks for more than it gives, its nearest control remains, and `conflict` tells. All joints there could be are
 * taken in one go; what comes out behind the last one is never read. */
DBK_WIDE void dbk_box(const dbk_model *model, const dbk_real y[DBK_MAX_DOF], const dbk_real u_prev[DBK_MAX_DOF],
                      dbk_real lower[restrict DBK_MAX_DOF], dbk_real upper[restrict DBK_MAX_DOF], int32_t *conflict) {
  const dbk_real margin = model->rounding; /* [rad] */
  int32_t beyond = 0;
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
    const dbk_real v = model->v_max[k], step = model->a_max[k] * model->period;
    const dbk_real low = dbk_max(-v, u_prev[k] - step), high = dbk_min(v, u_prev[k] + step);
    const dbk_real above = model->q_upper[k] - margin - y[k], below = y[k] - model->q_lower[k] - margin;
    const dbk_real to_upper = approach(model, model->a_max[k], above);
    const dbk_real to_lower = -approach(model, model->a_max[k], below);
    const dbk_real slack = (dbk_real)0.02 * step;
    beyond |= (k < model->n) & (((above > (dbk_real)0) & (to_upper < low - slack)) |
                                ((below > (dbk_real)0) & (to_lower > high + slack)));
    lower[k] = dbk_clamp(to_lower, low, high);
    upper[k] = dbk_clamp(to_upper, lower[k], high);
  }
  *conflict |= beyond;
}

/* u_prev + change -+ j dt^2, and no faster toward v_max than the acceleration can still be taken back in time */
int32_t dbk_jerk_box(const dbk_model *model, const dbk_real u_prev[DBK_MAX_DOF], const dbk_real change[DBK_MAX_DOF],
                     dbk_real lower[DBK_MAX_DOF], dbk_real upper[DBK_MAX_DOF]) {
  const dbk_real dt = model->period;
  int32_t room = 1;
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real j = model->j_max[k];
    if (!(j > (dbk_real)0)) { continue; }
    const dbk_real twist = j * dt * dt;
    const dbk_real up = dt * braking_speed(j, dt, dbk_max(model->v_max[k] - u_prev[k], (dbk_real)0));
    const dbk_real down = dt * braking_speed(j, dt, dbk_max(model->v_max[k] + u_prev[k], (dbk_real)0));
    const dbk_real low = u_prev[k] + dbk_max(change[k] - twist, dbk_min(-down, change[k] + twist));
    const dbk_real high = u_prev[k] + dbk_min(change[k] + twist, dbk_max(up, change[k] - twist));
    if (low > upper[k] || high < lower[k]) {
      room = 0;
      continue;
    }
    lower[k] = dbk_max(lower[k], low);
    upper[k] = dbk_min(upper[k], high);
  }
  return room;
}

/* hardest braking that keeps the direction of motion: every joint slows by the same factor, so that no row is approached
 * faster than before; one joint brakes with its full acceleration, all stop together */
void dbk_brake(const dbk_model *model, const dbk_real u_prev[DBK_MAX_DOF], dbk_real u[DBK_MAX_DOF]) {
  dbk_real keep = (dbk_real)0;
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real step = model->a_max[k] * model->period, size = dbk_abs(u_prev[k]);
    if (size > step) { keep = dbk_max(keep, (dbk_real)1 - step / size); }
  }
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real step = model->a_max[k] * model->period;
    u[k] = dbk_clamp(keep * u_prev[k], u_prev[k] - step, u_prev[k] + step);
  }
}
