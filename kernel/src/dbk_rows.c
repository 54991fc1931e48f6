/* Rows of the barrier functions (paper 4.2): for a sphere at distance h along the outward normal n of an obstacle,
 *
 *   n'J u  >=  -alpha(h) + n'v_o + velocity_error + tracking * sum_k |n'J_k| + max(0, -dt/2 n'a)
 *
 * with a the centre's acceleration at constant u (the sampling term), alpha(h) = alpha h, and for h < 0 the recovery
 * min(alpha |h|, recovery). A row is left out only when no control of the box can violate it and h is above a floor.
 * Where contact is permitted, the contact-speed row n'(J u - v_o) >= -max(speed, alpha h) takes its place. Where speed and
 * separation are asked for, n'J u >= -v_max(h) holds as well, as far as braking can follow it.
 */
#include "dbk_pair.h"

/* what could reach h = 0 within one period is looked at again by the certificate */
void dbk_remember(dbk_ctx *ctx, int32_t first, int32_t count, int32_t other) {
  const int32_t at = ctx->visits.count;
  if (at >= DBK_MAX_VISITS) {
    ctx->rows.overflow = 1;
    return;
  }
  ctx->visits.first[at] = (int16_t)first;
  ctx->visits.spheres[at] = (int16_t)count;
  ctx->visits.other[at] = (int16_t)other;
  ctx->visits.count = at + 1;
}

/* the rows from `first` on are moved by the joints from..upto-1, and belong to one sphere or (-1) to several */
static void open_span(dbk_rows *rows, int32_t first, const dbk_batch *w) {
  const int32_t at = rows->n_spans;
  if (at > 0 && rows->span_from[at - 1] == w->from && rows->span_upto[at - 1] == w->upto &&
      rows->span_sphere[at - 1] == w->sphere) {
    return;
  }
  rows->span_first[at] = first;
  rows->span_from[at] = w->from;
  rows->span_upto[at] = w->upto;
  rows->span_sphere[at] = w->sphere;
  rows->n_spans = at + 1;
}

/* copies the pairs that are to be kept behind the rows there are; every pair is written, and overwritten by the next one
 * unless it is kept. When there is no more room, that is told, and the step brakes. */
static inline void copy_kept(const dbk_batch *w, dbk_rows *restrict rows) {
  int32_t *restrict vary = w->sphere >= 0 ? rows->j : rows->i;
  int32_t n = rows->count;
  for (int32_t at = 0; at < w->count; ++at) {
    const int32_t r = n < DBK_MAX_ROWS ? n : DBK_MAX_ROWS;
    rows->h[r] = w->h[at];
    rows->b[r] = w->rhs[at];
    rows->nx[r] = w->nx[at];
    rows->ny[r] = w->ny[at];
    rows->nz[r] = w->nz[at];
    rows->yielding[r] = w->yielding[at];
    vary[r] = w->index[at];
    n += w->keep[at];
  }
  if (n > DBK_MAX_ROWS) {
    rows->overflow = 1;
    n = DBK_MAX_ROWS;
  }
  rows->count = n;
}

/* takes the pairs of a batch that are to be kept as rows */
DBK_WIDE void dbk_keep_rows(const dbk_scene *scene, dbk_ctx *ctx, const dbk_batch *w) {
  dbk_rows *restrict rows = &ctx->rows;
  const dbk_covers *c = &scene->covers;
  const int32_t first = rows->count;
  copy_kept(w, rows);
  if (first == rows->count) { return; }
  open_span(rows, first, w);
  int32_t *restrict same = w->sphere >= 0 ? rows->i : rows->j;
  const int32_t fixed = w->sphere >= 0 ? w->sphere : w->other, obstacle = w->kind == DBK_ROW_OBSTACLE;
  for (int32_t r = first; r < rows->count; ++r) {
    same[r] = fixed;
    rows->kind[r] = w->kind;
  }
  for (int32_t r = first; r < rows->count; ++r) {
    rows->moving[r] = obstacle ? c->moving[rows->j[r]] : 0;
    rows->rank[r] = obstacle ? c->rank[rows->j[r]] : DBK_RANK_BODY;
  }
}

/* n'J_k of rows that lie side by side, first..first+count-1, up to full vectors: what is written behind the last one is
 * written again by the next span */
typedef struct {
  int32_t first, count;
  dbk_real *square, *total; /* sums of squares and of sizes over the joints */
} columns;

