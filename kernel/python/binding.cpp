// Python's door to the kernel: arrays are checked here once, then handed over. A step of microseconds keeps the GIL: giving
// it away would let another thread hold the control period up by its switch interval (5 ms). Batches and loops release it.
#include <nanobind/nanobind.h>
#include <nanobind/ndarray.h>
#include <nanobind/stl/string.h>
#include <nanobind/stl/tuple.h>

#include <algorithm>
#include <cmath>
#include <cstring>
#include <memory>
#include <stdexcept>
#include <string>
#include <vector>

#include "arrays.h"
#include "dbk/dbk.h"
#include "dbk_lab.h"

namespace nb = nanobind;
void bind_lab(nb::module_ &m);  // lab_binding.cpp
using Array = nb::ndarray<const double, nb::c_contig, nb::device::cpu>;
using Out = nb::ndarray<double, nb::c_contig, nb::device::cpu>;
using Bytes = nb::ndarray<int8_t, nb::c_contig, nb::device::cpu>;

namespace {

void expect(bool good, const char *what) {
  if (!good) { throw std::invalid_argument(what); }
}

void copy(const Array &from, dbk_real *to, size_t count, const char *what) {
  expect(from.size() == count, what);
  for (size_t i = 0; i < count; ++i) { to[i] = static_cast<dbk_real>(from.data()[i]); }
}

std::vector<double> values(const nb::dict &d, const char *key) {
  const Array a = nb::cast<Array>(d[key]);
  return {a.data(), a.data() + a.size()};
}

void fill(const nb::dict &d, const char *key, dbk_real *to, size_t most) {
  const std::vector<double> v = values(d, key);
  expect(v.size() <= most, key);
  for (size_t i = 0; i < v.size(); ++i) { to[i] = static_cast<dbk_real>(v[i]); }
}

size_t fill(const nb::dict &d, const char *key, int32_t *to, size_t most) {
  const std::vector<double> v = values(d, key);
  expect(v.size() <= most, key);
  for (size_t i = 0; i < v.size(); ++i) { to[i] = static_cast<int32_t>(v[i]); }
  return v.size();
}

dbk_real number(const nb::dict &d, const char *key) { return static_cast<dbk_real>(nb::cast<double>(d[key])); }

void read_obstacle(const double *row, dbk_obstacle *o) {
  auto take = [&row](dbk_real *to, int count) {
    for (int i = 0; i < count; ++i) { to[i] = static_cast<dbk_real>(*row++); }
  };
  o->shape = static_cast<int32_t>(*row++);
  o->flags = static_cast<int32_t>(*row++);
  o->rank = static_cast<int32_t>(*row++);
  o->parts = static_cast<uint32_t>(*row++);
  take(&o->alpha, 1);
  take(o->position, 3);
  take(o->rotation, 9);
  take(o->half, 3);
  take(&o->radius, 1);
  take(o->velocity, 3);
  take(&o->margin, 1);
  take(&o->velocity_error, 1);
  take(&o->reaction, 1);
  take(&o->brake, 1);
  take(&o->approach, 1);
}
constexpr size_t kObstacle = 29;

struct Kernel {
  std::unique_ptr<dbk_model> model{new dbk_model()};
  std::unique_ptr<dbk_scene> scene{new dbk_scene()};
  std::unique_ptr<dbk_ctx> ctx{new dbk_ctx()}, other{new dbk_ctx()};
  dbk_in in{};
  dbk_out out{};
  size_t n = 0;
  nb::object answer_type, statuses;  // what a step answers with, and its status by number

