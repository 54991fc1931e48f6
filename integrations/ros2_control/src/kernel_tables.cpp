#include "dualbrain_ros2_control/kernel_tables.hpp"

#include <cstdlib>
#include <fstream>
#include <map>
#include <set>
#include <sstream>
#include <stdexcept>

namespace dualbrain_ros2_control {
namespace {

constexpr const char *kHeader = "dualbrain kernel tables 1";
constexpr size_t kObstacleColumns = 29, kNearColumns = 5, kSphereColumns = 7;

using Numbers = std::vector<double>;

[[noreturn]] void fail(const std::string &problem) {
  throw std::runtime_error(problem + ". Write the tables again with `dualbrain ros2 tables`");
}

// the lines of the file by key
class Lines {
 public:
  explicit Lines(const std::string &path) {
    std::ifstream file(path);
    std::string line;
    if (!file || !std::getline(file, line)) { fail("There are no kernel tables at " + path); }
    if (line != kHeader) { fail(path + " does not begin with `" + std::string(kHeader) + "`"); }
    while (std::getline(file, line)) { add(line); }
  }

  const std::vector<std::string> &words(const std::string &key) const {
    const auto found = lines_.find(key);
    if (found == lines_.end()) { fail("The tables lack `" + key + "`"); }
    read_.insert(key);
    return found->second;
  }

  // a key that nothing read may be a margin that this controller does not know
  void expect_all_read() const {
    for (const auto &line : lines_) {
      if (read_.count(line.first) == 0) { fail("The tables have the unknown key `" + line.first + "`"); }
    }
  }

  Numbers numbers(const std::string &key) const {
    Numbers values;
    for (const std::string &word : words(key)) {
      char *end = nullptr;
      values.push_back(std::strtod(word.c_str(), &end));
      if (end == word.c_str() || *end != '\0') { fail("`" + key + "` has an entry that is no number: " + word); }
    }
    return values;
  }

 private:
  void add(const std::string &line) {
    std::istringstream stream(line);
    std::string key, word;
    size_t count = 0;
    if (!(stream >> key >> count)) { fail("A line of the tables is not `KEY COUNT VALUES`"); }
    std::vector<std::string> &words = lines_[key];
    while (stream >> word) { words.push_back(word); }
    if (words.size() != count) { fail("`" + key + "` does not have the stated number of values"); }
  }

