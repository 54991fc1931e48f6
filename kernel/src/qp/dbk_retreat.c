/* Retreat from approaching obstacles (viability). The row of an obstacle permits an approach speed at h > 0. If an
 * obstacle starts to move toward the robot, the joints need some periods to reach the speeds that its rows require. No
 * control satisfies the rows in the meantime, although the robot evades: a retreat that goes on with the acceleration
 * of this period ends the approach at the closing speed c before h = 0 if
 *
 *   c <= sqrt((A dt / 2)^2 + 2 A h) - A dt / 2,   A = share a'(u - u_prev) / dt,
 *
 * and if the joints can reach the speed of the obstacle along the row. */
#include "qp/dbk_retreat.h"

#include "distance/dbk_approach_speed.h"

/* fraction of the acceleration that the retreat may need: the obstacle may accelerate further */
#define RETREAT_SHARE ((dbk_real)0.5)

/* approach speed that the row of an obstacle permits at h > 0 [m/s] */
static dbk_real permitted_speed(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx, int32_t r,
                                dbk_real h) {
  const dbk_rows *rows = &ctx->rows;
  const dbk_sphere_motion *m = &ctx->motion;
  const int32_t s = dbk_bounded(rows->i[r], DBK_ALL_SPHERES - 1);
  const int32_t o = dbk_bounded(rows->j[r], DBK_OBSTACLE_CAPACITY - 1);
  const dbk_real own_alpha = scene->capsules.alpha[o], alpha = own_alpha > (dbk_real)0 ? own_alpha : model->alpha;
  const dbk_real along = rows->nx[r] * m->ax[s] + rows->ny[r] * m->ay[s] + rows->nz[r] * m->az[s];
  const dbk_real sampling_term = dbk_max((dbk_real)-0.5 * model->period * along, (dbk_real)0);
  return dbk_approach_speed(alpha, model->braking_gain, model->arc_share, h, sampling_term);
}

/* 1: u begins a retreat that ends the approach of row r in time. With |a| = 1 all values are divided by the norm of the
 * row: h is in rad, speeds are in rad/s */
static int32_t ends_approach(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx, int32_t r, dbk_real b,
                             const dbk_real *u_prev, const dbk_real *u) {
  const dbk_rows *rows = &ctx->rows;
  if (rows->kind[r] != DBK_ROW_OBSTACLE || !rows->moving[r] || rows->clip[r]) { return 0; }
  const dbk_real distance = rows->h[r] - model->sampling, h = distance / rows->norm[r];
  dbk_real speed = (dbk_real)0, gain = (dbk_real)0, fastest = (dbk_real)0;
  if (!(h > (dbk_real)0)) { return 0; }
  for (int32_t k = 0; k < model->n; ++k) {
    speed += rows->a[k][r] * u[k];
    gain += rows->a[k][r] * (u[k] - u_prev[k]);
    fastest += dbk_abs(rows->a[k][r]) * model->v_max[k];
  }
  /* a'u that ends the approach */
  const dbk_real required = b + permitted_speed(model, scene, ctx, r, distance) / rows->norm[r];
  const dbk_real half = (dbk_real)0.5 * RETREAT_SHARE * dbk_max(gain, (dbk_real)0);
  const dbk_real closing = dbk_sqrt(half * half + (dbk_real)4 * half * h / model->period) - half;
  return required - speed <= closing && required <= fastest;
}

int32_t dbk_retreats_in_time(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx, const dbk_real *b,
                             int32_t count, const dbk_real u_prev[DBK_MAX_DOF], const dbk_real u[DBK_MAX_DOF]) {
  const dbk_rows *rows = &ctx->rows;
  for (int32_t r = 0; r < count; ++r) {
    dbk_real speed = (dbk_real)0;
    for (int32_t k = 0; k < model->n; ++k) { speed += rows->a[k][r] * u[k]; }
    const int32_t satisfied = speed >= b[r] - DBK_CHECK_TOL;
    if (!satisfied && !ends_approach(model, scene, ctx, r, b[r], u_prev, u)) { return 0; }
  }
  return 1;
}
