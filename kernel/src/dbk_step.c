/* One control step: refuse bad input, build rows, solve, check, certify, and always answer with an admissible control. */
#include "dbk_step.h"

static int32_t input_flags(const dbk_model *model, const dbk_scene *scene, const dbk_in *in) {
  int32_t flags = 0;
  const int32_t n = model->n;
  if (!dbk_all_finite(in->q, n) || !dbk_all_finite(in->v, n) || !dbk_all_finite(in->u_nom, n) ||
      !dbk_finite(in->opening) || dbk_abs(in->opening) > (dbk_real)0.1) {
    flags |= DBK_BAD_INPUT;
  }
  if (in->mobile && !(dbk_all_finite(in->base_rotation, 9) && dbk_all_finite(in->base_position, 3))) {
    flags |= DBK_BAD_INPUT;
  }
  if (!scene->ready) { flags |= DBK_BAD_SCENE; }
  /* ages below zero mean that a clock stepped; a few milliseconds of skew are forgiven */
  if (!(in->state_age <= model->state_age_max && in->state_age >= (dbk_real)-0.005)) { flags |= DBK_STALE_STATE; }
  if (!dbk_finite(in->scene_age)) { flags |= DBK_STALE_SCENE; }
  if (scene->moving && !(in->scene_age <= model->scene_age_max && in->scene_age >= (dbk_real)-0.005)) {
    flags |= DBK_STALE_SCENE;
  }
  for (int32_t k = 0; k < n; ++k) {
    const dbk_real y = in->q[k] + model->lag * in->v[k];
    if (!dbk_finite(y)) { continue; } /* told already */
    if (!(y >= model->q_lower[k] - DBK_FAR_OUTSIDE && y <= model->q_upper[k] + DBK_FAR_OUTSIDE)) {
      flags |= DBK_OUTSIDE;
    }
  }
  return flags;
}

/* what does not hang on the rows, at the lag-compensated state y = q + lag v: the box, and where the spheres are */
static int32_t locate(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                      const dbk_real *u_prev, const dbk_real *change) {
  dbk_real y[DBK_MAX_DOF] = {0};
  int32_t conflict = 0, room = 1;
  for (int32_t k = 0; k < model->n; ++k) { y[k] = in->q[k] + model->lag * in->v[k]; }
  dbk_box(model, y, u_prev, ctx->lower, ctx->upper, &conflict);
  if (change) { room = dbk_jerk_box(model, u_prev, change, ctx->lower, ctx->upper); }
  dbk_base(in, &ctx->frames);
  dbk_fk(model, y, &ctx->frames);
  dbk_spheres(model, scene, &ctx->frames, in->opening, &ctx->cloud);
  return (conflict ? DBK_INFEASIBLE : 0) | (room ? 0 : DBK_JERK);
}

/* the rows that a control of the trust box could violate */
static int32_t build(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real age, dbk_real extra,
                     int32_t known_only) {
  dbk_set_motion(model, scene, ctx);
  dbk_build_rows(model, scene, ctx, age, extra, known_only);
  return (ctx->rows.overflow ? DBK_ROW_OVERFLOW : 0) | (ctx->rows.stuck ? DBK_NO_GRADIENT : 0) |
         (ctx->rows.unavoidable ? DBK_UNAVOIDABLE : 0);
}

void dbk_all_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in) {
  if (!ctx->trusted) { return; }
  dbk_trust_all(model, ctx);
  (void)build(model, scene, ctx, in->scene_age, (dbk_real)0, 0);
}

/* the nominal control as it is, where it meets everything */
static int32_t nominal_holds(const dbk_model *model, dbk_ctx *ctx, const dbk_real *u_nom, dbk_real *u, dbk_out *out) {
  out->iterations = out->n_active = out->relaxed = 0;
  out->h_min = ctx->h_min;
  out->n_rows = ctx->rows.count;
  for (int32_t k = 0; k < model->n; ++k) { u[k] = u_nom[k]; }
  if (!dbk_check(&ctx->rows, model->n, ctx->lower, ctx->upper, u_nom, (dbk_real)0)) { return 0; }
  ctx->n_warm = 0;
  return 1;
}

/* closest control that meets box and rows; the flag tells when there is none, and u then brakes */
static int32_t optimise(const dbk_model *model, dbk_ctx *ctx, const dbk_real *u_nom, const dbk_real *brake, dbk_real *u,
                        dbk_out *out) {
  int32_t ids[DBK_QP_DIM];
  const int32_t warm = dbk_recall(model, ctx, ids);
  const int32_t result = dbk_qp(&ctx->rows, model->n, model->scale, ctx->lower, ctx->upper, u_nom, 0, DBK_QP_SHIFT, ids,
                                warm, &ctx->solution);
  out->iterations = ctx->solution.iterations;
  dbk_remember_active(model, ctx, out);
  for (int32_t k = 0; k < model->n; ++k) {
    u[k] = dbk_clamp(result == 0 ? ctx->solution.u[k] : brake[k], ctx->lower[k], ctx->upper[k]);
  }
  return result == 0 ? 0 : (result == 1 ? DBK_INFEASIBLE : DBK_QP_ITERATIONS);
}