/* the axes z_k of the joints and points p_k on them */
typedef struct {
  dbk_real zx[DBK_MAX_DOF], zy[DBK_MAX_DOF], zz[DBK_MAX_DOF], px[DBK_MAX_DOF], py[DBK_MAX_DOF], pz[DBK_MAX_DOF];
  int32_t slides[DBK_MAX_DOF];
} axes;

static axes axes_of(const dbk_model *model, const dbk_frames *frames) {
  axes out = {{0}, {0}, {0}, {0}, {0}, {0}, {0}};
  for (int32_t k = 0; k < model->n; ++k) {
    out.zx[k] = frames->rotation[k + 1][2];
    out.zy[k] = frames->rotation[k + 1][5];
    out.zz[k] = frames->rotation[k + 1][8];
    out.px[k] = frames->origin[k + 1][0];
    out.py[k] = frames->origin[k + 1][1];
    out.pz[k] = frames->origin[k + 1][2];
    out.slides[k] = model->joint_kind[k] == DBK_PRISMATIC;
  }
  return out;
}

/* velocity of the centre c of a sphere at unit speed of joint k: z_k x (c - p_k), or z_k where it slides */
typedef struct {
  dbk_real x[DBK_MAX_DOF], y[DBK_MAX_DOF], z[DBK_MAX_DOF];
} lever;

static inline void levers(const axes *at, const dbk_cloud *cloud, int32_t sphere, lever *restrict out) {
  const dbk_real cx = cloud->x[sphere], cy = cloud->y[sphere], cz = cloud->z[sphere];
  for (int32_t k = 0; k < DBK_MAX_DOF; ++k) {
    const dbk_real x = cx - at->px[k], y = cy - at->py[k], z = cz - at->pz[k];
    const dbk_real zx = at->zx[k], zy = at->zy[k], zz = at->zz[k];
    out->x[k] = at->slides[k] ? zx : zy * z - zz * y;
    out->y[k] = at->slides[k] ? zy : zz * x - zx * z;
    out->z[k] = at->slides[k] ? zz : zx * y - zy * x;
  }
}

/* rows of one sphere: n'J_k with its levers */
static inline void fill_for_sphere(const lever *j, int32_t k, const columns *at, dbk_rows *restrict rows) {
  const dbk_real jx = j->x[k], jy = j->y[k], jz = j->z[k];
  const dbk_real *nx = rows->nx + at->first, *ny = rows->ny + at->first, *nz = rows->nz + at->first;
  dbk_real *restrict a = rows->a[k] + at->first, *restrict square = at->square, *restrict total = at->total;
  for (int32_t r = 0; r < at->count; ++r) {
    const dbk_real mine = jx * nx[r] + jy * ny[r] + jz * nz[r];
    a[r] = mine;
    square[r] += mine * mine;
    total[r] += mine < (dbk_real)0 ? -mine : mine;
  }
}

/* of several spheres: z_k'(c x n) - n'(z_k x p_k), or n'z_k where joint k slides */
static inline void fill_for_several(const axes *axis, int32_t k, const columns *at, dbk_rows *restrict rows) {
  const dbk_real zx = axis->zx[k], zy = axis->zy[k], zz = axis->zz[k];
  const dbk_real px = axis->px[k], py = axis->py[k], pz = axis->pz[k];
  const int32_t slides = axis->slides[k];
  const dbk_real tx = slides ? (dbk_real)0 : zx, ty = slides ? (dbk_real)0 : zy, tz = slides ? (dbk_real)0 : zz;
  const dbk_real mx = slides ? -zx : zy * pz - zz * py, my = slides ? -zy : zz * px - zx * pz;
  const dbk_real mz = slides ? -zz : zx * py - zy * px;
  const dbk_real *rx = rows->mx + at->first, *ry = rows->my + at->first, *rz = rows->mz + at->first;
  const dbk_real *nx = rows->nx + at->first, *ny = rows->ny + at->first, *nz = rows->nz + at->first;
  dbk_real *restrict a = rows->a[k] + at->first, *restrict square = at->square, *restrict total = at->total;
  for (int32_t r = 0; r < at->count; ++r) {
    const dbk_real mine = (tx * rx[r] + ty * ry[r] + tz * rz[r]) - (mx * nx[r] + my * ny[r] + mz * nz[r]);
    a[r] = mine;
    square[r] += mine * mine;
    total[r] += mine < (dbk_real)0 ? -mine : mine;
  }
}

