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

/* a pair of links; `first` and `count` are the spheres of the distal link; the joints first_joint..end_joint-1 lie
 * between the links */
typedef struct {
  int32_t number; /* index in model->pair; after the last one: n_pairs + index in model->held_link */
  int32_t proximal, distal, first_joint, end_joint, first, count;
  dbk_real margin;
  dbk_spatial motion; /* of the distal link relative to the proximal one, and as seen from there */
  dbk_real bend;     /* maximum sampling term dt/2 |a| of the relative acceleration a of the spheres */
  dbk_real change;   /* maximum change of the closing speed within the trust region, plus the sampling term */
  dbk_real speed;    /* maximum closing speed within the trust region, including the sampling term, by joints and links */
  dbk_real closing;  /* the same for the rows, also by the direction of the motion */
  dbk_real excess;   /* maximum additional closing speed within the control bounds */
  dbk_real travel;   /* maximum decrease of h within this period, plus the cull floor [m] */
} link_pair;

/* velocity of the distal spheres relative to the proximal link at the centre of the trust region; `spread` is the
 * maximum change of the velocity within the trust region. `travel` is that of the pair, by the speeds of the spheres */
typedef struct {
  int32_t ready;
  dbk_real travel;
  dbk_real vx[DBK_SPHERE_CAPACITY], vy[DBK_SPHERE_CAPACITY], vz[DBK_SPHERE_CAPACITY], spread[DBK_SPHERE_CAPACITY];
} relative_motion;

/* 1 unless all of the following hold at distance h: no control within the trust region can violate the row, no control
 * within the control bounds can reach h = 0 within this period, and another pair is closer */
DBK_INLINED int32_t relevant(const dbk_model *model, const dbk_ctx *ctx, const link_pair *p, dbk_real closing,
                             dbk_real h) {
  const dbk_real stopping = dbk_stopping_speed(model->braking_gain, model->arc_share, h, p->bend);
  const dbk_real speed = dbk_min(model->alpha_self * h, stopping);
  return !(h > p->travel && speed >= closing && h + model->sampling >= ctx->h_min);
}

/* velocity v + w x c of the distal link at a point, relative to the proximal link */
DBK_INLINED void relative_velocity(const link_pair *p, dbk_real x, dbk_real y, dbk_real z, dbk_real v[3]) {
  const dbk_real *w = p->motion.tw, *t = p->motion.tv;
  v[0] = t[0] + (w[1] * z - w[2] * y);
  v[1] = t[1] + (w[2] * x - w[0] * z);
  v[2] = t[2] + (w[0] * y - w[1] * x);
}

/* The largest closing speed of two points whose difference is within `radius` of a vector of length `distance`, if the
 * product of the difference and the relative velocity is at least `product`. */
static inline dbk_real closing_within(const link_pair *p, dbk_real product, dbk_real distance, dbk_real radius) {
  const dbk_real nearest = distance - radius;
  if (!(nearest > DBK_CULL_FLOOR)) { return p->closing; }
  return dbk_min(p->closing, (product < (dbk_real)0 ? -product / nearest : (dbk_real)0) + p->change);
}

/* Bounds of the closing speeds by the joints between the links, and of the relative acceleration: joint k contributes
 * u_k z_k x v to the acceleration of a point that the joints after it move with v, twice, and once with its own v. */
