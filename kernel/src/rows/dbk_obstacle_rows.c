/* Rows between the links and the obstacles. Two loop orders compute the same arithmetic for every pair:
 *   - many candidates and few spheres: one sphere against all plain capsules at once (dbk_obstacle_rows_batched.c),
 *   - otherwise: one obstacle against all spheres of a link at once. This order also handles boxes, half-spaces,
 *     permitted contact, and speed and separation monitoring. */
#include "rows/dbk_obstacle_rows.h"

#include "distance/dbk_direction_cull.h"
#include "distance/dbk_distance.h"
#include "model/dbk_model.h"
#include "model/dbk_scene.h"
#include "rows/dbk_obstacle_rows_batched.h"
#include "rows/dbk_row_buffer.h"

/* a link with fewer spheres is not culled by direction: its rows cost as little */
#define MIN_SPHERES 3

/* an obstacle and the parameters that all spheres of a link share */
typedef struct {
  const dbk_obstacle *shape; /* at its predicted position */
  dbk_row_terms terms;
  int32_t index, permitted, separated;
} link_obstacle;

/* If contact is permitted, the contact speed replaces the recovery speed, and the velocity error is ignored. */
static link_obstacle link_obstacle_of(const dbk_model *model, const dbk_scene *scene,
                                      const dbk_predicted_obstacles *predicted, int32_t index,
                                      const dbk_link_candidates *link, dbk_obstacle *shape) {
  const dbk_real permit = scene->permit[link->link][index];
  const int32_t permitted = permit >= (dbk_real)0;
  *shape = scene->obstacle[index];
  for (int32_t e = 0; e < 3; ++e) { shape->position[e] += shape->velocity[e] * predicted->age; }
  const dbk_row_terms t = {predicted->margin[index] + link->held_error,
                           predicted->alpha[index],
                           model->braking_gain,
                           model->arc_share,
                           permitted ? -permit : model->recovery,
                           permitted ? (dbk_real)0 : shape->velocity_error,
                           (dbk_real)0.5 * model->period,
                           shape->velocity[0],
                           shape->velocity[1],
                           shape->velocity[2]};
  const link_obstacle result = {shape, t, index, permitted, !permitted && shape->brake > (dbk_real)0};
  return result;
}

typedef struct {
  dbk_real least; /* smallest h over the spheres of the link */
  int32_t any;    /* 1: at least one row is kept */
} summary;

/* computes the rows of all spheres of a link and one obstacle */
DBK_SIMD_CLONES static summary bound_link(const dbk_ctx *ctx, const dbk_link_candidates *link, const link_obstacle *o,
                                          dbk_pair_batch *restrict batch) {
  const dbk_sphere_set *spheres = &ctx->spheres;
  const dbk_sphere_motion *m = &ctx->motion;
  const int32_t first = link->first, permitted = o->permitted;
  const dbk_real *r = spheres->r + first, *vx = m->vx + first, *vy = m->vy + first, *vz = m->vz + first;
  const dbk_real *ax = m->ax + first, *ay = m->ay + first, *az = m->az + first, *spread = m->spread + first;
  const dbk_row_terms t = o->terms;
  dbk_real least[DBK_LANES];
  int32_t any[DBK_LANES] = {0};
  batch->count = link->count;
  batch->kind = DBK_ROW_OBSTACLE;
  batch->sphere = DBK_MANY_SPHERES;
  batch->other = o->index;
  batch->first_joint = 0;
  batch->end_joint = link->frame;
  dbk_distance(o->shape, DBK_PADDED(link->count), spheres->x + first, spheres->y + first, spheres->z + first, batch->h,
               batch->nx, batch->ny, batch->nz);
  for (int32_t l = 0; l < DBK_LANES; ++l) { least[l] = DBK_MAX_DISTANCE; }
  for (int32_t base = 0; base < link->count; base += DBK_LANES) {
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      const int32_t at = base + l, valid = at < link->count;
      const dbk_point_motion motion = {r[at], vx[at], vy[at], vz[at], ax[at], ay[at], az[at], spread[at]};
      const dbk_row_bound bound =
          dbk_bound_row(&motion, &t, 0, batch->h[at], batch->nx[at], batch->ny[at], batch->nz[at]);
      const dbk_real h = valid ? bound.h : DBK_MAX_DISTANCE;
      batch->h[at] = bound.h;
      batch->rhs[at] = bound.rhs;
      batch->headroom[at] = bound.headroom;
      batch->index[at] = first + at;
      batch->keep[at] = dbk_row_may_bind(&bound, permitted);
      batch->clip[at] = permitted;
      any[l] |= valid & batch->keep[at];
      least[l] = h < least[l] ? h : least[l];
    }
  }
  summary result = {dbk_min_lanes(least, DBK_MAX_DISTANCE), 0};
  for (int32_t l = 0; l < DBK_LANES; ++l) { result.any |= any[l]; }
  return result;
}

