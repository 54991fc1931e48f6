/* Rows between the links of the robot, and between the links and the held object.
 *
 * Only the joints between two links change their distance, so the rows use the velocity of the distal link (farther
 * from the base) relative to the proximal link (closer to the base). A pair of links passes four stages: bounding
 * sphere against bounding sphere, every proximal sphere against the distal bounding sphere, every proximal sphere
 * against all distal spheres (narrow phase), and finally the rows.
 */
#include "rows/dbk_self_collision_rows.h"

#include "distance/dbk_point_distance.h"
#include "model/dbk_model.h"
#include "rows/dbk_row_buffer.h"

#define RHS_ROUNDING ((dbk_real)1e-5) /* [m/s] upper bound of the rounding error of a right side */

/* a pair of links; `first` and `count` are the spheres of the distal link; the joints first_joint..end_joint-1 lie
 * between the links */
typedef struct {
  int32_t distal, first_joint, end_joint, first, count;
  dbk_real margin, sampling_term;
  dbk_real speed;  /* maximum closing speed within the trust region, including the sampling term */
  dbk_real excess; /* maximum additional closing speed within the control bounds */
} link_pair;

/* velocity of the distal spheres relative to the proximal link at the centre of the trust region; `spread` is the
 * maximum change of the velocity within the trust region, and `change` is the spread plus the sampling term */
typedef struct {
  dbk_real vx[DBK_SPHERE_CAPACITY], vy[DBK_SPHERE_CAPACITY], vz[DBK_SPHERE_CAPACITY];
  dbk_real spread[DBK_SPHERE_CAPACITY], change[DBK_SPHERE_CAPACITY];
} relative_motion;

/* maximum closing speed of two links within the trust region: the smaller of the bound by the joints between the links
 * and the bound by the speeds of both links in space */
static dbk_real closing_speed(const dbk_model *model, const dbk_sphere_motion *m, int32_t proximal, int32_t distal,
                              int32_t first_joint, int32_t end_joint) {
  dbk_real speed = m->sampling_term[proximal] + m->sampling_term[distal];
  for (int32_t k = first_joint; k < end_joint; ++k) { speed += m->joint_max_speed[k] * model->link_reach[k][distal]; }
  return dbk_min(speed, m->trust_speed[proximal] + m->trust_speed[distal]);
}

/* 1 unless all of the following hold at distance h: no control within the trust region can violate the row, no control
 * within the control bounds can reach h = 0 within this period, and another pair is closer */
static int32_t relevant(const dbk_model *model, const dbk_ctx *ctx, const link_pair *p, dbk_real h) {
  const dbk_real travel = model->period * (p->speed + p->excess) + DBK_CULL_FLOOR;
  return !(h > travel && model->alpha_self * h >= p->speed && h + model->sampling >= ctx->h_min);
}

/* lower bound of h between a sphere at (x, y, z) of radius r and the spheres of the distal link */
static dbk_real gap_to(const dbk_sphere_motion *m, const link_pair *p, dbk_real x, dbk_real y, dbk_real z, dbk_real r) {
  const dbk_real dx = m->bound_x[p->distal] - x, dy = m->bound_y[p->distal] - y, dz = m->bound_z[p->distal] - z;
  return dbk_sqrt(dx * dx + dy * dy + dz * dz) - m->bound_r[p->distal] - r - p->margin;
}

