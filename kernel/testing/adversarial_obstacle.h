/* An obstacle that moves toward the robot, and an oracle that decides whether the robot could have evaded it.
 *
 * The obstacle follows a plan: its velocity changes to `target` with at most `acceleration` and then stays constant
 * until the plan ends. Between two plans only the bounds of its speed and acceleration hold. A plan is evadable if one
 * of a set of sampled controls, admissible from the robot's true state (velocity, acceleration and joint limits), keeps
 * the h of the obstacle at `clearance` or more and every other true h at 0 or more, until the end of the plan and of
 * the obstacle's braking after it.
 */
#ifndef DBK_ADVERSARIAL_OBSTACLE_H
#define DBK_ADVERSARIAL_OBSTACLE_H

#include "reference_distance.h"

#ifdef __cplusplus
extern "C" {
#endif

typedef struct {
  double speed, acceleration; /* bounds of the obstacle's motion [m/s, m/s2] */
  double clearance;           /* clearance that an evasion must keep [m], at most DBK_REFERENCE_EXACT */
  int32_t evadable;           /* 1: only evadable plans are executed; 0: only plans that are not, if one is found */
} dbk_obstacle_rules;

typedef struct {
  double target[3];
  int32_t periods_left;
  int32_t attack;   /* 1: the target velocity points at the robot */
  int32_t evadable; /* result of the oracle */
} dbk_obstacle_plan;

/* the next plan of obstacles[moving]; the robot is at q with joint velocity v */
void dbk_plan_obstacle(const dbk_obstacle_rules *rules, const dbk_reference_robot *robot, const double *q,
                       const double *v, const dbk_true_obstacle *obstacles, int32_t n_obstacles, int32_t moving,
                       double period, uint64_t *random, dbk_obstacle_plan *plan);

/* moves the obstacle along the plan for one period */
void dbk_move_obstacle(const dbk_obstacle_rules *rules, const dbk_obstacle_plan *plan, double period,
                       dbk_true_obstacle *obstacle);

/* 1: a sampled admissible control keeps every h as required until the plan has ended and the obstacle has stopped */
int32_t dbk_escape_exists(const dbk_obstacle_rules *rules, const dbk_reference_robot *robot, const double *q,
                          const double *v, const dbk_true_obstacle *obstacles, int32_t n_obstacles, int32_t moving,
                          double period, const dbk_obstacle_plan *plan, uint64_t *random);

#ifdef __cplusplus
}
#endif
#endif
