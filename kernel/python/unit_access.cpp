// Single functions of the kernel, for unit tests: the QP, the independent check, distances, sine and cosine.
#include <nanobind/stl/tuple.h>
#include <nanobind/stl/vector.h>

#include <cmath>
#include <memory>
#include <vector>

#include "conversion/buffers.h"
#include "conversion/parse_model.h"

extern "C" {
#include "distance/dbk_distance.h"
#include "model/dbk_kinematics.h"
#include "qp/dbk_certificate.h"
#include "qp/dbk_qp.h"
}

namespace nb = nanobind;

namespace {

// solves the QP with rows A u >= b, which are normalised here; `scale` is S = L^-T of the weight. Returns the result,
// the iterations and the active set with its multipliers
nb::tuple solve_qp(const Array &scale, const Array &A, const Array &b, const Array &lower, const Array &upper,
                   const Array &u_nom, const Out &u) {
  const size_t n = u_nom.size(), m = b.size();
  expect(n >= 1 && n <= DBK_MAX_DOF && m <= DBK_MAX_ROWS && A.size() == n * m && scale.size() == n * n, "QP sizes");
  static thread_local std::unique_ptr<dbk_rows> rows{new dbk_rows()};
  dbk_real s[DBK_MAX_DOF][DBK_MAX_DOF] = {{0}}, lo[DBK_MAX_DOF], hi[DBK_MAX_DOF], un[DBK_MAX_DOF];
  for (size_t i = 0; i < n * n; ++i) { s[i / n][i % n] = static_cast<dbk_real>(scale.data()[i]); }
  copy(lower, lo, n, "lower");
  copy(upper, hi, n, "upper");
  copy(u_nom, un, n, "u_nom");
  int32_t kept = 0;
  bool impossible = false;
  std::vector<int32_t> origin;
  for (size_t r = 0; r < m; ++r) {
    double square = 0;
    for (size_t k = 0; k < n; ++k) { square += A.data()[r * n + k] * A.data()[r * n + k]; }
    const double norm = std::sqrt(square);
    if (norm < 1e-9) {
      impossible = impossible || b.data()[r] > 1e-9;
      continue;
    }
    for (size_t k = 0; k < n; ++k) { rows->a[k][kept] = static_cast<dbk_real>(A.data()[r * n + k] / norm); }
    rows->b[kept] = static_cast<dbk_real>(b.data()[r] / norm);
    origin.push_back(static_cast<int32_t>(r));
    ++kept;
  }
  for (int32_t r = kept; r < DBK_MAX_ROWS && r % DBK_LANES != 0; ++r) {
    for (size_t k = 0; k < n; ++k) { rows->a[k][r] = 0; }
    rows->b[r] = static_cast<dbk_real>(-1e9);
  }
  rows->count = kept;
  dbk_solution solution;
  const int32_t result = dbk_qp(rows.get(), int32_t(n), s, lo, hi, un, 0, 0, nullptr, 0, &solution);
  nb::list active;
  // a zero row with b > 0 is a certificate by itself
  const bool alone = impossible && result != 1;
  for (int a = 0; a < solution.n_active && !alone; ++a) {
    const int32_t id = solution.active[a];
    const int32_t original = id < 2 * int32_t(n) ? id : 2 * int32_t(n) + origin[size_t(id) - 2 * n];
    active.append(nb::make_tuple(original, double(solution.multiplier[a])));
  }
  for (size_t k = 0; k < n; ++k) { u.data()[k] = static_cast<double>(solution.u[k]); }
  return nb::make_tuple(impossible ? 1 : result, solution.iterations, nb::tuple(active));
}

// kernel rows from normalised rows with slack coefficients; padding rows fill the last SIMD vector
dbk_rows *make_rows(const Array &A, const Array &b, const Array &soft, size_t n) {
  static thread_local std::unique_ptr<dbk_rows> rows{new dbk_rows()};
  const size_t m = b.size();
  expect(n >= 1 && n <= DBK_MAX_DOF && m <= DBK_MAX_ROWS && A.size() == n * m && soft.size() == m, "row sizes");
  for (size_t r = 0; r < size_t(DBK_PADDED(m)); ++r) {
    for (size_t k = 0; k < n; ++k) { rows->a[k][r] = r < m ? static_cast<dbk_real>(A.data()[r * n + k]) : 0; }
    rows->b[r] = r < m ? static_cast<dbk_real>(b.data()[r]) : static_cast<dbk_real>(-1e9);
    rows->soft[r] = r < m ? static_cast<dbk_real>(soft.data()[r]) : 0;
  }
  rows->count = static_cast<int32_t>(m);
  return rows.get();
}

// solves the QP with normalised rows from the active set `warm`; with a slack if `slack`; the rows are tightened by
// `shift`. Returns the result, the iterations, the slack and the active set with its multipliers
nb::tuple solve_qp_warm(const Array &scale, const nb::tuple &A_b_soft, const Array &lower, const Array &upper,
                        const Array &u_nom, bool slack, double shift, const std::vector<int32_t> &warm, const Out &u) {
  const size_t n = u_nom.size();
  const dbk_rows *rows =
      make_rows(nb::cast<Array>(A_b_soft[0]), nb::cast<Array>(A_b_soft[1]), nb::cast<Array>(A_b_soft[2]), n);
  dbk_real s[DBK_MAX_DOF][DBK_MAX_DOF] = {{0}}, lo[DBK_MAX_DOF], hi[DBK_MAX_DOF], un[DBK_MAX_DOF];
  expect(scale.size() == n * n && u.size() == n, "QP sizes");
  for (size_t i = 0; i < n * n; ++i) { s[i / n][i % n] = static_cast<dbk_real>(scale.data()[i]); }
  copy(lower, lo, n, "lower");
  copy(upper, hi, n, "upper");
  copy(u_nom, un, n, "u_nom");
  dbk_solution solution;
  const int32_t result = dbk_qp(rows, int32_t(n), s, lo, hi, un, slack, static_cast<dbk_real>(shift), warm.data(),
                                int32_t(warm.size()), &solution);
  nb::list active;
  for (int a = 0; a < solution.n_active; ++a) {
    active.append(nb::make_tuple(solution.active[a], double(solution.multiplier[a])));
  }
  for (size_t k = 0; k < n; ++k) { u.data()[k] = static_cast<double>(solution.u[k]); }
  return nb::make_tuple(result, solution.iterations, double(solution.slack), nb::tuple(active));
}

// the independent check of a control
bool check(const Array &A, const Array &b, const Array &lower, const Array &upper, const Array &u, double tolerance) {
  const size_t n = u.size();
  dbk_real lo[DBK_MAX_DOF], hi[DBK_MAX_DOF], at[DBK_MAX_DOF];
  copy(lower, lo, n, "lower");
  copy(upper, hi, n, "upper");
  copy(u, at, n, "u");
  return dbk_check(make_rows(A, b, b, n), int32_t(n), lo, hi, at, static_cast<dbk_real>(tolerance)) != 0;
}

// signed distances (k,) and normals (k, 3) from points (k, 3) to one row of the obstacle table
void distance(const Array &obstacle, const Array &points, const Out &d, const Out &normals) {
  expect(obstacle.size() == kObstacle, "one obstacle row");
  const size_t count = points.size() / 3;
  expect(d.size() == count && normals.size() == 3 * count, "distance buffers");
  dbk_obstacle o;
  parse_obstacle(obstacle.data(), &o);
  for (size_t i = 0; i < count; ++i) {
    dbk_real p[3], h, n[3];
    for (int e = 0; e < 3; ++e) { p[e] = static_cast<dbk_real>(points.data()[3 * i + e]); }
    dbk_distance(&o, 1, p, p + 1, p + 2, &h, n, n + 1, n + 2);
    d.data()[i] = static_cast<double>(h);
    for (int e = 0; e < 3; ++e) { normals.data()[3 * i + e] = static_cast<double>(n[e]); }
  }
}

nb::tuple sine_cosine(double x) {
  dbk_real s, c;
  dbk_sincos(static_cast<dbk_real>(x), &s, &c);
  return nb::make_tuple(double(s), double(c));
}

}  // namespace

void bind_units(nb::module_ &m) {
  m.def("solve_qp", &solve_qp);
  m.def("solve_qp_warm", &solve_qp_warm);
  m.def("check", &check);
  m.def("distance", &distance);
  m.def("sincos", &sine_cosine);
}
