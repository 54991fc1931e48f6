/* One control step: validates the input, builds the rows, solves the QP, checks and certifies the result. Every step
 * returns an admissible control. */
#include "dbk_build_rows.h"
#include "model/dbk_control_bounds.h"
#include "model/dbk_kinematics.h"
#include "model/dbk_sphere_motion.h"
#include "model/dbk_trust_region.h"
#include "qp/dbk_certificate.h"
#include "qp/dbk_intervention.h"
#include "qp/dbk_qp.h"
#include "qp/dbk_relaxation.h"
#include "qp/dbk_retreat.h"
#include "qp/dbk_warm_start.h"
#include "speed/dbk_speed_braking.h"
#include "speed/dbk_speed_limit.h"

void dbk_init(dbk_ctx *ctx) {
  ctx->n_warm = ctx->speed.active = ctx->speed.n_cuts = 0;
  ctx->nearest.link_pair = -1;
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
    ctx->u_prev[k] = (dbk_real)0;
    ctx->u_nom_prev[k] = (dbk_real)0;
    ctx->u_change[k] = (dbk_real)0;
  }
}

/* 1 if the base is where the number type resolves the margins; the comparisons reject NaN */
static int32_t base_within_bounds(const dbk_in *in) {
  int32_t within = 1;
  for (int32_t e = 0; e < 3; ++e) { within &= (dbk_abs(in->base_position[e]) <= DBK_MAX_BASE); }
  return within;
}

/* flags of an invalid or stale input; 0 if the step can proceed */
static int32_t input_flags(const dbk_model *model, const dbk_scene *scene, const dbk_in *in) {
  int32_t flags = 0;
  const int32_t n = model->n;
  if (!dbk_all_finite(in->q, n) || !dbk_all_finite(in->v, n) || !dbk_all_finite(in->u_nom, n) ||
      !dbk_finite(in->opening) || dbk_abs(in->opening) > (dbk_real)0.1) {
    flags |= DBK_BAD_INPUT;
  }
  if (in->mobile && !(dbk_all_finite(in->base_rotation, 9) && base_within_bounds(in))) { flags |= DBK_BAD_INPUT; }
  if (!scene->ready) { flags |= DBK_BAD_SCENE; }
  /* a negative age means that a clock was set back, or that the stamp is of another clock */
  if (!(in->state_age <= model->state_age_max && in->state_age >= -DBK_CLOCK_TOL)) { flags |= DBK_STALE_STATE; }
  if (!dbk_finite(in->scene_age)) { flags |= DBK_STALE_SCENE; }
  if (scene->n_obstacles > 0 && !(in->scene_age >= -DBK_CLOCK_TOL)) { flags |= DBK_STALE_SCENE; }
  if (scene->moving && !(in->scene_age <= model->scene_age_max)) { flags |= DBK_STALE_SCENE; }
  for (int32_t k = 0; k < n; ++k) {
    const dbk_real y = in->q[k] + model->lag * in->v[k];
    if (!dbk_finite(y)) { continue; } /* already flagged */
    if (!(y >= model->q_lower[k] - DBK_OUTSIDE_TOL && y <= model->q_upper[k] + DBK_OUTSIDE_TOL)) {
      flags |= DBK_OUTSIDE;
    }
  }
  return flags;
}

/* control bounds, kinematics and speed limits at the lag-compensated state y = q + lag v, which do not depend on the
 * rows; the braking control then keeps the bounds and the speed limits */
static int32_t set_state(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                         const dbk_real *u_prev, const dbk_real *u_change, int32_t known_only, dbk_real *brake) {
  dbk_real y[DBK_MAX_DOF] = {0};
  int32_t conflict = 0, jerk_feasible = 1;
  for (int32_t k = 0; k < model->n; ++k) { y[k] = in->q[k] + model->lag * in->v[k]; }
  dbk_control_bounds(model, y, u_prev, ctx->lower, ctx->upper, &conflict);
  if (u_change) { jerk_feasible = dbk_jerk_bounds(model, y, u_prev, u_change, ctx->lower, ctx->upper); }
  dbk_base_frame(in, &ctx->frames);
  dbk_fk(model, y, &ctx->frames);
  dbk_spheres(model, scene, &ctx->frames, in->opening, &ctx->spheres);
  dbk_set_speed_limits(model, scene, ctx, in, u_prev, u_change, known_only);
  for (int32_t k = 0; k < model->n; ++k) { brake[k] = dbk_clamp(brake[k], ctx->lower[k], ctx->upper[k]); }
  return dbk_brake_within_speed(model, scene, ctx, brake) | (conflict ? DBK_INFEASIBLE : 0) |
         (jerk_feasible ? 0 : DBK_JERK);
}

