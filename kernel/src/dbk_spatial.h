/* Spatial velocity and acceleration of the frames along the kinematic chain. */
#ifndef DBK_SPATIAL_H
#define DBK_SPATIAL_H

#include "dbk_math.h"

static inline void dbk_cross(const dbk_real a[3], const dbk_real b[3], dbk_real out[3]) {
  out[0] = a[1] * b[2] - a[2] * b[1];
  out[1] = a[2] * b[0] - a[0] * b[2];
  out[2] = a[0] * b[1] - a[1] * b[0];
}

/* prismatic joint: frame i+1 translates relative to frame i at rate u (t in the trust region) along the axis z, which
 * rotates with frame i */
static inline void dbk_add_prismatic(const dbk_spatial *parent, const dbk_real z[3], dbk_real u, dbk_real t,
                                     dbk_spatial *child) {
  dbk_real dz[3];
  dbk_cross(parent->w, z, dz);
  *child = *parent;
  for (int32_t e = 0; e < 3; ++e) {
    child->v[e] += u * z[e];
    child->tv[e] += t * z[e];
    child->dv[e] += u * dz[e];
  }
}

/* revolute joint: frame i+1 rotates relative to frame i at rate u (t in the trust region) about the axis z through the
 * point p, which both move with frame i */
static inline void dbk_add_revolute(const dbk_spatial *parent, const dbk_real z[3], const dbk_real p[3], dbk_real u,
                                    dbk_real t, dbk_spatial *child) {
  dbk_real moment[3], dz[3], dp[3], wp[3], a[3], b[3];
  dbk_cross(p, z, moment); /* velocity at the base origin per unit rate: -z x p */
  dbk_cross(parent->w, z, dz);
  dbk_cross(parent->w, p, wp);
  for (int32_t e = 0; e < 3; ++e) { dp[e] = parent->v[e] + wp[e]; }
  dbk_cross(dp, z, a);
  dbk_cross(p, dz, b);
  for (int32_t e = 0; e < 3; ++e) {
    child->w[e] = parent->w[e] + u * z[e];
    child->v[e] = parent->v[e] + u * moment[e];
    child->tw[e] = parent->tw[e] + t * z[e];
    child->tv[e] = parent->tv[e] + t * moment[e];
    child->dw[e] = parent->dw[e] + u * dz[e];
    child->dv[e] = parent->dv[e] + u * (a[e] + b[e]);
  }
}

/* A base turns the axis of its drive, joint 1, by its turn, joint 2: the velocity along the axis changes its direction. */
static inline void dbk_turn_drive(dbk_spatial *chain) {
  dbk_real change[3];
  dbk_cross(chain[2].w, chain[1].v, change);
  for (int32_t e = 0; e < 3; ++e) { chain[2].dv[e] += change[e]; }
}

#endif
