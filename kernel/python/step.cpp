// Control. A step takes microseconds and keeps the GIL: if it released the GIL, another thread could delay the control
// period by its switch interval (5 ms). Batches release the GIL.
#include <cstring>
#include <limits>
#include <utility>

#include "conversion/arrays.h"
#include "kernel.h"

// size of a packed active row: kind, i, j, h and multiplier without padding
constexpr size_t kActiveSize = 3 * sizeof(int32_t) + 2 * sizeof(double);

// a measured opening may be outside the range of the gripper by this much [m]
constexpr double kOpeningTolerance = 0.005;

void import_numpy() {
  if (PyArray_ImportNumPyAPI() < 0) { throw nb::python_error(); }
}

void Kernel::set_result_type(nb::object type, nb::object status_objects) {
  result_type = std::move(type);
  statuses = std::move(status_objects);
}

void Kernel::reset(const Array &u_prev, const Array &u_change) {
  dbk_init(ctx.get());
  copy(u_prev, ctx->u_prev, n, "u_prev");
  copy(u_change, ctx->u_change, n, "u_change");
  std::memcpy(ctx->u_nom_prev, ctx->u_prev, sizeof ctx->u_prev);
}

dbk_real Kernel::plausible_opening(double opening) const {
  const bool plausible = !hull_model || (opening >= -kOpeningTolerance && opening <= opening_max + kOpeningTolerance);
  return plausible ? static_cast<dbk_real>(opening) : std::numeric_limits<dbk_real>::quiet_NaN();
}

nb::object Kernel::load(nb::handle q, nb::handle v, nb::handle u, nb::handle opening, nb::handle state_age,
                        nb::handle scene_age) {
  const bool known = opening.ptr() != Py_Ellipsis;
  const double number = known ? read_number(opening, "opening") : 0.0;
  const double ages[2] = {read_number(state_age, "now"), read_number(scene_age, "now")};
  read_vector(q, in.q, n, "q");
  read_vector(v, in.v, n, "v");
  nb::object nominal = read_vector(u, in.u_nom, n, "u_nom");
  in.opening = plausible_opening(number);
  given_opening = number;
  in.state_age = static_cast<dbk_real>(ages[0]);
  in.scene_age = static_cast<dbk_real>(ages[1]);
  used_model = model_of(known);
  return nominal;
}

nb::object Kernel::active() const {
  nb::object packed = nb::steal(PyBytes_FromStringAndSize(nullptr, out.n_active * Py_ssize_t(kActiveSize)));
  if (!packed.is_valid()) { throw nb::python_error(); }
  char *to = PyBytes_AsString(packed.ptr());
  for (int a = 0; a < out.n_active; ++a, to += kActiveSize) {
    const dbk_active &e = out.active[a];
    const int32_t id[3] = {e.kind, e.i, e.j};
    const double values[2] = {double(e.h), double(e.multiplier)};
    std::memcpy(to, id, sizeof id);
    std::memcpy(to + sizeof id, values, sizeof values);
  }
  return packed;
}

nb::object Kernel::step(nb::handle q, nb::handle v, nb::handle u_nom, nb::handle opening, nb::handle state_age,
                        nb::handle scene_age, nb::handle names) {
  expect(result_type.is_valid(), "set_result_type must be called first");
  const nb::object nominal = load(q, v, u_nom, opening, state_age, scene_age);
  dbk_step(used_model, scene.get(), ctx.get(), &in, &out);
  const nb::handle status = PyTuple_GetItem(statuses.ptr(), out.status);
  if (out.status >= DBK_STOPPED) {
    return result_type(make_array(out.u, n, pool), nominal, names, nb::borrow(status), out.flags, double(out.delta),
                       double(out.delta_rows), double(out.delta_box), double(out.h_min), out.certified != 0,
                       out.iterations, out.n_rows, active(), out.relaxed, 0.0, stop_evidence());
  }
  return result_type(make_array(out.u, n, pool), nominal, names, nb::borrow(status), out.flags, double(out.delta),
                     double(out.delta_rows), double(out.delta_box), double(out.h_min), out.certified != 0,
                     out.iterations, out.n_rows, active(), out.relaxed);
}

int Kernel::project(nb::handle q, nb::handle v, nb::handle u_nom, const Array &u_prev, nb::handle opening,
                    nb::handle state_age, nb::handle scene_age, double extra, const Out &u) {
  load(q, v, u_nom, opening, state_age, scene_age);
  dbk_real last[DBK_MAX_DOF] = {0}, result[DBK_MAX_DOF] = {0};
  copy(u_prev, last, n, "u_nom_prev");
  expect(u.size() == n, "u");
  const dbk_status status =
      dbk_project(used_model, scene.get(), projection_ctx.get(), &in, last, static_cast<dbk_real>(extra), result);
  for (size_t k = 0; k < n; ++k) { u.data()[k] = static_cast<double>(result[k]); }
  return status;
}

void Kernel::batch(const Array &q, const Array &v, const Array &u_nom, const Array &u_prev, const Array &opening,
                   double scene_age, const Out &u, const Bytes &status, const Out &delta, const Out &h_min,
                   const Integers &flags) const {
  const size_t m = status.size(), all = m * n;
  expect(q.size() == all && v.size() == all && u_nom.size() == all && u_prev.size() == all && u.size() == all &&
             (opening.size() == m || opening.size() == 0) && delta.size() == m && h_min.size() == m &&
             flags.size() == m,
         "batch of m states");
  const bool known = opening.size() == m;
  const dbk_model *used = model_of(known);
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
    state.opening = plausible_opening(known ? opening.data()[r] : 0.0);
    dbk_step(used, scene.get(), work.get(), &state, &result);
    for (size_t k = 0; k < n; ++k) { u.data()[r * n + k] = static_cast<double>(result.u[k]); }
    status.data()[r] = static_cast<int8_t>(result.status);
    delta.data()[r] = static_cast<double>(result.delta);
    h_min.data()[r] = static_cast<double>(result.h_min);
    flags.data()[r] = result.flags;
  }
}
