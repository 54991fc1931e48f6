/* Speed limits of the points of the robot, and the cuts that enforce them in the QP. */
#include "speed/dbk_speed_limit.h"

#include "distance/dbk_distance.h"
#include "model/dbk_model.h"
#include "qp/dbk_qp.h"
#include "speed/dbk_point_speed.h"

#define UNLIMITED ((dbk_real)1e9)
/* a projection is slower by this fraction, so that the filter passes it unchanged */
#define PROJECTION_SHARE ((dbk_real)0.995)

/* the largest speed at distance d from which a part decelerates to `near_speed` before it is within the distance of the
 * obstacle: v solves d - d_near = (v^2 - v_near^2) / (2 a) + v_h (v - v_near) / a with the speed v_h of the person */
static dbk_real speed_at(const dbk_obstacle *o, dbk_real person_speed, dbk_real d) {
  const dbk_real spare = d - o->near_distance, sum = person_speed + o->near_speed;
  if (!(spare > (dbk_real)0)) { return o->near_speed; }
  return dbk_sqrt(sum * sum + (dbk_real)2 * o->near_brake * spare) - person_speed;
}

/* the limits of the spheres of one link near an obstacle; `error` is the position error of the held object */
static void limit_link(const dbk_obstacle *o, const dbk_sphere_set *c, int32_t first, int32_t last, dbk_real margin,
                       dbk_real person_speed, dbk_real *allowed) {
  dbk_real d[DBK_SPHERE_CAPACITY], nx[DBK_SPHERE_CAPACITY], ny[DBK_SPHERE_CAPACITY], nz[DBK_SPHERE_CAPACITY];
  if (first >= last) { return; }
  dbk_distance(o, last - first, c->x + first, c->y + first, c->z + first, d, nx, ny, nz);
  for (int32_t i = 0; i < last - first; ++i) {
    const int32_t s = dbk_bounded(first + i, DBK_ALL_SPHERES - 1);
    allowed[s] = dbk_min(allowed[s], speed_at(o, person_speed, d[i] - c->r[s] - margin));
  }
}

/* the limits of all points near the obstacles with power and force limiting, at the predicted positions */
static void limit_near_obstacles(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real age,
                                 int32_t known_only) {
  dbk_real *allowed = ctx->speed.allowed;
  for (int32_t i = 0; i < scene->n_obstacles; ++i) {
    dbk_obstacle o = scene->obstacle[i];
    if (!(o.near_speed > (dbk_real)0) || (known_only && !(o.flags & DBK_KNOWN))) { continue; }
    for (int32_t e = 0; e < 3; ++e) { o.position[e] += o.velocity[e] * age; }
    const dbk_real margin = o.margin + o.velocity_error * dbk_max(age, (dbk_real)0) + model->rounding;
    const dbk_real person_speed = dbk_max(o.near_approach, scene->capsules.max_speed[i]);
    for (int32_t l = 0; l <= model->n_links; ++l) {
      const int32_t first = dbk_link_first_sphere(model, l), last = dbk_link_end_sphere(model, scene, l);
      const dbk_real error = l == model->n_links ? scene->held_error : (dbk_real)0;
      if (!(o.link_mask >> l & 1u) || dbk_link_frame(model, l) == 0) { continue; }
      limit_link(&o, &ctx->spheres, first, last, margin + error, person_speed, allowed);
    }
    dbk_real d, n[3];
    dbk_distance(&o, 1, ctx->speed.tool, ctx->speed.tool + 1, ctx->speed.tool + 2, &d, n, n + 1, n + 2);
    dbk_real *tool = &allowed[ctx->spheres.count];
    *tool = dbk_min(*tool, speed_at(&o, person_speed, d - margin));
  }
}

/* Reserves room for the change of every speed at the constant control u_prev: g = n'a is its growth, which the limit
 * covers for DBK_SPEED_PERIODS periods. The measured state is behind the lag-compensated one by `lag`, where a falling
 * speed was higher. */
DBK_SIMD_CLONES static void reserve_growth(const dbk_model *model, const dbk_point_velocities *v,
                                           dbk_speed *restrict speed) {
  const dbk_real ahead = DBK_SPEED_PERIODS * model->period, behind = -model->lag;
  const int32_t count = DBK_PADDED(speed->n_points);
  for (int32_t p = 0; p < count; ++p) {
    const dbk_real vx = v->vx[p], vy = v->vy[p], vz = v->vz[p];
    const dbk_real length = dbk_sqrt(vx * vx + vy * vy + vz * vz) + DBK_SPEED_FLOOR;
    const dbk_real growth = (vx * v->ax[p] + vy * v->ay[p] + vz * v->az[p]) / length;
    const dbk_real later = ahead * growth, earlier = behind * growth;
    const dbk_real change = later > earlier ? later : earlier, half = (dbk_real)0.5 * speed->allowed[p];
    const dbk_real reduced = speed->allowed[p] - change;
    speed->limit[p] = reduced > half ? reduced : half;
  }
}

