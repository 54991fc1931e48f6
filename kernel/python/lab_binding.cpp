// Python's door to the lab: the float64 judge and closed loops with everything at its bound; no part of the kernel.
#include <nanobind/nanobind.h>
#include <nanobind/stl/tuple.h>

#include <cstring>
#include <memory>
#include <vector>

#include "buffers.h"
#include "dbk_trial.h"

namespace nb = nanobind;

namespace {

constexpr size_t kThing = 24;  // shape moving position 3 rotation 9 half 3 radius velocity 3, the rest spare

template <typename T>
size_t fill(const nb::dict &d, const char *key, T *to, size_t most) {
  const Array a = nb::cast<Array>(d[key]);
  expect(a.size() <= most, key);
  for (size_t i = 0; i < a.size(); ++i) { to[i] = static_cast<T>(a.data()[i]); }
  return a.size();
}

// a part of a kernel, which must be of this very build
void *part(const nb::tuple &parts, size_t index) {
  const nb::capsule one = nb::cast<nb::capsule>(parts[index]);
  expect(one.name() != nullptr && std::strcmp(one.name(), kBuild) == 0, "parts of a kernel of this build");
  return one.data();
}

double number(const nb::dict &d, const char *key) { return nb::cast<double>(d[key]); }
int32_t whole(const nb::dict &d, const char *key) { return nb::cast<int32_t>(d[key]); }

std::vector<dbk_thing> read_things(const Array &rows) {
  const size_t count = rows.size() / kThing;
  expect(count <= DBK_JUDGE_THINGS && rows.size() == count * kThing, "rows of things have 24 columns");
  std::vector<dbk_thing> things(count, dbk_thing{});
  for (size_t i = 0; i < count; ++i) {
    const double *row = rows.data() + kThing * i;
    dbk_thing &t = things[i];
    t.shape = int32_t(row[0]);
    t.moving = int32_t(row[1]);
    std::memcpy(t.position, row + 2, sizeof t.position);
    std::memcpy(t.rotation, row + 5, sizeof t.rotation);
    std::memcpy(t.half, row + 14, sizeof t.half);
    t.radius = row[17];
    std::memcpy(t.velocity, row + 18, sizeof t.velocity);
  }
  return things;
}

nb::list listed(const int64_t *values, size_t count) {
  nb::list all;
  for (size_t i = 0; i < count; ++i) { all.append(values[i]); }
  return all;
}

nb::list listed(const double *values, size_t count) {
  nb::list all;
  for (size_t i = 0; i < count; ++i) { all.append(values[i]); }
  return all;
}

dbk_trial read_trial(const nb::dict &d) {
  dbk_trial t{};
  t.seed = nb::cast<uint64_t>(d["seed"]);
  t.steps = whole(d, "steps");
  t.hold = whole(d, "hold");
  t.toward = number(d, "toward");
  t.lag = number(d, "lag");
  t.push = number(d, "push");
  t.q_noise = number(d, "q_noise");
  t.v_noise = number(d, "v_noise");
  t.place_noise = number(d, "place_noise");
  t.speed_noise = number(d, "speed_noise");
  t.frame = whole(d, "frame");
  t.scene_longest = whole(d, "scene_longest");
  t.state_longest = whole(d, "state_longest");
  t.reckon = whole(d, "reckon");
  t.scene_drop = number(d, "scene_drop");
  t.state_drop = number(d, "state_drop");
  t.late = number(d, "late");
  t.told = number(d, "told");
  t.mover = {number(d, "mover_speed"), number(d, "mover_acceleration"), number(d, "spare"), whole(d, "evadable")};
  expect(t.steps > 0 && t.hold > 0 && t.frame > 0, "steps, hold and frame of a trial");
  return t;
}

nb::dict told(const dbk_account &a) {
  nb::dict d;
  d["steps"] = a.steps;
  d["status"] = listed(a.status, 5);
  d["held"] = listed(a.held, 5);
  d["still"] = listed(a.still, DBK_PREMISES);
  d["moving"] = nb::make_tuple(listed(a.moving[0], DBK_PREMISES), listed(a.moving[1], DBK_PREMISES));
  d["touched"] = listed(a.touched, 2);
  d["plans"] = listed(a.plans, 2);
  d["attacked"] = listed(a.attacked, 2);
  d["contacts"] = listed(a.contacts, 2);
  d["approaching"] = listed(a.approaching, 2);
  d["jerks"] = a.jerks;
  d["iterations"] = a.iterations;
  d["rows"] = a.rows;
  d["most_iterations"] = a.most_iterations;
  d["most_rows"] = a.most_rows;
  d["h_still"] = a.h_still;
  d["h_self"] = a.h_self;
  d["h_joint"] = a.h_joint;
  d["h_moving"] = listed(a.h_moving, 2);
  d["approach"] = listed(a.approach, 2);
  d["worst_step"] = a.worst_step;
  return d;
}

// A body for the judge, and what it judges.
struct Judge {
  dbk_judge_body body{};

