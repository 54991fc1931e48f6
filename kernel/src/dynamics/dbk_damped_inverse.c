/* Cholesky decomposition L L' = J J' + lambda^2 1, and two substitutions for each column of J. */
#include "dynamics/dbk_damped_inverse.h"

static void damped_gram(int32_t m, int32_t n, const dbk_real (*jacobian)[DBK_MAX_DOF], dbk_real damping,
                        dbk_real gram[DBK_MAX_TASK][DBK_MAX_TASK]) {
  for (int32_t i = 0; i < m; ++i) {
    for (int32_t j = 0; j <= i; ++j) {
      dbk_real sum = i == j ? damping : (dbk_real)0;
      for (int32_t k = 0; k < n; ++k) { sum += jacobian[i][k] * jacobian[j][k]; }
      gram[i][j] = sum;
    }
  }
}

/* replaces the lower triangle of a symmetric positive definite matrix by L, with the inverse of its diagonal */
static void decompose(int32_t m, dbk_real a[DBK_MAX_TASK][DBK_MAX_TASK]) {
  for (int32_t j = 0; j < m; ++j) {
    dbk_real pivot = a[j][j];
    for (int32_t k = 0; k < j; ++k) { pivot -= a[j][k] * a[j][k]; }
    a[j][j] = (dbk_real)1 / dbk_sqrt(pivot);
    for (int32_t i = j + 1; i < m; ++i) {
      for (int32_t k = 0; k < j; ++k) { a[i][j] -= a[i][k] * a[j][k]; }
      a[i][j] *= a[j][j];
    }
  }
}

static void substitute(int32_t m, const dbk_real (*lower)[DBK_MAX_TASK], dbk_real x[DBK_MAX_TASK]) {
  for (int32_t i = 0; i < m; ++i) {
    for (int32_t k = 0; k < i; ++k) { x[i] -= lower[i][k] * x[k]; }
    x[i] *= lower[i][i];
  }
  for (int32_t i = m - 1; i >= 0; --i) {
    for (int32_t k = i + 1; k < m; ++k) { x[i] -= lower[k][i] * x[k]; }
    x[i] *= lower[i][i];
  }
}

void dbk_damped_map(int32_t m, int32_t n, const dbk_real (*jacobian)[DBK_MAX_DOF], dbk_real damping,
                    dbk_real (*map)[DBK_MAX_DOF]) {
  dbk_real lower[DBK_MAX_TASK][DBK_MAX_TASK], column[DBK_MAX_TASK];
  damped_gram(m, n, jacobian, damping, lower);
  decompose(m, lower);
  for (int32_t k = 0; k < n; ++k) {
    for (int32_t i = 0; i < m; ++i) { column[i] = jacobian[i][k]; }
    substitute(m, (const dbk_real(*)[DBK_MAX_TASK])lower, column);
    for (int32_t i = 0; i < m; ++i) { map[i][k] = column[i]; }
  }
}
