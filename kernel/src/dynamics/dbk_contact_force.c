/* The damped least-squares contact force, at one point and at the best of many. */
#include "dynamics/dbk_contact_force.h"

#include "dbk_spatial.h"
#include "dynamics/dbk_damped_inverse.h"

void dbk_solve_contact_force(int32_t n, const dbk_real jacobian[3][DBK_MAX_DOF], const dbk_real torque[DBK_MAX_DOF],
                             dbk_real damping, dbk_contact_force *contact) {
  dbk_damped_map(3, n, jacobian, damping, contact->map);
  for (int32_t i = 0; i < 3; ++i) {
    contact->force[i] = (dbk_real)0;
    for (int32_t k = 0; k < n; ++k) { contact->force[i] += contact->map[i][k] * torque[k]; }
  }
  const dbk_real *f = contact->force;
  contact->unexplained = (dbk_real)0;
  for (int32_t k = 0; k < n; ++k) {
    const dbk_real left = torque[k] - (jacobian[0][k] * f[0] + jacobian[1][k] * f[1] + jacobian[2][k] * f[2]);
    contact->unexplained += left * left;
  }
  contact->cost = contact->unexplained + damping * (f[0] * f[0] + f[1] * f[1] + f[2] * f[2]);
}

/* the Jacobian of a point behind `joints` joints: no force at the point moves the joints after them */
static void point_jacobian(int32_t n, int32_t joints, const dbk_real linear[3][DBK_MAX_DOF],
                           const dbk_real angular[3][DBK_MAX_DOF], const dbk_real arm[3],
                           dbk_real jacobian[3][DBK_MAX_DOF]) {
  for (int32_t k = 0; k < n; ++k) {
    const dbk_real axis[3] = {angular[0][k], angular[1][k], angular[2][k]};
    dbk_real swept[3];
    dbk_cross(axis, arm, swept);
    for (int32_t e = 0; e < 3; ++e) { jacobian[e][k] = k < joints ? linear[e][k] + swept[e] : (dbk_real)0; }
  }
}

int32_t dbk_locate_contact(int32_t n, const dbk_real linear[3][DBK_MAX_DOF], const dbk_real angular[3][DBK_MAX_DOF],
                           const dbk_real tool[3], int32_t count, const dbk_real (*points)[3],
                           const int32_t *joint_count, const dbk_real torque[DBK_MAX_DOF], dbk_real damping,
                           dbk_contact_force *contact) {
  int32_t best = -1;
  for (int32_t i = 0; i < count; ++i) {
    dbk_real jacobian[3][DBK_MAX_DOF], arm[3];
    dbk_contact_force candidate;
    for (int32_t e = 0; e < 3; ++e) { arm[e] = points[i][e] - tool[e]; }
    point_jacobian(n, joint_count[i], linear, angular, arm, jacobian);
    dbk_solve_contact_force(n, (const dbk_real(*)[DBK_MAX_DOF])jacobian, torque, damping, &candidate);
    if (best < 0 || candidate.cost < contact->cost) {
      best = i;
      *contact = candidate;
    }
  }
  return best;
}