static void bound_speeds(const dbk_model *model, const dbk_sphere_motion *m, link_pair *p) {
  dbk_real speed = (dbk_real)0, acceleration = (dbk_real)0, turn = (dbk_real)0;
  p->excess = (dbk_real)0;
  p->change = DBK_RHS_ROUNDING;
  for (int32_t k = p->first_joint; k < p->end_joint; ++k) {
    const dbk_real reach = model->link_reach[k][p->distal], most = m->joint_max_speed[k] + m->joint_excess[k];
    const dbk_real own_turn = model->joint_kind[k] == DBK_PRISMATIC ? (dbk_real)0 : most;
    speed += m->joint_max_speed[k] * reach;
    acceleration += ((dbk_real)2 * turn + own_turn) * most * reach;
    turn += own_turn;
    p->excess += m->joint_excess[k] * reach;
    p->change += m->joint_half_width[k] * reach;
  }
  if (model->moving_base && p->first_joint == 0) { /* see dbk_turn_drive */
    acceleration += (m->joint_max_speed[0] + m->joint_excess[0]) * (m->joint_max_speed[1] + m->joint_excess[1]);
  }
  p->bend = (dbk_real)0.5 * model->period * acceleration;
  p->change += p->bend;
  p->speed = p->closing = dbk_min(speed, m->trust_speed[p->proximal] + m->trust_speed[p->distal]) + p->bend;
  p->travel = model->period * (p->speed + p->excess) + DBK_CULL_FLOOR;
}

/* c -= a x b */
static inline void subtract_cross(const dbk_real a[3], const dbk_real b[3], dbk_real c[3]) {
  c[0] -= a[1] * b[2] - a[2] * b[1];
  c[1] -= a[2] * b[0] - a[0] * b[2];
  c[2] -= a[0] * b[1] - a[1] * b[0];
}

/* velocity v + w x c and acceleration dv + dw x c + w x (v + w x c) of the distal link at a point c, as seen from the
 * proximal link */
static inline void relative_motion_at(const link_pair *p, dbk_real x, dbk_real y, dbk_real z, dbk_real v[3],
                                      dbk_real a[3]) {
  const dbk_real *w = p->motion.w, *t = p->motion.v, *dw = p->motion.dw, *dv = p->motion.dv;
  v[0] = t[0] + (w[1] * z - w[2] * y);
  v[1] = t[1] + (w[2] * x - w[0] * z);
  v[2] = t[2] + (w[0] * y - w[1] * x);
  a[0] = dv[0] + (dw[1] * z - dw[2] * y) + (w[1] * v[2] - w[2] * v[1]);
  a[1] = dv[1] + (dw[2] * x - dw[0] * z) + (w[2] * v[0] - w[0] * v[2]);
  a[2] = dv[2] + (dw[0] * y - dw[1] * x) + (w[0] * v[1] - w[1] * v[0]);
}

/* Sets the relative acceleration, and tightens its bound. With the spatial velocities V and accelerations A of the
 * proximal link p and the distal link d, it is A_d - A_p - V_p x (V_d - V_p). The common motion of both links changes no
 * distance and has no part in it. */
static void bound_acceleration(const dbk_model *model, const dbk_sphere_motion *m, link_pair *p) {
  const dbk_spatial *near = &m->chain[p->first_joint], *far = &m->chain[p->end_joint];
  const dbk_real *w = p->motion.w, *dw = p->motion.dw;
  const int32_t b = p->distal;
  dbk_real v[3], a[3];
  for (int32_t e = 0; e < 3; ++e) {
    p->motion.w[e] = far->w[e] - near->w[e];
    p->motion.v[e] = far->v[e] - near->v[e];
    p->motion.dw[e] = far->dw[e] - near->dw[e];
    p->motion.dv[e] = far->dv[e] - near->dv[e];
  }
  subtract_cross(near->w, p->motion.w, p->motion.dw);
  subtract_cross(near->w, p->motion.v, p->motion.dv);
  subtract_cross(near->v, p->motion.w, p->motion.dv);
  relative_motion_at(p, m->bound_x[b], m->bound_y[b], m->bound_z[b], v, a);
  const dbk_real turn = dbk_length(dw[0], dw[1], dw[2]) + (w[0] * w[0] + w[1] * w[1] + w[2] * w[2]);
  const dbk_real most = dbk_length(a[0], a[1], a[2]) + turn * m->centres_radius[b];
  const dbk_real less = p->bend - dbk_min(p->bend, (dbk_real)0.5 * model->period * most);
  p->bend -= less;
  p->change -= less;
  p->closing -= less;
}