  explicit Kernel(const nb::dict &d) {
    n = static_cast<size_t>(nb::cast<int>(d["n"]));
    expect(n >= 1 && n <= DBK_MAX_DOF, "number of joints");
    dbk_model &m = *model;
    m.n = static_cast<int32_t>(n);
    m.period = number(d, "period");
    m.alpha = number(d, "alpha");
    m.alpha_self = number(d, "alpha_self");
    m.alpha_joint = number(d, "alpha_joint");
    m.recovery = number(d, "recovery");
    m.sampling = number(d, "sampling");
    m.rounding = number(d, "rounding");
    m.self_margin = number(d, "self_margin");
    m.lag = number(d, "lag");
    m.tracking = number(d, "tracking");
    m.state_age_max = number(d, "state_age_max");
    m.scene_age_max = number(d, "scene_age_max");
    fill(d, "joint_rotation", &m.joint_rotation[0][0], n * 9);
    fill(d, "joint_offset", &m.joint_offset[0][0], n * 3);
    fill(d, "q_lower", m.q_lower, n);
    fill(d, "q_upper", m.q_upper, n);
    fill(d, "v_max", m.v_max, n);
    fill(d, "a_max", m.a_max, n);
    fill(d, "j_max", m.j_max, n);
    fill(d, "joint_kind", m.joint_kind, n);
    const std::vector<double> scale = values(d, "scale");
    expect(scale.size() == n * n, "scale");
    for (size_t i = 0; i < n; ++i) {
      for (size_t k = 0; k < n; ++k) { m.scale[i][k] = static_cast<dbk_real>(scale[i * n + k]); }
    }
    fill(d, "tool_rotation", m.tool_rotation, 9);
    fill(d, "tool_offset", m.tool_offset, 3);
    m.n_links = static_cast<int32_t>(fill(d, "link_frame", m.link_frame, DBK_MAX_LINKS));
    fill(d, "link_first", m.link_first, DBK_MAX_LINKS + 1);
    m.n_pairs = static_cast<int32_t>(fill(d, "pairs", &m.pair[0][0], 2 * DBK_MAX_PAIRS) / 2);
    m.n_held_links = static_cast<int32_t>(fill(d, "held_links", m.held_link, DBK_MAX_LINKS));
    const std::vector<double> s = values(d, "spheres");  // x y z radius slide_x slide_y slide_z
    m.n_spheres = static_cast<int32_t>(s.size() / 7);
    expect(m.n_spheres <= DBK_MAX_SPHERES, "number of spheres");
    expect(m.link_first[m.n_links] == m.n_spheres, "link_first");
    for (int i = 0; i < m.n_spheres; ++i) {
      const double *row = s.data() + 7 * i;
      dbk_real *to[7] = {m.x, m.y, m.z, m.radius, m.slide_x, m.slide_y, m.slide_z};
      for (int e = 0; e < 7; ++e) { to[e][i] = static_cast<dbk_real>(row[e]); }
    }
    dbk_prepare(&m);
    dbk_scene_clear(scene.get());
    dbk_scene_prepare(scene.get());
    dbk_init(ctx.get());
    dbk_init(other.get());
  }

  void set_obstacles(const Array &rows) {
    const size_t count = rows.size() / kObstacle;
    expect(count <= DBK_MAX_OBSTACLES && rows.size() == count * kObstacle, "obstacle rows have 29 columns");
    for (size_t i = 0; i < count; ++i) { read_obstacle(rows.data() + kObstacle * i, &scene->obstacle[i]); }
    scene->n_obstacles = static_cast<int32_t>(count);
    dbk_scene_prepare(scene.get());
  }

  // of the obstacles there are, and of what fills the last vector
  void clear_permits() {
    for (auto &row : scene->permit) {
      std::fill_n(row, DBK_PADDED(scene->n_obstacles), static_cast<dbk_real>(-1));
    }
  }

  void permit(int link, int obstacle, double speed) {
    expect(link >= 0 && link <= model->n_links && obstacle >= 0 && obstacle < DBK_MAX_OBSTACLES, "permit");
    const int slot = link;
    scene->permit[slot][obstacle] = static_cast<dbk_real>(speed);
  }

  void attach(const Array &spheres, double error) {
    const size_t count = spheres.size() / 4;
    expect(count <= DBK_MAX_HELD && spheres.size() == 4 * count, "held spheres (k <= 8, 4)");
    for (size_t i = 0; i < count; ++i) {
      scene->held_x[i] = static_cast<dbk_real>(spheres.data()[4 * i]);
      scene->held_y[i] = static_cast<dbk_real>(spheres.data()[4 * i + 1]);
      scene->held_z[i] = static_cast<dbk_real>(spheres.data()[4 * i + 2]);
      scene->held_r[i] = static_cast<dbk_real>(spheres.data()[4 * i + 3]);
    }
    scene->n_held = static_cast<int32_t>(count);
    scene->held_error = static_cast<dbk_real>(error);
    dbk_scene_prepare(scene.get());
  }

