// The dynamics of an arm: joint torques of its own motion, and the contact force behind the external ones.
#include <memory>
#include <vector>

#include "conversion/entries.h"

extern "C" {
#include "dynamics/dbk_contact_force.h"
#include "dynamics/dbk_damped_inverse.h"
#include "dynamics/dbk_inverse_dynamics.h"
}

namespace nb = nanobind;

namespace {

constexpr size_t kBody = 10;  // mass, centre 3, inertia 6

void write(const dbk_real *from, size_t count, double *&to) {
  for (size_t i = 0; i < count; ++i) { *to++ = static_cast<double>(from[i]); }
}

// the dynamic model of an arm; see dbk_inverse_dynamics.h
struct Dynamics {
  std::unique_ptr<dbk_dynamics> arm{new dbk_dynamics()};
  size_t n = 0;

  explicit Dynamics(const nb::dict &d) {
    n = static_cast<size_t>(nb::cast<int>(d["n"]));
    expect(n >= 1 && n <= DBK_MAX_DOF, "number of joints");
    arm->n = static_cast<int32_t>(n);
    fill(d, "joint_rotation", &arm->joint_rotation[0][0], n * 9);
    fill(d, "joint_offset", &arm->joint_offset[0][0], n * 3);
    fill(d, "joint_kind", arm->joint_kind, n);
    fill(d, "rotor_inertia", arm->rotor_inertia, n);
    fill(d, "damping", arm->damping, n);
    fill(d, "tool_offset", arm->tool_offset, 3);
    const std::vector<double> bodies = values(d, "bodies");
    expect(bodies.size() == n * kBody, "bodies");
    for (size_t i = 0; i < n; ++i) {
      const double *row = bodies.data() + kBody * i;
      dbk_body &body = arm->body[i];
      body.mass = static_cast<dbk_real>(row[0]);
      for (int e = 0; e < 3; ++e) { body.centre[e] = static_cast<dbk_real>(row[1 + e]); }
      for (int e = 0; e < 6; ++e) { body.inertia[e] = static_cast<dbk_real>(row[4 + e]); }
    }
  }