  std::map<std::string, std::vector<std::string>> lines_;
  mutable std::set<std::string> read_;
};

// copies exactly `count` values of `key` to `to`, which has room for `room`.
template <typename T>
void fill(const Lines &lines, const char *key, T *to, size_t count, size_t room) {
  const Numbers values = lines.numbers(key);
  if (values.size() != count) { fail("`" + std::string(key) + "` does not have the expected number of values"); }
  if (count > room) { fail("`" + std::string(key) + "` exceeds the capacity of this build of the kernel"); }
  for (size_t i = 0; i < count; ++i) { to[i] = static_cast<T>(values[i]); }
}

// a setting is one number for the whole robot, or one per joint, as the kernel declares it.
void setting(const Lines &lines, const char *key, dbk_real &to, size_t) { fill(lines, key, &to, 1, 1); }

template <size_t N>
void setting(const Lines &lines, const char *key, dbk_real (&to)[N], size_t joints) {
  fill(lines, key, to, joints, N);
}

void read_settings(const Lines &lines, size_t n, dbk_model &m) {
  fill(lines, "n", &m.n, 1, 1);
  if (m.n != static_cast<int32_t>(n)) { fail("`n` is not the number of `joints`"); }
  setting(lines, "period", m.period, n);
  setting(lines, "alpha", m.alpha, n);
  setting(lines, "alpha_self", m.alpha_self, n);
  setting(lines, "alpha_joint", m.alpha_joint, n);
  setting(lines, "recovery", m.recovery, n);
  setting(lines, "sampling", m.sampling, n);
  setting(lines, "rounding", m.rounding, n);
  setting(lines, "self_margin", m.self_margin, n);
  setting(lines, "lag", m.lag, n);
  setting(lines, "tracking", m.tracking, n);
  setting(lines, "speed_limit", m.speed_limit, n);
  setting(lines, "state_age_max", m.state_age_max, n);
  setting(lines, "scene_age_max", m.scene_age_max, n);
  fill(lines, "moving_base", &m.moving_base, 1, 1);
  fill(lines, "speed_first_joint", &m.speed_first_joint, 1, 1);
}

void read_joints(const Lines &lines, size_t n, dbk_model &m) {
  fill(lines, "joint_rotation", &m.joint_rotation[0][0], 9 * n, 9 * DBK_MAX_DOF);
  fill(lines, "joint_offset", &m.joint_offset[0][0], 3 * n, 3 * DBK_MAX_DOF);
  fill(lines, "joint_kind", m.joint_kind, n, DBK_MAX_DOF);
  const bool drives = n > 1 && m.joint_kind[0] == DBK_PRISMATIC && m.joint_kind[1] == DBK_REVOLUTE;
  if (m.moving_base && !drives) { fail("`moving_base` needs a prismatic drive and a revolute turn as first joints"); }
  fill(lines, "q_lower", m.q_lower, n, DBK_MAX_DOF);
  fill(lines, "q_upper", m.q_upper, n, DBK_MAX_DOF);
  fill(lines, "v_max", m.v_max, n, DBK_MAX_DOF);
  fill(lines, "a_max", m.a_max, n, DBK_MAX_DOF);
  fill(lines, "j_max", m.j_max, n, DBK_MAX_DOF);
  const Numbers scale = lines.numbers("scale");
  if (scale.size() != n * n) { fail("`scale` does not have the expected number of values"); }
  for (size_t i = 0; i < n; ++i) {
    for (size_t k = 0; k < n; ++k) { m.scale[i][k] = static_cast<dbk_real>(scale[i * n + k]); }
  }
  fill(lines, "tool_rotation", m.tool_rotation, 9, 9);
  fill(lines, "tool_offset", m.tool_offset, 3, 3);
}

void read_links(const Lines &lines, dbk_model &m) {
  const size_t links = lines.words("link_frame").size(), pairs = lines.words("pairs").size() / 2,
               held = lines.words("held_links").size();
  fill(lines, "link_frame", m.link_frame, links, DBK_MAX_LINKS);
  fill(lines, "link_first", m.link_first, links + 1, DBK_MAX_LINKS + 1);
  fill(lines, "pairs", &m.pair[0][0], 2 * pairs, 2 * DBK_MAX_PAIRS);
  fill(lines, "held_links", m.held_link, held, DBK_MAX_LINKS);
  m.n_links = static_cast<int32_t>(links);
  m.n_pairs = static_cast<int32_t>(pairs);
  m.n_held_links = static_cast<int32_t>(held);
}

void read_spheres(const Lines &lines, dbk_model &m) {
  const Numbers rows = lines.numbers("spheres");
  const size_t count = rows.size() / kSphereColumns;
  if (rows.size() != count * kSphereColumns || m.link_first[m.n_links] != static_cast<int32_t>(count)) {
    fail("`spheres` does not fit the links");
  }
  if (count > DBK_MAX_SPHERES) { fail("`spheres` exceeds the capacity of this build of the kernel"); }
  m.n_spheres = static_cast<int32_t>(count);
  for (size_t i = 0; i < count; ++i) {
    dbk_real *to[kSphereColumns] = {m.x, m.y, m.z, m.radius, m.slide_x, m.slide_y, m.slide_z};
    for (size_t e = 0; e < kSphereColumns; ++e) { to[e][i] = static_cast<dbk_real>(rows[kSphereColumns * i + e]); }
  }
}

// the columns have the order of the fields of dbk_obstacle
void read_obstacle(const double *column, dbk_obstacle &o) {
  const auto take = [&column](dbk_real *to, int count) {
    for (int i = 0; i < count; ++i) { to[i] = static_cast<dbk_real>(*column++); }
  };
  o = dbk_obstacle();
  o.shape = static_cast<int32_t>(*column++);
  o.flags = static_cast<int32_t>(*column++);
  o.rank = static_cast<int32_t>(*column++);
  o.link_mask = static_cast<uint32_t>(*column++);
  take(&o.alpha, 1);
  take(o.position, 3);
  take(o.rotation, 9);
  take(o.half, 3);
  take(&o.radius, 1);
  take(o.velocity, 3);
  take(&o.margin, 1);
  take(&o.velocity_error, 1);
  take(&o.reaction, 1);
  take(&o.brake, 1);
  take(&o.approach, 1);
}

void read_scene(const Lines &lines, dbk_scene &scene) {
  const Numbers rows = lines.numbers("obstacles"), near = lines.numbers("near");
  const size_t count = rows.size() / kObstacleColumns;
  if (rows.size() != count * kObstacleColumns || near.size() % kNearColumns != 0) {
    fail("`obstacles` or `near` does not have the expected number of values");
  }
  if (count > DBK_MAX_OBSTACLES) { fail("`obstacles` exceeds the capacity of this build of the kernel"); }
  dbk_scene_clear(&scene);
  for (size_t i = 0; i < count; ++i) { read_obstacle(rows.data() + kObstacleColumns * i, scene.obstacle[i]); }
  for (size_t i = 0; i < near.size(); i += kNearColumns) {
    const double index = near[i];
    if (!(index >= 0.0 && index < static_cast<double>(count))) { fail("`near` names an unknown obstacle"); }
    dbk_obstacle &o = scene.obstacle[static_cast<size_t>(index)];
    o.near_speed = static_cast<dbk_real>(near[i + 1]);
    o.near_distance = static_cast<dbk_real>(near[i + 2]);
    o.near_brake = static_cast<dbk_real>(near[i + 3]);
    o.near_approach = static_cast<dbk_real>(near[i + 4]);
  }
  scene.n_obstacles = static_cast<int32_t>(count);
  dbk_scene_prepare(&scene);
}

}  // namespace

KernelTables read_kernel_tables(const std::string &path) {
  const Lines lines(path);
  KernelTables tables{lines.words("joints"), std::make_unique<dbk_model>(), std::make_unique<dbk_scene>()};
  const size_t n = tables.joints.size();
  if (n < 1 || n > DBK_MAX_DOF) { fail("The number of joints exceeds the capacity of this build of the kernel"); }
  read_settings(lines, n, *tables.model);
  read_joints(lines, n, *tables.model);
  read_links(lines, *tables.model);
  read_spheres(lines, *tables.model);
  dbk_prepare(tables.model.get());
  read_scene(lines, *tables.scene);
  lines.expect_all_read();
  return tables;
}

}  // namespace dualbrain_ros2_control
