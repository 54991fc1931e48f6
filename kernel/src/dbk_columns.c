/* The normals of rows in joint space, n'J, span by span: one column of numbers for each joint. */
#include "dbk_pair.h"

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

static inline void axes_of(const dbk_model *model, const dbk_frames *frames, axes *restrict out) {
  for (int32_t k = 0; k < model->n; ++k) {
    out->zx[k] = frames->rotation[k + 1][2];
    out->zy[k] = frames->rotation[k + 1][5];
    out->zz[k] = frames->rotation[k + 1][8];
    out->px[k] = frames->origin[k + 1][0];
    out->py[k] = frames->origin[k + 1][1];
    out->pz[k] = frames->origin[k + 1][2];
    out->slides[k] = model->joint_kind[k] == DBK_PRISMATIC;
  }
}

/* of single spheres: n'J_k with the velocity of the centre c at unit speed of joint k, z_k x (c - p_k), or z_k where it
 * slides */
static inline void fill_for_single(const axes *axis, int32_t k, const columns *at, dbk_rows *restrict rows) {
  const dbk_real zx = axis->zx[k], zy = axis->zy[k], zz = axis->zz[k];
  const dbk_real px = axis->px[k], py = axis->py[k], pz = axis->pz[k];
  const int32_t slides = axis->slides[k], count = DBK_PADDED(at->count);
  const dbk_real *cx = rows->mx + at->first, *cy = rows->my + at->first, *cz = rows->mz + at->first;
  const dbk_real *nx = rows->nx + at->first, *ny = rows->ny + at->first, *nz = rows->nz + at->first;
  dbk_real *restrict a = rows->a[k] + at->first, *restrict square = at->square, *restrict total = at->total;
  for (int32_t r = 0; r < count; ++r) {
    const dbk_real x = cx[r] - px, y = cy[r] - py, z = cz[r] - pz;
    const dbk_real jx = slides ? zx : zy * z - zz * y, jy = slides ? zy : zz * x - zx * z;
    const dbk_real jz = slides ? zz : zx * y - zy * x;
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
  const int32_t slides = axis->slides[k], count = DBK_PADDED(at->count);
  const dbk_real tx = slides ? (dbk_real)0 : zx, ty = slides ? (dbk_real)0 : zy, tz = slides ? (dbk_real)0 : zz;
  const dbk_real mx = slides ? -zx : zy * pz - zz * py, my = slides ? -zy : zz * px - zx * pz;
  const dbk_real mz = slides ? -zz : zx * py - zy * px;
  const dbk_real *rx = rows->mx + at->first, *ry = rows->my + at->first, *rz = rows->mz + at->first;
  const dbk_real *nx = rows->nx + at->first, *ny = rows->ny + at->first, *nz = rows->nz + at->first;
  dbk_real *restrict a = rows->a[k] + at->first, *restrict square = at->square, *restrict total = at->total;
  for (int32_t r = 0; r < count; ++r) {
    const dbk_real mine = (tx * rx[r] + ty * ry[r] + tz * rz[r]) - (mx * nx[r] + my * ny[r] + mz * nz[r]);
    a[r] = mine;
    square[r] += mine * mine;
    total[r] += mine < (dbk_real)0 ? -mine : mine;
  }
}

/* c x n, or c, with c the centre of each row's sphere */
static void fill_moments(const dbk_cloud *cloud, int32_t several, int32_t first, int32_t last, dbk_rows *rows) {
  for (int32_t r = first; r < last; ++r) {
    const int32_t i = rows->i[r];
    const dbk_real x = cloud->x[i], y = cloud->y[i], z = cloud->z[i];
    rows->mx[r] = several ? y * rows->nz[r] - z * rows->ny[r] : x;
    rows->my[r] = several ? z * rows->nx[r] - x * rows->nz[r] : y;
    rows->mz[r] = several ? x * rows->ny[r] - y * rows->nx[r] : z;
  }
}

/* the columns of every span; joints that do not move it get zero */
DBK_WIDE void dbk_fill_columns(const dbk_model *model, const dbk_ctx *ctx, dbk_rows *restrict rows,
                               dbk_real *restrict square, dbk_real *restrict total) {
  axes axis;
  axes_of(model, &ctx->frames, &axis);
  for (int32_t s = 0; s < rows->n_spans; ++s) {
    const int32_t first = rows->span_first[s], several = rows->span_several[s];
    const int32_t from = rows->span_from[s], upto = rows->span_upto[s];
    const int32_t last = s + 1 < rows->n_spans ? rows->span_first[s + 1] : rows->count;
    const int32_t count = DBK_PADDED(last - first);
    const columns at = {first, count, square + first, total + first};
    fill_moments(&ctx->cloud, several, first, last, rows);
    dbk_clear(at.square, count);
    dbk_clear(at.total, count);
    for (int32_t k = 0; k < model->n; ++k) {
      if (k < from || k >= upto) {
        dbk_clear(rows->a[k] + first, count);
      } else if (several) {
        fill_for_several(&axis, k, &at, rows);
      } else {
        fill_for_single(&axis, k, &at, rows);
      }
    }
  }
}
