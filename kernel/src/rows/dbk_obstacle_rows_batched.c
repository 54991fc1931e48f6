/* Rows between one link and many plain capsules: the capsules are gathered into contiguous SIMD blocks, and each sphere
 * of the link is tested against all of them. The arithmetic of every pair is that of dbk_obstacle_rows.c. */
#include "rows/dbk_obstacle_rows_batched.h"

#include "distance/dbk_point_distance.h"
#include "model/dbk_scene.h"
#include "rows/dbk_row_buffer.h"

/* one SIMD vector of capsules, as a structure of arrays; `least` is the smallest h over the spheres of the link */
typedef struct {
  dbk_real x[DBK_LANES], y[DBK_LANES], z[DBK_LANES], ax[DBK_LANES], ay[DBK_LANES], az[DBK_LANES], half[DBK_LANES];
  dbk_real radius[DBK_LANES], margin[DBK_LANES], alpha[DBK_LANES], velocity_error[DBK_LANES];
  dbk_real vx[DBK_LANES], vy[DBK_LANES], vz[DBK_LANES], max_speed[DBK_LANES], least[DBK_LANES];
} capsule_block;

typedef struct {
  int32_t count, static_spheres; /* static_spheres: all capsules of the batch are static spheres */
  capsule_block block[DBK_MAX_OBSTACLES / DBK_LANES];
} capsule_batch;

/* copies obstacle o to a lane of a block; static spheres have no axis, velocity or velocity error */
static inline void gather_capsule(const dbk_obstacle_capsules *c, const dbk_predicted_obstacles *predicted,
                                  dbk_real held_error, int32_t static_spheres, int32_t o, capsule_block *restrict to,
                                  int32_t lane) {
  to->x[lane] = predicted->x[o];
  to->y[lane] = predicted->y[o];
  to->z[lane] = predicted->z[o];
  to->radius[lane] = c->radius[o];
  to->margin[lane] = predicted->margin[o] + held_error;
  to->alpha[lane] = predicted->alpha[o];
  to->max_speed[lane] = c->max_speed[o];
  to->least[lane] = DBK_MAX_DISTANCE;
  if (static_spheres) { return; }
  to->ax[lane] = c->ax[o];
  to->ay[lane] = c->ay[o];
  to->az[lane] = c->az[o];
  to->half[lane] = c->half[o];
  to->velocity_error[lane] = c->velocity_error[o];
  to->vx[lane] = c->vx[o];
  to->vy[lane] = c->vy[o];
  to->vz[lane] = c->vz[o];
}

/* gathers all obstacles of the batch; copies of the last one fill the last block */
static inline void gather_capsules(const dbk_obstacle_capsules *c, const dbk_predicted_obstacles *predicted,
                                   dbk_real held_error, int32_t static_spheres, const dbk_pair_batch *batch,
                                   capsule_batch *restrict to) {
  const int32_t last = batch->count - 1;
  for (int32_t base = 0; base <= last; base += DBK_LANES) {
    capsule_block *b = &to->block[base / DBK_LANES];
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      const int32_t o = dbk_bounded(batch->index[base + l < last ? base + l : last], DBK_MAX_OBSTACLES - 1);
      gather_capsule(c, predicted, held_error, static_spheres, o, b, l);
    }
  }
}

/* selects the plain capsules among the candidates of a link and gathers them */
static void gather(const dbk_scene *scene, const dbk_predicted_obstacles *predicted, const dbk_link_candidates *link,
                   capsule_batch *restrict to, dbk_pair_batch *restrict batch) {
  int32_t n = 0, static_spheres = 1;
  for (int32_t i = 0; i < link->n_obstacles; ++i) {
    const int32_t o = dbk_bounded(link->obstacle[i], DBK_MAX_OBSTACLES - 1);
    if (n >= DBK_MAX_OBSTACLES || !dbk_uses_plain_capsule(scene, link->link, o)) { continue; }
    batch->index[n] = o;
    batch->clip[n] = 0;
    static_spheres &= scene->capsules.static_sphere[o];
    ++n;
  }
  to->count = batch->count = n;
  to->static_spheres = static_spheres;
  if (static_spheres) {
    gather_capsules(&scene->capsules, predicted, link->held_error, 1, batch, to);
  } else {
    gather_capsules(&scene->capsules, predicted, link->held_error, 0, batch, to);
  }
}