/* Keeps the cuts that were active in the last step, and numbers them again in the warm start. Cuts of a point that no
 * longer exists, after an object was released, are omitted. */
static void keep_active_cuts(dbk_ctx *ctx) {
  dbk_speed *speed = &ctx->speed;
  int32_t kept = 0;
  for (int32_t c = 0; c < speed->n_cuts && kept < DBK_MAX_CUTS; ++c) {
    for (int32_t w = 0; w < ctx->n_warm; ++w) {
      if (ctx->warm[w][0] != DBK_ROW_SPEED || ctx->warm[w][2] != c) { continue; }
      if (speed->cut_point[c] >= speed->n_points) { continue; }
      speed->cut_point[kept] = speed->cut_point[c];
      speed->cut_ramped[kept] = speed->cut_ramped[c];
      speed->cut_x[kept] = speed->cut_x[c];
      speed->cut_y[kept] = speed->cut_y[c];
      speed->cut_z[kept] = speed->cut_z[c];
      ctx->warm[w][2] = kept; /* kept <= c: no later cut has this number */
      ++kept;
      break;
    }
  }
  speed->n_cuts = kept;
}

/* The control after the acceleration is reduced to zero with the jerk limit from the next period on. With the change c
 * in this period and J = j dt^2, the later changes c - J, c - 2 J, ... add up to at most R(c) = c^2 / (2 J) - c / 2 +
 * J / 8. R is convex and c differs by at most J from the last change, so R is at most J / 2 above its tangent there. */
static void set_ramp(const dbk_model *model, const dbk_real *u_prev, const dbk_real *u_change, dbk_speed *speed) {
  speed->ramped = 0;
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real jump = model->j_max[k] * model->period * model->period;
    speed->gain[k] = (dbk_real)1;
    speed->shift[k] = (dbk_real)0;
    if (!u_change || !(jump > (dbk_real)0)) { continue; }
    const dbk_real change = dbk_abs(u_change[k]), half = (dbk_real)0.5;
    speed->ramped = 1;
    if (change <= half * jump) { continue; }
    const dbk_real slope = change / jump - half;
    const dbk_real rest = half * change * change / jump - half * change + (dbk_real)0.625 * jump;
    speed->gain[k] += slope;
    speed->shift[k] = (u_change[k] < (dbk_real)0 ? -rest : rest) - slope * (u_prev[k] + u_change[k]);
  }
}

void dbk_set_speed_limits(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                          const dbk_real u_prev[DBK_MAX_DOF], const dbk_real *u_change, int32_t known_only) {
  dbk_speed *speed = &ctx->speed;
  dbk_point_velocities v;
  speed->n_points = ctx->spheres.count + 1;
  speed->active = model->speed_limit > (dbk_real)0 || (scene->n_obstacles > 0 && scene->capsules.any_near);
  if (!speed->active) {
    speed->n_cuts = 0;
    return;
  }
  const dbk_real limit = model->speed_limit > (dbk_real)0 ? model->speed_limit : UNLIMITED;
  const dbk_real share = ((dbk_real)1 - DBK_SPEED_ROUNDING) * (known_only ? PROJECTION_SHARE : (dbk_real)1);
  const int32_t count = DBK_PADDED(speed->n_points);
  dbk_place_tool(model, ctx);
  for (int32_t p = 0; p < count; ++p) { speed->allowed[p] = p < speed->n_points ? limit : UNLIMITED; }
  if (scene->n_obstacles > 0 && scene->capsules.any_near) {
    limit_near_obstacles(model, scene, ctx, in->scene_age, known_only);
  }
  for (int32_t p = 0; p < count; ++p) {
    speed->allowed[p] = dbk_max(share * speed->allowed[p] - DBK_SPEED_FLOOR, DBK_SPEED_FLOOR);
  }
  keep_active_cuts(ctx);
  for (int32_t p = 0; p < count; ++p) { v.vx[p] = v.vy[p] = v.vz[p] = v.ax[p] = v.ay[p] = v.az[p] = (dbk_real)0; }
  dbk_motion_of_points(model, scene, ctx, u_prev, &v);
  reserve_growth(model, &v, speed);
  set_ramp(model, u_prev, u_change, speed);
  for (int32_t p = 0; p < count; ++p) { speed->ramp_limit[p] = speed->limit[p]; }
}

