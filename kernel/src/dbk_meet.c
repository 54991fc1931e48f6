/* Spheres of the body against obstacles. Two ways round, with the same arithmetic for every pair: where a link has few
 * spheres and many capsules are near, one sphere meets all capsules at once (dbk_together.c); else one obstacle meets all
 * spheres of the link at once, which is also the way for boxes, half-spaces, permitted contact, and speed and separation. */
#include "dbk_pair.h"

/* what is the same for all spheres of a link that meet one obstacle */
typedef struct {
  const dbk_obstacle *shape; /* where it is now */
  dbk_terms terms;
  int32_t index, permitted, separated;
} meeting;

static meeting meeting_of(const dbk_model *model, const dbk_scene *scene, const dbk_surround *around, int32_t index,
                          const dbk_link_scene *near, dbk_obstacle *shape) {
  const dbk_real permit = scene->permit[near->link][index];
  const int32_t permitted = permit >= (dbk_real)0;
  *shape = scene->obstacle[index];
  for (int32_t e = 0; e < 3; ++e) { shape->position[e] += shape->velocity[e] * around->age; }
  const dbk_terms t = {around->margin[index] + near->held_error,
                       around->alpha[index],
                       permitted ? -permit : model->recovery,
                       permitted ? (dbk_real)0 : shape->velocity_error,
                       (dbk_real)0.5 * model->period,
                       shape->velocity[0],
                       shape->velocity[1],
                       shape->velocity[2]};
  const meeting it = {shape, t, index, permitted, !permitted && shape->brake > (dbk_real)0};
  return it;
}

typedef struct {
  dbk_real least; /* smallest h of the spheres of the link */
  int32_t any;    /* is a row to be kept? */
} summary;

/* all spheres of a link against one obstacle */
DBK_WIDE static summary link_meets(const dbk_ctx *ctx, const dbk_link_scene *near, const meeting *m, dbk_batch *restrict w) {
  const dbk_cloud *cloud = &ctx->cloud;
  const int32_t first = near->first, permitted = m->permitted;
  const dbk_terms t = m->terms;
  dbk_real least[DBK_LANES];
  int32_t any[DBK_LANES] = {0};
  w->count = near->count;
  w->kind = DBK_ROW_OBSTACLE;
  w->sphere = DBK_SEVERAL;
  w->other = m->index;
  w->from = 0;
  w->upto = near->frame;
  dbk_distance(m->shape, DBK_PADDED(near->count), cloud->x + first, cloud->y + first, cloud->z + first, w->h, w->nx,
               w->ny, w->nz);
  for (int32_t l = 0; l < DBK_LANES; ++l) { least[l] = DBK_BEYOND; }
  for (int32_t base = 0; base < near->count; base += DBK_LANES) {
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      const int32_t at = base + l, real = at < near->count;
      const dbk_mover it = dbk_mover_of(ctx, first + at);
      const dbk_weight weight = dbk_weigh(&it, &t, 0, w->h[at], w->nx[at], w->ny[at], w->nz[at]);
      const dbk_real h = real ? weight.h : DBK_BEYOND;
      w->h[at] = weight.h;
      w->rhs[at] = weight.rhs;
      w->room[at] = weight.room;
      w->index[at] = first + at;
      w->keep[at] = dbk_binds(&weight, permitted);
      w->yielding[at] = permitted;
      any[l] |= real & w->keep[at];
      least[l] = h < least[l] ? h : least[l];
    }
  }
  summary it = {dbk_least(least, DBK_BEYOND), 0};
  for (int32_t l = 0; l < DBK_LANES; ++l) { it.any |= any[l]; }
  return it;
}

/* the tighter of the barrier and of speed and separation */
static void separate(const meeting *m, int32_t count, dbk_batch *w) {
  for (int32_t s = 0; s < count; ++s) {
    const dbk_real toward = w->nx[s] * m->terms.vx + w->ny[s] * m->terms.vy + w->nz[s] * m->terms.vz;
    const dbk_real person = dbk_max(m->shape->approach, toward + m->terms.error);
    const dbk_real rhs = -dbk_separation_speed(m->shape, w->h[s], dbk_max(person, (dbk_real)0));
    if (rhs > w->rhs[s]) {
      const dbk_weight tighter = {w->h[s], rhs, w->room[s] - (rhs - w->rhs[s])};
      w->rhs[s] = rhs;
      w->keep[s] = dbk_binds(&tighter, 0);
      w->yielding[s] = 1;
    }
  }
}

static void meet_alone(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_surround *around,
                       const dbk_link_scene *near, int32_t index) {
  dbk_batch w;
  dbk_obstacle shape;
  const meeting m = meeting_of(model, scene, around, index, near, &shape);
  const summary it = link_meets(ctx, near, &m, &w);
  if (m.separated) { separate(&m, near->count, &w); }
  if (it.any || m.separated) { dbk_keep_rows(scene, ctx, &w); }
  if (!m.permitted) { dbk_judge(model, scene, ctx, near, index, it.least); }
}

/* the spheres of one link against the obstacles near it */
static void meet_link(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_surround *around,
                      const dbk_link_scene *near) {
  int32_t sociable = 0;
  for (int32_t i = 0; i < near->n_near; ++i) { sociable += dbk_sociable(scene, near->link, near->near[i]); }
  const int32_t together = sociable > near->count;
  if (together) { dbk_meet_together(model, scene, ctx, around, near); }
  if (together && sociable == near->n_near) { return; }
  for (int32_t i = 0; i < near->n_near; ++i) {
    const int32_t o = near->near[i];
    if (!(together && dbk_sociable(scene, near->link, o))) { meet_alone(model, scene, ctx, around, near, o); }
  }
}

/* rows of all links against all obstacles */
void dbk_meet_obstacles(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_surround *around) {
  dbk_nearby nearby;
  dbk_find_near(model, scene, ctx, around, &nearby);
  for (int32_t l = 0; l <= model->n_links; ++l) {
    if (nearby.count[l] == 0) { continue; }
    const int32_t first = dbk_first_sphere(model, l);
    const dbk_link_scene near = {l,
                                 first,
                                 dbk_last_sphere(model, scene, l) - first,
                                 dbk_link_frame(model, l),
                                 l == model->n_links ? scene->held_error : (dbk_real)0,
                                 nearby.count[l],
                                 nearby.index[l]};
    meet_link(model, scene, ctx, around, &near);
  }
}