/* replaces the right side of the barrier by that of speed and separation monitoring if it is stricter */
static void apply_separation(const link_obstacle *o, int32_t count, dbk_pair_batch *batch) {
  for (int32_t s = 0; s < count; ++s) {
    const dbk_real toward = batch->nx[s] * o->terms.vx + batch->ny[s] * o->terms.vy + batch->nz[s] * o->terms.vz;
    const dbk_real person_speed = dbk_max(o->shape->approach, toward + o->terms.velocity_error);
    const dbk_real rhs = -dbk_separation_speed(o->shape, batch->h[s], dbk_max(person_speed, (dbk_real)0));
    if (rhs > batch->rhs[s]) {
      const dbk_row_bound stricter = {batch->h[s], rhs, batch->headroom[s] - (rhs - batch->rhs[s])};
      batch->rhs[s] = rhs;
      batch->keep[s] = dbk_row_may_bind(&stricter, 0);
      batch->clip[s] = 1;
    }
  }
}

/* rows of one link and one obstacle */
static void single_obstacle_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx,
                                 const dbk_predicted_obstacles *predicted, const dbk_link_candidates *link,
                                 int32_t index) {
  dbk_pair_batch batch;
  dbk_obstacle shape;
  const link_obstacle o = link_obstacle_of(model, scene, predicted, index, link, &shape);
  const summary result = bound_link(ctx, link, &o, &batch);
  if (o.separated) { apply_separation(&o, link->count, &batch); }
  if (result.any || o.separated) { dbk_append_rows(scene, ctx, &batch); }
  if (!o.permitted) { dbk_record_distance(model, scene, ctx, link, index, result.least); }
}

static int32_t count_plain(const dbk_scene *scene, const dbk_link_candidates *link) {
  int32_t plain = 0;
  for (int32_t i = 0; i < link->n_obstacles; ++i) {
    const int32_t o = dbk_bounded(link->obstacle[i], DBK_MAX_OBSTACLES - 1);
    plain = dbk_bounded(plain + dbk_uses_plain_capsule(scene, link->link, o), DBK_MAX_OBSTACLES);
  }
  return plain;
}

/* Rows of one link and its candidates. The batched order is used if the plain capsules outnumber the spheres; both orders
 * round n'J differently, so the order depends on all candidates, before the cull by direction. */
static void link_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx,
                      const dbk_predicted_obstacles *predicted, dbk_link_candidates *link, int16_t *index) {
  int32_t plain = count_plain(scene, link);
  const int32_t batched = plain > link->count;
  if (link->count >= MIN_SPHERES) {
    link->n_obstacles = dbk_cull_by_direction(model, scene, ctx, predicted, link, index);
    plain = batched ? count_plain(scene, link) : 0;
  }
  if (batched && plain > 0) { dbk_obstacle_rows_batched(model, scene, ctx, predicted, link); }
  if (batched && plain == link->n_obstacles) { return; }
  for (int32_t i = 0; i < link->n_obstacles; ++i) {
    const int32_t o = dbk_bounded(link->obstacle[i], DBK_MAX_OBSTACLES - 1);
    if (!(batched && dbk_uses_plain_capsule(scene, link->link, o))) {
      single_obstacle_rows(model, scene, ctx, predicted, link, o);
    }
  }
}

/* a link and its candidates */
static dbk_link_candidates candidates_of(const dbk_model *model, const dbk_scene *scene, int32_t link, int32_t count,
                                         const int16_t *obstacle) {
  const int32_t first = dbk_link_first_sphere(model, link);
  const dbk_link_candidates result = {link,
                                      first,
                                      dbk_link_end_sphere(model, scene, link) - first,
                                      dbk_link_frame(model, link),
                                      link == model->n_links ? scene->held_error : (dbk_real)0,
                                      count,
                                      obstacle};
  return result;
}

void dbk_obstacle_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx,
                       const dbk_predicted_obstacles *predicted) {
  dbk_candidates candidates;
  dbk_broadphase(model, scene, ctx, predicted, &candidates);
  for (int32_t l = 0; l <= model->n_links; ++l) {
    const int32_t count = dbk_bounded(candidates.count[l], DBK_MAX_OBSTACLES);
    if (count == 0) { continue; }
    dbk_link_candidates link = candidates_of(model, scene, l, count, candidates.index[l]);
    link_rows(model, scene, ctx, predicted, &link, candidates.index[l]);
  }
}