/* 1 if a point is faster than its limit; NaN counts as too fast */
DBK_SIMD_CLONES static int32_t too_fast(const dbk_speed *speed, const dbk_real *limit, const dbk_point_velocities *v) {
  int32_t fast[DBK_LANES] = {0}, any = 0;
  const int32_t whole = speed->n_points / DBK_LANES * DBK_LANES;
  for (int32_t base = 0; base < whole; base += DBK_LANES) {
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      const int32_t p = base + l;
      const dbk_real square = v->vx[p] * v->vx[p] + v->vy[p] * v->vy[p] + v->vz[p] * v->vz[p];
      fast[l] |= !(square <= limit[p] * limit[p]);
    }
  }
  for (int32_t p = whole; p < speed->n_points; ++p) {
    const dbk_real square = v->vx[p] * v->vx[p] + v->vy[p] * v->vy[p] + v->vz[p] * v->vz[p];
    any |= !(square <= limit[p] * limit[p]);
  }
  for (int32_t l = 0; l < DBK_LANES; ++l) { any |= fast[l]; }
  return any;
}

const dbk_real *dbk_limited_velocities(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                                       const dbk_real u[DBK_MAX_DOF], int32_t ramped, dbk_point_velocities *out) {
  const dbk_speed *speed = &ctx->speed;
  dbk_real end[DBK_MAX_DOF] = {(dbk_real)0};
  for (int32_t k = 0; k < model->n; ++k) { end[k] = ramped ? speed->gain[k] * u[k] + speed->shift[k] : u[k]; }
  dbk_velocities_of_points(model, scene, ctx, end, out);
  return ramped ? speed->ramp_limit : speed->limit;
}

int32_t dbk_keeps_speed(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                        const dbk_real u[DBK_MAX_DOF]) {
  dbk_point_velocities v;
  if (!ctx->speed.active) { return 1; }
  for (int32_t ramped = 0; ramped <= ctx->speed.ramped; ++ramped) {
    const dbk_real *limit = dbk_limited_velocities(model, scene, ctx, u, ramped, &v);
    if (too_fast(&ctx->speed, limit, &v)) { return 0; }
  }
  return 1;
}

/* appends the row of a cut: -n'J_p (gain u + shift) >= -limit, normalised */
static void append_row(const dbk_model *model, dbk_ctx *ctx, int32_t cut) {
  dbk_rows *rows = &ctx->rows;
  const dbk_speed *speed = &ctx->speed;
  const dbk_real nx = speed->cut_x[cut], ny = speed->cut_y[cut], nz = speed->cut_z[cut];
  const int32_t point = speed->cut_point[cut], ramped = speed->cut_ramped[cut];
  dbk_real c[3], a[DBK_MAX_DOF], square = (dbk_real)0, before = (dbk_real)0, offset = (dbk_real)0;
  const int32_t frame = dbk_frame_of_point(model, ctx, point, c);
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real *r = ctx->frames.rotation[k + 1], *p = ctx->frames.origin[k + 1];
    const dbk_real zx = r[2], zy = r[5], zz = r[8], x = c[0] - p[0], y = c[1] - p[1], z = c[2] - p[2];
    const dbk_real along = nx * zx + ny * zy + nz * zz;
    const dbk_real around = nx * (zy * z - zz * y) + ny * (zz * x - zx * z) + nz * (zx * y - zy * x);
    const int32_t moves = k < frame && k >= model->speed_first_joint;
    const dbk_real value = !moves ? (dbk_real)0 : (model->joint_kind[k] == DBK_PRISMATIC ? -along : -around);
    before += value * ctx->u_prev[k];
    a[k] = ramped ? value * speed->gain[k] : value;
    offset += ramped ? value * speed->shift[k] : (dbk_real)0;
    square += a[k] * a[k];
  }
  const dbk_real norm = dbk_sqrt(square), limit = ramped ? speed->ramp_limit[point] : speed->limit[point];
  if (!(norm > DBK_ZERO_GRADIENT)) { return; } /* no joint can make the point faster than the limit */
  rows->overflow |= rows->count >= DBK_MAX_ROWS;
  if (rows->overflow || rows->count >= DBK_MAX_ROWS) { return; }
  const int32_t r = rows->count++;
  for (int32_t k = 0; k < model->n; ++k) { rows->a[k][r] = a[k] / norm; }
  rows->b[r] = (-((dbk_real)1 - DBK_SPEED_SHRINK) * limit - offset) / norm;
  rows->h[r] = speed->allowed[point] + before;
  rows->norm[r] = norm;
  rows->kind[r] = DBK_ROW_SPEED;
  rows->i[r] = point;
  rows->j[r] = cut;
  rows->moving[r] = rows->clip[r] = rows->rank[r] = 0;
  rows->soft[r] = (dbk_real)0;
}

