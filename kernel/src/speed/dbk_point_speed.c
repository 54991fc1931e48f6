/* Velocities of the points whose speed is limited. */
#include "speed/dbk_point_speed.h"

#include "dbk_spatial.h"
#include "model/dbk_model.h"

void dbk_place_tool(const dbk_model *model, dbk_ctx *ctx) {
  const dbk_real *r = ctx->frames.rotation[model->n], *o = ctx->frames.origin[model->n], *t = model->tool_offset;
  for (int32_t e = 0; e < 3; ++e) {
    ctx->speed.tool[e] = o[e] + (r[3 * e] * t[0] + r[3 * e + 1] * t[1] + r[3 * e + 2] * t[2]);
  }
}

int32_t dbk_frame_of_point(const dbk_model *model, const dbk_ctx *ctx, int32_t point, dbk_real position[3]) {
  const int32_t tool = point >= ctx->spheres.count, s = dbk_bounded(point, DBK_ALL_SPHERES - 1);
  position[0] = tool ? ctx->speed.tool[0] : ctx->spheres.x[s];
  position[1] = tool ? ctx->speed.tool[1] : ctx->spheres.y[s];
  position[2] = tool ? ctx->speed.tool[2] : ctx->spheres.z[s];
  return tool ? model->n : model->sphere_frame[s];
}

/* spatial motion of every frame at the control u, relative to frame speed_first_joint; without `accelerations` only tw
 * and tv */
static inline void chain_motion(const dbk_model *model, const dbk_frames *frames, const dbk_real *u,
                                int32_t accelerations, dbk_spatial chain[DBK_MAX_DOF + 1]) {
  const dbk_spatial rest = {{0}, {0}, {0}, {0}, {0}, {0}};
  chain[0] = rest;
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real *r = frames->rotation[k + 1];
    const dbk_real z[3] = {r[2], r[5], r[8]};
    const int32_t prismatic = model->joint_kind[k] == DBK_PRISMATIC;
    if (k < model->speed_first_joint) {
      chain[k + 1] = rest;
      continue;
    }
    if (!accelerations) {
      dbk_real moment[3];
      dbk_cross(frames->origin[k + 1], z, moment);
      for (int32_t e = 0; e < 3; ++e) {
        chain[k + 1].tw[e] = chain[k].tw[e] + (prismatic ? (dbk_real)0 : u[k] * z[e]);
        chain[k + 1].tv[e] = chain[k].tv[e] + u[k] * (prismatic ? z[e] : moment[e]);
      }
    } else if (prismatic) {
      dbk_add_prismatic(&chain[k], z, u[k], u[k], &chain[k + 1]);
    } else {
      dbk_add_revolute(&chain[k], z, frames->origin[k + 1], u[k], u[k], &chain[k + 1]);
    }
    if (accelerations && k == 1 && model->moving_base) { dbk_turn_drive(chain); }
  }
}

/* velocities tv + tw x c of `number` points from `first` at (x[0], y[0], z[0]) and so on. The loop runs to the end of the
 * last SIMD vector; a later call overwrites the entries after the last point, or no function reads them. */
static inline void move_points(const dbk_spatial *t, const dbk_real *x, const dbk_real *y, const dbk_real *z,
                               int32_t first, int32_t number, dbk_point_velocities *restrict out) {
  const dbk_real wx = t->tw[0], wy = t->tw[1], wz = t->tw[2], vx = t->tv[0], vy = t->tv[1], vz = t->tv[2];
  dbk_real *restrict ux = out->vx + first, *restrict uy = out->vy + first, *restrict uz = out->vz + first;
  const int32_t count = DBK_PADDED(number);
  for (int32_t i = 0; i < count; ++i) {
    ux[i] = vx + (wy * z[i] - wz * y[i]);
    uy[i] = vy + (wz * x[i] - wx * z[i]);
    uz[i] = vz + (wx * y[i] - wy * x[i]);
  }
}

/* accelerations dv + dw x c + w x (velocity of the point), likewise */
static inline void accelerate_points(const dbk_spatial *t, const dbk_real *x, const dbk_real *y, const dbk_real *z,
                                     int32_t first, int32_t number, dbk_point_velocities *restrict out) {
  const dbk_real wx = t->tw[0], wy = t->tw[1], wz = t->tw[2];
  const dbk_real ax = t->dw[0], ay = t->dw[1], az = t->dw[2], bx = t->dv[0], by = t->dv[1], bz = t->dv[2];
  const int32_t count = DBK_PADDED(number);
  for (int32_t i = 0; i < count; ++i) {
    const int32_t s = first + i;
    const dbk_real ux = out->vx[s], uy = out->vy[s], uz = out->vz[s];
    out->ax[s] = bx + (ay * z[i] - az * y[i]) + (wy * uz - wz * uy);
    out->ay[s] = by + (az * x[i] - ax * z[i]) + (wz * ux - wx * uz);
    out->az[s] = bz + (ax * y[i] - ay * x[i]) + (wx * uy - wy * ux);
  }
}

/* links with the same frame are processed in one loop, and the tool last */
static inline void move_all(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx, const dbk_real *u,
                            int32_t accelerations, dbk_point_velocities *out) {
  dbk_spatial chain[DBK_MAX_DOF + 1];
  const dbk_sphere_set *c = &ctx->spheres;
  dbk_real tool[3][DBK_LANES];
  int32_t end = 0;
  chain_motion(model, &ctx->frames, u, accelerations, chain);
  for (int32_t l = 0; l <= model->n_links; l = end) {
    const int32_t frame = dbk_link_frame(model, l);
    end = l + 1;
    while (end <= model->n_links && dbk_link_frame(model, end) == frame) { ++end; }
    const int32_t first = dbk_link_first_sphere(model, l), last = dbk_link_end_sphere(model, scene, end - 1);
    if (first >= last) { continue; }
    move_points(&chain[frame], c->x + first, c->y + first, c->z + first, first, last - first, out);
    if (!accelerations) { continue; }
    accelerate_points(&chain[frame], c->x + first, c->y + first, c->z + first, first, last - first, out);
  }
  for (int32_t e = 0; e < 3; ++e) {
    for (int32_t l = 0; l < DBK_LANES; ++l) { tool[e][l] = ctx->speed.tool[e]; }
  }
  const int32_t at = c->count;
  move_points(&chain[model->n], tool[0], tool[1], tool[2], at, 1, out);
  if (accelerations) {
    accelerate_points(&chain[model->n], tool[0], tool[1], tool[2], at, 1, out);
  }
}

DBK_SIMD_CLONES void dbk_velocities_of_points(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                                              const dbk_real u[DBK_MAX_DOF], dbk_point_velocities *out) {
  move_all(model, scene, ctx, u, 0, out);
}

DBK_SIMD_CLONES void dbk_motion_of_points(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                                          const dbk_real u[DBK_MAX_DOF], dbk_point_velocities *out) {
  move_all(model, scene, ctx, u, 1, out);
}
