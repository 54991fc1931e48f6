/* One sphere meets all capsules near its link at once: they are gathered side by side, so that vectors are full of pairs
 * that matter. The arithmetic of every pair is that of dbk_meet.c. */
#include "dbk_pair.h"

/* as many capsules as a vector takes, one array per number; `least` is the smallest h of any sphere of the link */
typedef struct {
  dbk_real x[DBK_LANES], y[DBK_LANES], z[DBK_LANES], ax[DBK_LANES], ay[DBK_LANES], az[DBK_LANES], half[DBK_LANES];
  dbk_real radius[DBK_LANES], margin[DBK_LANES], alpha[DBK_LANES], error[DBK_LANES];
  dbk_real vx[DBK_LANES], vy[DBK_LANES], vz[DBK_LANES], speed[DBK_LANES], least[DBK_LANES];
} block;

typedef struct {
  int32_t count, balls; /* are all of them balls at rest? */
  block block[DBK_MAX_OBSTACLES / DBK_LANES];
} company;

/* what a ball at rest has not is left out where all are `balls` */
static inline void gather_one(const dbk_covers *c, const dbk_surround *around, dbk_real held_error, int32_t balls,
                              int32_t o, block *restrict to, int32_t lane) {
  to->x[lane] = around->x[o];
  to->y[lane] = around->y[o];
  to->z[lane] = around->z[o];
  to->radius[lane] = c->radius[o];
  to->margin[lane] = around->margin[o] + held_error;
  to->alpha[lane] = around->alpha[o];
  to->speed[lane] = c->speed[o];
  to->least[lane] = DBK_BEYOND;
  if (balls) { return; }
  to->ax[lane] = c->ax[o];
  to->ay[lane] = c->ay[o];
  to->az[lane] = c->az[o];
  to->half[lane] = c->half[o];
  to->error[lane] = c->error[o];
  to->vx[lane] = c->vx[o];
  to->vy[lane] = c->vy[o];
  to->vz[lane] = c->vz[o];
}

static inline void gather_all(const dbk_covers *c, const dbk_surround *around, dbk_real held_error, int32_t balls,
                              const dbk_batch *w, company *restrict to) {
  const int32_t last = w->count - 1;
  for (int32_t base = 0; base <= last; base += DBK_LANES) {
    block *b = &to->block[base / DBK_LANES];
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      gather_one(c, around, held_error, balls, w->index[base + l < last ? base + l : last], b, l);
    }
  }
}

/* the sociable obstacles near a link; the last one fills the last vector */
static void gather(const dbk_scene *scene, const dbk_surround *around, const dbk_link_scene *near, company *restrict to,
                   dbk_batch *restrict w) {
  int32_t n = 0, balls = 1;
  for (int32_t i = 0; i < near->n_near; ++i) {
    const int32_t o = near->near[i];
    if (!dbk_sociable(scene, near->link, o)) { continue; }
    w->index[n] = o;
    w->yielding[n] = 0;
    balls &= scene->covers.ball[o];
    ++n;
  }
  to->count = w->count = n;
  to->balls = balls;
  if (balls) {
    gather_all(&scene->covers, around, near->held_error, 1, w, to);
  } else {
    gather_all(&scene->covers, around, near->held_error, 0, w, to);
  }
}

/* one sphere against the gathered capsules, or `balls` at rest; returns whether any row is kept */
static inline int32_t sphere_meets(const dbk_model *model, const dbk_ctx *ctx, int32_t sphere, int32_t balls,
                                   company *restrict c, dbk_batch *restrict w) {
  const dbk_mover m = dbk_mover_of(ctx, sphere);
  const dbk_real x = ctx->cloud.x[sphere], y = ctx->cloud.y[sphere], z = ctx->cloud.z[sphere];
  const dbk_real half_period = (dbk_real)0.5 * model->period, cap = model->recovery;
  const int32_t count = c->count;
  int32_t kept = 0;
  for (int32_t base = 0; base < count; base += DBK_LANES) {
    block *restrict b = &c->block[base / DBK_LANES];
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      const int32_t at = base + l;
      dbk_real nx, ny, nz;
      const dbk_real dx = x - b->x[l], dy = y - b->y[l], dz = z - b->z[l];
      const dbk_real far = balls ? dbk_off_point(dx, dy, dz, &nx, &ny, &nz)
                                 : dbk_off_segment(dx, dy, dz, b->ax[l], b->ay[l], b->az[l], b->half[l], &nx, &ny, &nz);
      const dbk_terms t = {b->margin[l], b->alpha[l], cap, b->error[l], half_period, b->vx[l], b->vy[l], b->vz[l]};
      const dbk_weight it = dbk_weigh(&m, &t, balls, far - b->radius[l], nx, ny, nz);
      const int32_t keep = (at < count) & dbk_binds(&it, 0);
      w->h[at] = it.h;
      w->nx[at] = nx;
      w->ny[at] = ny;
      w->nz[at] = nz;
      w->rhs[at] = it.rhs;
      w->keep[at] = keep;
      kept |= keep;
      b->least[l] = it.h < b->least[l] ? it.h : b->least[l];
    }
  }
  return kept;
}

DBK_WIDE static int32_t meets_capsules(const dbk_model *model, const dbk_ctx *ctx, int32_t sphere, company *restrict c,
                                       dbk_batch *restrict w) {
  return sphere_meets(model, ctx, sphere, 0, c, w);
}

DBK_WIDE static int32_t meets_balls(const dbk_model *model, const dbk_ctx *ctx, int32_t sphere, company *restrict c,
                                    dbk_batch *restrict w) {
  return sphere_meets(model, ctx, sphere, 1, c, w);
}

/* the smallest h goes into h_min; whatever one period could bring to h = 0 is looked at again (as dbk_judge does) */
static void judge_all(const dbk_model *model, dbk_ctx *ctx, const dbk_link_scene *near, const company *c,
                      const dbk_batch *w) {
  const dbk_real haste = ctx->motion.haste[near->link], period = model->period;
  dbk_real least[DBK_LANES];
  int32_t soon[DBK_LANES];
  for (int32_t l = 0; l < DBK_LANES; ++l) { least[l] = DBK_BEYOND; }
  for (int32_t base = 0; base < c->count; base += DBK_LANES) {
    const block *b = &c->block[base / DBK_LANES];
    int32_t any = 0;
    for (int32_t l = 0; l < DBK_LANES; ++l) {
      least[l] = b->least[l] < least[l] ? b->least[l] : least[l];
      soon[l] = !(b->least[l] >= period * (b->speed[l] + haste) + DBK_CULL_FLOOR);
      any |= soon[l];
    }
    for (int32_t l = 0; any && l < DBK_LANES && base + l < c->count; ++l) {
      if (soon[l]) { dbk_remember(ctx, near->first, near->count, w->index[base + l]); }
    }
  }
  ctx->h_min = dbk_min(ctx->h_min, dbk_least(least, DBK_BEYOND) + model->sampling);
}

void dbk_meet_together(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_surround *around,
                       const dbk_link_scene *near) {
  company c;
  dbk_batch w;
  gather(scene, around, near, &c, &w);
  w.kind = DBK_ROW_OBSTACLE;
  w.from = 0;
  w.upto = near->frame;
  for (int32_t s = near->first; s < near->first + near->count; ++s) {
    w.sphere = s;
    const int32_t kept = c.balls ? meets_balls(model, ctx, s, &c, &w) : meets_capsules(model, ctx, s, &c, &w);
    if (kept) { dbk_keep_rows(scene, ctx, &w); }
  }
  judge_all(model, ctx, near, &c, &w);
}
