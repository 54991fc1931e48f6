/* Motion of every collision sphere: its velocity at the centre of the trust region, the maximum change of the velocity
 * within the trust region, and its acceleration at the centre of the control bounds. The broad phase and the row
 * builders use these bounds to omit rows that no control can violate in this step. */
#include "model/dbk_sphere_motion.h"

#include "dbk_spatial.h"
#include "model/dbk_model.h"

/* centre velocity tv + tw x c and acceleration dv + dw x c + w x (v + w x c) of the spheres first..last-1. The loop
 * runs to the end of the last SIMD vector; a later call overwrites the entries after `last`, or no function reads
 * them. */
static inline void move_spheres(const dbk_spatial *t, const dbk_sphere_set *spheres, int32_t first, int32_t last,
                                dbk_sphere_motion *restrict out) {
  const dbk_real wx = t->w[0], wy = t->w[1], wz = t->w[2], vx = t->v[0], vy = t->v[1], vz = t->v[2];
  const dbk_real ax = t->dw[0], ay = t->dw[1], az = t->dw[2], bx = t->dv[0], by = t->dv[1], bz = t->dv[2];
  const dbk_real rx = t->tw[0], ry = t->tw[1], rz = t->tw[2], sx = t->tv[0], sy = t->tv[1], sz = t->tv[2];
  const int32_t count = DBK_PADDED(last - first);
  for (int32_t i = 0; i < count; ++i) {
    const int32_t s = first + i;
    const dbk_real x = spheres->x[s], y = spheres->y[s], z = spheres->z[s];
    const dbk_real ux = vx + (wy * z - wz * y), uy = vy + (wz * x - wx * z), uz = vz + (wx * y - wy * x);
    out->vx[s] = sx + (ry * z - rz * y);
    out->vy[s] = sy + (rz * x - rx * z);
    out->vz[s] = sz + (rx * y - ry * x);
    out->ax[s] = bx + (ay * z - az * y) + (wy * uz - wz * uy);
    out->ay[s] = by + (az * x - ax * z) + (wz * ux - wx * uz);
    out->az[s] = bz + (ax * y - ay * x) + (wx * uy - wy * ux);
  }
}

/* velocities and accelerations of all spheres; consecutive links with the same frame are processed in one loop */
static inline void move_all_spheres(const dbk_model *model, const dbk_scene *scene, const dbk_spatial *chain,
                                    dbk_ctx *ctx) {
  int32_t end = 0;
  for (int32_t l = 0; l <= model->n_links; l = end) {
    const int32_t frame = dbk_link_frame(model, l);
    end = l + 1;
    while (end <= model->n_links && dbk_link_frame(model, end) == frame) { ++end; }
    const int32_t first = dbk_link_first_sphere(model, l), last = dbk_link_end_sphere(model, scene, end - 1);
    if (first < last) { move_spheres(&chain[frame], &ctx->spheres, first, last, &ctx->motion); }
  }
}

/* per sphere: the sampling term dt/2 |a|, which is the maximum contribution of the acceleration a to the right side of
 * a row, and the maximum speed, including the sampling term */
static inline void bound_spheres(const dbk_sphere_motion *m, int32_t total, dbk_real half_period,
                                 dbk_real *restrict speed, dbk_real *restrict sampling_term) {
  const int32_t count = DBK_PADDED(total);
  for (int32_t s = 0; s < count; ++s) {
    const dbk_real vx = m->vx[s], vy = m->vy[s], vz = m->vz[s], ax = m->ax[s], ay = m->ay[s], az = m->az[s];
    sampling_term[s] = half_period * dbk_sqrt(ax * ax + ay * ay + az * az);
    speed[s] = dbk_sqrt(vx * vx + vy * vy + vz * vz) + m->spread[s] + sampling_term[s];
  }
}

/* the bounding sphere of a link at the current posture; the rounding error of its centre grows with the distance from
 * the origin and is added to the radius */
static inline void place_bounding_sphere(const dbk_frames *frames, const dbk_sphere_set *spheres,
                                         const dbk_bounding_sphere *bound, int32_t frame, int32_t first, int32_t link,
                                         dbk_sphere_motion *out) {
  const dbk_real *r = frames->rotation[frame];
  const dbk_real x = spheres->x[first] + (r[0] * bound->x + r[1] * bound->y + r[2] * bound->z);
  const dbk_real y = spheres->y[first] + (r[3] * bound->x + r[4] * bound->y + r[5] * bound->z);
  const dbk_real z = spheres->z[first] + (r[6] * bound->x + r[7] * bound->y + r[8] * bound->z);
  const dbk_real rounding = (dbk_real)1e-6 * (dbk_abs(x) + dbk_abs(y) + dbk_abs(z));
  out->bound_x[link] = x;
  out->bound_y[link] = y;
  out->bound_z[link] = z;
  out->bound_r[link] = bound->radius + rounding;
  out->centres_radius[link] = bound->centres_radius + rounding;
  out->inner_distance[link] = bound->inner_distance + rounding;
}

