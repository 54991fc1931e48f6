// Control. A step takes microseconds and keeps the GIL: if it released the GIL, another thread could delay the control
// period by its switch interval (5 ms). Batches release the GIL.
#include <cstring>
#include <utility>

#include "conversion/arrays.h"
#include "kernel.h"

// size of a packed active row: kind, i, j, h and multiplier without padding
constexpr size_t kActiveSize = 3 * sizeof(int32_t) + 2 * sizeof(double);

void import_numpy() {
  if (PyArray_ImportNumPyAPI() < 0) { throw nb::python_error(); }
}

void Kernel::set_result_type(nb::object type, nb::object status_objects) {
  result_type = std::move(type);
  statuses = std::move(status_objects);
}

void Kernel::reset(const Array &u_prev) {
  dbk_init(ctx.get());
  copy(u_prev, ctx->u_prev, n, "u_prev");
  std::memcpy(ctx->u_nom_prev, ctx->u_prev, sizeof ctx->u_prev);
}

nb::object Kernel::load(nb::handle q, nb::handle v, nb::handle u, double opening, double state_age, double scene_age) {
  read_vector(q, in.q, n, "q");
  read_vector(v, in.v, n, "v");
  in.opening = static_cast<dbk_real>(opening);
  in.state_age = static_cast<dbk_real>(state_age);
  in.scene_age = static_cast<dbk_real>(scene_age);
  return read_vector(u, in.u_nom, n, "u_nom");
}

nb::object Kernel::active() const {
  nb::object packed = nb::steal(PyBytes_FromStringAndSize(nullptr, out.n_active * Py_ssize_t(kActiveSize)));
  if (!packed.is_valid()) { throw nb::python_error(); }
  char *to = PyBytes_AS_STRING(packed.ptr());
  for (int a = 0; a < out.n_active; ++a, to += kActiveSize) {
    const dbk_active &e = out.active[a];
    const int32_t id[3] = {e.kind, e.i, e.j};
    const double values[2] = {double(e.h), double(e.multiplier)};
    std::memcpy(to, id, sizeof id);
    std::memcpy(to + sizeof id, values, sizeof values);
  }
  return packed;
}

nb::object Kernel::step(nb::handle q, nb::handle v, nb::handle u_nom, double opening, double state_age,
                        double scene_age, nb::handle names) {
  expect(result_type.is_valid(), "set_result_type must be called first");
  const nb::object nominal = load(q, v, u_nom, opening, state_age, scene_age);
  dbk_step(model.get(), scene.get(), ctx.get(), &in, &out);
  return result_type(make_array(out.u, n, pool), nominal, names,
                     nb::borrow(PyTuple_GET_ITEM(statuses.ptr(), out.status)), out.flags, double(out.delta),
                     double(out.delta_rows), double(out.delta_box), double(out.h_min), out.certified != 0,
                     out.iterations, out.n_rows, active(), out.relaxed);
}

int Kernel::project(nb::handle q, nb::handle v, nb::handle u_nom, const Array &u_prev, double opening, double state_age,
                    double scene_age, double extra, const Out &u) {
  load(q, v, u_nom, opening, state_age, scene_age);
  dbk_real last[DBK_MAX_DOF] = {0}, result[DBK_MAX_DOF] = {0};
  copy(u_prev, last, n, "u_nom_prev");
  expect(u.size() == n, "u");
  const dbk_status status =
      dbk_project(model.get(), scene.get(), projection_ctx.get(), &in, last, static_cast<dbk_real>(extra), result);
  for (size_t k = 0; k < n; ++k) { u.data()[k] = static_cast<double>(result[k]); }
  return status;
}

void Kernel::batch(const Array &q, const Array &v, const Array &u_nom, const Array &u_prev, const Array &opening,
                   double scene_age, const Out &u, const Bytes &status, const Out &delta, const Out &h_min) const {
  const size_t m = status.size(), all = m * n;
  expect(q.size() == all && v.size() == all && u_nom.size() == all && u_prev.size() == all && u.size() == all &&
             opening.size() == m && delta.size() == m && h_min.size() == m,
         "batch of m states");
  const std::unique_ptr<dbk_ctx> work{new dbk_ctx()};
  const nb::gil_scoped_release release;
  dbk_in state{};
  dbk_out result{};
  state.scene_age = static_cast<dbk_real>(scene_age);
  for (size_t r = 0; r < m; ++r) {
    dbk_init(work.get());
    for (size_t k = 0; k < n; ++k) {
      state.q[k] = static_cast<dbk_real>(q.data()[r * n + k]);
      state.v[k] = static_cast<dbk_real>(v.data()[r * n + k]);
      state.u_nom[k] = static_cast<dbk_real>(u_nom.data()[r * n + k]);
      work->u_prev[k] = work->u_nom_prev[k] = static_cast<dbk_real>(u_prev.data()[r * n + k]);
    }
    state.opening = static_cast<dbk_real>(opening.data()[r]);
    dbk_step(model.get(), scene.get(), work.get(), &state, &result);
    for (size_t k = 0; k < n; ++k) { u.data()[r * n + k] = static_cast<double>(result.u[k]); }
    status.data()[r] = static_cast<int8_t>(result.status);
    delta.data()[r] = static_cast<double>(result.delta);
    h_min.data()[r] = static_cast<double>(result.h_min);
  }
}