/* computes the relative motion of the distal spheres; returns the maximum closing speed over these spheres */
DBK_SIMD_CLONES static dbk_real set_relative_motion(const dbk_model *model, const dbk_ctx *ctx, const link_pair *p,
                                                    relative_motion *restrict out) {
  const dbk_sphere_motion *m = &ctx->motion;
  const int32_t count = DBK_PADDED(p->count);
  dbk_real t[6], fastest[DBK_LANES] = {(dbk_real)0};
  for (int32_t e = 0; e < 6; ++e) { t[e] = m->twist[p->end_joint][e] - m->twist[p->first_joint][e]; }
  const dbk_real wx = t[0], wy = t[1], wz = t[2], vx = t[3], vy = t[4], vz = t[5],
                 sampling_term = p->sampling_term + RHS_ROUNDING;
  /* spread: sum of half_width_k reach_k over the joints between the links */
  for (int32_t at = 0; at < count; ++at) { out->spread[at] = (dbk_real)0; }
  for (int32_t k = p->first_joint; k < p->end_joint; ++k) {
    const dbk_real half_width = m->joint_half_width[k];
    const dbk_real *restrict reach = model->reach[k] + p->first;
    for (int32_t at = 0; at < count; ++at) { out->spread[at] += half_width * reach[at]; }
  }
  /* velocity v + w x c from the relative twist (w, v) */
  for (int32_t base = 0; base < count; base += DBK_LANES) {
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      const int32_t at = base + l, s = p->first + at;
      const dbk_real x = ctx->spheres.x[s], y = ctx->spheres.y[s], z = ctx->spheres.z[s];
      const dbk_real ux = vx + (wy * z - wz * y), uy = vy + (wz * x - wx * z), uz = vz + (wx * y - wy * x);
      const dbk_real change = out->spread[at] + sampling_term;
      const dbk_real speed = at < p->count ? dbk_sqrt(ux * ux + uy * uy + uz * uz) + change : (dbk_real)0;
      out->vx[at] = ux;
      out->vy[at] = uy;
      out->vz[at] = uz;
      out->change[at] = change;
      fastest[l] = speed > fastest[l] ? speed : fastest[l];
    }
  }
  return dbk_max_lanes(fastest, (dbk_real)0);
}

typedef struct {
  dbk_real least; /* smallest h between proximal sphere i and the distal spheres */
  int32_t binds;  /* 0: no control within the trust region can violate a row, and h is above the cull floor */
} narrow_result;

/* Narrow phase of proximal sphere i. A row is safe if n'v - change >= -alpha h. With n = w / d, w the vector between
 * the centres, this is w'v + d (alpha h - change) >= 0, which needs no division. */
DBK_SIMD_CLONES static narrow_result narrow_phase(const dbk_model *model, const dbk_sphere_set *spheres,
                                                  const link_pair *p, const relative_motion *relative, int32_t i) {
  const dbk_real px = spheres->x[i], py = spheres->y[i], pz = spheres->z[i], radius = spheres->r[i] + p->margin;
  const dbk_real alpha = model->alpha_self;
  dbk_real least[DBK_LANES];
  int32_t binds[DBK_LANES] = {0};
  for (int32_t l = 0; l < DBK_LANES; ++l) { least[l] = DBK_MAX_DISTANCE; }
  for (int32_t base = 0; base < p->count; base += DBK_LANES) {
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      const int32_t at = base + l, s = p->first + at, valid = at < p->count;
      const dbk_real x = spheres->x[s] - px, y = spheres->y[s] - py, z = spheres->z[s] - pz;
      const dbk_real d = dbk_sqrt(x * x + y * y + z * z), h = d - spheres->r[s] - radius;
      const dbk_real toward = x * relative->vx[at] + y * relative->vy[at] + z * relative->vz[at];
      const dbk_real headroom = toward + d * (alpha * h - relative->change[at]);
      const int32_t safe = (headroom >= (dbk_real)0) & (h >= DBK_CULL_FLOOR);
      const dbk_real valid_h = valid ? h : DBK_MAX_DISTANCE;
      binds[l] |= valid & !safe;
      least[l] = valid_h < least[l] ? valid_h : least[l];
    }
  }
  narrow_result result = {dbk_min_lanes(least, DBK_MAX_DISTANCE), 0};
  for (int32_t l = 0; l < DBK_LANES; ++l) { result.binds |= binds[l]; }
  return result;
}

/* computes the rows of the distal spheres and proximal sphere i */
DBK_SIMD_CLONES static void bound_distal_spheres(const dbk_model *model, const dbk_ctx *ctx, const link_pair *p,
                                                 const relative_motion *relative, int32_t i,
                                                 dbk_pair_batch *restrict batch) {
  const dbk_sphere_set *spheres = &ctx->spheres;
  const dbk_sphere_motion *m = &ctx->motion;
  const int32_t count = DBK_PADDED(p->count);
  const dbk_real px = spheres->x[i], py = spheres->y[i], pz = spheres->z[i], radius = spheres->r[i];
  const dbk_real bx = m->ax[i], by = m->ay[i], bz = m->az[i];
  const dbk_row_terms t = {p->margin,   model->alpha_self, model->recovery, (dbk_real)0, (dbk_real)0.5 * model->period,
                           (dbk_real)0, (dbk_real)0,       (dbk_real)0};
  batch->count = p->count;
  batch->kind = DBK_ROW_SELF;
  batch->sphere = DBK_MANY_SPHERES;
  batch->other = i;
  batch->first_joint = p->first_joint;
  batch->end_joint = p->end_joint;
  for (int32_t at = 0; at < count; ++at) {
    const int32_t s = p->first + at;
    dbk_real nx, ny, nz;
    const dbk_real distance =
        dbk_point_distance(spheres->x[s] - px, spheres->y[s] - py, spheres->z[s] - pz, &nx, &ny, &nz);
    const dbk_point_motion motion = {spheres->r[s], relative->vx[at], relative->vy[at], relative->vz[at],
                                     m->ax[s] - bx, m->ay[s] - by,    m->az[s] - bz,    relative->spread[at]};
    const dbk_row_bound bound = dbk_bound_row(&motion, &t, 1, distance - radius, nx, ny, nz);
    batch->h[at] = bound.h;
    batch->nx[at] = nx;
    batch->ny[at] = ny;
    batch->nz[at] = nz;
    batch->rhs[at] = bound.rhs;
    batch->index[at] = s;
    batch->keep[at] = dbk_row_may_bind(&bound, 0);
    batch->clip[at] = 0;
  }
}