/* Sets the relative twist, and tightens the closing speed by the directions. With the difference c_s - c_i of the
 * centres of a distal and a proximal sphere, W the difference of the centres of the bounding spheres, V the relative
 * velocity at the centre of each, and the distances e and f of the centres from those of the bounding spheres,
 *
 *   (c_s - c_i)'v = W'V_p + e'V_p - f'V_d + e'(w x f)
 *
 * which is exact: w x (c_s - c_i) is orthogonal to c_s - c_i. */
static void bound_by_direction(const dbk_sphere_motion *m, link_pair *p) {
  const int32_t a = p->proximal, b = p->distal;
  const dbk_real x = m->bound_x[b] - m->bound_x[a], y = m->bound_y[b] - m->bound_y[a], z = m->bound_z[b] - m->bound_z[a];
  const dbk_real f = m->centres_radius[a], e = m->centres_radius[b];
  dbk_real near[3], far[3];
  for (int32_t i = 0; i < 3; ++i) {
    p->motion.tw[i] = m->chain[p->end_joint].tw[i] - m->chain[p->first_joint].tw[i];
    p->motion.tv[i] = m->chain[p->end_joint].tv[i] - m->chain[p->first_joint].tv[i];
  }
  relative_velocity(p, m->bound_x[a], m->bound_y[a], m->bound_z[a], near);
  relative_velocity(p, m->bound_x[b], m->bound_y[b], m->bound_z[b], far);
  const dbk_real turn = dbk_length(p->motion.tw[0], p->motion.tw[1], p->motion.tw[2]);
  const dbk_real origin = dbk_abs(m->bound_x[b]) + dbk_abs(m->bound_y[b]) + dbk_abs(m->bound_z[b]);
  p->change += DBK_VELOCITY_ROUNDING * turn * origin;
  const dbk_real product = (x * near[0] + y * near[1] + z * near[2]) - e * dbk_length(near[0], near[1], near[2]) -
                           f * dbk_length(far[0], far[1], far[2]) - turn * e * f;
  p->closing = closing_within(p, product, dbk_length(x, y, z), e + f);
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
  const dbk_real *w = p->motion.tw, *v = p->motion.tv;
  const dbk_real wx = w[0], wy = w[1], wz = w[2], vx = v[0], vy = v[1], vz = v[2];
  const dbk_real sampling_term = p->bend + DBK_RHS_ROUNDING;
  const dbk_real *sx = ctx->spheres.x + p->first, *sy = ctx->spheres.y + p->first, *sz = ctx->spheres.z + p->first;
  dbk_real fastest[DBK_LANES] = {(dbk_real)0};
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
      const int32_t at = base + l;
      const dbk_real x = sx[at], y = sy[at], z = sz[at];
      const dbk_real ux = vx + (wy * z - wz * y), uy = vy + (wz * x - wx * z), uz = vz + (wx * y - wy * x);
      const dbk_real change = out->spread[at] + sampling_term;
      const dbk_real speed = at < p->count ? dbk_sqrt(ux * ux + uy * uy + uz * uz) + change : (dbk_real)0;
      out->vx[at] = ux;
      out->vy[at] = uy;
      out->vz[at] = uz;
      fastest[l] = speed > fastest[l] ? speed : fastest[l];
    }
  }
  return dbk_max_lanes(fastest, (dbk_real)0);
}

/* computes the relative motion, and the travel by the speeds of the spheres, unless both are ready */
static void move_distal_spheres(const dbk_model *model, const dbk_ctx *ctx, const link_pair *p, relative_motion *out) {
  if (out->ready) { return; }
  const dbk_real speed = dbk_min(p->speed, set_relative_motion(model, ctx, p, out));
  out->travel = model->period * (speed + p->excess) + DBK_CULL_FLOOR;
  out->ready = 1;
}

typedef struct {
  dbk_real least; /* smallest h between proximal sphere i and the distal spheres */
  int32_t binds;  /* 0: no control within the trust region can violate a row, and h is above the cull floor */
} narrow_result;