  explicit Judge(const nb::dict &d) {
    body.n = whole(d, "n");
    expect(body.n >= 1 && body.n <= DBK_JUDGE_DOF, "number of joints");
    fill(d, "rotation", &body.rotation[0][0], 9 * DBK_JUDGE_DOF);
    fill(d, "offset", &body.offset[0][0], 3 * DBK_JUDGE_DOF);
    fill(d, "lower", body.lower, DBK_JUDGE_DOF);
    fill(d, "upper", body.upper, DBK_JUDGE_DOF);
    fill(d, "v_max", body.v_max, DBK_JUDGE_DOF);
    fill(d, "a_max", body.a_max, DBK_JUDGE_DOF);
    body.n_links = int32_t(fill(d, "frame", body.frame, DBK_JUDGE_LINKS));
    fill(d, "first", body.first, DBK_JUDGE_LINKS + 1);
    body.n_pairs = int32_t(fill(d, "pairs", &body.pair[0][0], 2 * DBK_JUDGE_PAIRS) / 2);
    fill(d, "centres", &body.centre[0][0], 3 * DBK_JUDGE_SPHERES);
    expect(fill(d, "radii", body.radius, DBK_JUDGE_SPHERES) == size_t(body.first[body.n_links]), "radii");
  }

  // h at postures (t, n) as columns still, moving, self, joint, approach of `to` (t, 5); things stand still
  void look(const Array &q, const Array &rows, double period, const Out &to) const {
    const size_t n = size_t(body.n), steps = q.size() / n;
    const std::vector<dbk_thing> things = read_things(rows);
    expect(q.size() == steps * n && to.size() == 5 * steps, "postures (t, n) and verdicts (t, 5)");
    dbk_judge judge;
    dbk_judge_reset(&judge);
    for (size_t t = 0; t < steps; ++t) {
      dbk_verdict v;
      dbk_judge_look(&body, &judge, q.data() + n * t, things.data(), int32_t(things.size()), period, &v);
      const double row[5] = {v.still, v.moving, v.self, v.joint, v.approach};
      std::memcpy(to.data() + 5 * t, row, sizeof row);
    }
  }

  // parts: those of a Kernel with its obstacles observed, in the order of `rows`; q (n,) is start and end
  nb::dict trial(const nb::tuple &parts, const Array &rows, const nb::dict &asked, const Out &q, const Out &q_log) const {
    auto *model = static_cast<dbk_model *>(part(parts, 0));
    auto *scene = static_cast<dbk_scene *>(part(parts, 1));
    auto *ctx = static_cast<dbk_ctx *>(part(parts, 2));
    std::vector<dbk_thing> things = read_things(rows);
    const dbk_trial t = read_trial(asked);
    expect(model->n == body.n && q.size() == size_t(body.n), "q (n,)");
    expect(scene->n_obstacles == int32_t(things.size()), "one observed obstacle for each thing");
    expect(q_log.size() == 0 || q_log.size() == size_t(t.steps) * size_t(body.n), "q_log (steps, n) or empty");
    dbk_account account;
    {
      const nb::gil_scoped_release release;
      dbk_run_trial(model, scene, ctx, &body, things.data(), int32_t(things.size()), &t, q.data(),
                    q_log.size() ? q_log.data() : nullptr, &account);
    }
    return told(account);
  }
};

}  // namespace

void bind_lab(nb::module_ &m) {
  nb::class_<Judge>(m, "Judge")
      .def(nb::init<const nb::dict &>())
      .def("look", &Judge::look)
      .def("trial", &Judge::trial);
}