  // rows a'u >= b of one step: (k, n + 3) of a, b, h, rank
  void constrain(const Array &rows) {
    const size_t width = n + 3, count = rows.size() / width;
    expect(count <= DBK_MAX_USER && rows.size() == count * width, "user rows have n + 3 columns");
    for (size_t r = 0; r < count; ++r) {
      const double *row = rows.data() + r * width;
      for (size_t k = 0; k < DBK_MAX_DOF; ++k) { scene->user_a[r][k] = k < n ? static_cast<dbk_real>(row[k]) : 0; }
      scene->user_b[r] = static_cast<dbk_real>(row[n]);
      scene->user_h[r] = static_cast<dbk_real>(row[n + 1]);
      scene->user_rank[r] = static_cast<int32_t>(row[n + 2]);
    }
    scene->n_user = static_cast<int32_t>(count);
    dbk_scene_prepare(scene.get());
  }

  // where the base stands from now on: rotation 9 row-major, position 3
  void stand(const Array &pose) {
    expect(pose.size() == 12, "base pose");
    for (size_t e = 0; e < 9; ++e) { in.base_rotation[e] = static_cast<dbk_real>(pose.data()[e]); }
    for (size_t e = 0; e < 3; ++e) { in.base_position[e] = static_cast<dbk_real>(pose.data()[9 + e]); }
    in.mobile = 1;
  }

  void reset(const Array &u_prev) {
    dbk_init(ctx.get());
    copy(u_prev, ctx->u_prev, n, "u_prev");
    std::memcpy(ctx->u_nom_prev, ctx->u_prev, sizeof ctx->u_prev);
  }

  // returns u_nom as it was read
  nb::object load(nb::handle q, nb::handle v, nb::handle u, double opening, double state_age, double scene_age) {
    take(q, in.q, n, "q");
    take(v, in.v, n, "v");
    in.opening = static_cast<dbk_real>(opening);
    in.state_age = static_cast<dbk_real>(state_age);
    in.scene_age = static_cast<dbk_real>(scene_age);
    return take(u, in.u_nom, n, "u_nom");
  }

  // what a step answers with: called with u, u_nom, names, status, flags, delta, delta_rows, delta_box, h_min, certified,
  // iterations, n_rows, rows, relaxed
  void answer_with(nb::object type, nb::object names_of_status) {
    answer_type = std::move(type);
    statuses = std::move(names_of_status);
  }

  nb::object active() const {
    if (out.n_active == 0) { return nb::steal(PyTuple_New(0)); }
    nb::object all = nb::steal(PyTuple_New(out.n_active));
    for (int a = 0; a < out.n_active; ++a) {
      const dbk_active &e = out.active[a];
      nb::object row = nb::make_tuple(e.kind, e.i, e.j, double(e.h), double(e.multiplier));
      PyTuple_SET_ITEM(all.ptr(), a, row.release().ptr());
    }
    return all;
  }

  nb::object step(nb::handle q, nb::handle v, nb::handle u_nom, double opening, double state_age, double scene_age,
                  nb::handle names) {
    expect(answer_type.is_valid(), "answer_with comes first");
    const nb::object wish = load(q, v, u_nom, opening, state_age, scene_age);
    dbk_step(model.get(), scene.get(), ctx.get(), &in, &out);
    return answer_type(give(out.u, n), wish, names, nb::borrow(PyTuple_GET_ITEM(statuses.ptr(), out.status)), out.flags,
                       double(out.delta), double(out.delta_rows), double(out.delta_box), double(out.h_min),
                       out.certified != 0, out.iterations, out.n_rows, active(), out.relaxed);
  }

  // rows of q, v, u_nom, u_prev (m, n) are independent states of a bolted body: each starts afresh from its u_prev,
  // without a warm start; the filter's own memory is left alone
  void batch(const Array &q, const Array &v, const Array &u_nom, const Array &u_prev, const Array &opening,
             double scene_age, const Out &u, const Bytes &status, const Out &delta, const Out &h_min) const {
    const size_t m = status.size(), all = m * n;
    expect(q.size() == all && v.size() == all && u_nom.size() == all && u_prev.size() == all && u.size() == all &&
               opening.size() == m && delta.size() == m && h_min.size() == m, "batch of m states");
    const std::unique_ptr<dbk_ctx> work{new dbk_ctx()};
    const nb::gil_scoped_release release;
    dbk_in state{};
    dbk_out answer{};
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
      dbk_step(model.get(), scene.get(), work.get(), &state, &answer);
      for (size_t k = 0; k < n; ++k) { u.data()[r * n + k] = static_cast<double>(answer.u[k]); }
      status.data()[r] = static_cast<int8_t>(answer.status);
      delta.data()[r] = static_cast<double>(answer.delta);
      h_min.data()[r] = static_cast<double>(answer.h_min);
    }
  }