/* computes the rows of one sphere and the gathered capsules; returns 1 if any row is kept */
static inline int32_t bound_sphere(const dbk_model *model, const dbk_ctx *ctx, int32_t sphere, int32_t static_spheres,
                                   capsule_batch *restrict c, dbk_pair_batch *restrict batch) {
  const dbk_point_motion m = dbk_point_motion_of(ctx, sphere);
  const dbk_real x = ctx->spheres.x[sphere], y = ctx->spheres.y[sphere], z = ctx->spheres.z[sphere];
  const dbk_real half_period = (dbk_real)0.5 * model->period, recovery = model->recovery;
  const dbk_real braking_gain = model->braking_gain, arc_share = model->arc_share;
  const int32_t count = c->count;
  int32_t any = 0;
  for (int32_t base = 0; base < count; base += DBK_LANES) {
    capsule_block *restrict b = &c->block[base / DBK_LANES];
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      const int32_t at = base + l;
      dbk_real nx, ny, nz;
      const dbk_real dx = x - b->x[l], dy = y - b->y[l], dz = z - b->z[l];
      const dbk_real distance =
          static_spheres ? dbk_point_distance(dx, dy, dz, &nx, &ny, &nz)
                         : dbk_segment_distance(dx, dy, dz, b->ax[l], b->ay[l], b->az[l], b->half[l], &nx, &ny, &nz);
      const dbk_row_terms t = {
          b->margin[l], b->alpha[l], braking_gain, arc_share, recovery, b->velocity_error[l],
          half_period,  b->vx[l],    b->vy[l],     b->vz[l]};
      const dbk_row_bound bound = dbk_bound_row(&m, &t, static_spheres, distance - b->radius[l], nx, ny, nz);
      const int32_t keep = (at < count) & dbk_row_may_bind(&bound, 0);
      batch->h[at] = bound.h;
      batch->nx[at] = nx;
      batch->ny[at] = ny;
      batch->nz[at] = nz;
      batch->rhs[at] = bound.rhs;
      batch->keep[at] = keep;
      any |= keep;
      b->least[l] = bound.h < b->least[l] ? bound.h : b->least[l];
    }
  }
  return any;
}

/* two specialisations: the constant argument removes the capsule axis, or keeps it */
DBK_SIMD_CLONES static int32_t bound_capsules(const dbk_model *model, const dbk_ctx *ctx, int32_t sphere,
                                              capsule_batch *restrict c, dbk_pair_batch *restrict batch) {
  return bound_sphere(model, ctx, sphere, 0, c, batch);
}

DBK_SIMD_CLONES static int32_t bound_static_spheres(const dbk_model *model, const dbk_ctx *ctx, int32_t sphere,
                                                    capsule_batch *restrict c, dbk_pair_batch *restrict batch) {
  return bound_sphere(model, ctx, sphere, 1, c, batch);
}

/* updates h_min and adds the pairs that could reach h = 0 within one period to the list for the certificate, as
 * dbk_record_distance does for one obstacle */
static void record_distances(const dbk_model *model, dbk_ctx *ctx, const dbk_link_candidates *link,
                             const capsule_batch *c, const dbk_pair_batch *batch) {
  const dbk_real max_speed = ctx->motion.max_speed[link->link], period = model->period;
  dbk_real least[DBK_LANES];
  int32_t close[DBK_LANES];
  for (int32_t l = 0; l < DBK_LANES; ++l) { least[l] = DBK_MAX_DISTANCE; }
  for (int32_t base = 0; base < c->count; base += DBK_LANES) {
    const capsule_block *b = &c->block[base / DBK_LANES];
    int32_t any = 0;
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      least[l] = b->least[l] < least[l] ? b->least[l] : least[l];
      close[l] = !(b->least[l] >= period * (b->max_speed[l] + max_speed) + DBK_CULL_FLOOR);
      any |= close[l];
    }
    for (int32_t l = 0; any && l < DBK_LANES && base + l < c->count; ++l) {
      if (close[l]) { dbk_revisit_pairs(ctx, link->first, link->count, batch->index[base + l]); }
    }
  }
  ctx->h_min = dbk_min(ctx->h_min, dbk_min_lanes(least, DBK_MAX_DISTANCE) + model->sampling);
}

void dbk_obstacle_rows_batched(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx,
                               const dbk_predicted_obstacles *predicted, const dbk_link_candidates *link) {
  capsule_batch c;
  dbk_pair_batch batch;
  gather(scene, predicted, link, &c, &batch);
  batch.kind = DBK_ROW_OBSTACLE;
  batch.first_joint = 0;
  batch.end_joint = link->frame;
  const int32_t end = dbk_bounded(link->first + link->count, DBK_ALL_SPHERES);
  for (int32_t s = link->first; s < end; ++s) {
    batch.sphere = s;
    const int32_t any =
        c.static_spheres ? bound_static_spheres(model, ctx, s, &c, &batch) : bound_capsules(model, ctx, s, &c, &batch);
    if (any) { dbk_append_rows(scene, ctx, &batch); }
  }
  record_distances(model, ctx, link, &c, &batch);
}
