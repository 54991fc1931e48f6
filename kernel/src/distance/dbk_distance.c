/* Signed distance from points to the surface of one obstacle, and the outward unit normal, which is the gradient.
 *
 * All three shapes are convex, so the distance is a convex function of the point: along a straight line it never falls
 * below its tangent. Inside a shape the normal points to the nearest surface, so a row with this normal moves the point
 * out.
 */
#include "distance/dbk_distance.h"

#include "distance/dbk_point_distance.h"

/* a capsule: a segment of half length half[2] along local z with a radius; a sphere has half length 0 */
static inline void to_capsule(const dbk_obstacle *o, int32_t count, const dbk_real *restrict x,
                              const dbk_real *restrict y, const dbk_real *restrict z, dbk_real *restrict d,
                              dbk_real *restrict nx, dbk_real *restrict ny, dbk_real *restrict nz) {
  const dbk_real px = o->position[0], py = o->position[1], pz = o->position[2];
  const dbk_real ax = o->rotation[2], ay = o->rotation[5], az = o->rotation[8];
  const dbk_real half = o->half[2], radius = o->radius;
  for (int32_t i = 0; i < count; ++i) {
    dbk_real ux, uy, uz;
    d[i] = dbk_segment_distance(x[i] - px, y[i] - py, z[i] - pz, ax, ay, az, half, &ux, &uy, &uz) - radius;
    nx[i] = ux;
    ny[i] = uy;
    nz[i] = uz;
  }
}

/* a point on or in the box: the nearest face determines the distance (<= 0) and the normal */
static void inside_box(const dbk_obstacle *o, const dbk_real local[3], dbk_real *d, dbk_real *nx, dbk_real *ny,
                       dbk_real *nz) {
  int32_t face = 2;
  dbk_real depth = dbk_abs(local[2]) - o->half[2];
  for (int32_t e = 0; e < 2; ++e) {
    const dbk_real other = dbk_abs(local[e]) - o->half[e];
    if (other > depth) {
      depth = other;
      face = e;
    }
  }
  const dbk_real sign = local[face] < (dbk_real)0 ? (dbk_real)-1 : (dbk_real)1;
  *d = depth;
  *nx = sign * o->rotation[face];
  *ny = sign * o->rotation[3 + face];
  *nz = sign * o->rotation[6 + face];
}

static inline void to_box(const dbk_obstacle *o, int32_t count, const dbk_real *restrict x, const dbk_real *restrict y,
                          const dbk_real *restrict z, dbk_real *restrict d, dbk_real *restrict nx,
                          dbk_real *restrict ny, dbk_real *restrict nz) {
  const dbk_real px = o->position[0], py = o->position[1], pz = o->position[2];
  const dbk_real *r = o->rotation;
  const dbk_real r0 = r[0], r1 = r[1], r2 = r[2], r3 = r[3], r4 = r[4], r5 = r[5], r6 = r[6], r7 = r[7], r8 = r[8];
  const dbk_real hx = o->half[0], hy = o->half[1], hz = o->half[2];
  /* outside the box: w is the vector from the nearest surface point, in local coordinates */
  for (int32_t i = 0; i < count; ++i) {
    const dbk_real vx = x[i] - px, vy = y[i] - py, vz = z[i] - pz;
    const dbk_real lx = r0 * vx + r3 * vy + r6 * vz, ly = r1 * vx + r4 * vy + r7 * vz, lz = r2 * vx + r5 * vy + r8 * vz;
    const dbk_real ux = lx < hx ? lx : hx, uy = ly < hy ? ly : hy, uz = lz < hz ? lz : hz;
    const dbk_real wx = lx - (ux > -hx ? ux : -hx), wy = ly - (uy > -hy ? uy : -hy), wz = lz - (uz > -hz ? uz : -hz);
    const dbk_real distance = dbk_sqrt(wx * wx + wy * wy + wz * wz);
    const dbk_real inverse = (dbk_real)1 / (distance > DBK_MIN_DISTANCE ? distance : DBK_MIN_DISTANCE);
    d[i] = distance;
    nx[i] = (r0 * wx + r1 * wy + r2 * wz) * inverse;
    ny[i] = (r3 * wx + r4 * wy + r5 * wz) * inverse;
    nz[i] = (r6 * wx + r7 * wy + r8 * wz) * inverse;
  }
  /* on or inside the box, in a second loop so that the first one vectorises */
  for (int32_t i = 0; i < count; ++i) {
    if (!(d[i] > DBK_MIN_DISTANCE)) {
      const dbk_real vx = x[i] - px, vy = y[i] - py, vz = z[i] - pz;
      const dbk_real local[3] = {r0 * vx + r3 * vy + r6 * vz, r1 * vx + r4 * vy + r7 * vz, r2 * vx + r5 * vy + r8 * vz};
      inside_box(o, local, d + i, nx + i, ny + i, nz + i);
    }
  }
}

/* a half-space: all points below the plane through the position with normal local z */
static inline void to_half_space(const dbk_obstacle *o, int32_t count, const dbk_real *restrict x,
                                 const dbk_real *restrict y, const dbk_real *restrict z, dbk_real *restrict d,
                                 dbk_real *restrict nx, dbk_real *restrict ny, dbk_real *restrict nz) {
  const dbk_real px = o->position[0], py = o->position[1], pz = o->position[2];
  const dbk_real ax = o->rotation[2], ay = o->rotation[5], az = o->rotation[8];
  for (int32_t i = 0; i < count; ++i) {
    d[i] = (x[i] - px) * ax + (y[i] - py) * ay + (z[i] - pz) * az;
    nx[i] = ax;
    ny[i] = ay;
    nz[i] = az;
  }
}

DBK_SIMD_CLONES void dbk_distance(const dbk_obstacle *shape, int32_t count, const dbk_real *x, const dbk_real *y,
                                  const dbk_real *z, dbk_real *d, dbk_real *nx, dbk_real *ny, dbk_real *nz) {
  if (shape->shape == DBK_CAPSULE) {
    to_capsule(shape, count, x, y, z, d, nx, ny, nz);
  } else if (shape->shape == DBK_BOX) {
    to_box(shape, count, x, y, z, d, nx, ny, nz);
  } else {
    to_half_space(shape, count, x, y, z, d, nx, ny, nz);
  }
}