/* c x n, with c the centre of each row's sphere */
static void fill_moments(const dbk_cloud *cloud, dbk_rows *rows, int32_t first, int32_t last) {
  for (int32_t r = first; r < last; ++r) {
    const int32_t i = rows->i[r];
    const dbk_real x = cloud->x[i], y = cloud->y[i], z = cloud->z[i];
    rows->mx[r] = y * rows->nz[r] - z * rows->ny[r];
    rows->my[r] = z * rows->nx[r] - x * rows->nz[r];
    rows->mz[r] = x * rows->ny[r] - y * rows->nx[r];
  }
}

/* the columns of every span; joints that do not move it get zero */
DBK_WIDE static void fill_columns(const dbk_model *model, const dbk_ctx *ctx, dbk_rows *restrict rows,
                                dbk_real *restrict square, dbk_real *restrict total) {
  const axes axis = axes_of(model, &ctx->frames);
  lever j;
  for (int32_t s = 0; s < rows->n_spans; ++s) {
    const int32_t first = rows->span_first[s], sphere = rows->span_sphere[s];
    const int32_t last = s + 1 < rows->n_spans ? rows->span_first[s + 1] : rows->count;
    const columns at = {first, DBK_PADDED(last - first), square + first, total + first};
    for (int32_t r = 0; r < at.count; ++r) { at.square[r] = at.total[r] = (dbk_real)0; }
    if (sphere >= 0) {
      levers(&axis, &ctx->cloud, sphere, &j);
    } else {
      fill_moments(&ctx->cloud, rows, first, last);
    }
    for (int32_t k = 0; k < model->n; ++k) {
      if (k < rows->span_from[s] || k >= rows->span_upto[s]) {
        for (int32_t r = 0; r < at.count; ++r) { rows->a[k][first + r] = (dbk_real)0; }
      } else if (sphere >= 0) {
        fill_for_sphere(&j, k, &at, rows);
      } else {
        fill_for_several(&axis, k, &at, rows);
      }
    }
  }
}

/* a row that no joint can change: fine if nothing is needed, or if it is the mount that stands there */
static void judge_fixed(const dbk_model *model, dbk_rows *rows, int32_t r) {
  const int32_t mount = rows->kind[r] == DBK_ROW_OBSTACLE && model->sphere_frame[rows->i[r]] <= 1 && !rows->moving[r];
  if (rows->b[r] <= (dbk_real)0 || mount) { return; }
  if (rows->h[r] + model->sampling < (dbk_real)0) { rows->stuck = 1; }
  rows->unavoidable = 1;
}

static void move_row(const dbk_model *model, dbk_rows *rows, int32_t to, int32_t r) {
  for (int32_t k = 0; k < model->n; ++k) { rows->a[k][to] = rows->a[k][r]; }
  rows->b[to] = rows->b[r];
  rows->h[to] = rows->h[r];
  rows->norm[to] = rows->norm[r];
  rows->kind[to] = rows->kind[r];
  rows->i[to] = rows->i[r];
  rows->j[to] = rows->j[r];
  rows->moving[to] = rows->moving[r];
  rows->rank[to] = rows->rank[r];
  rows->yielding[to] = rows->yielding[r];
  rows->nx[to] = rows->nx[r];
  rows->ny[to] = rows->ny[r];
  rows->nz[to] = rows->nz[r];
}

/* rows without a gradient are judged and leave */
static void drop_fixed(const dbk_model *model, dbk_rows *rows) {
  int32_t kept = 0;
  for (int32_t r = 0; r < rows->count; ++r) {
    if (!(rows->norm[r] > DBK_ZERO_GRADIENT)) {
      judge_fixed(model, rows, r);
      continue;
    }
    if (kept != r) { move_row(model, rows, kept, r); }
    ++kept;
  }
  rows->count = kept;
}

/* recovery and contact rows ask for no more than the box can give */
static void yield(const dbk_model *model, const dbk_ctx *ctx, dbk_rows *rows) {
  for (int32_t r = 0; r < rows->count; ++r) {
    if (!rows->yielding[r] && rows->h[r] >= (dbk_real)0) { continue; }
    dbk_real best = (dbk_real)0;
    for (int32_t k = 0; k < model->n; ++k) {
      const dbk_real a = rows->a[k][r], low = a * ctx->lower[k], high = a * ctx->upper[k];
      best += low > high ? low : high;
    }
    rows->b[r] = dbk_min(rows->b[r], best - DBK_QP_SHIFT * 4 * rows->norm[r]);
  }
}

