// Conversion of a robot and of obstacles; see parse_model.h.
#include "conversion/parse_model.h"

#include <vector>

#include "conversion/entries.h"

namespace nb = nanobind;

namespace {

dbk_real number(const nb::dict &d, const char *key) { return static_cast<dbk_real>(nb::cast<double>(d[key])); }

void parse_settings(const nb::dict &d, size_t n, dbk_model &m) {
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
  m.speed_limit = number(d, "speed_limit");
  m.moving_base = static_cast<int32_t>(number(d, "moving_base"));
  m.speed_first_joint = static_cast<int32_t>(number(d, "speed_first_joint"));
  m.state_age_max = number(d, "state_age_max");
  m.scene_age_max = number(d, "scene_age_max");
}

void parse_joints(const nb::dict &d, size_t n, dbk_model &m) {
  fill(d, "joint_rotation", &m.joint_rotation[0][0], n * 9);
  fill(d, "joint_offset", &m.joint_offset[0][0], n * 3);
  fill(d, "q_lower", m.q_lower, n);
  fill(d, "q_upper", m.q_upper, n);
  fill(d, "v_max", m.v_max, n);
  fill(d, "a_max", m.a_max, n);
  fill(d, "j_max", m.j_max, n);
  fill(d, "tracking", m.tracking, n);
  fill(d, "joint_kind", m.joint_kind, n);
  const bool drives = n > 1 && m.joint_kind[0] == DBK_PRISMATIC && m.joint_kind[1] == DBK_REVOLUTE;
  expect(!m.moving_base || drives, "moving_base");
  const std::vector<double> scale = values(d, "scale");
  expect(scale.size() == n * n, "scale");
  for (size_t i = 0; i < n; ++i) {
    for (size_t k = 0; k < n; ++k) { m.scale[i][k] = static_cast<dbk_real>(scale[i * n + k]); }
  }
}

// rows of x, y, z, radius, slide_x, slide_y, slide_z
void parse_spheres(const std::vector<double> &rows, dbk_model &m) {
  m.n_spheres = static_cast<int32_t>(rows.size() / 7);
  expect(m.n_spheres <= DBK_MAX_SPHERES, "number of spheres");
  expect(m.link_first[m.n_links] == m.n_spheres, "link_first");
  for (int i = 0; i < m.n_spheres; ++i) {
    const double *row = rows.data() + 7 * i;
    dbk_real *to[7] = {m.x, m.y, m.z, m.radius, m.slide_x, m.slide_y, m.slide_z};
    for (int e = 0; e < 7; ++e) { to[e][i] = static_cast<dbk_real>(row[e]); }
  }
}

void parse_links(const nb::dict &d, dbk_model &m) {
  fill(d, "tool_rotation", m.tool_rotation, 9);
  fill(d, "tool_offset", m.tool_offset, 3);
  m.n_links = static_cast<int32_t>(fill(d, "link_frame", m.link_frame, DBK_MAX_LINKS));
  fill(d, "link_first", m.link_first, DBK_MAX_LINKS + 1);
  m.n_pairs = static_cast<int32_t>(fill(d, "pairs", &m.pair[0][0], 2 * DBK_MAX_PAIRS) / 2);
  m.n_held_links = static_cast<int32_t>(fill(d, "held_links", m.held_link, DBK_MAX_LINKS));
  parse_spheres(values(d, "spheres"), m);
}

}  // namespace

void parse_model(const nb::dict &d, dbk_model *model) {
  const size_t n = static_cast<size_t>(nb::cast<int>(d["n"]));
  expect(n >= 1 && n <= DBK_MAX_DOF, "number of joints");
  parse_settings(d, n, *model);
  parse_joints(d, n, *model);
  parse_links(d, *model);
  dbk_prepare(model);
}

std::unique_ptr<dbk_model> parse_hull_model(const nb::dict &d, const dbk_model &model) {
  if (!d.contains("hull_spheres")) { return nullptr; }
  const std::vector<double> rows = values(d, "hull_spheres");
  std::unique_ptr<dbk_model> hull{new dbk_model(model)};
  expect(rows.size() == 7 * static_cast<size_t>(model.n_spheres), "hull_spheres");
  parse_spheres(rows, *hull);
  dbk_prepare(hull.get());
  return hull;
}

void parse_obstacle(const double *row, dbk_obstacle *o) {
  auto take = [&row](dbk_real *to, int count) {
    for (int i = 0; i < count; ++i) { to[i] = static_cast<dbk_real>(*row++); }
  };
  o->shape = static_cast<int32_t>(*row++);
  o->flags = static_cast<int32_t>(*row++);
  o->rank = static_cast<int32_t>(*row++);
  o->link_mask = static_cast<uint32_t>(*row++);
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
  o->near_speed = o->near_distance = o->near_brake = o->near_approach = 0;
}
