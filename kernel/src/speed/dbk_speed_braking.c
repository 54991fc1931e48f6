/* Braking within the speed limits: the closest control to braking that keeps them, or else the one that keeps the least
 * part of the excess of braking. */
#include "speed/dbk_speed_braking.h"

#include "qp/dbk_qp.h"
#include "speed/dbk_speed_limit.h"

#define UNLIMITED ((dbk_real)1e9)
/* [m/s] what one unit of the slack adds to the limit with the largest step; small, so that an excess is expensive */
#define SLACK_STEP ((dbk_real)1e-2)
/* fraction of the allowed speed that is searched without the reserve: the room for cuts is within the allowed speed */
#define SEARCHED_SHARE ((dbk_real)1 - (dbk_real)3 * DBK_SPEED_SHRINK)

/* the searches, in their order */
enum {
  WITH_RESERVE, /* the limits that are reduced by the growth of the speeds */
  ALLOWED,      /* the allowed speeds; after the ramp the least share above them */
  LEAST_EXCESS  /* the least part of the excess of braking over the allowed speeds; after the ramp no limit */
};

/* A search: the limits that may be exceeded are v + e step with the least e >= 0. */
typedef struct {
  int32_t kind, soft;                 /* soft: there are limits that may be exceeded */
  dbk_real step[DBK_SPHERE_CAPACITY]; /* [m/s] */
  dbk_real largest;                   /* the largest step */
} limit_search;

/* Sets the steps. With e <= 1 no part is faster than its limit or than under braking, which therefore is a solution of
 * the last search. */
static void set_steps(const dbk_model *model, const dbk_scene *scene, const dbk_ctx *ctx, const dbk_real *brake,
                      int32_t kind, limit_search *search) {
  const dbk_speed *speed = &ctx->speed;
  dbk_point_velocities v;
  search->kind = kind;
  search->soft = kind == LEAST_EXCESS || (kind == ALLOWED && speed->ramped);
  search->largest = DBK_SPEED_FLOOR;
  if (!search->soft) { return; }
  (void)dbk_limited_velocities(model, scene, ctx, brake, 0, &v);
  for (int32_t p = 0; p < speed->n_points; ++p) {
    const dbk_real base = SEARCHED_SHARE * speed->allowed[p], attained = dbk_length(v.vx[p], v.vy[p], v.vz[p]);
    const dbk_real braking = attained + attained * (dbk_real)2 * DBK_SPEED_SHRINK + DBK_SPEED_FLOOR;
    search->step[p] = kind == ALLOWED ? base : dbk_max(braking - base, (dbk_real)0);
    const int32_t limited = speed->allowed[p] < (dbk_real)0.5 * UNLIMITED;
    search->largest = dbk_max(search->largest, limited ? search->step[p] : (dbk_real)0);
  }
}

/* the limits of a search without reserve at the excess e */
static void set_limits(dbk_speed *speed, const limit_search *search, dbk_real excess) {
  for (int32_t p = 0; p < speed->n_points; ++p) {
    const dbk_real base = SEARCHED_SHARE * speed->allowed[p];
    const dbk_real raised = search->soft ? base + excess * search->step[p] : base;
    speed->limit[p] = search->kind == ALLOWED ? base : raised;
    speed->ramp_limit[p] = search->kind == ALLOWED ? raised : UNLIMITED;
  }
}

/* the rows of all cuts, with the slack in those that may be exceeded: -n'J_p u + (step / largest) SLACK_STEP s >= -v */
static void set_soft_rows(const dbk_model *model, dbk_ctx *ctx, const limit_search *search) {
  const dbk_speed *speed = &ctx->speed;
  dbk_rows *rows = &ctx->rows;
  set_limits(&ctx->speed, search, (dbk_real)0);
  dbk_only_speed_rows(model, ctx);
  if (!search->soft) { return; }
  for (int32_t r = 0; r < rows->count; ++r) {
    const int32_t cut = dbk_bounded(rows->j[r], DBK_MAX_CUTS - 1);
    if (speed->cut_ramped[cut] != (search->kind == ALLOWED)) { continue; }
    const dbk_real part = search->step[speed->cut_point[cut]] / search->largest;
    rows->soft[r] = dbk_min((dbk_real)1, ((dbk_real)1 - DBK_SPEED_SHRINK) * part * SLACK_STEP / rows->norm[r]);
  }
}

