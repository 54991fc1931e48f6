/* How every sphere moves: its velocity at the middle of the trust box, how far any control of that box can change it, and
 * its acceleration at the middle of the whole box. This is what tells which rows may bind in this step. */
#include "dbk_pair.h"

typedef struct {
  dbk_real w[3], v[3], dw[3], dv[3]; /* spatial velocity and acceleration about the base origin at constant u */
  dbk_real tw[3], tv[3];             /* spatial velocity at the middle of the trust box */
} spatial;

static inline void cross(const dbk_real a[3], const dbk_real b[3], dbk_real out[3]) {
  out[0] = a[1] * b[2] - a[2] * b[1];
  out[1] = a[2] * b[0] - a[0] * b[2];
  out[2] = a[0] * b[1] - a[1] * b[0];
}

/* frame i+1 = frame i plus a slide at rate u (or t) along axis z; the axis itself turns with frame i */
static inline void add_slide(const spatial *parent, const dbk_real z[3], dbk_real u, dbk_real t, spatial *child) {
  dbk_real dz[3];
  cross(parent->w, z, dz);
  *child = *parent;
  for (int32_t e = 0; e < 3; ++e) {
    child->v[e] += u * z[e];
    child->tv[e] += t * z[e];
    child->dv[e] += u * dz[e];
  }
}

/* frame i+1 = frame i plus a turn at rate u (or t) about axis z through p; the axis itself moves with frame i */
static inline void add_turn(const spatial *parent, const dbk_real z[3], const dbk_real p[3], dbk_real u, dbk_real t,
                            spatial *child) {
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
    child->tw[e] = parent->tw[e] + t * z[e];
    child->tv[e] = parent->tv[e] + t * moment[e];
    child->dw[e] = parent->dw[e] + u * dz[e];
    child->dv[e] = parent->dv[e] + u * (a[e] + b[e]);
  }
}

/* centre velocity tv + tw x c and acceleration dv + dw x c + w x (v + w x c) of the spheres first..last-1. The loop
 * runs on to a full vector: what it writes behind `last` is written again by the next frame, or never read. */
static inline void move(const spatial *t, const dbk_cloud *cloud, int32_t first, int32_t last, dbk_motion *restrict out) {
  const dbk_real wx = t->w[0], wy = t->w[1], wz = t->w[2], vx = t->v[0], vy = t->v[1], vz = t->v[2];
  const dbk_real ax = t->dw[0], ay = t->dw[1], az = t->dw[2], bx = t->dv[0], by = t->dv[1], bz = t->dv[2];
  const dbk_real rx = t->tw[0], ry = t->tw[1], rz = t->tw[2], sx = t->tv[0], sy = t->tv[1], sz = t->tv[2];
  const int32_t count = DBK_PADDED(last - first);
  for (int32_t i = 0; i < count; ++i) {
    const int32_t s = first + i;
    const dbk_real x = cloud->x[s], y = cloud->y[s], z = cloud->z[s];
    const dbk_real ux = vx + (wy * z - wz * y), uy = vy + (wz * x - wx * z), uz = vz + (wx * y - wy * x);
    out->vx[s] = sx + (ry * z - rz * y);
    out->vy[s] = sy + (rz * x - rx * z);
    out->vz[s] = sz + (rx * y - ry * x);
    out->ax[s] = bx + (ay * z - az * y) + (wy * uz - wz * uy);
    out->ay[s] = by + (az * x - ax * z) + (wz * ux - wx * uz);
    out->az[s] = bz + (ax * y - ay * x) + (wx * uy - wy * ux);
  }
}

/* velocities and accelerations of all spheres; neighbouring links of one frame are taken together */
static inline void move_all(const dbk_model *model, const dbk_scene *scene, const spatial *chain, dbk_ctx *ctx) {
  int32_t end = 0;
  for (int32_t l = 0; l <= model->n_links; l = end) {
    const int32_t frame = dbk_link_frame(model, l);
    end = l + 1;
    while (end <= model->n_links && dbk_link_frame(model, end) == frame) { ++end; }
    const int32_t first = dbk_first_sphere(model, l), last = dbk_last_sphere(model, scene, end - 1);
    if (first < last) { move(&chain[frame], &ctx->cloud, first, last, &ctx->motion); }
  }
}

/* greatest speed of every sphere, and what its acceleration can add to a row's right side */
static inline void hurry(const dbk_motion *m, int32_t total, dbk_real half_period, dbk_real *restrict speed,
                  dbk_real *restrict bend) {
  const int32_t count = DBK_PADDED(total);
  for (int32_t s = 0; s < count; ++s) {
    const dbk_real vx = m->vx[s], vy = m->vy[s], vz = m->vz[s], ax = m->ax[s], ay = m->ay[s], az = m->az[s];
    bend[s] = half_period * dbk_sqrt(ax * ax + ay * ay + az * az);
    speed[s] = dbk_sqrt(vx * vx + vy * vy + vz * vz) + m->spread[s] + bend[s];
  }
}

