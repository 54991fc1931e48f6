/* A closed loop in which every error takes the worst value within its stated bound; the result is measured in float64
 * by the reference distance.
 *
 * Plant: ydot = u + r with |r_k| <= push, directed toward the closest row; y = q + lag v; q follows y with an exact
 * first-order lag. Joint measurement: |q_m - q| <= q_noise and |v_m - v| <= v_noise, alternately worst-case toward the
 * closest row and random. Perception: one scene every `frame` periods with error norms <= place_noise and speed_noise;
 * scenes can be lost, but none is older than `scene_longest` periods. Joint states: bursts of at most `state_longest`
 * lost states; with `dead_reckoning` the caller adds the controls that it has sent since the last state. Late steps:
 * the filter is not called, and the previous control remains. A moving obstacle that touches the robot stops and
 * withdraws.
 */
#ifndef DBK_WORST_CASE_LOOP_H
#define DBK_WORST_CASE_LOOP_H

#include "adversarial_obstacle.h"
#include "dbk/dbk.h"
#include "reference_distance.h"

#ifdef __cplusplus
extern "C" {
#endif

/* the failed premises of the invariance theorem, as bits; DBK_PREMISES is the number of combinations */
enum { DBK_NOT_FEASIBLE = 1, DBK_NOT_FRESH = 2, DBK_NOT_ON_TIME = 4, DBK_NOT_CERTIFIED = 8, DBK_PREMISES = 16 };

typedef struct {
  uint64_t seed;
  int32_t steps, hold; /* the nominal control changes every `hold` periods */
  double toward;       /* share of choices that move toward a row; the rest are bang-bang controls */
  double lag, push, q_noise, v_noise, place_noise, speed_noise;
  int32_t frame, scene_longest, state_longest, dead_reckoning;
  double scene_drop, state_drop,
      late;              /* probabilities: a scene is lost, a burst of state losses starts, a step is late */
  double velocity_share; /* share of an obstacle's velocity that the filter receives */
  dbk_obstacle_rules obstacle;
} dbk_loop_config;

/* Counts of steps unless noted. Index 0 or 1 of the arrays of two: the current plan of the moving obstacle is not
 * evadable or evadable. Index of the arrays of DBK_PREMISES: the failed premises since h was last clearly positive. */
typedef struct {
  int64_t steps, status[5];
  int64_t premise_held[5];                       /* feasible, fresh, on time, certified, and all four */
  int64_t static_violation[DBK_PREMISES];        /* h < 0 for static obstacles, self-collision or joint limits */
  int64_t moving_violation[2][DBK_PREMISES];     /* h < 0 for the moving obstacle while the robot moves toward it */
  int64_t contact[2];                            /* h < 0 for the moving obstacle */
  int64_t plans[2], plan_steps[2];               /* number of plans; steps under a plan */
  int64_t contact_onset[2];                      /* transitions to h < 0 */
  int64_t approaching_onset[2];                  /* those while the robot moves toward the obstacle */
  int64_t bound_violation;                       /* u left the acceleration bounds */
  int64_t iterations, rows;                      /* sums */
  int32_t max_iterations, max_rows;              /* per step */
  double h_static, h_self, h_joint, h_moving[2]; /* minima */
  double approach[2];                            /* maximum speed of the robot toward the obstacle in contact [m/s] */
  int64_t worst_step;                            /* step of the minimum h_static */
} dbk_loop_result;

/* q (n,) is the start posture, at rest, and receives the end posture; obstacles[i] is the ground truth of
 * scene->obstacle[i]; q_log is (steps, n) or null */
void dbk_run_worst_case_loop(const dbk_model *model, dbk_scene *scene, dbk_ctx *ctx, const dbk_reference_robot *robot,
                             dbk_true_obstacle *obstacles, int32_t n_obstacles, const dbk_loop_config *config,
                             double *q, double *q_log, dbk_loop_result *result);

#ifdef __cplusplus
}
#endif
#endif
