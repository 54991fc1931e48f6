/* The row of one pair: a moving sphere and another body (an obstacle or another sphere of the robot). */
#ifndef DBK_PAIRS_H
#define DBK_PAIRS_H

#include "dbk_math.h"
#include "distance/dbk_approach_speed.h"

#define DBK_BATCH_CAPACITY (DBK_SPHERE_CAPACITY > DBK_OBSTACLE_CAPACITY ? DBK_SPHERE_CAPACITY : DBK_OBSTACLE_CAPACITY)
enum { DBK_MANY_SPHERES = -1 }; /* value of dbk_pair_batch.sphere if the sphere varies within the batch */

/* A batch of pairs, as a structure of arrays. One side is common to all pairs: the moving sphere, or the other body
 * (then `sphere` is DBK_MANY_SPHERES); `index` is the varying side. Both are numbered as in dbk_active. */
typedef struct {
  int32_t count, kind, sphere, other;
  int32_t first_joint, end_joint; /* joints first_joint..end_joint-1 move the pairs */
  dbk_real h[DBK_BATCH_CAPACITY], nx[DBK_BATCH_CAPACITY], ny[DBK_BATCH_CAPACITY], nz[DBK_BATCH_CAPACITY];
  dbk_real rhs[DBK_BATCH_CAPACITY];
  /* minimum of n'v - rhs over the trust region; < 0: a control can violate the row */
  dbk_real headroom[DBK_BATCH_CAPACITY];
  int32_t index[DBK_BATCH_CAPACITY], keep[DBK_BATCH_CAPACITY], clip[DBK_BATCH_CAPACITY];
} dbk_pair_batch;

/* motion of the moving sphere: velocity at the centre of the trust region, acceleration at the centre of the control
 * bounds, and the maximum change of the velocity within the trust region */
typedef struct {
  dbk_real r, vx, vy, vz, ax, ay, az, spread;
} dbk_point_motion;

static inline dbk_point_motion dbk_point_motion_of(const dbk_ctx *ctx, int32_t s) {
  const dbk_sphere_motion *m = &ctx->motion;
  const dbk_point_motion motion = {ctx->spheres.r[s], m->vx[s], m->vy[s], m->vz[s],
                                   m->ax[s],          m->ay[s], m->az[s], m->spread[s]};
  return motion;
}

/* row parameters of the other body and of the model; `recovery` limits the right side for h < 0 */
typedef struct {
  dbk_real margin, alpha, braking_gain, arc_share, recovery, velocity_error, half_period, vx, vy, vz;
} dbk_row_terms;

typedef struct {
  dbk_real h, rhs, headroom;
} dbk_row_bound;

/* Computes h, the right side and the headroom of the row of a sphere at distance d along the outward normal n:
 *
 *   rhs = min(-s, recovery) + n'v_o + velocity_error + max(0, -dt/2 n'a),   s = dbk_approach_speed
 *
 * If the other body is `at_rest`, its velocity and velocity error are ignored. */
static inline dbk_row_bound dbk_bound_row(const dbk_point_motion *m, const dbk_row_terms *t, int32_t at_rest,
                                          dbk_real d, dbk_real nx, dbk_real ny, dbk_real nz) {
  const dbk_real h = d - m->r - t->margin;
  const dbk_real along_normal = -t->half_period * (nx * m->ax + ny * m->ay + nz * m->az);
  const dbk_real sampling_term = along_normal > (dbk_real)0 ? along_normal : (dbk_real)0;
  const dbk_real away = -dbk_approach_speed(t->alpha, t->braking_gain, t->arc_share, h, sampling_term);
  const dbk_real barrier = away < t->recovery ? away : t->recovery;
  const dbk_real with_drift = at_rest ? barrier : barrier + (nx * t->vx + ny * t->vy + nz * t->vz) + t->velocity_error;
  const dbk_real rhs = with_drift + sampling_term;
  const dbk_real rate = nx * m->vx + ny * m->vy + nz * m->vz;
  const dbk_row_bound bound = {h, rhs, rate - m->spread - rhs};
  return bound;
}

/* 1: a control within the trust region can violate the row, or the pair is closer than the cull floor. A NaN keeps the
 * row, and the row then fails the independent check. `permitted`: contact is permitted, so closeness alone does not
 * matter */
static inline int32_t dbk_row_may_bind(const dbk_row_bound *bound, int32_t permitted) {
  const int32_t violable = !(bound->headroom >= (dbk_real)0), close = !(bound->h >= DBK_CULL_FLOOR);
  return violable | (close & !permitted);
}

#endif