/* proximal sphere i against the distal spheres: narrow phase, h_min, the list for the certificate, and rows */
static void sphere_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const link_pair *p,
                        const relative_motion *relative, int32_t i) {
  const narrow_result result = narrow_phase(model, &ctx->spheres, p, relative, i);
  ++ctx->narrow_phase_count;
  ctx->h_min = dbk_min(ctx->h_min, result.least + model->sampling);
  if (!(result.least >= model->period * (p->speed + p->excess) + DBK_CULL_FLOOR)) {
    dbk_revisit_pairs(ctx, p->first, p->count, -1 - i);
  }
  if (result.binds) {
    dbk_pair_batch batch;
    bound_distal_spheres(model, ctx, p, relative, i, &batch);
    dbk_append_rows(scene, ctx, &batch);
  }
}

/* rows of one pair of links */
static void link_pair_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, int32_t proximal,
                           int32_t distal, dbk_real extra) {
  const dbk_sphere_motion *m = &ctx->motion;
  const dbk_sphere_set *spheres = &ctx->spheres;
  const int32_t first = dbk_link_first_sphere(model, distal), count = dbk_link_end_sphere(model, scene, distal) - first;
  const int32_t first_joint = dbk_link_frame(model, proximal), end_joint = dbk_link_frame(model, distal);
  const dbk_real held_error = distal == model->n_links ? scene->held_error : (dbk_real)0;
  if (count <= 0 || first_joint == end_joint) { return; }
  link_pair p = {distal,
                 first_joint,
                 end_joint,
                 first,
                 count,
                 model->self_margin + model->sampling + model->rounding + extra + held_error,
                 m->sampling_term[proximal] + m->sampling_term[distal],
                 closing_speed(model, m, proximal, distal, first_joint, end_joint),
                 (dbk_real)0};
  for (int32_t k = first_joint; k < end_joint; ++k) { p.excess += m->joint_excess[k] * model->link_reach[k][distal]; }
  /* bounding spheres, first with the bound by links, then with the tighter bound by spheres */
  const dbk_real gap =
      gap_to(m, &p, m->bound_x[proximal], m->bound_y[proximal], m->bound_z[proximal], m->bound_r[proximal]);
  if (!relevant(model, ctx, &p, gap)) { return; }
  relative_motion relative;
  p.speed = dbk_min(p.speed, set_relative_motion(model, ctx, &p, &relative));
  if (!relevant(model, ctx, &p, gap)) { return; }
  /* single spheres of the proximal link */
  for (int32_t i = model->link_first[proximal]; i < model->link_first[proximal + 1]; ++i) {
    if (relevant(model, ctx, &p, gap_to(m, &p, spheres->x[i], spheres->y[i], spheres->z[i], spheres->r[i]))) {
      sphere_rows(model, scene, ctx, &p, &relative, i);
    }
  }
}

/* The pairs are processed from the last one: it is at the end of the arm and is usually the closest, which lets h_min
 * cull more of the other pairs. */
void dbk_self_collision_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real extra) {
  for (int32_t p = model->n_pairs - 1; p >= 0; --p) {
    link_pair_rows(model, scene, ctx, model->pair[p][0], model->pair[p][1], extra);
  }
  if (scene->n_held > 0) {
    for (int32_t l = 0; l < model->n_held_links; ++l) {
      link_pair_rows(model, scene, ctx, model->held_link[l], model->n_links, extra);
    }
  }
}
