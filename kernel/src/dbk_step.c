/* One control step: refuse bad input, build rows, solve, check, certify, and always answer with an admissible control. */
#include "dbk_math.h"

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

/* everything that the QP needs, at the lag-compensated state y = q + lag v */
static int32_t build(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                     const dbk_real *u_prev, const dbk_real *change, dbk_real extra, int32_t known_only) {
  dbk_real y[DBK_MAX_DOF];
  int32_t conflict = 0, room = 1;
  for (int32_t k = 0; k < model->n; ++k) { y[k] = in->q[k] + model->lag * in->v[k]; }
  dbk_box(model, y, u_prev, ctx->lower, ctx->upper, &conflict);
  if (change) { room = dbk_jerk_box(model, u_prev, change, ctx->lower, ctx->upper); }
  dbk_base(in, &ctx->frames);
  dbk_fk(model, y, &ctx->frames);
  dbk_spheres(model, scene, &ctx->frames, in->opening, &ctx->cloud);
  dbk_set_motion(model, scene, ctx);
  dbk_build_rows(model, scene, ctx, in->scene_age, extra, known_only);
  return (ctx->rows.overflow ? DBK_ROW_OVERFLOW : 0) | (ctx->rows.stuck ? DBK_NO_GRADIENT : 0) |
         (ctx->rows.unavoidable ? DBK_UNAVOIDABLE : 0) | (conflict ? DBK_INFEASIBLE : 0) | (room ? 0 : DBK_JERK);
}

/* the warm start in this step's numbering */
static int32_t recall(const dbk_model *model, const dbk_ctx *ctx, int32_t ids[DBK_QP_DIM]) {
  int32_t count = 0;
  for (int32_t w = 0; w < ctx->n_warm; ++w) {
    const int32_t kind = ctx->warm[w][0], i = ctx->warm[w][1], j = ctx->warm[w][2];
    if (kind == DBK_ROW_LOWER) { ids[count++] = i; }
    if (kind == DBK_ROW_UPPER) { ids[count++] = model->n + i; }
    if (kind == DBK_ROW_OBSTACLE || kind == DBK_ROW_SELF || kind == DBK_ROW_USER) {
      for (int32_t r = 0; r < ctx->rows.count; ++r) {
        if (ctx->rows.i[r] == i && ctx->rows.j[r] == j && ctx->rows.kind[r] == kind) {
          ids[count++] = 2 * model->n + r;
          break;
        }
      }
    }
  }
  return count;
}

/* which of its limits a bound of the box comes from */
static int32_t limit_of(const dbk_model *model, const dbk_ctx *ctx, int32_t k, int32_t upper) {
  const dbk_real sign = upper ? (dbk_real)1 : (dbk_real)-1, dt = model->period;
  const dbk_real bound = sign * (upper ? ctx->upper[k] : ctx->lower[k]), last = sign * ctx->u_prev[k];
  const dbk_real step = model->a_max[k] * dt, near = (dbk_real)1e-3 * step;
  const dbk_real jerk = last + sign * ctx->change[k] + model->j_max[k] * dt * dt;
  if (bound >= model->v_max[k] - near) { return DBK_LIMIT_VELOCITY; }
  if (bound >= last + step - near) { return DBK_LIMIT_ACCELERATION; }
  return model->j_max[k] > (dbk_real)0 && dbk_abs(bound - jerk) <= near ? DBK_LIMIT_JERK : DBK_LIMIT_POSITION;
}

static void name_active(const dbk_model *model, const dbk_ctx *ctx, int32_t at, dbk_active *out) {
  const int32_t id = ctx->solution.active[at], n = model->n;
  out->multiplier = ctx->solution.multiplier[at];
  if (id >= 2 * n) {
    const int32_t r = id - 2 * n;
    out->kind = ctx->rows.kind[r];
    out->i = ctx->rows.i[r];
    out->j = ctx->rows.j[r];
    out->h = ctx->rows.h[r];
  } else {
    out->kind = id < n ? DBK_ROW_LOWER : DBK_ROW_UPPER;
    out->i = id < n ? id : id - n;
    out->j = limit_of(model, ctx, out->i, id >= n);
    out->h = (dbk_real)0;
  }
}

static void remember(const dbk_model *model, dbk_ctx *ctx, dbk_out *out) {
  const int32_t count = ctx->solution.n_active;
  out->n_active = count;
  for (int32_t a = 0; a < count; ++a) { name_active(model, ctx, a, &out->active[a]); }
  ctx->n_warm = count < DBK_QP_DIM ? count : 0;
  for (int32_t a = 0; a < ctx->n_warm; ++a) {
    ctx->warm[a][0] = out->active[a].kind;
    ctx->warm[a][1] = out->active[a].i;
    ctx->warm[a][2] = out->active[a].j;
  }
}

