/* Broad phase: tests the bounding sphere of every link against the enclosing capsule of every obstacle.
 *
 * The distance between the two bounding shapes is a lower bound of h for all their pairs of spheres and obstacle. A
 * link and an obstacle are culled only if all of the following hold:
 *   - no control within the trust region can violate a row of the pair,
 *   - no control within the control bounds can reach h = 0 within this period,
 *   - another pair is closer, so the culled pair does not determine h_min. All roundings are conservative: they can
 *     only keep additional pairs.
 */
#include "distance/dbk_broadphase.h"

#include "distance/dbk_approach_speed.h"
#include "distance/dbk_point_distance.h"
#include "model/dbk_model.h"
#include "model/dbk_scene.h"

/* constant-velocity prediction; the velocity error, the margins of the model and the extra clearance add up to one
 * margin */
DBK_SIMD_CLONES void dbk_predict_obstacles(const dbk_model *model, const dbk_scene *scene, dbk_real age, dbk_real extra,
                                           int32_t known_only, dbk_predicted_obstacles *restrict out) {
  const dbk_obstacle_capsules *c = &scene->capsules;
  const dbk_real sampling = model->sampling, rounding = model->rounding, alpha = model->alpha;
  const dbk_real growth = dbk_max(age, (dbk_real)0); /* a small negative age does not reduce a margin */
  const int32_t lanes = DBK_PADDED(scene->n_obstacles);
  for (int32_t o = 0; o < lanes; ++o) {
    const dbk_real own_alpha = c->alpha[o];
    out->x[o] = c->x[o] + c->vx[o] * age;
    out->y[o] = c->y[o] + c->vy[o] * age;
    out->z[o] = c->z[o] + c->vz[o] * age;
    out->margin[o] = c->margin[o] + c->velocity_error[o] * growth + sampling + rounding + extra;
    out->alpha[o] = own_alpha > (dbk_real)0 ? own_alpha : alpha;
    out->link_mask[o] = (c->known[o] | !known_only) ? c->link_mask[o] : 0u;
  }
  out->lanes = lanes;
  out->age = age;
  out->extra = extra;
  out->known_only = known_only;
}

/* Lower bounds `gap` of h between the spheres of a link and every capsule. `nearest` accumulates over the links an
 * upper bound of the smallest h with every plain capsule: the bounding sphere contains a sphere within inner_distance
 * of its centre. If `any_elongated` is 0, all capsules are spheres. */
static inline void capsule_gaps(const dbk_scene *scene, const dbk_predicted_obstacles *p, const dbk_sphere_motion *m,
                                int32_t link, int32_t any_elongated, dbk_real held_error, dbk_real *restrict gap,
                                dbk_real *restrict nearest) {
  const dbk_obstacle_capsules *c = &scene->capsules;
  const dbk_real *permit = scene->permit[link];
  const dbk_real px = m->bound_x[link], py = m->bound_y[link], pz = m->bound_z[link];
  const dbk_real radius = m->bound_r[link] + held_error, depth = m->bound_r[link] + m->inner_distance[link];
  const int32_t lanes = DBK_PADDED(p->lanes);
  for (int32_t o = 0; o < lanes; ++o) {
    dbk_real nx, ny, nz;
    const dbk_real x = px - p->x[o], y = py - p->y[o], z = pz - p->z[o];
    const dbk_real d = any_elongated
                           ? dbk_segment_distance(x, y, z, c->ax[o], c->ay[o], c->az[o], c->half[o], &nx, &ny, &nz)
                           : dbk_point_distance(x, y, z, &nx, &ny, &nz);
    const dbk_real h = d - c->radius[o] - p->margin[o] - radius, h_upper = h + depth;
    const int32_t plain = (int32_t)(p->link_mask[o] >> link & 1u) & c->plain[o] & (permit[o] < (dbk_real)0);
    gap[o] = h;
    nearest[o] = (plain & (h_upper < nearest[o])) ? h_upper : nearest[o];
  }
}

/* exact distance between a half-space and the bounding sphere of every link */
static void half_space_gaps(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                            const dbk_predicted_obstacles *p, dbk_real gap[DBK_ALL_LINKS][DBK_OBSTACLE_CAPACITY]) {
  const dbk_sphere_motion *m = &ctx->motion;
  for (int32_t o = 0; o < scene->n_obstacles; ++o) {
    if (scene->obstacle[o].shape != DBK_HALF_SPACE) { continue; }
    const dbk_obstacle_capsules *c = &scene->capsules;
    for (int32_t l = 0; l <= model->n_links; ++l) {
      if (!dbk_link_can_collide(model, scene, l)) { continue; }
      const dbk_real held_error = l == model->n_links ? scene->held_error : (dbk_real)0;
      const dbk_real x = m->bound_x[l] - p->x[o], y = m->bound_y[l] - p->y[o], z = m->bound_z[l] - p->z[o];
      gap[l][o] = x * c->ax[o] + y * c->ay[o] + z * c->az[o] - p->margin[o] - m->bound_r[l] - held_error;
    }
  }
}

/* minimum of an array that fills whole SIMD vectors, at most DBK_MAX_DISTANCE */
static inline dbk_real minimum(const dbk_real *x, int32_t lanes) {
  dbk_real least[DBK_LANES];
  for (int32_t i = 0; i < DBK_LANES; ++i) { least[i] = DBK_MAX_DISTANCE; }
  for (int32_t base = 0; base < lanes; base += DBK_LANES) {
    for (int32_t i = 0; i < DBK_LANES; ++i) { least[i] = x[base + i] < least[i] ? x[base + i] : least[i]; }
  }
  return dbk_min_lanes(least, DBK_MAX_DISTANCE);
}

