/* Independent check of a control, and the certificate of the next state. Both are independent of the QP solver. */
#include "qp/dbk_certificate.h"

#include "distance/dbk_distance.h"
#include "model/dbk_kinematics.h"

DBK_SIMD_CLONES int32_t dbk_check(const dbk_rows *rows, int32_t n, const dbk_real lower[DBK_MAX_DOF],
                                  const dbk_real upper[DBK_MAX_DOF], const dbk_real u[DBK_MAX_DOF],
                                  dbk_real tolerance) {
  dbk_real value[DBK_ROW_CAPACITY];
  const int32_t count = DBK_PADDED(rows->count); /* the padding rows never fail */
  int32_t valid = 1, k = 0;
  for (int32_t i = 0; i < n; ++i) { valid &= dbk_finite(u[i]) && u[i] >= lower[i] && u[i] <= upper[i]; }
  for (int32_t r = 0; r < count; ++r) { value[r] = tolerance - rows->b[r]; }
  for (; k + 1 < n; k += 2) { /* two columns at a time */
    const dbk_real *restrict a = rows->a[k], *restrict b = rows->a[k + 1];
    const dbk_real ua = u[k], ub = u[k + 1];
    for (int32_t r = 0; r < count; ++r) { value[r] = (value[r] + a[r] * ua) + b[r] * ub; }
  }
  for (; k < n; ++k) {
    for (int32_t r = 0; r < count; ++r) { value[r] += rows->a[k][r] * u[k]; }
  }
  for (int32_t r = 0; r < count; ++r) { valid &= value[r] >= (dbk_real)0; }
  return valid;
}

/* the other body of a group of pairs, now and after one period */
typedef struct {
  dbk_obstacle now, next;
  dbk_real margin_now, margin_next;
  int32_t fixed; /* a static obstacle */
} body_prediction;

/* Decrease of h [m] that no joint causes: a static obstacle that touches the mount of the robot, such as the floor below
 * the first link, keeps its distance in every posture, up to a gradient that counts as zero and the rounding of both
 * distances. 0 for all other pairs. */
static dbk_real allowance_of(const dbk_model *model, const dbk_ctx *ctx, const body_prediction *p, int32_t s,
                            const dbk_real n[3]) {
  if (!p->fixed || model->sphere_frame[s] > 1) { return (dbk_real)0; }
  const dbk_real *r = ctx->frames.rotation[1], *o = ctx->frames.origin[1];
  const dbk_real x = ctx->spheres.x[s] - o[0], y = ctx->spheres.y[s] - o[1], z = ctx->spheres.z[s] - o[2];
  dbk_real v[3] = {r[2], r[5], r[8]}; /* velocity of the centre per unit speed of the first joint */
  if (model->joint_kind[0] == DBK_REVOLUTE) {
    v[0] = r[5] * z - r[8] * y;
    v[1] = r[8] * x - r[2] * z;
    v[2] = r[2] * y - r[5] * x;
  }
  const dbk_real gradient = dbk_abs(n[0] * v[0] + n[1] * v[1] + n[2] * v[2]);
  const dbk_real allowance = DBK_ZERO_GRADIENT * model->v_max[0] * model->period + DBK_MOUNT_ROUNDING;
  return gradient <= DBK_ZERO_GRADIENT ? allowance : (dbk_real)0;
}

/* 1: every sphere first..first+count-1 has h >= 0 at the next state, or an h no smaller than now.
 * ctx->rejected_pair receives the last sphere that fails. */