/* Narrow phase of proximal sphere i. A row is safe if n'v - change >= -s with s = min(alpha h, dbk_stopping_speed),
 * at most that of dbk_approach_speed. With n = w / d, w the vector between the centres, this is w'v + d (s - change) >= 0,
 * which needs no division. `v` is the relative velocity at the centre of sphere i, since w'v is the same at both centres.
 * keep[] is 1 for the spheres whose row may bind. */
DBK_SIMD_CLONES static narrow_result narrow_phase(const dbk_model *model, const dbk_sphere_set *spheres,
                                                  const link_pair *p, const dbk_real v[3], int32_t i,
                                                  int32_t *restrict keep) {
  const dbk_real px = spheres->x[i], py = spheres->y[i], pz = spheres->z[i], radius = spheres->r[i] + p->margin;
  const dbk_real vx = v[0], vy = v[1], vz = v[2], change = p->change, bend = p->bend;
  const dbk_real alpha = model->alpha_self, braking_gain = model->braking_gain, arc_share = model->arc_share;
  const dbk_real *restrict sx = spheres->x + p->first, *restrict sy = spheres->y + p->first;
  const dbk_real *restrict sz = spheres->z + p->first, *restrict sr = spheres->r + p->first;
  dbk_real least[DBK_LANES];
  int32_t binds[DBK_LANES] = {0};
  for (int32_t l = 0; l < DBK_LANES; ++l) { least[l] = DBK_MAX_DISTANCE; }
  for (int32_t base = 0; base < p->count; base += DBK_LANES) {
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      const int32_t at = base + l, valid = at < p->count;
      const dbk_real x = sx[at] - px, y = sy[at] - py, z = sz[at] - pz;
      const dbk_real d = dbk_sqrt(x * x + y * y + z * z), h = d - sr[at] - radius;
      const dbk_real stopping = dbk_stopping_speed(braking_gain, arc_share, h, bend);
      const dbk_real headroom = (x * vx + y * vy + z * vz) + d * (dbk_min(alpha * h, stopping) - change);
      const int32_t safe = (headroom >= (dbk_real)0) & (h >= DBK_CULL_FLOOR);
      const dbk_real valid_h = valid ? h : DBK_MAX_DISTANCE;
      keep[at] = valid & !safe;
      binds[l] |= valid & !safe;
      least[l] = valid_h < least[l] ? valid_h : least[l];
    }
  }
  narrow_result result = {dbk_min_lanes(least, DBK_MAX_DISTANCE), 0};
  for (int32_t l = 0; l < DBK_LANES; ++l) { result.binds |= binds[l]; }
  return result;
}

/* Computes the rows of the kept distal spheres and proximal sphere i. The second derivative of the distance of two points is
 * n'a + (|v|^2 - (n'v)^2) / distance. */