/* fills the last SIMD vector with rows that never bind */
static void pad_rows(const dbk_model *model, dbk_rows *rows) {
  for (int32_t r = rows->count; r < DBK_PADDED(rows->count); ++r) {
    for (int32_t k = 0; k < model->n; ++k) { rows->a[k][r] = (dbk_real)0; }
    rows->b[r] = (dbk_real)-1e9;
    rows->soft[r] = (dbk_real)0;
  }
}

void dbk_speed_rows(const dbk_model *model, dbk_ctx *ctx) {
  const int32_t n_cuts = dbk_bounded(ctx->speed.n_cuts, DBK_MAX_CUTS);
  for (int32_t c = 0; c < n_cuts; ++c) { append_row(model, ctx, c); }
}

void dbk_only_speed_rows(const dbk_model *model, dbk_ctx *ctx) {
  ctx->rows.count = ctx->rows.overflow = 0;
  dbk_speed_rows(model, ctx);
  pad_rows(model, &ctx->rows);
}

/* the point of first..last-1 that exceeds its limit by the largest factor; -1 if none does */
static int32_t fastest(const dbk_real *limit, const dbk_point_velocities *v, int32_t first, int32_t last) {
  dbk_real most = (dbk_real)1;
  int32_t found = -1;
  for (int32_t p = first; p < last; ++p) {
    const dbk_real square = v->vx[p] * v->vx[p] + v->vy[p] * v->vy[p] + v->vz[p] * v->vz[p];
    const dbk_real factor = square / (limit[p] * limit[p]);
    if (factor > most) {
      most = factor;
      found = p;
    }
  }
  return found;
}

/* adds the cut of a point in the direction of its velocity, and its row; 0 if there is no room */
static int32_t add_cut(const dbk_model *model, dbk_ctx *ctx, const dbk_point_velocities *v, int32_t point,
                       int32_t ramped) {
  dbk_speed *speed = &ctx->speed;
  const int32_t at = speed->n_cuts;
  if (point < 0) { return 1; }
  const dbk_real length = dbk_length(v->vx[point], v->vy[point], v->vz[point]);
  if (at >= DBK_MAX_CUTS || !dbk_finite(length)) { return 0; }
  speed->cut_point[at] = point;
  speed->cut_ramped[at] = ramped;
  speed->cut_x[at] = v->vx[point] / length;
  speed->cut_y[at] = v->vy[point] / length;
  speed->cut_z[at] = v->vz[point] / length;
  speed->n_cuts = at + 1;
  append_row(model, ctx, at);
  return !ctx->rows.overflow;
}

int32_t dbk_cut_speed(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_real u[DBK_MAX_DOF]) {
  dbk_point_velocities v;
  const int32_t tool = ctx->spheres.count;
  int32_t fast = 0, room = 1;
  if (!ctx->speed.active) { return 0; }
  for (int32_t ramped = 0; ramped <= ctx->speed.ramped; ++ramped) {
    const dbk_real *limit = dbk_limited_velocities(model, scene, ctx, u, ramped, &v);
    if (!too_fast(&ctx->speed, limit, &v)) { continue; }
    fast = 1;
    /* one cut for every link: the velocities of its points are similar */
    for (int32_t l = 0; l <= model->n_links; ++l) {
      const int32_t first = dbk_link_first_sphere(model, l), last = dbk_link_end_sphere(model, scene, l);
      room &= add_cut(model, ctx, &v, fastest(limit, &v, first, last), ramped);
    }
    room &= add_cut(model, ctx, &v, fastest(limit, &v, tool, tool + 1), ramped);
  }
  if (!fast) { return 0; }
  pad_rows(model, &ctx->rows);
  return room ? 1 : -1;
}

void dbk_slow_down(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                   const dbk_real brake[DBK_MAX_DOF], dbk_real u[DBK_MAX_DOF]) {
  dbk_real start[DBK_MAX_DOF], part = (dbk_real)0.5, share = (dbk_real)0;
  if (dbk_keeps_speed(model, scene, ctx, u)) { return; }
  for (int32_t k = 0; k < model->n; ++k) { start[k] = u[k]; }
  for (int32_t tries = 0; tries < DBK_SPEED_ROUNDS; ++tries) {
    for (int32_t k = 0; k < model->n; ++k) { u[k] = brake[k] + (share + part) * (start[k] - brake[k]); }
    if (dbk_keeps_speed(model, scene, ctx, u)) { share += part; }
    part *= (dbk_real)0.5;
  }
  for (int32_t k = 0; k < model->n; ++k) {
    u[k] = dbk_clamp(brake[k] + share * (start[k] - brake[k]), ctx->lower[k], ctx->upper[k]);
  }
}
