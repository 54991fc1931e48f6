/* Spheres of the body against obstacles. Two ways round, with the same arithmetic for every pair: where a link has few
 * spheres and many capsules are near, one sphere meets all capsules at once; else one obstacle meets all spheres of the
 * link at once, which is also the way for boxes, half-spaces, permitted contact, and speed and separation. */
#include "dbk_pair.h"

/* obstacles near one link: `block` are the vectors of the table with a capsule among them that is met by each sphere */
typedef struct {
  int32_t link, first, count, frame; /* of the spheres */
  dbk_real held_error;
  int32_t together[DBK_MAX_OBSTACLES]; /* 1: met by each sphere in turn together with the others */
  int32_t n_blocks, block[DBK_MAX_OBSTACLES / DBK_LANES];
  dbk_real least[DBK_MAX_OBSTACLES]; /* smallest h of any sphere */
} link_scene;

static dbk_mover mover_of(const dbk_ctx *ctx, int32_t s) {
  const dbk_motion *m = &ctx->motion;
  const dbk_mover it = {ctx->cloud.r[s], m->vx[s], m->vy[s], m->vz[s], m->ax[s], m->ay[s], m->az[s], m->spread[s]};
  return it;
}

/* one sphere against the capsules of some blocks; returns whether any row is kept */
DBK_WIDE static int32_t sphere_meets(const dbk_model *model, const dbk_covers *c, const dbk_surround *around,
                                     const dbk_ctx *ctx, link_scene *restrict near, int32_t sphere,
                                     dbk_batch *restrict w) {
  const dbk_mover m = mover_of(ctx, sphere);
  const dbk_real x = ctx->cloud.x[sphere], y = ctx->cloud.y[sphere], z = ctx->cloud.z[sphere];
  const dbk_real half_period = (dbk_real)0.5 * model->period, cap = model->recovery, held = near->held_error;
  int32_t any[DBK_LANES] = {0}, kept = 0;
  w->count = near->n_blocks * DBK_LANES;
  w->kind = DBK_ROW_OBSTACLE;
  w->sphere = sphere;
  w->from = 0;
  w->upto = near->frame;
  for (int32_t b = 0; b < near->n_blocks; ++b) {
    const int32_t base = near->block[b];
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      const int32_t o = base + l, at = b * DBK_LANES + l;
      dbk_real nx, ny, nz;
      const dbk_real far = dbk_off_segment(x - around->x[o], y - around->y[o], z - around->z[o], c->ax[o], c->ay[o],
                                           c->az[o], c->half[o], &nx, &ny, &nz);
      const dbk_terms t = {around->margin[o] + held, around->alpha[o], cap,      c->error[o],
                           half_period,              c->vx[o],         c->vy[o], c->vz[o]};
      const dbk_weight it = dbk_weigh(&m, &t, far - c->radius[o], nx, ny, nz);
      const int32_t keep = near->together[o] & dbk_binds(&it, 0);
      w->h[at] = it.h;
      w->nx[at] = nx;
      w->ny[at] = ny;
      w->nz[at] = nz;
      w->rhs[at] = it.rhs;
      w->index[at] = o;
      w->keep[at] = keep;
      w->yielding[at] = 0;
      any[l] |= keep;
      near->least[o] = it.h < near->least[o] ? it.h : near->least[o];
    }
  }
  for (int32_t l = 0; l < DBK_LANES; ++l) { kept |= any[l]; }
  return kept;
}

/* what is the same for all spheres of a link that meet one obstacle */
typedef struct {
  const dbk_obstacle *shape; /* where it is now */
  dbk_terms terms;
  int32_t index, permitted, separated;
} meeting;

