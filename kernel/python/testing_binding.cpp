// Python binding of the testing library: float64 reference distances and the worst-case closed loop; not a part of the
// kernel.
#include <nanobind/nanobind.h>
#include <nanobind/stl/tuple.h>

#include <cstring>
#include <memory>
#include <vector>

#include "conversion/buffers.h"
#include "worst_case_loop.h"

namespace nb = nanobind;

namespace {

// shape, moving, position 3, rotation 9, half 3, radius, velocity 3; the other columns are unused
constexpr size_t kTrueObstacle = 24;

template <typename T>
size_t fill(const nb::dict &d, const char *key, T *to, size_t max_count) {
  const Array a = nb::cast<Array>(d[key]);
  expect(a.size() <= max_count, key);
  for (size_t i = 0; i < a.size(); ++i) { to[i] = static_cast<T>(a.data()[i]); }
  return a.size();
}

// a pointer from the handles of a kernel, which must belong to this build
void *pointer(const nb::tuple &handles, size_t index) {
  const nb::capsule one = nb::cast<nb::capsule>(handles[index]);
  expect(one.name() != nullptr && std::strcmp(one.name(), kBuild) == 0, "handles of a kernel of this build");
  return one.data();
}

double number(const nb::dict &d, const char *key) { return nb::cast<double>(d[key]); }
int32_t integer(const nb::dict &d, const char *key) { return nb::cast<int32_t>(d[key]); }

std::vector<dbk_true_obstacle> parse_obstacles(const Array &rows) {
  const size_t count = rows.size() / kTrueObstacle;
  expect(count <= DBK_REFERENCE_OBSTACLES && rows.size() == count * kTrueObstacle,
         "rows of true obstacles have 24 columns");
  std::vector<dbk_true_obstacle> obstacles(count, dbk_true_obstacle{});
  for (size_t i = 0; i < count; ++i) {
    const double *row = rows.data() + kTrueObstacle * i;
    dbk_true_obstacle &o = obstacles[i];
    o.shape = int32_t(row[0]);
    o.moving = int32_t(row[1]);
    std::memcpy(o.position, row + 2, sizeof o.position);
    std::memcpy(o.rotation, row + 5, sizeof o.rotation);
    std::memcpy(o.half, row + 14, sizeof o.half);
    o.radius = row[17];
    std::memcpy(o.velocity, row + 18, sizeof o.velocity);
  }
  return obstacles;
}

nb::list to_list(const int64_t *values, size_t count) {
  nb::list all;
  for (size_t i = 0; i < count; ++i) { all.append(values[i]); }
  return all;
}

nb::list to_list(const double *values, size_t count) {
  nb::list all;
  for (size_t i = 0; i < count; ++i) { all.append(values[i]); }
  return all;
}

dbk_loop_config parse_config(const nb::dict &d) {
  dbk_loop_config c{};
  c.seed = nb::cast<uint64_t>(d["seed"]);
  c.steps = integer(d, "steps");
  c.hold = integer(d, "hold");
  c.toward = number(d, "toward");
  c.lag = number(d, "lag");
  c.push = number(d, "push");
  c.q_noise = number(d, "q_noise");
  c.v_noise = number(d, "v_noise");
  c.place_noise = number(d, "place_noise");
  c.speed_noise = number(d, "speed_noise");
  c.frame = integer(d, "frame");
  c.scene_longest = integer(d, "scene_longest");
  c.state_longest = integer(d, "state_longest");
  c.dead_reckoning = integer(d, "dead_reckoning");
  c.scene_drop = number(d, "scene_drop");
  c.state_drop = number(d, "state_drop");
  c.late = number(d, "late");
  c.velocity_share = number(d, "velocity_share");
  c.obstacle = {number(d, "mover_speed"), number(d, "mover_acceleration"), number(d, "clearance"),
                integer(d, "evadable")};
  expect(c.steps > 0 && c.hold > 0 && c.frame > 0, "steps, hold and frame of a loop");
  return c;
}

// the keys are the column names of recorded experiment logs and must not change
nb::dict to_dict(const dbk_loop_result &r) {
  nb::dict d;
  d["steps"] = r.steps;
  d["status"] = to_list(r.status, 5);
  d["held"] = to_list(r.premise_held, 5);
  d["still"] = to_list(r.static_violation, DBK_PREMISES);
  d["moving"] =
      nb::make_tuple(to_list(r.moving_violation[0], DBK_PREMISES), to_list(r.moving_violation[1], DBK_PREMISES));
  d["touched"] = to_list(r.contact, 2);
  d["plans"] = to_list(r.plans, 2);
  d["attacked"] = to_list(r.plan_steps, 2);
  d["contacts"] = to_list(r.contact_onset, 2);
  d["approaching"] = to_list(r.approaching_onset, 2);
  d["jerks"] = r.bound_violation;
  d["iterations"] = r.iterations;
  d["rows"] = r.rows;
  d["most_iterations"] = r.max_iterations;
  d["most_rows"] = r.max_rows;
  d["h_still"] = r.h_static;
  d["h_self"] = r.h_self;
  d["h_joint"] = r.h_joint;
  d["h_moving"] = to_list(r.h_moving, 2);
  d["approach"] = to_list(r.approach, 2);
  d["worst_step"] = r.worst_step;
  return d;
}

// a robot in float64
struct ReferenceDistance {
  dbk_reference_robot robot{};

