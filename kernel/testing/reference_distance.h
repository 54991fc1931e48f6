/* Reference kinematics and distances in float64, for tests and experiments only.
 *
 * The reference shares no code, no type and no number with the kernel: the caller passes the robot and the true
 * obstacles in double precision. The distances are exact. A pair is measured again only if it can have come closer than
 * DBK_REFERENCE_EXACT since its last measurement: the true displacements of all centres are subtracted from the
 * measured distance. Therefore h is exact below DBK_REFERENCE_EXACT and saturated at this value above it. The first
 * measurement after a reset covers all pairs and does not saturate.
 */
#ifndef DBK_REFERENCE_DISTANCE_H
#define DBK_REFERENCE_DISTANCE_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define DBK_REFERENCE_DOF 8
#define DBK_REFERENCE_SPHERES 160
#define DBK_REFERENCE_LINKS 24
#define DBK_REFERENCE_PAIRS 96
#define DBK_REFERENCE_OBSTACLES 48
#define DBK_REFERENCE_EXACT 0.02 /* [m] h is exact below this value */

enum { DBK_TRUE_CAPSULE, DBK_TRUE_BOX, DBK_TRUE_HALF_SPACE };

typedef struct {
  int32_t n, n_links, n_pairs;
  double rotation[DBK_REFERENCE_DOF][9], offset[DBK_REFERENCE_DOF][3]; /* parent <- joint at q = 0, row-major */
  double lower[DBK_REFERENCE_DOF], upper[DBK_REFERENCE_DOF], v_max[DBK_REFERENCE_DOF], a_max[DBK_REFERENCE_DOF];
  int32_t frame[DBK_REFERENCE_LINKS], first[DBK_REFERENCE_LINKS + 1], pair[DBK_REFERENCE_PAIRS][2];
  double centre[DBK_REFERENCE_SPHERES][3], radius[DBK_REFERENCE_SPHERES]; /* in the chain frame of the link */
} dbk_reference_robot;

typedef struct {
  int32_t shape, moving;
  double position[3], rotation[9], half[3], radius, velocity[3]; /* capsule: half[2] along local z */
} dbk_true_obstacle;

/* smallest true h against static obstacles, moving obstacles and the robot itself [m], and to the joint limits [rad] */
typedef struct {
  double h_static, h_moving, h_self, h_joint;
  double approach; /* maximum speed of the robot toward a moving obstacle over the pairs with h < 0 [m/s] */
} dbk_reference_distances;

typedef struct {
  int32_t fresh; /* 1: no measurement since the reset */
  /* centres at the last and at the previous measurement, and positions of the obstacles at the last one */
  double centre[DBK_REFERENCE_SPHERES][3], previous[DBK_REFERENCE_SPHERES][3], obstacle[DBK_REFERENCE_OBSTACLES][3];
  /* lower bounds of h of every link and obstacle, and of every link pair */
  double bound[DBK_REFERENCE_LINKS][DBK_REFERENCE_OBSTACLES], self_bound[DBK_REFERENCE_PAIRS];
} dbk_reference_state;

/* the next measurement covers all pairs */
void dbk_reference_reset(dbk_reference_state *state);

/* true h at posture q (n,) and the current obstacle positions; `period` is the time since the last measurement [s] */
void dbk_reference_measure(const dbk_reference_robot *robot, dbk_reference_state *state, const double *q,
                           const dbk_true_obstacle *obstacles, int32_t n_obstacles, double period,
                           dbk_reference_distances *distances);

/* signed distance from a point to the surface of an obstacle [m] */
double dbk_true_distance(const dbk_true_obstacle *obstacle, const double point[3]);

/* centres of all spheres at posture q */
void dbk_reference_centres(const dbk_reference_robot *robot, const double *q, double centre[DBK_REFERENCE_SPHERES][3]);

#ifdef __cplusplus
}
#endif
#endif