/* builds the rows that a control within the trust region can violate */
static int32_t build(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real age, dbk_real extra,
                     int32_t known_only) {
  dbk_set_sphere_motion(model, scene, ctx);
  dbk_build_rows(model, scene, ctx, age, extra, known_only);
  return (ctx->rows.overflow ? DBK_ROW_OVERFLOW : 0) | (ctx->rows.no_gradient ? DBK_NO_GRADIENT : 0) |
         (ctx->rows.unavoidable ? DBK_UNAVOIDABLE : 0);
}

void dbk_all_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in) {
  if (!ctx->trust_active) { return; }
  dbk_trust_region_full(model, ctx);
  (void)build(model, scene, ctx, in->scene_age, (dbk_real)0, 0);
}

/* returns 1 with u = u_nom if the nominal control satisfies the bounds, all rows and the speed limits */
static int32_t nominal_is_safe(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_real *u_nom,
                               dbk_real *u, dbk_out *out) {
  out->iterations = out->n_active = out->relaxed = 0;
  out->h_min = ctx->h_min;
  out->n_rows = ctx->rows.count;
  for (int32_t k = 0; k < model->n; ++k) { u[k] = u_nom[k]; }
  if (!dbk_check(&ctx->rows, model->n, ctx->lower, ctx->upper, u_nom, (dbk_real)0)) { return 0; }
  if (!dbk_keeps_speed(model, scene, ctx, u_nom)) { return 0; }
  ctx->n_warm = 0;
  return 1;
}

/* Solves the QP, again with cuts as long as a solution is too fast; if it has no solution, u is the braking control and
 * the result is a flag. A solution that is still too fast after DBK_SPEED_ROUNDS moves toward braking. */
static int32_t optimise(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_real *u_nom,
                        const dbk_real *brake, dbk_real *u, dbk_out *out) {
  int32_t ids[DBK_QP_DIM], result = 0, cut = 0;
  out->iterations = 0;
  for (int32_t tries = 0; tries < DBK_SPEED_ROUNDS; ++tries) {
    const int32_t warm = dbk_warm_start_load(model, ctx, ids);
    result = dbk_qp(&ctx->rows, model->n, model->scale, ctx->lower, ctx->upper, u_nom, 0, DBK_QP_SHIFT, ids, warm,
                    &ctx->solution);
    out->iterations += ctx->solution.iterations;
    dbk_warm_start_store(model, ctx, out);
    for (int32_t k = 0; k < model->n; ++k) {
      u[k] = dbk_clamp(result == 0 ? ctx->solution.u[k] : brake[k], ctx->lower[k], ctx->upper[k]);
    }
    cut = result == 0 ? dbk_cut_speed(model, scene, ctx, u) : 0;
    if (cut <= 0) { break; }
  }
  if (cut != 0) { dbk_slow_down(model, scene, ctx, brake, u); }
  return result == 0 ? 0 : (result == 1 ? DBK_INFEASIBLE : DBK_QP_ITERATIONS);
}

/* solves the problem with the rows of the trust region. Returns 1: u is the solution of the full problem, 0: u is
 * outside the trust region, -1: no solution */
static int32_t solve_in_trust_region(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx,
                                     const dbk_real *u_nom, const dbk_real *brake, dbk_real *u, dbk_out *out) {
  if (nominal_is_safe(model, scene, ctx, u_nom, u, out)) { return dbk_trust_region_contains(model, ctx, u); }
  if (optimise(model, scene, ctx, u_nom, brake, u, out) ||
      !dbk_check(&ctx->rows, model->n, ctx->lower, ctx->upper, u, DBK_CHECK_TOL)) {
    ctx->n_warm = 0;
    return -1;
  }
  return dbk_trust_region_contains(model, ctx, u);
}

/* tries trust regions: first around the expected solution, then around the last result. Returns 1 if u is the solution
 * of the full problem */
static int32_t search_trust_regions(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                                    const dbk_real *u_prev, dbk_real extra, int32_t known_only, const dbk_real *brake,
                                    dbk_real *u, dbk_out *out) {
  int32_t found = 0;
  dbk_trust_region_around(model, ctx, ctx->n_warm > 0 ? u_prev : in->u_nom);
  for (int32_t tries = 0; ctx->trust_active && found == 0 && tries < DBK_TRUST_TRIES; ++tries) {
    if (tries > 0) { dbk_trust_region_around(model, ctx, u); }
    if (build(model, scene, ctx, in->scene_age, extra, known_only)) { return 0; }
    found = solve_in_trust_region(model, scene, ctx, in->u_nom, brake, u, out);
  }
  return found > 0;
}