static int32_t stays_safe(const dbk_model *model, dbk_ctx *ctx, const body_prediction *p, int32_t first,
                          int32_t count) {
  const dbk_sphere_set *now = &ctx->spheres, *next = &ctx->next_spheres;
  dbk_real d[DBK_ALL_SPHERES], nx[DBK_ALL_SPHERES], ny[DBK_ALL_SPHERES], nz[DBK_ALL_SPHERES];
  int32_t safe = 1;
  dbk_distance(&p->next, count, next->x + first, next->y + first, next->z + first, d, nx, ny, nz);
  for (int32_t i = 0; i < count; ++i) {
    const int32_t s = first + i;
    if (s >= DBK_ALL_SPHERES) { return 0; } /* no sphere; no group has one */
    const dbk_real h = d[i] - next->r[s] - p->margin_next;
    if (!(h >= (dbk_real)0)) {
      dbk_real before, n[3];
      dbk_distance(&p->now, 1, now->x + s, now->y + s, now->z + s, &before, n, n + 1, n + 2);
      const dbk_real h_now = before - now->r[s] - p->margin_now;
      if (!(h >= h_now - allowance_of(model, ctx, p, s, n))) {
        ctx->rejected_pair.i = s;
        ctx->rejected_pair.h = h_now;
        ctx->rejected_pair.next = h;
        safe = 0;
      }
    }
  }
  return safe;
}

/* sphere i of the robot as an obstacle */
static void sphere_obstacle(const dbk_sphere_set *spheres, int32_t i, dbk_obstacle *out) {
  const dbk_obstacle shape = {.shape = DBK_CAPSULE,
                              .flags = DBK_STATIC,
                              .radius = spheres->r[i],
                              .position = {spheres->x[i], spheres->y[i], spheres->z[i]}};
  *out = shape;
}

/* The next state is y + dt u with the lag-compensated state y = q + lag v; obstacles move on for one period. Culled
 * pairs cannot reach h = 0 within one period. */
int32_t dbk_certify(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                    const dbk_real u[DBK_MAX_DOF]) {
  dbk_real y[DBK_MAX_DOF];
  dbk_frames frames;
  int32_t safe = 1;
  const int32_t n_groups = dbk_bounded(ctx->revisits.count, DBK_MAX_REVISITS);
  if (n_groups == 0) { return 1; }
  for (int32_t k = 0; k < model->n; ++k) { y[k] = (in->q[k] + model->lag * in->v[k]) + model->period * u[k]; }
  dbk_base_frame(in, &frames);
  dbk_fk(model, y, &frames);
  dbk_spheres(model, scene, &frames, in->opening, &ctx->next_spheres);
  for (int32_t c = 0; c < n_groups; ++c) {
    const int32_t first = dbk_bounded(ctx->revisits.first_sphere[c], DBK_ALL_SPHERES - 1);
    const int32_t count = dbk_bounded(ctx->revisits.n_spheres[c], DBK_ALL_SPHERES), other = ctx->revisits.other[c];
    const dbk_real held_error = first >= model->n_spheres ? scene->held_error : (dbk_real)0;
    body_prediction p;
    if (other >= 0) {
      /* an obstacle at constant velocity */
      const dbk_obstacle *o = &scene->obstacle[dbk_bounded(other, DBK_MAX_OBSTACLES - 1)];
      p.now = *o;
      p.next = *o;
      p.fixed = (o->flags & DBK_STATIC) != 0;
      for (int32_t e = 0; e < 3; ++e) {
        p.now.position[e] += o->velocity[e] * in->scene_age;
        p.next.position[e] += o->velocity[e] * (in->scene_age + model->period);
      }
      p.margin_now = o->margin + o->velocity_error * dbk_max(in->scene_age, (dbk_real)0) + model->rounding + held_error;
      p.margin_next = p.margin_now + o->velocity_error * model->period;
    } else {
      /* a sphere of the robot */
      p.fixed = 0;
      p.margin_now = p.margin_next = model->self_margin + model->rounding + held_error;
      const int32_t sphere = dbk_bounded(-1 - other, DBK_ALL_SPHERES - 1);
      sphere_obstacle(&ctx->spheres, sphere, &p.now);
      sphere_obstacle(&ctx->next_spheres, sphere, &p.next);
    }
    if (!stays_safe(model, ctx, &p, first, count)) {
      ctx->rejected_pair.kind = other >= 0 ? DBK_ROW_OBSTACLE : DBK_ROW_SELF;
      ctx->rejected_pair.j = other >= 0 ? other : -1 - other;
      safe = 0;
    }
  }
  return safe;
}