/* unit rows, so that row tolerances are in rad/s; from here on h is what remains to h = 0 without the sampling margin */
static inline void make_unit(const dbk_model *model, dbk_rows *rows) {
  dbk_real inverse[DBK_ROW_ROOM];
  const int32_t count = DBK_PADDED(rows->count);
  for (int32_t r = 0; r < count; ++r) {
    inverse[r] = (dbk_real)1 / rows->norm[r];
    rows->b[r] *= inverse[r];
    rows->h[r] += model->sampling;
  }
  for (int32_t k = 0; k < model->n; ++k) {
    dbk_real *restrict a = rows->a[k];
    for (int32_t r = 0; r < count; ++r) { a[r] *= inverse[r]; }
  }
}

/* rows that were handed in, as unit rows after all others */
static void user_rows(const dbk_model *model, const dbk_scene *scene, dbk_rows *rows) {
  for (int32_t u = 0; u < scene->n_user; ++u) {
    dbk_real square = (dbk_real)0;
    for (int32_t k = 0; k < model->n; ++k) { square += scene->user_a[u][k] * scene->user_a[u][k]; }
    const dbk_real norm = dbk_sqrt(square);
    if (!(norm > DBK_ZERO_GRADIENT)) {
      if (!(scene->user_b[u] <= (dbk_real)0)) { rows->unavoidable = 1; }
      continue;
    }
    if (rows->count >= DBK_MAX_ROWS) {
      rows->overflow = 1;
      return;
    }
    const int32_t r = rows->count++;
    for (int32_t k = 0; k < model->n; ++k) { rows->a[k][r] = scene->user_a[u][k] / norm; }
    rows->b[r] = scene->user_b[u] / norm;
    rows->h[r] = scene->user_h[u];
    rows->norm[r] = norm;
    rows->kind[r] = DBK_ROW_USER;
    rows->i[r] = u;
    rows->j[r] = 0;
    rows->moving[r] = rows->yielding[r] = 0;
    rows->rank[r] = scene->user_rank[u];
  }
}

/* empty rows fill the last vector */
static void pad(const dbk_model *model, dbk_rows *rows) {
  for (int32_t r = rows->count; r < DBK_PADDED(rows->count); ++r) {
    for (int32_t k = 0; k < model->n; ++k) { rows->a[k][r] = (dbk_real)0; }
    rows->b[r] = (dbk_real)-1e9;
    rows->soft[r] = (dbk_real)0;
  }
}

/* from normals to unit rows of the QP */
DBK_WIDE void dbk_finish_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx) {
  dbk_rows *rows = &ctx->rows;
  dbk_real square[DBK_ROW_ROOM], total[DBK_ROW_ROOM];
  int32_t fixed = 0, yielding = 0;
  fill_columns(model, ctx, rows, square, total);
  for (int32_t r = 0; r < rows->count; ++r) {
    const dbk_real norm = dbk_sqrt(square[r]);
    rows->norm[r] = norm;
    rows->b[r] += model->tracking * total[r];
    fixed |= !(norm > DBK_ZERO_GRADIENT);
    yielding |= rows->yielding[r] | !(rows->h[r] >= (dbk_real)0);
  }
  if (fixed) { drop_fixed(model, rows); }
  if (yielding) { yield(model, ctx, rows); }
  make_unit(model, rows);
  user_rows(model, scene, rows);
  pad(model, rows);
}

void dbk_build_rows(const dbk_model *model, const dbk_scene *scene, dbk_ctx *ctx, dbk_real age, dbk_real extra,
                    int32_t known_only) {
  ctx->rows.count = ctx->rows.overflow = ctx->rows.stuck = ctx->rows.unavoidable = ctx->rows.n_spans = 0;
  ctx->visits.count = 0;
  ctx->h_min = DBK_BEYOND;
  if (scene->n_obstacles > 0) {
    dbk_surround around;
    dbk_surroundings(model, scene, age, extra, known_only, &around);
    dbk_meet_obstacles(model, scene, ctx, &around);
  }
  dbk_meet_self(model, scene, ctx, extra);
  dbk_finish_rows(model, scene, ctx);
}