/* Sets bit `link` of `relevant` for every obstacle that is relevant for the link. This is a separate function because
 * compilers otherwise interleave two links and do not vectorise the loop. */
DBK_SIMD_CLONES static void mark_relevant(const dbk_model *model, const dbk_scene *scene, const dbk_sphere_motion *m,
                                          const dbk_predicted_obstacles *p, int32_t link, const dbk_real *gap,
                                          dbk_real h_min, uint32_t *restrict relevant) {
  const dbk_obstacle_capsules *c = &scene->capsules;
  const dbk_real trust_speed = m->trust_speed[link], max_speed = m->max_speed[link], sampling = model->sampling,
                 period = model->period, braking_gain = model->braking_gain, arc_share = model->arc_share,
                 sampling_term = m->sampling_term[link];
  const uint32_t bit = 1u << link;
  const int32_t lanes = DBK_PADDED(p->lanes);
  for (int32_t o = 0; o < lanes; ++o) {
    /* h decreases by at most `travel` within this period; a row holds if its speed covers both maximum speeds */
    const dbk_real h = gap[o], travel = period * (c->max_speed[o] + max_speed) + DBK_CULL_FLOOR;
    const dbk_real speed = dbk_approach_speed(p->alpha[o], braking_gain, arc_share, h, sampling_term);
    const int32_t safe = (h > travel) & (speed >= c->max_speed[o] + trust_speed) & (h + sampling >= h_min);
    relevant[o] |= p->link_mask[o] & bit & ((uint32_t)safe - 1u);
  }
}

/* speed and separation monitoring can be stricter than the barrier */
static void mark_separation(const dbk_model *model, const dbk_scene *scene, const dbk_sphere_motion *m,
                            const dbk_predicted_obstacles *p, dbk_real gap[DBK_ALL_LINKS][DBK_OBSTACLE_CAPACITY],
                            uint32_t *relevant) {
  for (int32_t o = 0; o < scene->n_obstacles; ++o) {
    const dbk_obstacle *obstacle = &scene->obstacle[o];
    if (!(obstacle->brake > (dbk_real)0)) { continue; }
    const dbk_real person_speed = dbk_max(obstacle->approach, scene->capsules.max_speed[o]);
    for (int32_t l = 0; l <= model->n_links; ++l) {
      if (!dbk_link_can_collide(model, scene, l)) { continue; }
      const int32_t safe = dbk_separation_speed(obstacle, gap[l][o], person_speed) >= m->trust_speed[l];
      relevant[o] |= safe ? 0u : (p->link_mask[o] & (1u << l));
    }
  }
}

/* converts one bit per link and obstacle to one list of obstacles per link */
static void list_candidates(const dbk_model *model, const uint32_t *relevant, int32_t lanes, dbk_candidates *out) {
  for (int32_t l = 0; l <= model->n_links; ++l) { out->count[l] = 0; }
  for (int32_t o = 0; o < lanes; ++o) {
    for (uint32_t bits = relevant[o]; bits; bits &= bits - 1u) {
      const int32_t l = dbk_bounded(dbk_lowest_bit(bits), DBK_ALL_LINKS - 1);
      const int32_t at = dbk_bounded(out->count[l], DBK_MAX_OBSTACLES - 1);
      out->index[l][at] = (int16_t)o;
      out->count[l] = at + 1;
    }
  }
}

DBK_SIMD_CLONES void dbk_broadphase(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                                    const dbk_predicted_obstacles *predicted, dbk_candidates *out) {
  dbk_real gap[DBK_ALL_LINKS][DBK_OBSTACLE_CAPACITY], nearest[DBK_OBSTACLE_CAPACITY];
  uint32_t relevant[DBK_OBSTACLE_CAPACITY];
  int32_t link[DBK_ALL_LINKS], count = 0;
  const int32_t lanes = DBK_PADDED(predicted->lanes);
  for (int32_t l = 0; l <= model->n_links; ++l) {
    if (count < DBK_ALL_LINKS && dbk_link_can_collide(model, scene, l)) { link[count++] = l; }
  }
  for (int32_t o = 0; o < lanes; ++o) {
    nearest[o] = DBK_MAX_DISTANCE;
    relevant[o] = 0u;
  }
  /* lower bounds of h; the constant argument lets the compiler specialise the loop for spheres */
  for (int32_t i = 0; i < count; ++i) {
    const int32_t l = dbk_bounded(link[i], DBK_ALL_LINKS - 1);
    const dbk_real held_error = l == model->n_links ? scene->held_error : (dbk_real)0;
    if (scene->capsules.any_elongated) {
      capsule_gaps(scene, predicted, &ctx->motion, l, 1, held_error, gap[l], nearest);
    } else {
      capsule_gaps(scene, predicted, &ctx->motion, l, 0, held_error, gap[l], nearest);
    }
  }
  const dbk_real h_min = minimum(nearest, lanes) + model->sampling;
  if (scene->capsules.any_half_space) { half_space_gaps(model, scene, ctx, predicted, gap); }
  /* relevance by the bounds, then by speed and separation monitoring */
  for (int32_t i = 0; i < count; ++i) {
    const int32_t l = dbk_bounded(link[i], DBK_ALL_LINKS - 1);
    mark_relevant(model, scene, &ctx->motion, predicted, l, gap[l], h_min, relevant);
  }
  if (scene->capsules.any_separation) { mark_separation(model, scene, &ctx->motion, predicted, gap, relevant); }
  list_candidates(model, relevant, lanes, out);
}