  explicit ReferenceDistance(const nb::dict &d) {
    robot.n = integer(d, "n");
    expect(robot.n >= 1 && robot.n <= DBK_REFERENCE_DOF, "number of joints");
    fill(d, "rotation", &robot.rotation[0][0], 9 * DBK_REFERENCE_DOF);
    fill(d, "offset", &robot.offset[0][0], 3 * DBK_REFERENCE_DOF);
    fill(d, "lower", robot.lower, DBK_REFERENCE_DOF);
    fill(d, "upper", robot.upper, DBK_REFERENCE_DOF);
    fill(d, "v_max", robot.v_max, DBK_REFERENCE_DOF);
    fill(d, "a_max", robot.a_max, DBK_REFERENCE_DOF);
    robot.n_links = int32_t(fill(d, "frame", robot.frame, DBK_REFERENCE_LINKS));
    fill(d, "first", robot.first, DBK_REFERENCE_LINKS + 1);
    robot.n_pairs = int32_t(fill(d, "pairs", &robot.pair[0][0], 2 * DBK_REFERENCE_PAIRS) / 2);
    fill(d, "centres", &robot.centre[0][0], 3 * DBK_REFERENCE_SPHERES);
    expect(fill(d, "radii", robot.radius, DBK_REFERENCE_SPHERES) == size_t(robot.first[robot.n_links]), "radii");
  }

  // true h at the postures (t, n) among obstacles at rest; `to` (t, 5) receives the columns h_static, h_moving, h_self,
  // h_joint, approach
  void measure(const Array &q, const Array &rows, double period, const Out &to) const {
    const size_t n = size_t(robot.n), steps = q.size() / n;
    const std::vector<dbk_true_obstacle> obstacles = parse_obstacles(rows);
    expect(q.size() == steps * n && to.size() == 5 * steps, "postures (t, n) and distances (t, 5)");
    dbk_reference_state state;
    dbk_reference_reset(&state);
    for (size_t t = 0; t < steps; ++t) {
      dbk_reference_distances d;
      dbk_reference_measure(&robot, &state, q.data() + n * t, obstacles.data(), int32_t(obstacles.size()), period, &d);
      const double row[5] = {d.h_static, d.h_moving, d.h_self, d.h_joint, d.approach};
      std::memcpy(to.data() + 5 * t, row, sizeof row);
    }
  }

  // runs the worst-case loop with a kernel whose obstacles correspond to `rows`; q (n,) is the start and receives the
  // end
  nb::dict run_worst_case_loop(const nb::tuple &handles, const Array &rows, const nb::dict &settings, const Out &q,
                               const Out &q_log) const {
    auto *model = static_cast<dbk_model *>(pointer(handles, 0));
    auto *scene = static_cast<dbk_scene *>(pointer(handles, 1));
    auto *ctx = static_cast<dbk_ctx *>(pointer(handles, 2));
    std::vector<dbk_true_obstacle> obstacles = parse_obstacles(rows);
    const dbk_loop_config config = parse_config(settings);
    expect(model->n == robot.n && q.size() == size_t(robot.n), "q (n,)");
    expect(scene->n_obstacles == int32_t(obstacles.size()), "one observed obstacle for each true obstacle");
    expect(q_log.size() == 0 || q_log.size() == size_t(config.steps) * size_t(robot.n), "q_log (steps, n) or empty");
    dbk_loop_result result;
    {
      const nb::gil_scoped_release release;
      dbk_run_worst_case_loop(model, scene, ctx, &robot, obstacles.data(), int32_t(obstacles.size()), &config, q.data(),
                              q_log.size() ? q_log.data() : nullptr, &result);
    }
    return to_dict(result);
  }
};

}  // namespace

void bind_testing(nb::module_ &m) {
  nb::class_<ReferenceDistance>(m, "ReferenceDistance")
      .def(nb::init<const nb::dict &>())
      .def("measure", &ReferenceDistance::measure)
      .def("run_worst_case_loop", &ReferenceDistance::run_worst_case_loop);
}
