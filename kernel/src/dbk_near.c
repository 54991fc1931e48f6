/* Which obstacles matter for which links: the ball around a link against the capsule around an obstacle. A pair is left
 * out only when, by this lower bound of h, no control of the trust box can violate any of its rows, no control at all can
 * bring it to h = 0 in this period, and another pair is nearer, so that h_min is not found here. Everything is rounded toward looking again. */
#include "dbk_pair.h"

/* obstacles moved on by the age of the scene; error and dials of the filter become margins */
DBK_WIDE void dbk_surroundings(const dbk_model *model, const dbk_scene *scene, dbk_real age, dbk_real extra,
                               int32_t known_only, dbk_surround *restrict out) {
  const dbk_covers *c = &scene->covers;
  const dbk_real sampling = model->sampling, rounding = model->rounding, alpha = model->alpha;
  const int32_t lanes = DBK_PADDED(scene->n_obstacles);
  for (int32_t o = 0; o < lanes; ++o) {
    const dbk_real own = c->alpha[o];
    out->x[o] = c->x[o] + c->vx[o] * age;
    out->y[o] = c->y[o] + c->vy[o] * age;
    out->z[o] = c->z[o] + c->vz[o] * age;
    out->margin[o] = c->margin[o] + c->error[o] * age + sampling + rounding + extra;
    out->alpha[o] = own > (dbk_real)0 ? own : alpha;
    out->parts[o] = (c->known[o] | !known_only) ? c->parts[o] : 0u;
  }
  out->lanes = lanes;
  out->age = age;
  out->extra = extra;
  out->known_only = known_only;
}

/* v_max from d = v_h (T_r + T_s) + v T_r + v^2 / (2 a), T_s = v / a: the speed toward a person at which the robot still
 * stops in time; 0 when even a robot at rest is too near */
dbk_real dbk_separation_speed(const dbk_obstacle *o, dbk_real d, dbk_real person) {
  const dbk_real late = o->reaction + person / o->brake, spare = d - person * o->reaction;
  if (!(spare > (dbk_real)0)) { return (dbk_real)0; }
  return o->brake * (dbk_sqrt(late * late + (dbk_real)2 * spare / o->brake) - late);
}

/* lower bounds of h between every sphere of a link and the capsules; and how far the nearest pair with each open capsule
 * can be at most, as the innermost sphere of the ball is that near. Is none `any_long`, the capsules are balls. */
static inline void capsule_gaps(const dbk_scene *scene, const dbk_surround *s, const dbk_motion *m, int32_t link,
                                int32_t any_long, dbk_real held_error, dbk_real *restrict gap,
                                dbk_real *restrict nearest) {
  const dbk_covers *c = &scene->covers;
  const dbk_real *permit = scene->permit[link];
  const dbk_real px = m->bound_x[link], py = m->bound_y[link], pz = m->bound_z[link];
  const dbk_real off = m->bound_r[link] + held_error, depth = m->bound_r[link] + m->inner[link];
  const int32_t lanes = DBK_PADDED(s->lanes);
  for (int32_t o = 0; o < lanes; ++o) {
    dbk_real nx, ny, nz;
    const dbk_real x = px - s->x[o], y = py - s->y[o], z = pz - s->z[o];
    const dbk_real d = any_long ? dbk_off_segment(x, y, z, c->ax[o], c->ay[o], c->az[o], c->half[o], &nx, &ny, &nz)
                                : dbk_off_point(x, y, z, &nx, &ny, &nz);
    const dbk_real h = d - c->radius[o] - s->margin[o] - off, most = h + depth;
    const int32_t open = (int32_t)(s->parts[o] >> link & 1u) & c->plain[o] & (permit[o] < (dbk_real)0);
    gap[o] = h;
    nearest[o] = (open & (most < nearest[o])) ? most : nearest[o];
  }
}

/* a half-space is flat: its distance to the middle of the ball is exact */
static void half_space_gaps(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                            const dbk_surround *s, dbk_real gap[DBK_ALL_LINKS][DBK_OBSTACLE_ROOM]) {
  const dbk_motion *m = &ctx->motion;
  for (int32_t o = 0; o < scene->n_obstacles; ++o) {
    if (scene->obstacle[o].shape != DBK_HALF_SPACE) { continue; }
    const dbk_covers *c = &scene->covers;
    for (int32_t l = 0; l <= model->n_links; ++l) {
      if (!dbk_takes_part(model, scene, l)) { continue; }
      const dbk_real held_error = l == model->n_links ? scene->held_error : (dbk_real)0;
      const dbk_real x = m->bound_x[l] - s->x[o], y = m->bound_y[l] - s->y[o], z = m->bound_z[l] - s->z[o];
      gap[l][o] = x * c->ax[o] + y * c->ay[o] + z * c->az[o] - s->margin[o] - m->bound_r[l] - held_error;
    }
  }
}

