/* Spheres of the body against each other, and against what is held. Only the joints between two links change their
 * distance, so speeds are those of one link as seen from the other. From coarse to fine: ball of a link against ball of a
 * link, sphere against ball, distances of a sphere from all spheres of a link, and at last the rows. */
#include "dbk_pair.h"

/* what is the same for all spheres of one pair of links; joints from..upto-1 lie between them */
typedef struct {
  int32_t far, from, upto, first, count;
  dbk_real margin, bend;
  dbk_real speed; /* no pair closes faster within the trust box; `bend`, the accelerations' part in the row, is included */
  dbk_real beyond; /* within the whole box a pair may close faster by this */
} link_pair;

/* how spheres of link `far` move as seen from link `near`, at the middle of the trust box; `change`: what it and both
 * accelerations can make of that in a row */
typedef struct {
  dbk_real vx[DBK_SPHERE_ROOM], vy[DBK_SPHERE_ROOM], vz[DBK_SPHERE_ROOM], spread[DBK_SPHERE_ROOM], change[DBK_SPHERE_ROOM];
} relative_motion;

/* how fast two links can close within the trust box: as the joints between them can, or as they move in space */
static dbk_real closing_speed(const dbk_model *model, const dbk_motion *m, int32_t near, int32_t far, int32_t from,
                              int32_t upto) {
  dbk_real speed = m->bend[near] + m->bend[far];
  for (int32_t k = from; k < upto; ++k) { speed += m->fast[k] * model->link_reach[k][far]; }
  return dbk_min(speed, m->speed[near] + m->speed[far]);
}

/* does something at distance h matter: may a control of the trust box violate its row, may any bring it to h = 0 in this
 * period, or is it the nearest of all? */
static int32_t matters(const dbk_model *model, const dbk_ctx *ctx, const link_pair *p, dbk_real h) {
  const dbk_real soon = model->period * (p->speed + p->beyond) + DBK_CULL_FLOOR;
  return !(h > soon && model->alpha_self * h >= p->speed && h + model->sampling >= ctx->h_min);
}

/* lower bound of h between a ball at (x, y, z) of radius r and the spheres of link `far` */
static dbk_real gap_to(const dbk_motion *m, const link_pair *p, dbk_real x, dbk_real y, dbk_real z, dbk_real r) {
  const dbk_real dx = m->bound_x[p->far] - x, dy = m->bound_y[p->far] - y, dz = m->bound_z[p->far] - z;
  return dbk_sqrt(dx * dx + dy * dy + dz * dz) - m->bound_r[p->far] - r - p->margin;
}

/* relative motion of the spheres of link `far`; returns the greatest closing speed among them */
DBK_WIDE static dbk_real move_relative(const dbk_model *model, const dbk_ctx *ctx, const link_pair *p,
                                       relative_motion *restrict out) {
  const dbk_motion *m = &ctx->motion;
  const int32_t count = DBK_PADDED(p->count);
  dbk_real t[6], fastest[DBK_LANES] = {(dbk_real)0};
  for (int32_t e = 0; e < 6; ++e) { t[e] = m->twist[p->upto][e] - m->twist[p->from][e]; }
  const dbk_real wx = t[0], wy = t[1], wz = t[2], vx = t[3], vy = t[4], vz = t[5], bend = p->bend + DBK_ROUNDED;
  for (int32_t at = 0; at < count; ++at) { out->spread[at] = (dbk_real)0; }
  for (int32_t k = p->from; k < p->upto; ++k) {
    const dbk_real wide = m->wide[k];
    const dbk_real *restrict reach = model->reach[k] + p->first;
    for (int32_t at = 0; at < count; ++at) { out->spread[at] += wide * reach[at]; }
  }
  for (int32_t base = 0; base < count; base += DBK_LANES) {
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      const int32_t at = base + l, s = p->first + at;
      const dbk_real x = ctx->cloud.x[s], y = ctx->cloud.y[s], z = ctx->cloud.z[s];
      const dbk_real ux = vx + (wy * z - wz * y), uy = vy + (wz * x - wx * z), uz = vz + (wx * y - wy * x);
      const dbk_real change = out->spread[at] + bend;
      const dbk_real speed = at < p->count ? dbk_sqrt(ux * ux + uy * uy + uz * uz) + change : (dbk_real)0;
      out->vx[at] = ux;
      out->vy[at] = uy;
      out->vz[at] = uz;
      out->change[at] = change;
      fastest[l] = speed > fastest[l] ? speed : fastest[l];
    }
  }
  return dbk_greatest(fastest, (dbk_real)0);
}

typedef struct {
  dbk_real least; /* smallest h between sphere i and the spheres of link `far` */
  int32_t binds;  /* 0: no control of the box violates a row of theirs, and h is above the floor */
} glance;

/* rate >= -alpha h holds with n = w / d where w'v - d change + d alpha h >= 0: no division is needed to see that */
DBK_WIDE static glance look(const dbk_model *model, const dbk_cloud *cloud, const link_pair *p,
                            const relative_motion *relative, int32_t i) {
  const dbk_real px = cloud->x[i], py = cloud->y[i], pz = cloud->z[i], off = cloud->r[i] + p->margin;
  const dbk_real alpha = model->alpha_self;
  dbk_real least[DBK_LANES];
  int32_t binds[DBK_LANES] = {0};
  for (int32_t l = 0; l < DBK_LANES; ++l) { least[l] = DBK_BEYOND; }
  for (int32_t base = 0; base < p->count; base += DBK_LANES) {
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      const int32_t at = base + l, s = p->first + at, real = at < p->count;
      const dbk_real x = cloud->x[s] - px, y = cloud->y[s] - py, z = cloud->z[s] - pz;
      const dbk_real d = dbk_sqrt(x * x + y * y + z * z), h = d - cloud->r[s] - off;
      const dbk_real toward = x * relative->vx[at] + y * relative->vy[at] + z * relative->vz[at];
      const dbk_real room = toward + d * (alpha * h - relative->change[at]);
      const int32_t safe = (room >= (dbk_real)0) & (h >= DBK_CULL_FLOOR);
      const dbk_real mine = real ? h : DBK_BEYOND;
      binds[l] |= real & !safe;
      least[l] = mine < least[l] ? mine : least[l];
    }
  }
  glance it = {dbk_least(least, DBK_BEYOND), 0};
  for (int32_t l = 0; l < DBK_LANES; ++l) { it.binds |= binds[l]; }
  return it;
}