/* the answer by the rows of the trust box: 1 where it is that of all rows, 0 where it lies outside, -1 where there is none */
static int32_t solve_in_trust(const dbk_model *model, dbk_ctx *ctx, const dbk_real *u_nom, const dbk_real *brake,
                              dbk_real *u, dbk_out *out) {
  if (nominal_holds(model, ctx, u_nom, u, out)) { return dbk_in_trust(model, ctx, u); }
  if (optimise(model, ctx, u_nom, brake, u, out) ||
      !dbk_check(&ctx->rows, model->n, ctx->lower, ctx->upper, u, DBK_CHECK_TOL)) {
    ctx->n_warm = 0;
    return -1;
  }
  return dbk_in_trust(model, ctx, u);
}

/* looks where the answer is expected, then around what was found there; 1 where that led to the answer by all rows */
static int32_t search(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                      const dbk_real *u_prev, dbk_real extra, int32_t known_only, const dbk_real *brake, dbk_real *u,
                      dbk_out *out) {
  int32_t found = 0;
  dbk_trust_near(model, ctx, ctx->n_warm > 0 ? u_prev : in->u_nom);
  for (int32_t tries = 0; ctx->trusted && found == 0 && tries < DBK_TRUST_TRIES; ++tries) {
    if (tries > 0) { dbk_trust_near(model, ctx, u); }
    if (build(model, scene, ctx, in->scene_age, extra, known_only)) { return 0; }
    found = solve_in_trust(model, ctx, in->u_nom, brake, u, out);
  }
  return found > 0;
}

/* the answer by all rows, or the least violation of them */
static int32_t solve_all(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_real *u_nom,
                         const dbk_real *brake, dbk_real *u, dbk_out *out) {
  if (nominal_holds(model, ctx, u_nom, u, out)) { return 0; }
  const int32_t failed = optimise(model, ctx, u_nom, brake, u, out);
  if (failed & DBK_INFEASIBLE) {
    out->relaxed = dbk_relax(model, scene, ctx, brake, u);
    ctx->n_warm = 0;
  }
  return failed;
}

/* keep u if the next step is certified; else go from u toward braking, never toward zero, until it is. If nothing is, what
 * moves is about to touch: the answer stays the relaxed one, which no pair has worse than braking, or else is to brake */
static int32_t certify(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                       const dbk_real *brake, int32_t relaxed, dbk_real *u) {
  dbk_real start[DBK_MAX_DOF];
  const int32_t n = model->n;
  for (int32_t k = 0; k < n; ++k) { start[k] = u[k]; }
  for (int32_t tries = 0; tries <= 4; ++tries) {
    const dbk_real part = (dbk_real)0.25 * (dbk_real)tries;
    for (int32_t k = 0; k < n; ++k) {
      u[k] = dbk_clamp(start[k] + part * (brake[k] - start[k]), ctx->lower[k], ctx->upper[k]);
    }
    if (tries == 0) {
      for (int32_t k = 0; k < n; ++k) { u[k] = start[k]; }
    }
    const int32_t sound =
        dbk_check(&ctx->rows, n, ctx->lower, ctx->upper, u, relaxed || tries == 4 ? (dbk_real)1e6 : DBK_CHECK_TOL);
    if (sound && dbk_certify(model, scene, ctx, in, u)) { return 1; }
  }
  const int32_t kept = relaxed && dbk_check(&ctx->rows, n, ctx->lower, ctx->upper, start, DBK_CHECK_TOL);
  for (int32_t k = 0; k < n; ++k) { u[k] = kept ? start[k] : brake[k]; }
  return 0;
}

static dbk_status finish(const dbk_model *model, dbk_ctx *ctx, const dbk_in *in, dbk_status status, int32_t flags,
                         int32_t certified, const dbk_real *u, dbk_out *out) {
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
    dbk_real value = (dbk_real)0;
    if (k < model->n) { value = dbk_clamp(u[k], -model->v_max[k], model->v_max[k]); }
    out->u[k] = value;
    ctx->change[k] = value - ctx->u_prev[k];
    ctx->u_prev[k] = value;
  }
  out->status = (int32_t)status;
  out->flags = flags;
  out->certified = certified;
  dbk_measure(model, ctx, in, out);
  return status;
}