  int project(nb::handle q, nb::handle v, nb::handle wish, const Array &u_prev, double opening, double state_age,
              double scene_age, double extra, const Out &u) {
    load(q, v, wish, opening, state_age, scene_age);
    dbk_real last[DBK_MAX_DOF] = {0}, answer[DBK_MAX_DOF] = {0};
    copy(u_prev, last, n, "u_nom_prev");
    expect(u.size() == n, "u");
    dbk_status status;
    {
        status = dbk_project(model.get(), scene.get(), other.get(), &in, last, static_cast<dbk_real>(extra), answer);
    }
    for (size_t k = 0; k < n; ++k) { u.data()[k] = static_cast<double>(answer[k]); }
    return status;
  }

  // tool pose and its Jacobian: position 3, rotation 9, jacobian (6, n), one flat array
  void tool(const Array &q, const Out &to) {
    dbk_real angles[DBK_MAX_DOF] = {0}, linear[3][DBK_MAX_DOF], angular[3][DBK_MAX_DOF], p[3];
    dbk_frames f;
    copy(q, angles, n, "q");
    expect(to.size() == 12 + 6 * n, "tool buffer");
    dbk_base(&in, &f);
    dbk_fk(model.get(), angles, &f);
    const dbk_real *r = f.rotation[n], *o = f.origin[n], *t = model->tool_offset, *w = model->tool_rotation;
    double *out_ = to.data();
    for (int i = 0; i < 3; ++i) {
      p[i] = o[i] + (r[3 * i] * t[0] + r[3 * i + 1] * t[1] + r[3 * i + 2] * t[2]);
      out_[i] = static_cast<double>(p[i]);
      for (int j = 0; j < 3; ++j) {
        out_[3 + 3 * i + j] = static_cast<double>(r[3 * i] * w[j] + r[3 * i + 1] * w[3 + j] + r[3 * i + 2] * w[6 + j]);
      }
    }
    dbk_jacobian(model.get(), &f, p, linear, angular);
    for (size_t i = 0; i < 3; ++i) {
      for (size_t k = 0; k < n; ++k) {
        out_[12 + i * n + k] = static_cast<double>(linear[i][k]);
        out_[12 + (3 + i) * n + k] = static_cast<double>(angular[i][k]);
      }
    }
  }

  int spheres(const Array &q, double opening, const Out &to) {
    dbk_real angles[DBK_MAX_DOF] = {0};
    dbk_frames f;
    dbk_cloud cloud;
    copy(q, angles, n, "q");
    dbk_base(&in, &f);
    dbk_fk(model.get(), angles, &f);
    dbk_spheres(model.get(), scene.get(), &f, static_cast<dbk_real>(opening), &cloud);
    expect(to.size() >= static_cast<size_t>(4 * cloud.count), "sphere buffer");
    for (int s = 0; s < cloud.count; ++s) {
      const dbk_real row[4] = {cloud.x[s], cloud.y[s], cloud.z[s], cloud.r[s]};
      for (int e = 0; e < 4; ++e) { to.data()[4 * s + e] = static_cast<double>(row[e]); }
    }
    return cloud.count;
  }

  // the rows of the last step, all that a control of its box could violate: list of (kind, i, j, h, norm, b, a...)
  nb::list rows() {
    nb::list all;
    dbk_all_rows(model.get(), scene.get(), ctx.get(), &in);
    for (int r = 0; r < ctx->rows.count; ++r) {
      nb::list a;
      for (size_t k = 0; k < n; ++k) { a.append(double(ctx->rows.a[k][r])); }
      all.append(nb::make_tuple(ctx->rows.kind[r], ctx->rows.i[r], ctx->rows.j[r], double(ctx->rows.h[r]),
                                double(ctx->rows.norm[r]), double(ctx->rows.b[r]), nb::tuple(a)));
    }
    return all;
  }

  nb::tuple box() const {
    nb::list low, high;
    for (size_t k = 0; k < n; ++k) {
      low.append(double(ctx->lower[k]));
      high.append(double(ctx->upper[k]));
    }
    return nb::make_tuple(nb::tuple(low), nb::tuple(high));
  }

