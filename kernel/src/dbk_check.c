/* The independent check of a control, and the certificate of the next step. Neither trusts the solver. */
#include "dbk_math.h"

/* finite, inside the box, every row met to `tolerance`; a NaN anywhere answers 0 */
DBK_WIDE int32_t dbk_check(const dbk_rows *rows, int32_t n, const dbk_real lower[DBK_MAX_DOF],
                           const dbk_real upper[DBK_MAX_DOF], const dbk_real u[DBK_MAX_DOF], dbk_real tolerance) {
  dbk_real value[DBK_ROW_ROOM];
  const int32_t count = DBK_PADDED(rows->count); /* empty rows fill the last vector */
  int32_t good = 1, k = 0;
  for (int32_t i = 0; i < n; ++i) { good &= dbk_finite(u[i]) && u[i] >= lower[i] && u[i] <= upper[i]; }
  for (int32_t r = 0; r < count; ++r) { value[r] = tolerance - rows->b[r]; }
  for (; k + 1 < n; k += 2) { /* two columns at a time */
    const dbk_real *restrict a = rows->a[k], *restrict b = rows->a[k + 1];
    const dbk_real ua = u[k], ub = u[k + 1];
    for (int32_t r = 0; r < count; ++r) { value[r] = (value[r] + a[r] * ua) + b[r] * ub; }
  }
  for (; k < n; ++k) {
    for (int32_t r = 0; r < count; ++r) { value[r] += rows->a[k][r] * u[k]; }
  }
  for (int32_t r = 0; r < count; ++r) { good &= value[r] >= (dbk_real)0; }
  return good;
}

typedef struct {
  dbk_obstacle now, next;
  dbk_real margin_now, margin_next;
} moment;

/* the smallest h of spheres first..first+count-1 at the next step stays >= 0, or no deeper than it is now */
static int32_t kept(const dbk_cloud *now, const dbk_cloud *next, const moment *m, int32_t first, int32_t count) {
  dbk_real d[DBK_ALL_SPHERES], nx[DBK_ALL_SPHERES], ny[DBK_ALL_SPHERES], nz[DBK_ALL_SPHERES];
  int32_t good = 1;
  dbk_distance(&m->next, count, next->x + first, next->y + first, next->z + first, d, nx, ny, nz);
  for (int32_t s = 0; s < count; ++s) {
    const dbk_real h = d[s] - next->r[first + s] - m->margin_next;
    if (!(h >= (dbk_real)0)) {
      dbk_real before, x, y, z;
      dbk_distance(&m->now, 1, now->x + first + s, now->y + first + s, now->z + first + s, &before, &x, &y, &z);
      good &= h >= before - now->r[first + s] - m->margin_now;
    }
  }
  return good;
}

static void ball(const dbk_cloud *cloud, int32_t i, dbk_obstacle *out) {
  const dbk_obstacle shape = {.shape = DBK_CAPSULE, .flags = DBK_STATIC, .radius = cloud->r[i],
                              .position = {cloud->x[i], cloud->y[i], cloud->z[i]}};
  *out = shape;
}

/* h(y + dt u) >= 0 for every pair that was not culled; obstacles move on for one period as well */
int32_t dbk_certify(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                    const dbk_real u[DBK_MAX_DOF]) {
  dbk_real y[DBK_MAX_DOF];
  dbk_frames frames;
  int32_t good = 1;
  if (ctx->visits.count == 0) { return 1; }
  for (int32_t k = 0; k < model->n; ++k) { y[k] = (in->q[k] + model->lag * in->v[k]) + model->period * u[k]; }
  dbk_base(in, &frames);
  dbk_fk(model, y, &frames);
  dbk_spheres(model, scene, &frames, in->opening, &ctx->next);
  for (int32_t c = 0; c < ctx->visits.count; ++c) {
    const int32_t first = ctx->visits.first[c], count = ctx->visits.spheres[c], other = ctx->visits.other[c];
    const dbk_real held_error = first >= model->n_spheres ? scene->held_error : (dbk_real)0;
    moment m;
    if (other >= 0) {
      const dbk_obstacle *o = &scene->obstacle[other];
      m.now = *o;
      m.next = *o;
      for (int32_t e = 0; e < 3; ++e) {
        m.now.position[e] += o->velocity[e] * in->scene_age;
        m.next.position[e] += o->velocity[e] * (in->scene_age + model->period);
      }
      m.margin_now = o->margin + o->velocity_error * in->scene_age + model->rounding + held_error;
      m.margin_next = m.margin_now + o->velocity_error * model->period;
      good &= kept(&ctx->cloud, &ctx->next, &m, first, count);
    } else {
      m.margin_now = m.margin_next = model->self_margin + model->rounding + held_error;
      ball(&ctx->cloud, -1 - other, &m.now);
      ball(&ctx->next, -1 - other, &m.next);
      good &= kept(&ctx->cloud, &ctx->next, &m, first, count);
    }
  }
  return good;
}