/* Searches the control closest to braking within the limits of a search. Returns 1 if u keeps them. */
static int32_t find_control(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, int32_t kind,
                            const dbk_real *brake, dbk_real *u) {
  limit_search search;
  dbk_real excess = (dbk_real)0;
  int32_t cut = 0;
  set_steps(model, scene, ctx, brake, kind, &search);
  for (int32_t k = 0; k < model->n; ++k) { u[k] = brake[k]; }
  ctx->rows.count = ctx->rows.overflow = 0;
  for (int32_t tries = 0; tries <= DBK_SPEED_ROUNDS; ++tries) {
    if (kind != WITH_RESERVE) { set_limits(&ctx->speed, &search, excess); }
    cut = dbk_cut_speed(model, scene, ctx, u);
    if (cut <= 0 || tries == DBK_SPEED_ROUNDS) { break; }
    if (kind != WITH_RESERVE) { set_soft_rows(model, ctx, &search); }
    const dbk_real shift = search.soft ? (dbk_real)0 : DBK_QP_SHIFT;
    if (dbk_qp(&ctx->rows, model->n, model->scale, ctx->lower, ctx->upper, brake, search.soft, shift, 0, 0,
               &ctx->solution)) {
      cut = -1;
      break;
    }
    excess = SLACK_STEP * dbk_max(ctx->solution.slack, (dbk_real)0) / search.largest;
    if (kind == LEAST_EXCESS) { excess = dbk_min(excess, (dbk_real)1); }
    for (int32_t k = 0; k < model->n; ++k) { u[k] = dbk_clamp(ctx->solution.u[k], ctx->lower[k], ctx->upper[k]); }
  }
  return cut == 0;
}

/* The limits that u exceeds become its speeds, with room for cuts up to the allowed speed. Returns 1 if u exceeds an
 * allowed speed. */
static int32_t raise_limits(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_real *u) {
  dbk_speed *speed = &ctx->speed;
  dbk_point_velocities v;
  int32_t above = 0;
  for (int32_t ramped = 0; ramped <= speed->ramped; ++ramped) {
    (void)dbk_limited_velocities(model, scene, ctx, u, ramped, &v);
    dbk_real *limit = ramped ? speed->ramp_limit : speed->limit;
    for (int32_t p = 0; p < speed->n_points; ++p) {
      const dbk_real attained = dbk_length(v.vx[p], v.vy[p], v.vz[p]);
      const int32_t allowed = attained <= speed->allowed[p];
      if (attained <= limit[p]) { continue; }
      limit[p] = attained + attained * (dbk_real)2 * DBK_SPEED_SHRINK + DBK_SPEED_FLOOR;
      if (allowed && !ramped) { limit[p] = dbk_min(limit[p], speed->allowed[p]); }
      above |= !ramped && !allowed;
    }
  }
  return above;
}

int32_t dbk_brake_within_speed(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx,
                               dbk_real brake[DBK_MAX_DOF]) {
  dbk_speed *speed = &ctx->speed;
  dbk_real u[DBK_MAX_DOF], reserved[DBK_SPHERE_CAPACITY];
  int32_t found = 0, kind;
  if (!speed->active) { return 0; }
  const int32_t kept = speed->n_cuts; /* of the last step */
  for (int32_t p = 0; p < speed->n_points; ++p) { reserved[p] = speed->limit[p]; }
  for (kind = WITH_RESERVE; kind <= LEAST_EXCESS; ++kind) {
    found = find_control(model, scene, ctx, kind, brake, u);
    speed->n_cuts = kept;
    if (found) { break; }
  }
  for (int32_t p = 0; p < speed->n_points; ++p) { speed->limit[p] = speed->ramp_limit[p] = reserved[p]; }
  if (found) {
    for (int32_t k = 0; k < model->n; ++k) { brake[k] = u[k]; }
    if (kind == WITH_RESERVE) { return 0; }
  }
  return raise_limits(model, scene, ctx, brake) ? DBK_OVERSPEED : 0;
}
