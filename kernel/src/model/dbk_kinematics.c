/* Forward kinematics of the chain, sphere centres and the geometric Jacobian. */
#include "model/dbk_kinematics.h"

/* The argument is reduced to |r| <= pi/4. The remainder of the Taylor polynomials on this interval is below half a unit
 * in the last place. pi/2 is subtracted in three parts, so that the reduction is exact for joint angles. */
void dbk_sincos(dbk_real x, dbk_real *sine, dbk_real *cosine) {
#ifdef DBK_DOUBLE
  static const dbk_real part[3] = {1.57079631090164184570e+00, 1.58932547122958567300e-08, 6.12323399573676603587e-17};
  static const dbk_real s[7] = {-1.0 / 6,        1.0 / 120,        -1.0 / 5040,         1.0 / 362880,
                                -1.0 / 39916800, 1.0 / 6227020800, -1.0 / 1307674368000};
  static const dbk_real c[8] = {-1.0 / 2,       1.0 / 24,        -1.0 / 720,         1.0 / 40320,
                                -1.0 / 3628800, 1.0 / 479001600, -1.0 / 87178291200, 1.0 / 20922789888000};
  enum { S_TERMS = 7, C_TERMS = 8 };
#else
  static const dbk_real part[3] = {1.5703125f, 4.83751296997e-04f, 7.54978995489e-08f};
  static const dbk_real s[4] = {-1.0f / 6, 1.0f / 120, -1.0f / 5040, 1.0f / 362880};
  static const dbk_real c[5] = {-1.0f / 2, 1.0f / 24, -1.0f / 720, 1.0f / 40320, -1.0f / 3628800};
  enum { S_TERMS = 4, C_TERMS = 5 };
#endif
  /* x = k pi/2 + r */
  const dbk_real bounded = x == x ? dbk_clamp(x, (dbk_real)-1000, (dbk_real)1000) : (dbk_real)0; /* NaN has no integer */
  const dbk_real turns = bounded * (dbk_real)0.63661977236758134308;
  const int32_t k = (int32_t)(turns + (turns >= (dbk_real)0 ? (dbk_real)0.5 : (dbk_real)-0.5));
  const dbk_real kr = (dbk_real)k;
  const dbk_real r = ((x - kr * part[0]) - kr * part[1]) - kr * part[2];
  const dbk_real r2 = r * r;
  /* Taylor polynomials by Horner's rule */
  dbk_real ps = s[S_TERMS - 1];
  dbk_real pc = c[C_TERMS - 1];
  for (int32_t i = S_TERMS - 2; i >= 0; --i) { ps = ps * r2 + s[i]; }
  for (int32_t i = C_TERMS - 2; i >= 0; --i) { pc = pc * r2 + c[i]; }
  const dbk_real sr = r + r * r2 * ps;
  const dbk_real cr = (dbk_real)1 + r2 * pc;
  /* the quadrant selects the function and the sign */
  const int32_t quarter = k & 3;
  const dbk_real first = (quarter & 1) ? cr : sr;
  const dbk_real second = (quarter & 1) ? sr : cr;
  *sine = (quarter & 2) ? -first : first;
  *cosine = (quarter == 1 || quarter == 2) ? -second : second;
}

void dbk_base_frame(const dbk_in *in, dbk_frames *frames) {
  for (int32_t e = 0; e < 9; ++e) {
    frames->rotation[0][e] = in->mobile ? in->base_rotation[e] : ((e % 4 == 0) ? (dbk_real)1 : (dbk_real)0);
  }
  for (int32_t e = 0; e < 3; ++e) { frames->origin[0][e] = in->mobile ? in->base_position[e] : (dbk_real)0; }
}

/* frame i = frame i-1 * fixed transform * (rotation about z or translation along z by q_i) */
void dbk_fk(const dbk_model *model, const dbk_real q[DBK_MAX_DOF], dbk_frames *frames) {
  for (int32_t i = 0; i < model->n; ++i) {
    const dbk_real *parent = frames->rotation[i];
    const dbk_real *fixed = model->joint_rotation[i];
    const dbk_real *offset = model->joint_offset[i];
    const int32_t prismatic = model->joint_kind[i] == DBK_PRISMATIC;
    dbk_real sine = (dbk_real)0, cosine = (dbk_real)1;
    if (!prismatic) { dbk_sincos(q[i], &sine, &cosine); }
    for (int32_t r = 0; r < 3; ++r) {
      const dbk_real *row = parent + 3 * r;
      const dbk_real x = row[0] * fixed[0] + row[1] * fixed[3] + row[2] * fixed[6];
      const dbk_real y = row[0] * fixed[1] + row[1] * fixed[4] + row[2] * fixed[7];
      frames->rotation[i + 1][3 * r] = cosine * x + sine * y;
      frames->rotation[i + 1][3 * r + 1] = cosine * y - sine * x;
      frames->rotation[i + 1][3 * r + 2] = row[0] * fixed[2] + row[1] * fixed[5] + row[2] * fixed[8];
      frames->origin[i + 1][r] = frames->origin[i][r] + (row[0] * offset[0] + row[1] * offset[1] + row[2] * offset[2]);
      if (prismatic) { frames->origin[i + 1][r] += q[i] * frames->rotation[i + 1][3 * r + 2]; }
    }
  }
}