static dbk_status refuse(const dbk_model *model, dbk_ctx *ctx, const dbk_in *in, int32_t flags, const dbk_real *brake,
                         dbk_out *out) {
  out->h_min = DBK_UNKNOWN;
  out->iterations = out->n_rows = out->n_active = out->relaxed = 0;
  ctx->n_warm = ctx->trusted = ctx->rows.count = 0;
  return finish(model, ctx, in, DBK_STOPPED, flags, 0, brake, out);
}

static dbk_status passed(const dbk_model *model, dbk_ctx *ctx, const dbk_in *in, int32_t flags, const dbk_real *u,
                         dbk_out *out) {
  int32_t same = 1;
  for (int32_t k = 0; k < model->n; ++k) { same &= u[k] == in->u_nom[k]; }
  return finish(model, ctx, in, same ? DBK_SAFE : DBK_MODIFIED, flags, 1, u, out);
}

/* the step by all rows that a control of the box could violate */
static dbk_status step_in_box(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                              int32_t flags, const dbk_real *brake, dbk_out *out) {
  dbk_real u[DBK_MAX_DOF];
  dbk_trust_all(model, ctx);
  flags |= build(model, scene, ctx, in->scene_age, (dbk_real)0, 0);
  if (flags & (DBK_ROW_OVERFLOW | DBK_NO_GRADIENT)) {
    out->h_min = ctx->h_min;
    out->n_rows = ctx->rows.count;
    out->iterations = out->n_active = out->relaxed = 0;
    return finish(model, ctx, in, DBK_STOPPED, flags, 0, brake, out);
  }
  flags |= solve_all(model, scene, ctx, in->u_nom, brake, u, out);
  if (flags & DBK_QP_ITERATIONS) { return finish(model, ctx, in, DBK_STOPPED, flags, 0, brake, out); }
  const int32_t relaxed = (flags & (DBK_INFEASIBLE | DBK_UNAVOIDABLE)) != 0;
  const int32_t certified = certify(model, scene, ctx, in, brake, relaxed, u);
  if (!certified) { return finish(model, ctx, in, DBK_FAULT, flags | DBK_UNCERTIFIED, 0, u, out); }
  if (relaxed) { return finish(model, ctx, in, DBK_RELAXED, flags, 1, u, out); }
  return passed(model, ctx, in, flags, u, out);
}

dbk_status dbk_step(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in, dbk_out *out) {
  dbk_real brake[DBK_MAX_DOF], u[DBK_MAX_DOF];
  dbk_brake(model, ctx->u_prev, brake);
  const int32_t refused = input_flags(model, scene, in);
  if (refused) { return refuse(model, ctx, in, refused, brake, out); }
  const int32_t flags = locate(model, scene, ctx, in, ctx->u_prev, ctx->change);
  for (int32_t k = 0; k < model->n; ++k) { brake[k] = dbk_clamp(brake[k], ctx->lower[k], ctx->upper[k]); }
  if (!(flags & DBK_INFEASIBLE) && search(model, scene, ctx, in, ctx->u_prev, (dbk_real)0, 0, brake, u, out) &&
      dbk_certify(model, scene, ctx, in, u)) {
    return passed(model, ctx, in, flags, u, out);
  }
  return step_in_box(model, scene, ctx, in, flags, brake, out);
}

dbk_status dbk_project(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                       const dbk_real u_prev[DBK_MAX_DOF], dbk_real extra, dbk_real u[DBK_MAX_DOF]) {
  dbk_real brake[DBK_MAX_DOF];
  dbk_out ignored;
  dbk_brake(model, u_prev, brake);
  int32_t flags = input_flags(model, scene, in);
  if (!flags) {
    flags = locate(model, scene, ctx, in, u_prev, 0);
    for (int32_t k = 0; k < model->n; ++k) { brake[k] = dbk_clamp(brake[k], ctx->lower[k], ctx->upper[k]); }
    if (!(flags & DBK_INFEASIBLE) && search(model, scene, ctx, in, u_prev, extra, 1, brake, u, &ignored)) {
      return DBK_MODIFIED;
    }
    dbk_trust_all(model, ctx);
    flags |= build(model, scene, ctx, in->scene_age, extra, 1);
    if (!(flags & (DBK_ROW_OVERFLOW | DBK_NO_GRADIENT))) {
      flags |= solve_all(model, scene, ctx, in->u_nom, brake, u, &ignored);
      if (!(flags & DBK_QP_ITERATIONS)) { return (flags & DBK_INFEASIBLE) ? DBK_RELAXED : DBK_MODIFIED; }
    }
  }
  for (int32_t k = 0; k < model->n; ++k) { u[k] = brake[k]; }
  return DBK_STOPPED;
}