/* rows of the spheres of link `far` against sphere i */
DBK_WIDE static void weigh_sphere(const dbk_model *model, const dbk_ctx *ctx, const link_pair *p,
                                  const relative_motion *relative, int32_t i, dbk_batch *restrict w) {
  const dbk_cloud *cloud = &ctx->cloud;
  const dbk_motion *m = &ctx->motion;
  const int32_t count = DBK_PADDED(p->count);
  const dbk_real px = cloud->x[i], py = cloud->y[i], pz = cloud->z[i], radius = cloud->r[i];
  const dbk_real bx = m->ax[i], by = m->ay[i], bz = m->az[i];
  const dbk_terms t = {p->margin, model->alpha_self, model->recovery, (dbk_real)0, (dbk_real)0.5 * model->period,
                       (dbk_real)0, (dbk_real)0, (dbk_real)0};
  w->count = p->count;
  w->kind = DBK_ROW_SELF;
  w->sphere = DBK_SEVERAL;
  w->other = i;
  w->from = p->from;
  w->upto = p->upto;
  for (int32_t at = 0; at < count; ++at) {
    const int32_t s = p->first + at;
    dbk_real nx, ny, nz;
    const dbk_real far = dbk_off_point(cloud->x[s] - px, cloud->y[s] - py, cloud->z[s] - pz, &nx, &ny, &nz);
    const dbk_mover it = {cloud->r[s],     relative->vx[at], relative->vy[at], relative->vz[at],
                          m->ax[s] - bx, m->ay[s] - by,    m->az[s] - bz,    relative->spread[at]};
    const dbk_weight weight = dbk_weigh(&it, &t, 1, far - radius, nx, ny, nz);
    w->h[at] = weight.h;
    w->nx[at] = nx;
    w->ny[at] = ny;
    w->nz[at] = nz;
    w->rhs[at] = weight.rhs;
    w->index[at] = s;
    w->keep[at] = dbk_binds(&weight, 0);
    w->yielding[at] = 0;
  }
}

/* sphere i of link `near` against the spheres of link `far` */
static void meet_sphere(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const link_pair *p,
                        const relative_motion *relative, int32_t i) {
  const glance it = look(model, &ctx->cloud, p, relative, i);
  ++ctx->glances;
  ctx->h_min = dbk_min(ctx->h_min, it.least + model->sampling);
  if (!(it.least >= model->period * (p->speed + p->beyond) + DBK_CULL_FLOOR)) { dbk_remember(ctx, p->first, p->count, -1 - i); }
  if (it.binds) {
    dbk_batch w;
    weigh_sphere(model, ctx, p, relative, i, &w);
    dbk_keep_rows(scene, ctx, &w);
  }
}

/* spheres of link `far` (moved by more joints) against those of link `near` */
static void meet_link(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, int32_t near, int32_t far,
                      dbk_real extra) {
  const dbk_motion *m = &ctx->motion;
  const dbk_cloud *cloud = &ctx->cloud;
  const int32_t first = dbk_first_sphere(model, far), count = dbk_last_sphere(model, scene, far) - first;
  const int32_t from = dbk_link_frame(model, near), upto = dbk_link_frame(model, far);
  const dbk_real held_error = far == model->n_links ? scene->held_error : (dbk_real)0;
  if (count <= 0 || from == upto) { return; }
  link_pair p = {far, from, upto, first, count,
                 model->self_margin + model->sampling + model->rounding + extra + held_error,
                 m->bend[near] + m->bend[far],
                 closing_speed(model, m, near, far, from, upto), (dbk_real)0};
  for (int32_t k = from; k < upto; ++k) { p.beyond += m->beyond[k] * model->link_reach[k][far]; }
  const dbk_real gap = gap_to(m, &p, m->bound_x[near], m->bound_y[near], m->bound_z[near], m->bound_r[near]);
  if (!matters(model, ctx, &p, gap)) { return; }
  relative_motion relative;
  p.speed = dbk_min(p.speed, move_relative(model, ctx, &p, &relative));
  if (!matters(model, ctx, &p, gap)) { return; }
  for (int32_t i = model->link_first[near]; i < model->link_first[near + 1]; ++i) {
    if (matters(model, ctx, &p, gap_to(m, &p, cloud->x[i], cloud->y[i], cloud->z[i], cloud->r[i]))) {
      meet_sphere(model, scene, ctx, &p, &relative, i);
    }
  }
}

/* rows of all pairs of links that are kept apart; the last pairs of the list, far out on the arm, are nearest as a rule */
void dbk_meet_self(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real extra) {
  for (int32_t p = model->n_pairs - 1; p >= 0; --p) {
    meet_link(model, scene, ctx, model->pair[p][0], model->pair[p][1], extra);
  }
  if (scene->n_held > 0) {
    for (int32_t l = 0; l < model->n_held_links; ++l) {
      meet_link(model, scene, ctx, model->held_link[l], model->n_links, extra);
    }
  }
}