static meeting meeting_of(const dbk_model *model, const dbk_scene *scene, const dbk_surround *around, int32_t index,
                          const link_scene *near, dbk_obstacle *shape) {
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
DBK_WIDE static summary link_meets(const dbk_ctx *ctx, const link_scene *near, const meeting *m, dbk_batch *restrict w) {
  const dbk_cloud *cloud = &ctx->cloud;
  const int32_t first = near->first, permitted = m->permitted;
  const dbk_terms t = m->terms;
  dbk_real least[DBK_LANES];
  int32_t any[DBK_LANES] = {0};
  w->count = near->count;
  w->kind = DBK_ROW_OBSTACLE;
  w->sphere = -1;
  w->other = m->index;
  w->from = 0;
  w->upto = near->frame;
  dbk_distance(m->shape, DBK_PADDED(near->count), cloud->x + first, cloud->y + first, cloud->z + first, w->h, w->nx,
               w->ny, w->nz);
  for (int32_t l = 0; l < DBK_LANES; ++l) { least[l] = DBK_BEYOND; }
  for (int32_t base = 0; base < near->count; base += DBK_LANES) {
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      const int32_t at = base + l, real = at < near->count;
      const dbk_mover it = mover_of(ctx, first + at);
      const dbk_weight weight = dbk_weigh(&it, &t, w->h[at], w->nx[at], w->ny[at], w->nz[at]);
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
  summary it = {least[0], any[0]};
  for (int32_t l = 1; l < DBK_LANES; ++l) {
    it.least = dbk_min(it.least, least[l]);
    it.any |= any[l];
  }
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

/* sorts the obstacles that are near a link into those that a sphere meets together, and counts the others */
DBK_WIDE static int32_t sort_near(const dbk_scene *scene, const int32_t *flags, int32_t lanes, link_scene *near) {
  int32_t together = 0, single = 0;
  for (int32_t o = 0; o < lanes; ++o) {
    near->together[o] = flags[o] & scene->covers.plain[o] & (scene->permit[near->link][o] < (dbk_real)0);
    near->least[o] = DBK_BEYOND;
    together += near->together[o];
    single += flags[o] & !near->together[o];
  }
  near->n_blocks = 0;
  const int32_t many = together > near->count;
  for (int32_t base = 0; base < lanes; base += DBK_LANES) {
    int32_t any = 0;
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      near->together[base + l] &= many;
      any |= near->together[base + l];
    }
    if (any) { near->block[near->n_blocks++] = base; }
  }
  return many ? single : single + together;
}

/* the smallest h of a link and an obstacle goes into h_min; what one period could bring to h = 0 is looked at again */
static void judge(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const link_scene *near, int32_t index,
                  dbk_real least) {
  const dbk_real speed = scene->covers.speed[index] + ctx->motion.haste[near->link];
  ctx->h_min = dbk_min(ctx->h_min, least + model->sampling);
  if (!(least >= model->period * speed + DBK_CULL_FLOOR)) { dbk_remember(ctx, near->first, near->count, index); }
}

/* the same for all capsules that were met together */
DBK_WIDE static void judge_together(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const link_scene *near) {
  const dbk_real fastest = ctx->motion.haste[near->link], period = model->period;
  for (int32_t b = 0; b < near->n_blocks; ++b) {
    const dbk_real *least = near->least + near->block[b], *speed = scene->covers.speed + near->block[b];
    const int32_t *together = near->together + near->block[b];
    int32_t close[DBK_LANES], any = 0;
    dbk_real h[DBK_LANES];
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      h[l] = together[l] ? least[l] : DBK_BEYOND;
      close[l] = together[l] & !(least[l] >= period * (speed[l] + fastest) + DBK_CULL_FLOOR);
    }
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      ctx->h_min = dbk_min(ctx->h_min, h[l] + model->sampling);
      any |= close[l];
    }
    for (int32_t l = 0; any && l < DBK_LANES; ++l) {
      if (close[l]) { dbk_remember(ctx, near->first, near->count, near->block[b] + l); }
    }
  }
}

static void meet_together(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_surround *around,
                          link_scene *near) {
  dbk_batch w;
  for (int32_t s = near->first; s < near->first + near->count; ++s) {
    if (sphere_meets(model, &scene->covers, around, ctx, near, s, &w)) { dbk_keep_rows(scene, ctx, &w); }
  }
  judge_together(model, scene, ctx, near);
}

static void meet_alone(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_surround *around,
                       const link_scene *near, int32_t index) {
  dbk_batch w;
  dbk_obstacle shape;
  const meeting m = meeting_of(model, scene, around, index, near, &shape);
  const summary it = link_meets(ctx, near, &m, &w);
  if (m.separated) { separate(&m, near->count, &w); }
  if (it.any || m.separated) { dbk_keep_rows(scene, ctx, &w); }
  if (!m.permitted) { judge(model, scene, ctx, near, index, it.least); }
}

/* rows of all links against all obstacles */
void dbk_meet_obstacles(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_surround *around) {
  dbk_nearby nearby;
  link_scene near;
  dbk_find_near(model, scene, ctx, around, &nearby);
  for (int32_t l = 0; l <= model->n_links; ++l) {
    if (!nearby.any[l]) { continue; }
    near.link = l;
    near.first = dbk_first_sphere(model, l);
    near.count = dbk_last_sphere(model, scene, l) - near.first;
    near.frame = dbk_link_frame(model, l);
    near.held_error = l == model->n_links ? scene->held_error : (dbk_real)0;
    const int32_t alone = sort_near(scene, nearby.near[l], around->lanes, &near);
    if (near.n_blocks > 0) { meet_together(model, scene, ctx, around, &near); }
    for (int32_t o = 0; alone > 0 && o < around->lanes; ++o) {
      if (nearby.near[l][o] && !near.together[o]) { meet_alone(model, scene, ctx, around, &near, o); }
    }
  }
}