  nb::dict closed_loop(const Out &q, uint64_t seed, int hold, double toward, const Out &q_log, const Out &u_log,
                       const Bytes &status_log) {
    dbk_tally tally{};
    tally.h_min = 1e9;
    const size_t steps = status_log.size();
    expect(q.size() == n && q_log.size() == steps * n && u_log.size() == steps * n && hold > 0, "log sizes");
    const dbk_adversary a{seed, int(steps), hold, toward};
    {
      const nb::gil_scoped_release release;
      dbk_closed_loop(model.get(), scene.get(), ctx.get(), &a, q.data(), q_log.data(), u_log.data(), status_log.data(),
                      &tally);
    }
    nb::dict d;
    const char *names[5] = {"safe", "modified", "relaxed", "stopped", "fault"};
    for (int i = 0; i < 5; ++i) { d[names[i]] = tally.status[i]; }
    d["rows"] = tally.rows;
    d["iterations"] = tally.iterations;
    d["h_min"] = tally.h_min;
    return d;
  }

  // mean seconds of one step along recorded states (steps, n)
  double time_steps(const Array &q, const Array &u_nom, bool cold) {
    const size_t steps = q.size() / n;
    expect(q.size() == steps * n && u_nom.size() == q.size(), "recorded states");
    std::vector<dbk_in> all(steps, dbk_in{});
    for (size_t t = 0; t < steps; ++t) {
      for (size_t k = 0; k < n; ++k) {
        all[t].q[k] = static_cast<dbk_real>(q.data()[t * n + k]);
        all[t].u_nom[k] = static_cast<dbk_real>(u_nom.data()[t * n + k]);
      }
    }
    const nb::gil_scoped_release release;
    return dbk_time_steps(model.get(), scene.get(), ctx.get(), all.data(), int(steps), cold, &out);
  }
};

// the QP alone: rows A u >= b (made unit rows here), weight through `scale` (S = L^-T)
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
  const bool alone = impossible && result != 1;  // one zero row is a certificate by itself
  for (int a = 0; a < solution.n_active && !alone; ++a) {
    const int32_t id = solution.active[a];
    const int32_t shown = id < 2 * int32_t(n) ? id : 2 * int32_t(n) + origin[size_t(id) - 2 * n];
    active.append(nb::make_tuple(shown, double(solution.multiplier[a])));
  }
  for (size_t k = 0; k < n; ++k) { u.data()[k] = static_cast<double>(solution.u[k]); }
  return nb::make_tuple(impossible ? 1 : result, solution.iterations, nb::tuple(active));
}

// distances (k,) and normals (k, 3) from points (k, 3) to one obstacle row
void distance(const Array &obstacle, const Array &points, const Out &d, const Out &normals) {
  expect(obstacle.size() == kObstacle, "one obstacle row");
  const size_t count = points.size() / 3;
  expect(d.size() == count && normals.size() == 3 * count, "distance buffers");
  dbk_obstacle o;
  read_obstacle(obstacle.data(), &o);
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

NB_MODULE(DBK_MODULE, m) {
  if (PyArray_ImportNumPyAPI() < 0) { throw nb::python_error(); }
  m.doc() = "The safety kernel, compiled.";
  m.attr("real") = sizeof(dbk_real) == 4 ? "float32" : "float64";
  m.attr("source_hash") = DBK_HASH;
  m.attr("flags") = DBK_FLAGS;
  m.attr("max_rows") = DBK_MAX_ROWS;
  m.attr("max_obstacles") = DBK_MAX_OBSTACLES;
  m.attr("max_spheres") = DBK_MAX_SPHERES;
  m.attr("max_held") = DBK_MAX_HELD;
  m.attr("max_user") = DBK_MAX_USER;
  nb::class_<Kernel>(m, "Kernel")
      .def(nb::init<const nb::dict &>())
      .def("set_obstacles", &Kernel::set_obstacles)
      .def("clear_permits", &Kernel::clear_permits)
      .def("permit", &Kernel::permit)
      .def("attach", &Kernel::attach)
      .def("constrain", &Kernel::constrain)
      .def("stand", &Kernel::stand)
      .def("reset", &Kernel::reset)
      .def("answer_with", &Kernel::answer_with)
      .def("step", &Kernel::step)
      .def("batch", &Kernel::batch)
      .def("project", &Kernel::project)
      .def("tool", &Kernel::tool)
      .def("spheres", &Kernel::spheres)
      .def("rows", &Kernel::rows)
      .def("box", &Kernel::box)
      .def("closed_loop", &Kernel::closed_loop)
      .def("parts", [](Kernel &k) { return nb::make_tuple(nb::capsule(k.model.get()), nb::capsule(k.scene.get()), nb::capsule(k.ctx.get())); })
      .def("time_steps", &Kernel::time_steps);
  m.def("solve_qp", &solve_qp);
  m.def("distance", &distance);
  m.def("sincos", &sine_cosine);
  bind_lab(m);
}
