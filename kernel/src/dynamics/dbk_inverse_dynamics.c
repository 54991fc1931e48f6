/* Recursive Newton-Euler equations in the axes of each frame (Craig, Introduction to Robotics, 6.5). R is the rotation
 * from frame i to frame i - 1, p the origin of frame i in frame i - 1, z its axis; m, c and I are mass, centre and the
 * inertia about the centre of the bodies on frame i:
 *
 *   w_i = R'w_{i-1} + z qd_i                   al_i = R'al_{i-1} + z qdd_i + R'w_{i-1} x z qd_i
 *   a_i = R'(a_{i-1} + al_{i-1} x p + w_{i-1} x (w_{i-1} x p))
 *   f_i = m (a_i + al_i x c + w_i x (w_i x c)),   n_i = I al_i + w_i x I w_i
 *   F_i = f_i + R F_{i+1},                        N_i = n_i + c x f_i + R N_{i+1} + p_{i+1} x R F_{i+1}
 *   tau_i = z.N_i + rotor_i qdd_i + damping_i qd_i
 *
 * A prismatic joint adds z qdd_i + 2 w_i x z qd_i to a_i instead of its parts in w and al, and its force is z.F_i. */
#include "dynamics/dbk_inverse_dynamics.h"

#include "dbk_spatial.h"
#include "model/dbk_kinematics.h"

/* rotation (row-major) and origin of a frame in the frame before it */
typedef struct {
  dbk_real rotation[9], origin[3];
} transform;

typedef struct {
  dbk_real force[3], moment[3];
} wrench;

static void joint_frame(const dbk_dynamics *arm, int32_t i, dbk_real q, transform *frame) {
  const dbk_real *fixed = arm->joint_rotation[i];
  const int32_t prismatic = arm->joint_kind[i] == DBK_PRISMATIC;
  dbk_real sine = (dbk_real)0, cosine = (dbk_real)1;
  if (!prismatic) { dbk_sincos(q, &sine, &cosine); }
  for (int32_t r = 0; r < 3; ++r) {
    const dbk_real x = fixed[3 * r], y = fixed[3 * r + 1], z = fixed[3 * r + 2];
    frame->rotation[3 * r] = cosine * x + sine * y;
    frame->rotation[3 * r + 1] = cosine * y - sine * x;
    frame->rotation[3 * r + 2] = z;
    frame->origin[r] = arm->joint_offset[i][r] + (prismatic ? q * z : (dbk_real)0);
  }
}

/* R' times a vector */
static void to_child(const dbk_real r[9], const dbk_real x[3], dbk_real out[3]) {
  for (int32_t e = 0; e < 3; ++e) { out[e] = r[e] * x[0] + r[3 + e] * x[1] + r[6 + e] * x[2]; }
}

/* R times a vector */
static void to_parent(const dbk_real r[9], const dbk_real x[3], dbk_real out[3]) {
  for (int32_t e = 0; e < 3; ++e) { out[e] = r[3 * e] * x[0] + r[3 * e + 1] * x[1] + r[3 * e + 2] * x[2]; }
}

/* a + al x p + w x (w x p) */
static void point_acceleration(const dbk_frame_motion *motion, const dbk_real point[3], dbk_real out[3]) {
  dbk_real turned[3], swept[3], inward[3];
  dbk_cross(motion->turn, point, turned);
  dbk_cross(motion->spin, point, swept);
  dbk_cross(motion->spin, swept, inward);
  for (int32_t e = 0; e < 3; ++e) { out[e] = motion->linear[e] + turned[e] + inward[e]; }
}

/* the motion of a frame from that of the frame before it */
static void next_motion(const dbk_frame_motion *parent, const transform *frame, int32_t prismatic, dbk_real v,
                        dbk_real a, dbk_frame_motion *child) {
  dbk_real at_origin[3];
  point_acceleration(parent, frame->origin, at_origin);
  to_child(frame->rotation, at_origin, child->linear);
  to_child(frame->rotation, parent->spin, child->spin);
  to_child(frame->rotation, parent->turn, child->turn);
  if (prismatic) {
    child->linear[0] += (dbk_real)2 * child->spin[1] * v;
    child->linear[1] -= (dbk_real)2 * child->spin[0] * v;
    child->linear[2] += a;
  } else {
    child->turn[0] += child->spin[1] * v;
    child->turn[1] -= child->spin[0] * v;
    child->turn[2] += a;
    child->spin[2] += v;
  }
}