/* transforms `count` points from a frame of the chain to the base frame */
static void transform_points(const dbk_frames *frames, int32_t frame, int32_t count, const dbk_real *x,
                             const dbk_real *y, const dbk_real *z, dbk_real *restrict ox, dbk_real *restrict oy,
                             dbk_real *restrict oz) {
  const dbk_real *r = frames->rotation[frame];
  const dbk_real *p = frames->origin[frame];
  const dbk_real r0 = r[0], r1 = r[1], r2 = r[2], r3 = r[3], r4 = r[4], r5 = r[5], r6 = r[6], r7 = r[7], r8 = r[8];
  const dbk_real px = p[0], py = p[1], pz = p[2];
  for (int32_t s = 0; s < count; ++s) {
    ox[s] = px + (r0 * x[s] + r1 * y[s] + r2 * z[s]);
    oy[s] = py + (r3 * x[s] + r4 * y[s] + r5 * z[s]);
    oz[s] = pz + (r6 * x[s] + r7 * y[s] + r8 * z[s]);
  }
}

void dbk_spheres(const dbk_model *model, const dbk_scene *scene, const dbk_frames *frames, dbk_real opening,
                 dbk_sphere_set *spheres) {
  dbk_real lx[DBK_MAX_SPHERES], ly[DBK_MAX_SPHERES], lz[DBK_MAX_SPHERES];
  /* the centres in the frames of their links; finger spheres are displaced by the opening */
  for (int32_t s = 0; s < model->n_spheres; ++s) {
    lx[s] = model->x[s] + opening * model->slide_x[s];
    ly[s] = model->y[s] + opening * model->slide_y[s];
    lz[s] = model->z[s] + opening * model->slide_z[s];
    spheres->r[s] = model->radius[s];
  }
  for (int32_t l = 0; l < model->n_links; ++l) {
    const int32_t first = model->link_first[l], count = model->link_first[l + 1] - first;
    if (count == 0) { continue; }
    transform_points(frames, model->link_frame[l], count, lx + first, ly + first, lz + first, spheres->x + first,
                     spheres->y + first, spheres->z + first);
  }
  /* the held object moves with the last frame */
  const int32_t first = model->n_spheres;
  transform_points(frames, model->n, scene->n_held, scene->held_x, scene->held_y, scene->held_z, spheres->x + first,
                   spheres->y + first, spheres->z + first);
  for (int32_t s = 0; s < scene->n_held; ++s) { spheres->r[first + s] = scene->held_r[s]; }
  spheres->count = first + scene->n_held;
}

/* column k (linear; angular): (z_k x (point - p_k); z_k) for a revolute joint, (z_k; 0) for a prismatic joint */
void dbk_jacobian(const dbk_model *model, const dbk_frames *frames, const dbk_real point[3],
                  dbk_real linear[3][DBK_MAX_DOF], dbk_real angular[3][DBK_MAX_DOF]) {
  for (int32_t k = 0; k < model->n; ++k) {
    const dbk_real *r = frames->rotation[k + 1];
    const dbk_real zx = r[2], zy = r[5], zz = r[8];
    if (model->joint_kind[k] == DBK_PRISMATIC) {
      for (int32_t e = 0; e < 3; ++e) {
        linear[e][k] = r[3 * e + 2];
        angular[e][k] = (dbk_real)0;
      }
      continue;
    }
    const dbk_real dx = point[0] - frames->origin[k + 1][0];
    const dbk_real dy = point[1] - frames->origin[k + 1][1];
    const dbk_real dz = point[2] - frames->origin[k + 1][2];
    linear[0][k] = zy * dz - zz * dy;
    linear[1][k] = zz * dx - zx * dz;
    linear[2][k] = zx * dy - zy * dx;
    angular[0][k] = zx;
    angular[1][k] = zy;
    angular[2][k] = zz;
  }
}
