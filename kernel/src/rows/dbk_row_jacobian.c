/* Rows in joint space: n'J of every row, with n the normal and J the Jacobian of the sphere's centre. The computation
 * proceeds span by span and joint by joint, so that the inner loops run over rows and vectorise. */
#include "rows/dbk_row_jacobian.h"

/* the rows first..end-1 of one span. The loops run to the end of the last SIMD vector; the next span overwrites the
 * entries after the last row */
typedef struct {
  int32_t first, end;
  dbk_real *square, *total; /* sum_k a_k^2, and sum_k share_k |a_k| with the tracking share, of all rows */
} span_rows;

/* axes z_k of the joints and points p_k on them */
typedef struct {
  dbk_real zx[DBK_MAX_DOF], zy[DBK_MAX_DOF], zz[DBK_MAX_DOF], px[DBK_MAX_DOF], py[DBK_MAX_DOF], pz[DBK_MAX_DOF];
  dbk_real share[DBK_MAX_DOF];
  int32_t prismatic[DBK_MAX_DOF];
} joint_axes;

static inline void set_axes(const dbk_model *model, const dbk_frames *frames, joint_axes *restrict out) {
  for (int32_t k = 0; k < model->n; ++k) {
    out->zx[k] = frames->rotation[k + 1][2];
    out->zy[k] = frames->rotation[k + 1][5];
    out->zz[k] = frames->rotation[k + 1][8];
    out->px[k] = frames->origin[k + 1][0];
    out->py[k] = frames->origin[k + 1][1];
    out->pz[k] = frames->origin[k + 1][2];
    out->share[k] = model->tracking_share[k];
    out->prismatic[k] = model->joint_kind[k] == DBK_PRISMATIC;
  }
}

/* column k for a span of one sphere: n'J_k with J_k = z_k x (c - p_k), or z_k for a prismatic joint, c the centre */
static inline void fill_one_sphere(const joint_axes *axis, int32_t k, const span_rows *span, dbk_rows *restrict rows) {
  const dbk_real zx = axis->zx[k], zy = axis->zy[k], zz = axis->zz[k];
  const dbk_real px = axis->px[k], py = axis->py[k], pz = axis->pz[k];
  const dbk_real share = axis->share[k];
  const int32_t prismatic = axis->prismatic[k], end = span->end;
  const dbk_real *cx = rows->mx, *cy = rows->my, *cz = rows->mz, *nx = rows->nx, *ny = rows->ny, *nz = rows->nz;
  dbk_real *restrict a = rows->a[k], *restrict square = span->square, *restrict total = span->total;
  for (int32_t r = span->first; r < end; ++r) {
    const dbk_real x = cx[r] - px, y = cy[r] - py, z = cz[r] - pz;
    const dbk_real jx = prismatic ? zx : zy * z - zz * y, jy = prismatic ? zy : zz * x - zx * z;
    const dbk_real jz = prismatic ? zz : zx * y - zy * x;
    const dbk_real value = jx * nx[r] + jy * ny[r] + jz * nz[r];
    a[r] = value;
    square[r] += value * value;
    total[r] += share * dbk_abs(value);
  }
}

/* column k for a span of many spheres: z_k'(c x n) - n'(z_k x p_k), or n'z_k for a prismatic joint */
static inline void fill_many_spheres(const joint_axes *axis, int32_t k, const span_rows *span,
                                     dbk_rows *restrict rows) {
  const dbk_real zx = axis->zx[k], zy = axis->zy[k], zz = axis->zz[k];
  const dbk_real px = axis->px[k], py = axis->py[k], pz = axis->pz[k];
  const dbk_real share = axis->share[k];
  const int32_t prismatic = axis->prismatic[k], end = span->end;
  const dbk_real tx = prismatic ? (dbk_real)0 : zx, ty = prismatic ? (dbk_real)0 : zy,
                 tz = prismatic ? (dbk_real)0 : zz;
  const dbk_real mx = prismatic ? -zx : zy * pz - zz * py, my = prismatic ? -zy : zz * px - zx * pz;
  const dbk_real mz = prismatic ? -zz : zx * py - zy * px;
  const dbk_real *rx = rows->mx, *ry = rows->my, *rz = rows->mz, *nx = rows->nx, *ny = rows->ny, *nz = rows->nz;
  dbk_real *restrict a = rows->a[k], *restrict square = span->square, *restrict total = span->total;
  for (int32_t r = span->first; r < end; ++r) {
    const dbk_real value = (tx * rx[r] + ty * ry[r] + tz * rz[r]) - (mx * nx[r] + my * ny[r] + mz * nz[r]);
    a[r] = value;
    square[r] += value * value;
    total[r] += share * dbk_abs(value);
  }
}

/* sets (mx, my, mz) to the moment c x n for a span of many spheres, else to c, with c the centre of the row's sphere */
static void fill_moments(const dbk_sphere_set *spheres, int32_t many_spheres, int32_t first, int32_t last,
                         dbk_rows *rows) {
  for (int32_t r = first; r < last; ++r) {
    const int32_t i = dbk_bounded(rows->i[r], DBK_ALL_SPHERES - 1);
    const dbk_real x = spheres->x[i], y = spheres->y[i], z = spheres->z[i];
    rows->mx[r] = many_spheres ? y * rows->nz[r] - z * rows->ny[r] : x;
    rows->my[r] = many_spheres ? z * rows->nx[r] - x * rows->nz[r] : y;
    rows->mz[r] = many_spheres ? x * rows->ny[r] - y * rows->nx[r] : z;
  }
}

/* the columns of joints that do not move a span are zero */
DBK_SIMD_CLONES void dbk_row_jacobian(const dbk_model *model, const dbk_ctx *ctx, dbk_rows *restrict rows,
                                      dbk_real *restrict square, dbk_real *restrict total) {
  joint_axes axis;
  set_axes(model, &ctx->frames, &axis);
  const int32_t n_spans = dbk_bounded(rows->n_spans, DBK_MAX_SPANS);
  for (int32_t s = 0; s < n_spans; ++s) {
    const int32_t first = rows->span_first[s], many_spheres = rows->span_many_spheres[s];
    const int32_t first_joint = rows->span_first_joint[s], end_joint = rows->span_end_joint[s];
    const int32_t last = s + 1 < n_spans ? rows->span_first[s + 1] : rows->count;
    const int32_t end = dbk_bounded(first + DBK_PADDED(last - first), DBK_ROW_CAPACITY);
    const span_rows span = {first, end, square, total};
    fill_moments(&ctx->spheres, many_spheres, first, last, rows);
    dbk_fill_zero(square, first, end);
    dbk_fill_zero(total, first, end);
    for (int32_t k = 0; k < model->n; ++k) {
      if (k < first_joint || k >= end_joint) {
        dbk_fill_zero(rows->a[k], first, end);
      } else if (many_spheres) {
        fill_many_spheres(&axis, k, &span, rows);
      } else {
        fill_one_sphere(&axis, k, &span, rows);
      }
    }
  }
}
