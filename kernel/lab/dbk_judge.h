/* An independent judge in float64: kinematics and distances written apart from the kernel, for tests and proofs only.
 *
 * It shares no code, no type and no number with the kernel: bodies and things come in double from the caller. Distances
 * are exact; pairs that cannot have come within DBK_JUDGE_NEAR since they were last measured are not measured again
 * (every centre's true displacement is subtracted from what was measured), so h is exact below that and capped there;
 * the first look measures everything and caps nothing.
 */
#ifndef DBK_JUDGE_H
#define DBK_JUDGE_H

#include <stdint.h>

#ifdef __cplusplus
extern "C" {
#endif

#define DBK_JUDGE_DOF 8
#define DBK_JUDGE_SPHERES 160
#define DBK_JUDGE_LINKS 24
#define DBK_JUDGE_PAIRS 96
#define DBK_JUDGE_THINGS 48
#define DBK_JUDGE_NEAR 0.02 /* [m] what is farther is not told apart */

enum { DBK_THING_CAPSULE, DBK_THING_BOX, DBK_THING_PLANE };

typedef struct {
  int32_t n, n_links, n_pairs;
  double rotation[DBK_JUDGE_DOF][9], offset[DBK_JUDGE_DOF][3]; /* parent <- joint at q = 0, row-major */
  double lower[DBK_JUDGE_DOF], upper[DBK_JUDGE_DOF], v_max[DBK_JUDGE_DOF], a_max[DBK_JUDGE_DOF];
  int32_t frame[DBK_JUDGE_LINKS], first[DBK_JUDGE_LINKS + 1], pair[DBK_JUDGE_PAIRS][2];
  double centre[DBK_JUDGE_SPHERES][3], radius[DBK_JUDGE_SPHERES]; /* in the chain frame of their link */
} dbk_judge_body;

typedef struct {
  int32_t shape, moving;
  double position[3], rotation[9], half[3], radius, velocity[3]; /* capsule: half[2] along local z */
} dbk_thing;

typedef struct {
  double still, moving, self, joint; /* smallest true h: static things, moving things, own links [m]; limits [rad] */
  double approach;                   /* greatest own speed toward a moving thing among pairs with h < 0 [m/s] */
} dbk_verdict;

typedef struct {
  int32_t fresh;
  double at[DBK_JUDGE_SPHERES][3], was[DBK_JUDGE_SPHERES][3], things[DBK_JUDGE_THINGS][3];
  double slack[DBK_JUDGE_LINKS][DBK_JUDGE_THINGS], self_slack[DBK_JUDGE_PAIRS];
} dbk_judge;

/* forget what was measured; the first look afterwards measures everything */
void dbk_judge_reset(dbk_judge *judge);

/* true h at posture q (n,) with things where they are now; own speeds from the last look, `period` seconds ago */
void dbk_judge_look(const dbk_judge_body *body, dbk_judge *judge, const double *q, const dbk_thing *things,
                    int32_t n_things, double period, dbk_verdict *verdict);

/* signed distance from a point to the surface of a thing [m] */
double dbk_thing_distance(const dbk_thing *thing, const double point[3]);

/* centres of all spheres at posture q */
void dbk_judge_centres(const dbk_judge_body *body, const double *q, double centre[DBK_JUDGE_SPHERES][3]);

#ifdef __cplusplus
}
#endif
#endif