DBK_SIMD_CLONES static void bound_distal_spheres(const dbk_model *model, const dbk_ctx *ctx, const link_pair *p,
                                                 const relative_motion *relative, int32_t i,
                                                 dbk_pair_batch *restrict batch) {
  const dbk_sphere_set *spheres = &ctx->spheres;
  const int32_t count = DBK_PADDED(p->count);
  const dbk_real px = spheres->x[i], py = spheres->y[i], pz = spheres->z[i], radius = spheres->r[i];
  const dbk_real *sx = spheres->x + p->first, *sy = spheres->y + p->first, *sz = spheres->z + p->first;
  const dbk_real *sr = spheres->r + p->first;
  const dbk_row_terms t = {p->margin,
                           model->alpha_self,
                           model->braking_gain,
                           model->arc_share,
                           model->recovery,
                           (dbk_real)0,
                           (dbk_real)0.5 * model->period,
                           (dbk_real)0,
                           (dbk_real)0,
                           (dbk_real)0};
  batch->count = p->count;
  batch->kind = DBK_ROW_SELF;
  batch->sphere = DBK_MANY_SPHERES;
  batch->other = i;
  batch->first_joint = p->first_joint;
  batch->end_joint = p->end_joint;
  for (int32_t at = 0; at < count; ++at) {
    if (DBK_LANES == 1 && !batch->keep[at]) { continue; }
    dbk_real nx, ny, nz, v[3], a[3];
    relative_motion_at(p, sx[at], sy[at], sz[at], v, a);
    const dbk_real distance = dbk_point_distance(sx[at] - px, sy[at] - py, sz[at] - pz, &nx, &ny, &nz);
    const dbk_real rate = nx * v[0] + ny * v[1] + nz * v[2];
    const dbk_real across = (v[0] * v[0] + v[1] * v[1] + v[2] * v[2]) - rate * rate;
    const dbk_real turn = dbk_max(across, (dbk_real)0) / dbk_max(distance, radius);
    const dbk_point_motion motion = {sr[at],           relative->vx[at], relative->vy[at], relative->vz[at],
                                     a[0] + turn * nx, a[1] + turn * ny, a[2] + turn * nz, relative->spread[at]};
    const dbk_row_bound bound = dbk_bound_row(&motion, &t, 1, distance - radius, nx, ny, nz);
    batch->h[at] = bound.h;
    batch->nx[at] = nx;
    batch->ny[at] = ny;
    batch->nz[at] = nz;
    batch->rhs[at] = bound.rhs;
    batch->index[at] = p->first + at;
    batch->keep[at] &= dbk_row_may_bind(&bound, 0);
    batch->clip[at] = 0;
  }
}

/* updates h_min by the smallest h of a group of pairs, and keeps the group for the next step if it is the nearest */
static void record_nearest(dbk_ctx *ctx, dbk_real h, int32_t number, int32_t sphere) {
  if (!(h < ctx->h_min)) { return; }
  const dbk_nearest_links group = {number, sphere};
  ctx->h_min = h;
  ctx->nearest = group;
}

/* proximal sphere i against the distal spheres: narrow phase, h_min, the list for the certificate. Returns 1 if a row
 * may bind, with keep[] = 1 for its sphere */
static int32_t test_sphere(const dbk_model *model, dbk_ctx *ctx, const link_pair *p, relative_motion *relative,
                           const dbk_real v[3], int32_t i, int32_t *keep) {
  const narrow_result result = narrow_phase(model, &ctx->spheres, p, v, i, keep);
  ++ctx->narrow_phase_count;
  record_nearest(ctx, result.least + model->sampling, p->number, i);
  if (!(result.least >= p->travel)) {
    move_distal_spheres(model, ctx, p, relative);
    if (!(result.least >= relative->travel)) { dbk_revisit_pairs(ctx, p->first, p->count, -1 - i); }
  }
  return result.binds;
}

/* the spheres of the proximal link, each against the bounding sphere of the distal link, then against its spheres. The
 * relative motion of the distal spheres is computed for the first rows */
static void proximal_spheres(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const link_pair *p) {
  const dbk_sphere_motion *m = &ctx->motion;
  const dbk_sphere_set *c = &ctx->spheres;
  const dbk_real bx = m->bound_x[p->distal], by = m->bound_y[p->distal], bz = m->bound_z[p->distal];
  const dbk_real radius = m->centres_radius[p->distal], surface = m->bound_r[p->distal] + p->margin;
  relative_motion relative;
  relative.ready = 0;
  for (int32_t i = model->link_first[p->proximal]; i < model->link_first[p->proximal + 1]; ++i) {
    const dbk_real x = bx - c->x[i], y = by - c->y[i], z = bz - c->z[i], distance = dbk_length(x, y, z);
    dbk_real v[3];
    relative_velocity(p, c->x[i], c->y[i], c->z[i], v);
    const dbk_real product = (x * v[0] + y * v[1] + z * v[2]) - radius * dbk_length(v[0], v[1], v[2]);
    const dbk_real closing = closing_within(p, product, distance, radius);
    if (!relevant(model, ctx, p, closing, distance - surface - c->r[i])) { continue; }
    dbk_pair_batch batch;
    if (!test_sphere(model, ctx, p, &relative, v, i, batch.keep)) { continue; }
    move_distal_spheres(model, ctx, p, &relative);
    bound_distal_spheres(model, ctx, p, &relative, i, &batch);
    dbk_append_rows(scene, ctx, &batch);
  }
}