/* minimises the violation of the rows. Returns DBK_RETREAT if the robot evades all obstacles whose rows are violated */
static int32_t relax(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_real *u_prev,
                     const dbk_real *brake, dbk_real *u, dbk_out *out) {
  dbk_real required[DBK_MAX_ROWS];
  const int32_t count = ctx->rows.count, possible = !ctx->rows.unavoidable;
  for (int32_t r = 0; r < count; ++r) { required[r] = ctx->rows.b[r]; }
  out->relaxed = dbk_relax(model, scene, ctx, brake, u);
  ctx->n_warm = 0;
  return possible && dbk_retreats_in_time(model, scene, ctx, required, count, u_prev, u) ? DBK_RETREAT : 0;
}

/* solves the problem with all rows, or minimises their violation */
static int32_t solve_full(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_real *u_nom,
                          const dbk_real *u_prev, const dbk_real *brake, dbk_real *u, dbk_out *out) {
  if (nominal_is_safe(model, scene, ctx, u_nom, u, out)) { return 0; }
  const int32_t failed = optimise(model, scene, ctx, u_nom, brake, u, out);
  return failed & DBK_INFEASIBLE ? failed | relax(model, scene, ctx, u_prev, brake, u, out) : failed;
}

/* braking along the direction of motion within the control bounds, without regard to the speed limits */
static void full_braking(const dbk_model *model, const dbk_ctx *ctx, dbk_real u[DBK_MAX_DOF]) {
  dbk_brake(model, ctx->u_prev, u);
  dbk_limit_brake_jerk(model, ctx->u_prev, ctx->u_change, u);
  for (int32_t k = 0; k < model->n; ++k) { u[k] = dbk_clamp(u[k], ctx->lower[k], ctx->upper[k]); }
}

/* Keeps u if the next state is certified. Otherwise u moves in four steps toward braking, never toward zero, until the
 * next state is certified; u also keeps the speed limits. If none is, an obstacle is about to touch the robot: the
 * result is the relaxed control, for which no pair closes faster than under braking, or else the braking control. Adds
 * DBK_UNVERIFIED to *flags if u violates a row that the QP was to satisfy. */
static int32_t certify(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                       const dbk_real *brake, int32_t relaxed, dbk_real *u, int32_t *flags) {
  dbk_real start[DBK_MAX_DOF], full[DBK_MAX_DOF];
  const dbk_real *last = brake;
  const int32_t n = model->n;
  for (int32_t k = 0; k < n; ++k) { start[k] = u[k]; }
  for (int32_t tries = 0; tries <= 4; ++tries) {
    const dbk_real part = (dbk_real)0.25 * (dbk_real)tries;
    if (tries > 0) { *flags &= ~DBK_RETREAT; } /* braking instead of the retreat */
    for (int32_t k = 0; k < n; ++k) {
      u[k] = dbk_clamp(start[k] + part * (brake[k] - start[k]), ctx->lower[k], ctx->upper[k]);
    }
    if (tries == 0) {
      for (int32_t k = 0; k < n; ++k) { u[k] = start[k]; }
    }
    /* a relaxed control and pure braking may violate rows */
    const int32_t satisfied =
        dbk_check(&ctx->rows, n, ctx->lower, ctx->upper, u, relaxed || tries == 4 ? (dbk_real)1e6 : DBK_CHECK_TOL);
    if (tries == 0 && !satisfied) { *flags |= DBK_UNVERIFIED; }
    if (satisfied && dbk_keeps_speed(model, scene, ctx, u) && dbk_certify(model, scene, ctx, in, u)) { return 1; }
  }
  if (*flags & DBK_OVERSPEED) { /* no part is faster than under full braking, which closes no pair faster */
    full_braking(model, ctx, full);
    for (int32_t k = 0; k < n; ++k) { u[k] = full[k]; }
    if (dbk_certify(model, scene, ctx, in, u)) { return 1; }
    last = full;
  }
  const int32_t keep = relaxed && dbk_check(&ctx->rows, n, ctx->lower, ctx->upper, start, DBK_CHECK_TOL) &&
                       dbk_keeps_speed(model, scene, ctx, start);
  for (int32_t k = 0; k < n; ++k) { u[k] = keep ? start[k] : last[k]; }
  return 0;
}

/* Writes the result and stores the control for the next step. Every path of a step ends here: the control is finite and
 * within the velocity limits for every u, also for NaN (checked in tests/static_analysis). */
static dbk_status finish(const dbk_model *model, dbk_ctx *ctx, const dbk_in *in, dbk_status status, int32_t flags,
                         int32_t certified, const dbk_real *u, dbk_out *out) {
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
    dbk_real value = (dbk_real)0;
    if (k < model->n) {
      const dbk_real x = u[k];
      if (x == x) { value = dbk_clamp(x, -model->v_max[k], model->v_max[k]); } /* NaN: standstill */
    }
    out->u[k] = value;
    ctx->u_change[k] = value - ctx->u_prev[k];
    ctx->u_prev[k] = value;
  }
  out->status = (int32_t)status;
  out->flags = flags;
  out->certified = certified;
  dbk_intervention(model, ctx, in, out);
  return status;
}