/* closest control that meets box and rows; flags tell when there is none */
static int32_t solve(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_real *u_nom,
                     const dbk_real *brake, dbk_real *u, dbk_out *out) {
  int32_t ids[DBK_QP_DIM];
  const int32_t n = model->n;
  out->iterations = out->n_active = out->relaxed = 0;
  for (int32_t k = 0; k < n; ++k) { u[k] = u_nom[k]; }
  if (dbk_check(&ctx->rows, n, ctx->lower, ctx->upper, u_nom, (dbk_real)0)) {
    ctx->n_warm = 0;
    return 0;
  }
  const int32_t warm = recall(model, ctx, ids);
  const int32_t result = dbk_qp(&ctx->rows, n, model->scale, ctx->lower, ctx->upper, u_nom, 0, DBK_QP_SHIFT, ids, warm,
                                &ctx->solution);
  out->iterations = ctx->solution.iterations;
  remember(model, ctx, out);
  if (result == 1) {
    out->relaxed = dbk_relax(model, scene, ctx, brake, u);
    ctx->n_warm = 0;
    return DBK_INFEASIBLE;
  }
  for (int32_t k = 0; k < n; ++k) {
    u[k] = dbk_clamp(result == 0 ? ctx->solution.u[k] : brake[k], ctx->lower[k], ctx->upper[k]);
  }
  return result == 2 ? DBK_QP_ITERATIONS : 0;
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

static dbk_real distance_w(const dbk_model *model, const dbk_real *a, const dbk_real *b) {
  dbk_real square = (dbk_real)0;
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real e = (a[k] - b[k]) / model->v_max[k];
    square += e * e;
  }
  return dbk_sqrt(square / (dbk_real)model->n);
}

/* delta = |u - u_nom|_W, W = diag(1/v_max^2)/n, saturated at 2. To the box only what remains with the box around the
 * previous nominal: what phi itself could not have followed; the rest is the rows' (paper 4.4) */
static void measure(const dbk_model *model, dbk_ctx *ctx, const dbk_in *in, dbk_out *out) {
  dbk_real clipped[DBK_MAX_DOF];
  const int32_t finite = dbk_all_finite(in->u_nom, model->n);
  if (!finite) {
    out->delta = out->delta_rows = (dbk_real)2;
    out->delta_box = (dbk_real)0;
    return;
  }
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real step = model->a_max[k] * model->period, last = ctx->u_nom_prev[k];
    const dbk_real within = dbk_clamp(in->u_nom[k], last - step, last + step);
    clipped[k] = dbk_clamp(within, -model->v_max[k], model->v_max[k]);
    ctx->u_nom_prev[k] = in->u_nom[k];
  }
  const dbk_real delta = distance_w(model, out->u, in->u_nom), box = distance_w(model, clipped, in->u_nom);
  out->delta = delta <= (dbk_real)2 ? delta : (dbk_real)2;
  out->delta_box = dbk_min(out->delta, box <= (dbk_real)2 ? box : (dbk_real)2);
  out->delta_rows = out->delta - out->delta_box;
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
  measure(model, ctx, in, out);
  return status;
}

dbk_status dbk_step(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in, dbk_out *out) {
  dbk_real brake[DBK_MAX_DOF], u[DBK_MAX_DOF];
  dbk_brake(model, ctx->u_prev, brake);
  out->h_min = (dbk_real)0;
  out->iterations = out->n_rows = out->n_active = out->relaxed = 0;
  int32_t flags = input_flags(model, scene, in);
  if (flags) {
    ctx->n_warm = 0;
    return finish(model, ctx, in, DBK_STOPPED, flags, 0, brake, out);
  }
  flags = build(model, scene, ctx, in, ctx->u_prev, ctx->change, (dbk_real)0, 0);
  out->h_min = ctx->h_min;
  out->n_rows = ctx->rows.count;
  for (int32_t k = 0; k < model->n; ++k) { brake[k] = dbk_clamp(brake[k], ctx->lower[k], ctx->upper[k]); }
  if (flags & (DBK_ROW_OVERFLOW | DBK_NO_GRADIENT)) {
    return finish(model, ctx, in, DBK_STOPPED, flags, 0, brake, out);
  }
  flags |= solve(model, scene, ctx, in->u_nom, brake, u, out);
  if (flags & DBK_QP_ITERATIONS) { return finish(model, ctx, in, DBK_STOPPED, flags, 0, brake, out); }
  const int32_t relaxed = (flags & (DBK_INFEASIBLE | DBK_UNAVOIDABLE)) != 0;
  const int32_t certified = certify(model, scene, ctx, in, brake, relaxed, u);
  if (!certified) { return finish(model, ctx, in, DBK_FAULT, flags | DBK_UNCERTIFIED, 0, u, out); }
  int32_t same = 1;
  for (int32_t k = 0; k < model->n; ++k) { same &= u[k] == in->u_nom[k]; }
  const dbk_status status = relaxed ? DBK_RELAXED : (same ? DBK_SAFE : DBK_MODIFIED);
  return finish(model, ctx, in, status, flags, certified, u, out);
}

dbk_status dbk_project(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, const dbk_in *in,
                       const dbk_real u_prev[DBK_MAX_DOF], dbk_real extra, dbk_real u[DBK_MAX_DOF]) {
  dbk_real brake[DBK_MAX_DOF];
  dbk_out ignored;
  dbk_brake(model, u_prev, brake);
  int32_t flags = input_flags(model, scene, in);
  if (!flags) {
    flags = build(model, scene, ctx, in, u_prev, 0, extra, 1);
    for (int32_t k = 0; k < model->n; ++k) { brake[k] = dbk_clamp(brake[k], ctx->lower[k], ctx->upper[k]); }
    if (!(flags & (DBK_ROW_OVERFLOW | DBK_NO_GRADIENT))) {
      flags |= solve(model, scene, ctx, in->u_nom, brake, u, &ignored);
      if (!(flags & DBK_QP_ITERATIONS)) { return (flags & DBK_INFEASIBLE) ? DBK_RELAXED : DBK_MODIFIED; }
    }
  }
  for (int32_t k = 0; k < model->n; ++k) { u[k] = brake[k]; }
  return DBK_STOPPED;
}
