/* Second broad phase of a link and its candidates. The first one bounds the closing speed by the largest speed of the
 * link. This one evaluates the obstacle at the centre B of the bounding sphere of the link, and uses the direction: with
 * the vector W from the nearest point of the obstacle's core (the segment of a capsule, or the shape itself) to B, and
 * with centres of spheres within e of B, the vector w from the nearest point to a centre is within e of W, because the
 * projection onto a convex set does not expand distances. With the velocity V of B and the angular velocity o,
 *
 *   n'v = w'(V + o x (c - B)) / |w| >= (W'V - e |V|) / |w| - |o| e,   |w| >= |W| - e.
 */
#include "distance/dbk_direction_cull.h"

#include "distance/dbk_approach_speed.h"
#include "distance/dbk_distance.h"

/* a link: centre of its bounding sphere, velocity there, and the closing speed that does not depend on the direction */
typedef struct {
  dbk_real centre[3], velocity[3], speed, turn, radius, change, max_speed, surface, sampling_term;
} link_motion;

static link_motion motion_of(const dbk_model *model, const dbk_ctx *ctx, const dbk_link_candidates *link) {
  const dbk_sphere_motion *m = &ctx->motion;
  const dbk_real *w = m->chain[link->frame].tw, *v = m->chain[link->frame].tv;
  const int32_t l = link->link;
  const dbk_real x = m->bound_x[l], y = m->bound_y[l], z = m->bound_z[l];
  link_motion b = {{x, y, z},
                   {v[0] + (w[1] * z - w[2] * y), v[1] + (w[2] * x - w[0] * z), v[2] + (w[0] * y - w[1] * x)},
                   (dbk_real)0,
                   dbk_length(w[0], w[1], w[2]),
                   m->centres_radius[l],
                   m->sampling_term[l] + DBK_RHS_ROUNDING,
                   m->max_speed[l],
                   m->bound_r[l] + link->held_error,
                   m->sampling_term[l]};
  b.speed = dbk_length(b.velocity[0], b.velocity[1], b.velocity[2]);
  b.change += DBK_VELOCITY_ROUNDING * b.turn * (dbk_abs(x) + dbk_abs(y) + dbk_abs(z));
  for (int32_t k = 0; k < link->frame; ++k) { b.change += m->joint_half_width[k] * model->link_reach[k][l]; }
  return b;
}

/* maximum closing speed of the link toward a static obstacle at distance `d` of the core along the normal n */
static dbk_real closing_speed(const link_motion *b, dbk_real d, const dbk_real n[3]) {
  const dbk_real rate = n[0] * b->velocity[0] + n[1] * b->velocity[1] + n[2] * b->velocity[2];
  const dbk_real product = d * rate - b->radius * b->speed, nearest = d - b->radius;
  if (!(nearest > DBK_CULL_FLOOR)) { return b->speed + b->turn * b->radius + b->change; }
  return (product < (dbk_real)0 ? -product / nearest : (dbk_real)0) + b->turn * b->radius + b->change;
}

/* 1: the obstacle cannot be culled */
static int32_t relevant(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                        const dbk_predicted_obstacles *p, const link_motion *b, int32_t o) {
  const dbk_obstacle *shape = &scene->obstacle[o];
  const dbk_real max_speed = scene->capsules.max_speed[o];
  dbk_real d, n[3], at[3];
  if (shape->brake > (dbk_real)0) { return 1; } /* speed and separation monitoring can be stricter */
  for (int32_t e = 0; e < 3; ++e) { at[e] = b->centre[e] - shape->velocity[e] * p->age; }
  dbk_distance(shape, 1, at, at + 1, at + 2, &d, n, n + 1, n + 2);
  const dbk_real h = d - b->surface - p->margin[o], core = shape->shape == DBK_CAPSULE ? d + shape->radius : d;
  const dbk_real travel = model->period * (max_speed + b->max_speed) + DBK_CULL_FLOOR;
  const dbk_real speed =
      dbk_approach_speed(p->alpha[o], model->braking_gain, model->arc_share, h, b->sampling_term);
  return !(h > travel && speed >= max_speed + closing_speed(b, core, n) &&
           h + model->sampling >= ctx->h_min);
}

int32_t dbk_cull_by_direction(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx,
                              const dbk_predicted_obstacles *predicted, const dbk_link_candidates *link,
                              int16_t *index) {
  const link_motion b = motion_of(model, ctx, link);
  int32_t kept = 0;
  for (int32_t i = 0; i < link->n_obstacles; ++i) {
    const int32_t o = dbk_bounded(index[i], DBK_MAX_OBSTACLES - 1);
    if (relevant(model, scene, ctx, predicted, &b, o) && kept < DBK_MAX_OBSTACLES) { index[kept++] = (int16_t)o; }
  }
  return kept;
}
