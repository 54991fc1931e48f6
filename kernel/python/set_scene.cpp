// Scene of the filter: obstacles, contact permits, held object, user rows, base pose.
#include <algorithm>

#include "conversion/parse_model.h"
#include "kernel.h"

Kernel::Kernel(const nb::dict &d) {
  parse_model(d, model.get());
  hull_model = parse_hull_model(d, *model);
  if (hull_model) { opening_max = nb::cast<double>(d["opening_max"]); }
  n = static_cast<size_t>(model->n);
  dbk_scene_clear(scene.get());
  dbk_scene_prepare(scene.get());
  dbk_init(ctx.get());
  dbk_init(projection_ctx.get());
}

void Kernel::set_obstacles(const Array &rows) {
  const size_t count = rows.size() / kObstacle;
  expect(count <= DBK_MAX_OBSTACLES && rows.size() == count * kObstacle, "obstacle rows have 29 columns");
  for (size_t i = 0; i < count; ++i) { parse_obstacle(rows.data() + kObstacle * i, &scene->obstacle[i]); }
  scene->n_obstacles = static_cast<int32_t>(count);
  dbk_scene_prepare(scene.get());
}

void Kernel::limit_near(int obstacle, double speed, double distance, double brake, double approach) {
  expect(obstacle >= 0 && obstacle < scene->n_obstacles, "limit_near");
  dbk_obstacle &o = scene->obstacle[obstacle];
  o.near_speed = static_cast<dbk_real>(speed);
  o.near_distance = static_cast<dbk_real>(distance);
  o.near_brake = static_cast<dbk_real>(brake);
  o.near_approach = static_cast<dbk_real>(approach);
  dbk_scene_prepare(scene.get());
}

void Kernel::clear_permits() {
  for (auto &row : scene->permit) { std::fill_n(row, DBK_PADDED(scene->n_obstacles), static_cast<dbk_real>(-1)); }
}

void Kernel::permit(int link, int obstacle, double speed) {
  expect(link >= 0 && link <= model->n_links && obstacle >= 0 && obstacle < DBK_MAX_OBSTACLES, "permit");
  const int slot = link;
  scene->permit[slot][obstacle] = static_cast<dbk_real>(speed);
}

void Kernel::attach(const Array &spheres, double error) {
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

void Kernel::constrain(const Array &rows) {
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

void Kernel::set_base_pose(const Array &pose) {
  expect(pose.size() == 12, "base pose");
  for (size_t e = 0; e < 9; ++e) { in.base_rotation[e] = static_cast<dbk_real>(pose.data()[e]); }
  for (size_t e = 0; e < 3; ++e) { in.base_position[e] = static_cast<dbk_real>(pose.data()[9 + e]); }
  in.mobile = 1;
}
