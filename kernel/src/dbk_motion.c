/* How every sphere moves under the controls of the box: velocity and acceleration at the middle of the box, and how far
 * any control of the box can change the velocity. This is what tells which rows may bind in this step. */
#include "dbk_math.h"

typedef struct {
  dbk_real w[3], v[3], dw[3], dv[3]; /* spatial velocity and acceleration about the base origin at constant u */
} spatial;

static void cross(const dbk_real a[3], const dbk_real b[3], dbk_real out[3]) {
  out[0] = a[1] * b[2] - a[2] * b[1];
  out[1] = a[2] * b[0] - a[0] * b[2];
  out[2] = a[0] * b[1] - a[1] * b[0];
}

/* frame i+1 = frame i plus a slide at rate u along axis z; the axis itself turns with frame i */
static void add_slide(const spatial *parent, const dbk_real z[3], dbk_real u, spatial *child) {
  dbk_real dz[3];
  cross(parent->w, z, dz);
  *child = *parent;
  for (int32_t e = 0; e < 3; ++e) {
    child->v[e] += u * z[e];
    child->dv[e] += u * dz[e];
  }
}

/* frame i+1 = frame i plus a turn at rate u about axis z through p; the axis itself moves with frame i */
static void add_turn(const spatial *parent, const dbk_real z[3], const dbk_real p[3], dbk_real u, spatial *child) {
  dbk_real moment[3], dz[3], dp[3], wp[3], a[3], b[3];
  cross(p, z, moment); /* velocity at the origin of a unit turn: -z x p */
  cross(parent->w, z, dz);
  cross(parent->w, p, wp);
  for (int32_t e = 0; e < 3; ++e) { dp[e] = parent->v[e] + wp[e]; }
  cross(dp, z, a);
  cross(p, dz, b);
  for (int32_t e = 0; e < 3; ++e) {
    child->w[e] = parent->w[e] + u * z[e];
    child->v[e] = parent->v[e] + u * moment[e];
    child->dw[e] = parent->dw[e] + u * dz[e];
    child->dv[e] = parent->dv[e] + u * (a[e] + b[e]);
  }
}

/* centre velocity v + w x c and acceleration dv + dw x c + w x (centre velocity) of the spheres first..last-1 */
static void move(const spatial *t, const dbk_cloud *cloud, int32_t first, int32_t last, dbk_motion *out) {
  const dbk_real wx = t->w[0], wy = t->w[1], wz = t->w[2], vx = t->v[0], vy = t->v[1], vz = t->v[2];
  const dbk_real ax = t->dw[0], ay = t->dw[1], az = t->dw[2], bx = t->dv[0], by = t->dv[1], bz = t->dv[2];
  for (int32_t s = first; s < last; ++s) {
    const dbk_real x = cloud->x[s], y = cloud->y[s], z = cloud->z[s];
    const dbk_real ux = vx + (wy * z - wz * y), uy = vy + (wz * x - wx * z), uz = vz + (wx * y - wy * x);
    out->vx[s] = ux;
    out->vy[s] = uy;
    out->vz[s] = uz;
    out->ax[s] = bx + (ay * z - az * y) + (wy * uz - wz * uy);
    out->ay[s] = by + (az * x - ax * z) + (wz * ux - wx * uz);
    out->az[s] = bz + (ax * y - ay * x) + (wx * uy - wy * ux);
  }
}

/* one ball around the spheres of a link, and the greatest speed among them */
static void bound(const dbk_cloud *cloud, int32_t first, int32_t last, dbk_real half_period, int32_t link,
                  dbk_motion *out) {
  dbk_real lo[3] = {cloud->x[first], cloud->y[first], cloud->z[first]};
  dbk_real hi[3] = {lo[0], lo[1], lo[2]};
  for (int32_t s = first; s < last; ++s) {
    lo[0] = dbk_min(lo[0], cloud->x[s]);
    hi[0] = dbk_max(hi[0], cloud->x[s]);
    lo[1] = dbk_min(lo[1], cloud->y[s]);
    hi[1] = dbk_max(hi[1], cloud->y[s]);
    lo[2] = dbk_min(lo[2], cloud->z[s]);
    hi[2] = dbk_max(hi[2], cloud->z[s]);
  }
  const dbk_real half = (dbk_real)0.5;
  const dbk_real cx = half * (lo[0] + hi[0]), cy = half * (lo[1] + hi[1]), cz = half * (lo[2] + hi[2]);
  dbk_real radius = (dbk_real)0, speed = (dbk_real)0;
  for (int32_t s = first; s < last; ++s) {
    const dbk_real x = cloud->x[s] - cx, y = cloud->y[s] - cy, z = cloud->z[s] - cz;
    const dbk_real vx = out->vx[s], vy = out->vy[s], vz = out->vz[s];
    const dbk_real ax = out->ax[s], ay = out->ay[s], az = out->az[s];
    radius = dbk_max(radius, dbk_sqrt(x * x + y * y + z * z) + cloud->r[s]);
    speed = dbk_max(speed, dbk_sqrt(vx * vx + vy * vy + vz * vz) + out->spread[s] +
                               half_period * dbk_sqrt(ax * ax + ay * ay + az * az));
  }
  out->bound_x[link] = cx;
  out->bound_y[link] = cy;
  out->bound_z[link] = cz;
  out->bound_r[link] = radius + DBK_CULL_FLOOR * (dbk_real)0.01;
  out->speed[link] = speed;
}

void dbk_set_motion(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx) {
  spatial chain[DBK_MAX_DOF + 1] = {{{0}, {0}, {0}, {0}}};
  const int32_t total = ctx->cloud.count;
  dbk_motion *out = &ctx->motion;
  for (int32_t s = 0; s < total; ++s) { out->spread[s] = (dbk_real)0; }
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real *r = ctx->frames.rotation[k + 1];
    const dbk_real z[3] = {r[2], r[5], r[8]};
    const dbk_real middle = (dbk_real)0.5 * (ctx->lower[k] + ctx->upper[k]);
    const dbk_real wide = (dbk_real)0.5 * (ctx->upper[k] - ctx->lower[k]) + model->tracking;
    const dbk_real *restrict reach = model->reach[k];
    if (model->joint_kind[k] == DBK_PRISMATIC) {
      add_slide(&chain[k], z, middle, &chain[k + 1]);
    } else {
      add_turn(&chain[k], z, ctx->frames.origin[k + 1], middle, &chain[k + 1]);
    }
    for (int32_t s = 0; s < total; ++s) { out->spread[s] += wide * reach[s]; }
  }
  for (int32_t l = 0; l <= model->n_links; ++l) {
    const int32_t held = l == model->n_links;
    const int32_t first = held ? model->n_spheres : model->link_first[l];
    const int32_t last = held ? model->n_spheres + scene->n_held : model->link_first[l + 1];
    if (first < last) {
      move(&chain[held ? model->n : model->link_frame[l]], &ctx->cloud, first, last, out);
      bound(&ctx->cloud, first, last, (dbk_real)0.5 * model->period, l, out);
    } else {
      out->bound_x[l] = out->bound_y[l] = out->bound_z[l] = out->bound_r[l] = out->speed[l] = (dbk_real)0;
    }
  }
}
