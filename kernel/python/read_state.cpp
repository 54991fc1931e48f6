// Rows and bounds of the last step, and the kinematics.
#include <cmath>

#include "kernel.h"

extern "C" {
#include "model/dbk_kinematics.h"
}

nb::list Kernel::rows() {
  nb::list all;
  dbk_all_rows(used_model, scene.get(), ctx.get(), &in);
  for (int r = 0; r < ctx->rows.count; ++r) {
    nb::list a;
    for (size_t k = 0; k < n; ++k) { a.append(double(ctx->rows.a[k][r])); }
    all.append(nb::make_tuple(ctx->rows.kind[r], ctx->rows.i[r], ctx->rows.j[r], double(ctx->rows.h[r]),
                              double(ctx->rows.norm[r]), double(ctx->rows.b[r]), nb::tuple(a)));
  }
  return all;
}

nb::tuple Kernel::box() const {
  nb::list low, high;
  for (size_t k = 0; k < n; ++k) {
    low.append(double(ctx->lower[k]));
    high.append(double(ctx->upper[k]));
  }
  return nb::make_tuple(nb::tuple(low), nb::tuple(high));
}

void Kernel::tool(const Array &q, const Out &to) {
  dbk_real angles[DBK_MAX_DOF] = {0}, linear[3][DBK_MAX_DOF], angular[3][DBK_MAX_DOF], p[3];
  dbk_frames f;
  copy(q, angles, n, "q");
  expect(to.size() == 12 + 6 * n, "tool buffer");
  dbk_base_frame(&in, &f);
  dbk_fk(model.get(), angles, &f);
  const dbk_real *r = f.rotation[n], *o = f.origin[n], *t = model->tool_offset, *w = model->tool_rotation;
  double *flat = to.data();
  for (int i = 0; i < 3; ++i) {
    p[i] = o[i] + (r[3 * i] * t[0] + r[3 * i + 1] * t[1] + r[3 * i + 2] * t[2]);
    flat[i] = static_cast<double>(p[i]);
    for (int j = 0; j < 3; ++j) {
      flat[3 + 3 * i + j] = static_cast<double>(r[3 * i] * w[j] + r[3 * i + 1] * w[3 + j] + r[3 * i + 2] * w[6 + j]);
    }
  }
  dbk_jacobian(model.get(), &f, p, linear, angular);
  for (size_t i = 0; i < 3; ++i) {
    for (size_t k = 0; k < n; ++k) {
      flat[12 + i * n + k] = static_cast<double>(linear[i][k]);
      flat[12 + (3 + i) * n + k] = static_cast<double>(angular[i][k]);
    }
  }
}

int Kernel::spheres(const Array &q, double opening, const Out &to) {
  const bool known = !std::isnan(opening);
  dbk_real angles[DBK_MAX_DOF] = {0};
  dbk_frames f;
  dbk_sphere_set set;
  copy(q, angles, n, "q");
  dbk_base_frame(&in, &f);
  dbk_fk(model.get(), angles, &f);
  dbk_spheres(model_of(known), scene.get(), &f, static_cast<dbk_real>(known ? opening : 0.0), &set);
  expect(to.size() >= static_cast<size_t>(4 * set.count), "sphere buffer");
  for (int s = 0; s < set.count; ++s) {
    const dbk_real row[4] = {set.x[s], set.y[s], set.z[s], set.r[s]};
    for (int e = 0; e < 4; ++e) { to.data()[4 * s + e] = static_cast<double>(row[e]); }
  }
  return set.count;
}