  // joint states q, v, a (n,); `base` (9,): angular velocity, angular and linear acceleration of the base; `to`
  // (2 n + 12,): own, per_load, wrist, wrist_per_load
  void torque(const Array &q, const Array &v, const Array &a, const Array &base, const Out &to) const {
    dbk_real position[DBK_MAX_DOF] = {0}, velocity[DBK_MAX_DOF] = {0}, acceleration[DBK_MAX_DOF] = {0};
    dbk_frame_motion motion;
    dbk_arm_torque result;
    copy(q, position, n, "q");
    copy(v, velocity, n, "v");
    copy(a, acceleration, n, "a");
    expect(base.size() == 9 && to.size() == 2 * n + 12, "base or torque buffer");
    for (size_t e = 0; e < 3; ++e) {
      motion.spin[e] = static_cast<dbk_real>(base.data()[e]);
      motion.turn[e] = static_cast<dbk_real>(base.data()[3 + e]);
      motion.linear[e] = static_cast<dbk_real>(base.data()[6 + e]);
    }
    dbk_inverse_dynamics(arm.get(), &motion, position, velocity, acceleration, &result);
    double *out = to.data();
    write(result.own, n, out);
    write(result.per_load, n, out);
    write(result.wrist, 6, out);
    write(result.wrist_per_load, 6, out);
  }
};

// `jacobian` (6, m) of the tool, of which the last n columns belong to the arm
void read_jacobian(const Array &jacobian, size_t n, dbk_real linear[3][DBK_MAX_DOF], dbk_real angular[3][DBK_MAX_DOF]) {
  const size_t m = jacobian.size() / 6;
  expect(n >= 1 && n <= m && m <= DBK_MAX_DOF && jacobian.size() == 6 * m, "jacobian");
  for (size_t e = 0; e < 3; ++e) {
    for (size_t k = 0; k < n; ++k) {
      linear[e][k] = static_cast<dbk_real>(jacobian.data()[e * m + m - n + k]);
      angular[e][k] = static_cast<dbk_real>(jacobian.data()[(3 + e) * m + m - n + k]);
    }
  }
}

// force 3, map (3, n), unexplained
void write_contact(const dbk_contact_force &contact, size_t n, const Out &to) {
  expect(to.size() == 4 + 3 * n, "force buffer");
  double *out = to.data();
  write(contact.force, 3, out);
  for (size_t e = 0; e < 3; ++e) { write(contact.map[e], n, out); }
  write(&contact.unexplained, 1, out);
}

// the force at the tool
void contact_force(const Array &jacobian, const Array &torque, double damping, const Out &to) {
  const size_t n = torque.size();
  dbk_real linear[3][DBK_MAX_DOF], angular[3][DBK_MAX_DOF], external[DBK_MAX_DOF];
  dbk_contact_force contact;
  read_jacobian(jacobian, n, linear, angular);
  copy(torque, external, n, "torque");
  dbk_solve_contact_force(int32_t(n), linear, external, static_cast<dbk_real>(damping), &contact);
  write_contact(contact, n, to);
}

// the force at the point, out of `points` (k, 3), that explains the torque best; returns its index
int locate_contact(const Array &jacobian, const Array &tool, const Array &points, const Integers &joint_count,
                   const Array &torque, double damping, const Out &to) {
  const size_t n = torque.size(), count = joint_count.size();
  dbk_real linear[3][DBK_MAX_DOF], angular[3][DBK_MAX_DOF], external[DBK_MAX_DOF], origin[3];
  dbk_real at[DBK_ALL_SPHERES][3];
  dbk_contact_force contact;
  read_jacobian(jacobian, n, linear, angular);
  copy(torque, external, n, "torque");
  copy(tool, origin, 3, "tool");
  expect(count >= 1 && count <= DBK_ALL_SPHERES && points.size() == 3 * count, "points");
  for (size_t i = 0; i < 3 * count; ++i) { at[i / 3][i % 3] = static_cast<dbk_real>(points.data()[i]); }
  const int best = dbk_locate_contact(int32_t(n), linear, angular, origin, int32_t(count), at, joint_count.data(),
                                      external, static_cast<dbk_real>(damping), &contact);
  write_contact(contact, n, to);
  return best;
}

// u = map' (task - J free) + free for a Jacobian (6, n): moves the tool by `task` (6,) and the null space by `free` (n,)
void damped_step(const Array &jacobian, double damping, const Array &task, const Array &free, const Out &u) {
  const size_t n = free.size();
  dbk_real rows[DBK_MAX_TASK][DBK_MAX_DOF], map[DBK_MAX_TASK][DBK_MAX_DOF], left[DBK_MAX_TASK];
  expect(n >= 1 && n <= DBK_MAX_DOF && jacobian.size() == 6 * n && task.size() == 6 && u.size() == n, "jacobian");
  for (size_t i = 0; i < 6; ++i) {
    left[i] = static_cast<dbk_real>(task.data()[i]);
    for (size_t k = 0; k < n; ++k) {
      rows[i][k] = static_cast<dbk_real>(jacobian.data()[i * n + k]);
      left[i] -= rows[i][k] * static_cast<dbk_real>(free.data()[k]);
    }
  }
  dbk_damped_map(6, int32_t(n), rows, static_cast<dbk_real>(damping), map);
  for (size_t k = 0; k < n; ++k) {
    double sum = free.data()[k];
    for (size_t i = 0; i < 6; ++i) { sum += static_cast<double>(map[i][k] * left[i]); }
    u.data()[k] = sum;
  }
}

}  // namespace

void bind_dynamics(nb::module_ &m) {
  nb::class_<Dynamics>(m, "Dynamics").def(nb::init<const nb::dict &>()).def("torque", &Dynamics::torque);
  m.def("contact_force", &contact_force);
  m.def("locate_contact", &locate_contact);
  m.def("damped_step", &damped_step);
}