/* rejects the input: the robot brakes, and h_min is NaN */
static dbk_status reject(const dbk_model *model, dbk_ctx *ctx, const dbk_in *in, int32_t flags, const dbk_real *brake,
                         dbk_out *out) {
  out->h_min = DBK_NAN;
  out->iterations = out->n_rows = out->n_active = out->relaxed = 0;
  ctx->n_warm = ctx->trust_active = ctx->rows.count = 0;
  return finish(model, ctx, in, DBK_STOPPED, flags, 0, brake, out);
}

/* accepts a certified control */
static dbk_status accept(const dbk_model *model, dbk_ctx *ctx, const dbk_in *in, int32_t flags, const dbk_real *u,
                         dbk_out *out) {
  int32_t same = 1;
  for (int32_t k = 0; k < model->n; ++k) { same &= u[k] == in->u_nom[k]; }
  return finish(model, ctx, in, same ? DBK_SAFE : DBK_MODIFIED, flags, 1, u, out);
}

/* the step with all rows that a control within the bounds can violate */
static dbk_status full_step(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                            int32_t flags, const dbk_real *brake, dbk_out *out) {
  dbk_real u[DBK_MAX_DOF];
  dbk_trust_region_full(model, ctx);
  flags |= build(model, scene, ctx, in->scene_age, (dbk_real)0, 0);
  if (flags & (DBK_ROW_OVERFLOW | DBK_NO_GRADIENT)) {
    out->h_min = ctx->h_min;
    out->n_rows = ctx->rows.count;
    out->iterations = out->n_active = out->relaxed = 0;
    return finish(model, ctx, in, DBK_STOPPED, flags, 0, brake, out);
  }
  flags |= solve_full(model, scene, ctx, in->u_nom, ctx->u_prev, brake, u, out);
  if (flags & DBK_QP_ITERATIONS) { return finish(model, ctx, in, DBK_STOPPED, flags, 0, brake, out); }
  const int32_t relaxed = (flags & (DBK_INFEASIBLE | DBK_UNAVOIDABLE)) != 0;
  const int32_t certified = certify(model, scene, ctx, in, brake, relaxed, u, &flags);
  if (!certified) { return finish(model, ctx, in, DBK_FAULT, flags | DBK_UNCERTIFIED, 0, u, out); }
  if (relaxed) { return finish(model, ctx, in, DBK_RELAXED, flags, 1, u, out); }
  return accept(model, ctx, in, flags, u, out);
}

dbk_status dbk_step(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in, dbk_out *out) {
  dbk_real brake[DBK_MAX_DOF], u[DBK_MAX_DOF];
  dbk_brake(model, ctx->u_prev, brake);
  dbk_limit_brake_jerk(model, ctx->u_prev, ctx->u_change, brake);
  const int32_t rejected = input_flags(model, scene, in);
  if (rejected) { return reject(model, ctx, in, rejected, brake, out); }
  const int32_t flags = set_state(model, scene, ctx, in, ctx->u_prev, ctx->u_change, 0, brake);
  /* the fast path: a certified solution from a trust region */
  if (!(flags & DBK_INFEASIBLE) &&
      search_trust_regions(model, scene, ctx, in, ctx->u_prev, (dbk_real)0, 0, brake, u, out) &&
      dbk_certify(model, scene, ctx, in, u)) {
    return accept(model, ctx, in, flags, u, out);
  }
  return full_step(model, scene, ctx, in, flags, brake, out);
}

dbk_status dbk_project(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                       const dbk_real u_prev[DBK_MAX_DOF], dbk_real extra, dbk_real u[DBK_MAX_DOF]) {
  dbk_real brake[DBK_MAX_DOF];
  dbk_out ignored;
  dbk_brake(model, u_prev, brake);
  int32_t flags = input_flags(model, scene, in);
  if (!flags) {
    flags = set_state(model, scene, ctx, in, u_prev, 0, 1, brake);
    if (!(flags & DBK_INFEASIBLE) &&
        search_trust_regions(model, scene, ctx, in, u_prev, extra, 1, brake, u, &ignored)) {
      return DBK_MODIFIED;
    }
    dbk_trust_region_full(model, ctx);
    flags |= build(model, scene, ctx, in->scene_age, extra, 1);
    if (!(flags & (DBK_ROW_OVERFLOW | DBK_NO_GRADIENT))) {
      flags |= solve_full(model, scene, ctx, in->u_nom, u_prev, brake, u, &ignored);
      if (!(flags & DBK_QP_ITERATIONS)) { return (flags & DBK_INFEASIBLE) ? DBK_RELAXED : DBK_MODIFIED; }
    }
  }
  for (int32_t k = 0; k < model->n; ++k) { u[k] = brake[k]; }
  return DBK_STOPPED;
}