static void times_inertia(const dbk_real inertia[6], const dbk_real x[3], dbk_real out[3]) {
  out[0] = inertia[0] * x[0] + inertia[3] * x[1] + inertia[4] * x[2];
  out[1] = inertia[3] * x[0] + inertia[1] * x[1] + inertia[5] * x[2];
  out[2] = inertia[4] * x[0] + inertia[5] * x[1] + inertia[2] * x[2];
}

/* force, and moment about the frame's origin, that move a body */
static void body_wrench(const dbk_body *body, const dbk_frame_motion *motion, wrench *out) {
  dbk_real momentum[3], turned[3], gyroscopic[3], lever[3];
  point_acceleration(motion, body->centre, out->force);
  for (int32_t e = 0; e < 3; ++e) { out->force[e] *= body->mass; }
  times_inertia(body->inertia, motion->spin, momentum);
  times_inertia(body->inertia, motion->turn, turned);
  dbk_cross(motion->spin, momentum, gyroscopic);
  dbk_cross(body->centre, out->force, lever);
  for (int32_t e = 0; e < 3; ++e) { out->moment[e] = turned[e] + gyroscopic[e] + lever[e]; }
}

/* carries a wrench from a frame to the frame before it */
static void carry(const transform *frame, wrench *load) {
  dbk_real force[3], moment[3], lever[3];
  to_parent(frame->rotation, load->force, force);
  to_parent(frame->rotation, load->moment, moment);
  dbk_cross(frame->origin, force, lever);
  for (int32_t e = 0; e < 3; ++e) {
    load->force[e] = force[e];
    load->moment[e] = moment[e] + lever[e];
  }
}

static dbk_real along_joint(const dbk_dynamics *arm, int32_t i, const wrench *load) {
  return arm->joint_kind[i] == DBK_PRISMATIC ? load->force[2] : load->moment[2];
}

static void pack(const wrench *from, dbk_real to[6]) {
  for (int32_t e = 0; e < 3; ++e) {
    to[e] = from->force[e];
    to[3 + e] = from->moment[e];
  }
}

void dbk_inverse_dynamics(const dbk_dynamics *arm, const dbk_frame_motion *base, const dbk_real q[DBK_MAX_DOF],
                          const dbk_real v[DBK_MAX_DOF], const dbk_real a[DBK_MAX_DOF], dbk_arm_torque *torque) {
  const int32_t n = arm->n;
  transform chain[DBK_MAX_DOF];
  wrench own[DBK_MAX_DOF], load;
  dbk_frame_motion motion = *base;
  for (int32_t i = 0; i < n; ++i) {
    const dbk_frame_motion parent = motion;
    joint_frame(arm, i, q[i], &chain[i]);
    next_motion(&parent, &chain[i], arm->joint_kind[i] == DBK_PRISMATIC, v[i], a[i], &motion);
    body_wrench(&arm->body[i], &motion, &own[i]);
  }
  const dbk_body kilogram = {(dbk_real)1, {arm->tool_offset[0], arm->tool_offset[1], arm->tool_offset[2]}, {0}};
  body_wrench(&kilogram, &motion, &load);
  pack(&own[n - 1], torque->wrist);
  pack(&load, torque->wrist_per_load);
  wrench total = {{0}, {0}};
  for (int32_t i = n - 1; i >= 0; --i) {
    for (int32_t e = 0; e < 3; ++e) {
      total.force[e] += own[i].force[e];
      total.moment[e] += own[i].moment[e];
    }
    torque->own[i] = along_joint(arm, i, &total) + arm->rotor_inertia[i] * a[i] + arm->damping[i] * v[i];
    torque->per_load[i] = along_joint(arm, i, &load);
    carry(&chain[i], &total);
    carry(&chain[i], &load);
  }
}