/* bounding spheres and speed bounds of all links */
static inline void bound_links(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx) {
  dbk_real speed[DBK_SPHERE_CAPACITY], sampling_term[DBK_SPHERE_CAPACITY];
  dbk_sphere_motion *out = &ctx->motion;
  bound_spheres(out, ctx->spheres.count, (dbk_real)0.5 * model->period, speed, sampling_term);
  for (int32_t l = 0; l <= model->n_links; ++l) {
    const int32_t first = dbk_link_first_sphere(model, l), last = dbk_link_end_sphere(model, scene, l);
    /* maxima over the spheres of the link */
    out->trust_speed[l] = out->sampling_term[l] = (dbk_real)0;
    for (int32_t s = first; s < last; ++s) {
      out->trust_speed[l] = dbk_max(out->trust_speed[l], speed[s]);
      out->sampling_term[l] = dbk_max(out->sampling_term[l], sampling_term[s]);
    }
    out->max_speed[l] = out->trust_speed[l];
    /* the bounding sphere, zero for a link without spheres */
    if (first < last) {
      const dbk_bounding_sphere *bound =
          l == model->n_links ? &scene->held_bounding_sphere : &model->bounding_sphere[l];
      place_bounding_sphere(&ctx->frames, &ctx->spheres, bound, dbk_link_frame(model, l), first, l, out);
    } else {
      out->bound_x[l] = out->bound_y[l] = out->bound_z[l] = out->bound_r[l] = (dbk_real)0;
      out->centres_radius[l] = out->inner_distance[l] = (dbk_real)0;
    }
  }
  /* controls outside the trust region increase the speed by at most the excess of every joint times its lever arm */
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real excess = out->joint_excess[k], *restrict reach = model->link_reach[k];
    for (int32_t l = 0; l <= model->n_links; ++l) { out->max_speed[l] += excess * reach[l]; }
  }
}

DBK_SIMD_CLONES void dbk_set_sphere_motion(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx) {
  const dbk_spatial rest = {{0}, {0}, {0}, {0}, {0}, {0}};
  const int32_t count = DBK_PADDED(ctx->spheres.count);
  dbk_sphere_motion *out = &ctx->motion;
  dbk_spatial *chain = out->chain;
  chain[0] = rest; /* the base */
  /* spatial velocities along the chain, bounds of the joint rates, and the spread sum_k half_width_k reach_k of
   * spheres */
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real *r = ctx->frames.rotation[k + 1];
    const dbk_real z[3] = {r[2], r[5], r[8]};
    const dbk_real centre = (dbk_real)0.5 * (ctx->lower[k] + ctx->upper[k]);
    const dbk_real low = ctx->trust_lower[k], high = ctx->trust_upper[k], trust_centre = (dbk_real)0.5 * (low + high);
    const dbk_real half_width = (dbk_real)0.5 * (high - low) + model->tracking[k];
    const dbk_real *restrict reach = model->reach[k];
    if (model->joint_kind[k] == DBK_PRISMATIC) {
      dbk_add_prismatic(&chain[k], z, centre, trust_centre, &chain[k + 1]);
    } else {
      dbk_add_revolute(&chain[k], z, ctx->frames.origin[k + 1], centre, trust_centre, &chain[k + 1]);
    }
    if (k == 1 && model->moving_base) { dbk_turn_drive(chain); }
    out->joint_half_width[k] = half_width;
    out->joint_max_speed[k] = dbk_abs(trust_centre) + half_width;
    out->joint_excess[k] = dbk_max(ctx->upper[k] - high, low - ctx->lower[k]);
    /* the first joint begins the sums */
    if (k == 0) {
      for (int32_t s = 0; s < count; ++s) { out->spread[s] = half_width * reach[s]; }
    } else {
      for (int32_t s = model->first_moved[k]; s < count; ++s) { out->spread[s] += half_width * reach[s]; }
    }
  }
  move_all_spheres(model, scene, chain, ctx);
  bound_links(model, scene, ctx);
}