/* a pair of links by its number; `count` is 0 if the distal link has no spheres, or if no joint is between the links. The
 * speeds are not set */
static link_pair link_pair_of(const dbk_model *model, const dbk_scene *scene, int32_t number, dbk_real extra) {
  const int32_t held = number >= model->n_pairs;
  const int32_t other = held ? dbk_bounded(number - model->n_pairs, DBK_MAX_LINKS - 1) : 0;
  link_pair p;
  p.number = number;
  p.proximal = held ? model->held_link[other] : model->pair[number][0];
  p.distal = held ? model->n_links : model->pair[number][1];
  p.first = dbk_link_first_sphere(model, p.distal);
  p.first_joint = dbk_link_frame(model, p.proximal);
  p.end_joint = dbk_link_frame(model, p.distal);
  p.count = p.first_joint == p.end_joint ? 0 : dbk_link_end_sphere(model, scene, p.distal) - p.first;
  const dbk_real held_error = p.distal == model->n_links ? scene->held_error : (dbk_real)0;
  p.margin = model->self_margin + model->sampling + model->rounding + extra + held_error;
  return p;
}

/* rows of one pair of links: bounding sphere against bounding sphere, first with the closing speed by joints, then with
 * the direction of the relative motion */
static void link_pair_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, int32_t number,
                           dbk_real extra) {
  const dbk_sphere_motion *m = &ctx->motion;
  link_pair p = link_pair_of(model, scene, number, extra);
  const int32_t near = p.proximal;
  if (p.count <= 0) { return; }
  bound_speeds(model, m, &p);
  const dbk_real gap = gap_to(m, &p, m->bound_x[near], m->bound_y[near], m->bound_z[near], m->bound_r[near]);
  if (!relevant(model, ctx, &p, p.closing, gap)) { return; }
  bound_by_direction(m, &p);
  if (!relevant(model, ctx, &p, p.closing, gap)) { return; }
  bound_acceleration(model, m, &p);
  if (!relevant(model, ctx, &p, p.closing, gap)) { return; }
  proximal_spheres(model, scene, ctx, &p);
}

static int32_t pair_count(const dbk_model *model, const dbk_scene *scene) {
  return model->n_pairs + (scene->n_held > 0 ? model->n_held_links : 0);
}

/* the arithmetic is that of the narrow phase, so h is one of the values whose minimum is h_min */
void dbk_start_from_nearest_links(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real extra) {
  const int32_t number = ctx->nearest.link_pair, i = ctx->nearest.sphere;
  const dbk_sphere_set *c = &ctx->spheres;
  if (number < 0 || number >= pair_count(model, scene)) { return; }
  const link_pair p = link_pair_of(model, scene, number, extra);
  if (i < model->link_first[p.proximal] || i >= model->link_first[p.proximal + 1]) { return; }
  const int32_t end = dbk_bounded(p.first + p.count, DBK_ALL_SPHERES);
  for (int32_t s = p.first; s < end; ++s) {
    const dbk_real x = c->x[s] - c->x[i], y = c->y[s] - c->y[i], z = c->z[s] - c->z[i], radius = c->r[i] + p.margin;
    const dbk_real h = dbk_sqrt(x * x + y * y + z * z) - c->r[s] - radius;
    ctx->h_min = dbk_min(ctx->h_min, h + model->sampling);
  }
}

/* The pairs are processed from the last one: it is at the end of the arm and is usually the closest, which lets h_min
 * cull more of the other pairs. */
void dbk_self_collision_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real extra) {
  for (int32_t p = model->n_pairs - 1; p >= 0; --p) { link_pair_rows(model, scene, ctx, p, extra); }
  for (int32_t p = model->n_pairs; p < pair_count(model, scene); ++p) { link_pair_rows(model, scene, ctx, p, extra); }
}