/* where the ball around a link is now; far from the origin rounding is larger, and so is the ball */
static inline void place_ball(const dbk_frames *frames, const dbk_cloud *cloud, const dbk_ball *ball, int32_t frame,
                       int32_t first, int32_t link, dbk_motion *out) {
  const dbk_real *r = frames->rotation[frame];
  const dbk_real x = cloud->x[first] + (r[0] * ball->x + r[1] * ball->y + r[2] * ball->z);
  const dbk_real y = cloud->y[first] + (r[3] * ball->x + r[4] * ball->y + r[5] * ball->z);
  const dbk_real z = cloud->z[first] + (r[6] * ball->x + r[7] * ball->y + r[8] * ball->z);
  const dbk_real rounding = (dbk_real)1e-6 * (dbk_abs(x) + dbk_abs(y) + dbk_abs(z));
  out->bound_x[link] = x;
  out->bound_y[link] = y;
  out->bound_z[link] = z;
  out->bound_r[link] = ball->radius + rounding;
  out->inner[link] = ball->inner + rounding;
}

/* balls and greatest speeds of the links */
static inline void bound_links(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx) {
  dbk_real speed[DBK_SPHERE_ROOM], bend[DBK_SPHERE_ROOM];
  dbk_motion *out = &ctx->motion;
  hurry(out, ctx->cloud.count, (dbk_real)0.5 * model->period, speed, bend);
  for (int32_t l = 0; l <= model->n_links; ++l) {
    const int32_t first = dbk_first_sphere(model, l), last = dbk_last_sphere(model, scene, l);
    out->speed[l] = out->bend[l] = (dbk_real)0;
    for (int32_t s = first; s < last; ++s) {
      out->speed[l] = dbk_max(out->speed[l], speed[s]);
      out->bend[l] = dbk_max(out->bend[l], bend[s]);
    }
    out->haste[l] = out->speed[l];
    if (first < last) {
      const dbk_ball *ball = l == model->n_links ? &scene->held_ball : &model->ball[l];
      place_ball(&ctx->frames, &ctx->cloud, ball, dbk_link_frame(model, l), first, l, out);
    } else {
      out->bound_x[l] = out->bound_y[l] = out->bound_z[l] = out->bound_r[l] = out->inner[l] = (dbk_real)0;
    }
  }
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real beyond = out->beyond[k], *restrict reach = model->link_reach[k];
    for (int32_t l = 0; l <= model->n_links; ++l) { out->haste[l] += beyond * reach[l]; }
  }
}

DBK_WIDE void dbk_set_motion(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx) {
  spatial chain[DBK_MAX_DOF + 1];
  const spatial still = {{0}, {0}, {0}, {0}, {0}, {0}};
  const int32_t count = DBK_PADDED(ctx->cloud.count);
  dbk_motion *out = &ctx->motion;
  chain[0] = still; /* the base */
  dbk_clear(out->spread, count);
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real *r = ctx->frames.rotation[k + 1];
    const dbk_real z[3] = {r[2], r[5], r[8]};
    const dbk_real middle = (dbk_real)0.5 * (ctx->lower[k] + ctx->upper[k]);
    const dbk_real low = ctx->trust_lower[k], high = ctx->trust_upper[k], aim = (dbk_real)0.5 * (low + high);
    const dbk_real wide = (dbk_real)0.5 * (high - low) + model->tracking;
    const dbk_real *restrict reach = model->reach[k];
    if (model->joint_kind[k] == DBK_PRISMATIC) {
      add_slide(&chain[k], z, middle, aim, &chain[k + 1]);
    } else {
      add_turn(&chain[k], z, ctx->frames.origin[k + 1], middle, aim, &chain[k + 1]);
    }
    out->wide[k] = wide;
    out->fast[k] = dbk_abs(aim) + wide;
    out->beyond[k] = dbk_max(ctx->upper[k] - high, low - ctx->lower[k]);
    for (int32_t s = 0; s < count; ++s) { out->spread[s] += wide * reach[s]; }
  }
  for (int32_t k = 0; k <= model->n; ++k) {
    for (int32_t e = 0; e < 3; ++e) {
      out->twist[k][e] = chain[k].tw[e];
      out->twist[k][3 + e] = chain[k].tv[e];
    }
  }
  move_all(model, scene, chain, ctx);
  bound_links(model, scene, ctx);
}