/* the least of some numbers that fill whole vectors, or DBK_BEYOND */
static inline dbk_real least_of(const dbk_real *x, int32_t lanes) {
  dbk_real least[DBK_LANES];
  for (int32_t i = 0; i < DBK_LANES; ++i) { least[i] = DBK_BEYOND; }
  for (int32_t base = 0; base < lanes; base += DBK_LANES) {
    for (int32_t i = 0; i < DBK_LANES; ++i) { least[i] = x[base + i] < least[i] ? x[base + i] : least[i]; }
  }
  return dbk_least(least, DBK_BEYOND);
}

/* bit `link` where the obstacle matters for that link (a function by itself, lest a compiler takes two links at a time
 * and no vectors) */
DBK_WIDE static void mark(const dbk_model *model, const dbk_scene *scene, const dbk_motion *m, const dbk_surround *s,
                          int32_t link, const dbk_real *gap, dbk_real h_min, uint32_t *restrict matters) {
  const dbk_covers *c = &scene->covers;
  const dbk_real speed = m->speed[link], haste = m->haste[link], sampling = model->sampling, period = model->period;
  const uint32_t bit = 1u << link;
  const int32_t lanes = DBK_PADDED(s->lanes);
  for (int32_t o = 0; o < lanes; ++o) {
    const dbk_real h = gap[o], soon = period * (c->speed[o] + haste) + DBK_CULL_FLOOR;
    const int32_t safe = (h > soon) & (s->alpha[o] * h >= c->speed[o] + speed) & (h + sampling >= h_min);
    matters[o] |= s->parts[o] & bit & ((uint32_t)safe - 1u);
  }
}

/* speed and separation may ask for more than the barrier does */
static void mark_separation(const dbk_model *model, const dbk_scene *scene, const dbk_motion *m, const dbk_surround *s,
                            dbk_real gap[DBK_ALL_LINKS][DBK_OBSTACLE_ROOM], uint32_t *matters) {
  for (int32_t o = 0; o < scene->n_obstacles; ++o) {
    const dbk_obstacle *it = &scene->obstacle[o];
    if (!(it->brake > (dbk_real)0)) { continue; }
    const dbk_real person = dbk_max(it->approach, scene->covers.speed[o]);
    for (int32_t l = 0; l <= model->n_links; ++l) {
      if (!dbk_takes_part(model, scene, l)) { continue; }
      const int32_t safe = dbk_separation_speed(it, gap[l][o], person) >= m->speed[l];
      matters[o] |= safe ? 0u : (s->parts[o] & (1u << l));
    }
  }
}

/* from a bit for each link to a list for each link */
static void list(const dbk_model *model, const uint32_t *matters, int32_t lanes, dbk_nearby *out) {
  for (int32_t l = 0; l <= model->n_links; ++l) { out->count[l] = 0; }
  for (int32_t o = 0; o < lanes; ++o) {
    for (uint32_t left = matters[o]; left; left &= left - 1u) {
      const int32_t l = dbk_lowest_bit(left);
      out->index[l][out->count[l]++] = (int16_t)o;
    }
  }
}

DBK_WIDE void dbk_find_near(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                            const dbk_surround *around, dbk_nearby *out) {
  dbk_real gap[DBK_ALL_LINKS][DBK_OBSTACLE_ROOM], nearest[DBK_OBSTACLE_ROOM];
  uint32_t matters[DBK_OBSTACLE_ROOM];
  int32_t link[DBK_ALL_LINKS], count = 0;
  const int32_t lanes = DBK_PADDED(around->lanes);
  for (int32_t l = 0; l <= model->n_links; ++l) {
    if (dbk_takes_part(model, scene, l)) { link[count++] = l; }
  }
  for (int32_t o = 0; o < lanes; ++o) {
    nearest[o] = DBK_BEYOND;
    matters[o] = 0u;
  }
  for (int32_t i = 0; i < count; ++i) {
    const dbk_real held_error = link[i] == model->n_links ? scene->held_error : (dbk_real)0;
    if (scene->covers.any_long) {
      capsule_gaps(scene, around, &ctx->motion, link[i], 1, held_error, gap[link[i]], nearest);
    } else {
      capsule_gaps(scene, around, &ctx->motion, link[i], 0, held_error, gap[link[i]], nearest);
    }
  }
  const dbk_real h_min = least_of(nearest, lanes) + model->sampling;
  if (scene->covers.any_half_space) { half_space_gaps(model, scene, ctx, around, gap); }
  for (int32_t i = 0; i < count; ++i) {
    mark(model, scene, &ctx->motion, around, link[i], gap[link[i]], h_min, matters);
  }
  if (scene->covers.any_separation) { mark_separation(model, scene, &ctx->motion, around, gap, matters); }
  list(model, matters, lanes, out);
}
